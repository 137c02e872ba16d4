"""Figures of a diagnosis: residual before and after, in time, against its revealing variable, in frequency."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.diagnosis.model.errors import spread
from oed.files.writing import write_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from estimators.diagnosis.result.report import Diagnosis


def binned(x: Any, r: Any, bins: int = 25) -> tuple[Any, Any, Any]:
    """Mean of r in bins of equal count of x, and its standard error."""
    order = np.argsort(x)
    groups = np.array_split(order, min(bins, max(2, len(x) // 20)))
    return (
        np.array([x[g].mean() for g in groups]),
        np.array([r[g].mean() for g in groups]),
        np.array([r[g].std() / np.sqrt(len(g)) for g in groups]),
    )


def residual_figure(result: Diagnosis, output: int = 0) -> Figure:
    """Residual on the test record before and after, six ways."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    test = result.extra["test"]
    y = np.nan_to_num(test.y[:, output])
    pairs = [("before", result.yhat_before[:, output], "C1"), ("after", result.yhat_after[:, output], "C0")]
    figure = Figure(figsize=(12, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    (time, spectrum, spread), (level, velocity, drive) = figure.subplots(2, 3)
    u = test.u[:, min(output, test.n_inputs - 1)]
    name = test.output_names[output]
    for label, simulated, colour in pairs:
        r = y - simulated
        time.plot(test.t, r, color=colour, lw=0.7, label=label)
        power = np.abs(np.fft.rfft((r - r.mean()) * np.hanning(len(r)))) ** 2
        width = max(1, len(power) // 100)
        smooth = np.convolve(power, np.ones(width) / width, mode="same")
        spectrum.semilogy(
            np.linspace(0, 0.5 / test.dt, len(power)), smooth + 1e-300, color=colour, label=label
        )
        spread.hist(r, 60, density=True, histtype="step", color=colour, label=label)
        for axis, x in ((level, simulated), (velocity, np.gradient(simulated) / test.dt), (drive, u)):
            centre, mean, error = binned(x, r)
            axis.errorbar(centre, mean, 2 * error, color=colour, fmt=".-", lw=0.8, label=label)
    time.set(xlabel="time [s]", ylabel=f"residual of {name}", title="in time")
    spectrum.set(xlabel="frequency [Hz]", ylabel="power", title="in frequency")
    level.set(xlabel=f"simulated {name}", ylabel="mean residual, 2 s.e.", title="against the level")
    velocity.set(
        xlabel=f"velocity of {name} [1/s]", ylabel="mean residual, 2 s.e.", title="against the velocity"
    )
    spread.set(xlabel=f"residual of {name}", ylabel="density", title="distribution")
    drive.set(
        xlabel=f"input {test.input_names[min(output, test.n_inputs - 1)]}",
        ylabel="mean residual, 2 s.e.",
        title="against the input",
    )
    time.legend()
    figure.suptitle(f"{result.effect}: {result.rmse_before} -> {result.rmse_after}")
    return figure


def _range_of(part: Any, f: Any, channel: Any) -> tuple[Any, str]:
    """Values that the effect's argument takes in the record, and its name."""
    from estimators.diagnosis.effects import Slot
    from estimators.diagnosis.model.layouts import layout_matrices, states

    u, slot = channel.u[:, part.channel], part.effect.slot
    if slot is Slot.PLANT:
        rates, U = f.structure.rates(f.p), channel.u[:, list(f.structure.inputs)]
        position, velocity = layout_matrices(f.structure.layout, rates)[3:]
        fast = part.effect.against == "velocity"
        X = states(f.structure.layout, rates, U)
        # the linear part alone swings wider where a spring stiffens: the middle 99 % are shown
        return X @ (
            velocity if fast else position
        ), "velocity" if fast else "position (in units of the input)"
    if slot is Slot.INPUT:
        sl = f.structure.slices()[f.structure.parts.index(part)]
        return part.blocked(u, f.p[sl]), "between the two blocks" if part.first else "input"
    return _before(part, f, channel), "output before the sensor"


def _before(part: Any, f: Any, channel: Any) -> Any:
    """(N,) the output where an effect at the output meets it: without this effect and those behind it."""
    from estimators.diagnosis.effects import Slot
    from estimators.diagnosis.model.simulation import simulate

    parts, at = f.structure.parts, f.structure.parts.index(part)
    last = (Slot.OUTPUT, Slot.ADDED)
    kept, places = f.structure.keeping(
        [q.effect.slot not in last or (q.effect.slot is Slot.OUTPUT and k < at) for k, q in enumerate(parts)]
    )
    return simulate(kept, f.p[places], channel.u, channel.clock)


ALIKE = 0.2
"""Of the values that go in, the span of those that come out from which on a curve is compared with y = x. Where it is further
off, the linear part has the rest of the gain, and the nearest straight line shows what bends."""


def _straight(x: Any, y: Any) -> Any:
    """(2,) the line that a curve y at x (K,) is compared with, at its ends."""
    ends, span = x[[0, -1]], np.ptp(x)
    if ALIKE * span <= np.ptp(y) <= span / ALIKE and np.max(np.abs(y - x)) <= span:
        return ends
    return np.polyval(np.polyfit(x, y, 1), ends)


@dataclass(frozen=True, eq=False)
class Characteristic:
    """How an effect acts over the values (K,) that its argument takes in the record: `y` with its `band` of 2 standard errors,
    `straight` (2,) what would be linear, at the ends; None where there is no such line."""

    sentence: str
    argument: str
    unit: str  # of what it acts on
    x: Any
    y: Any
    band: Any
    straight: Any

    @property
    def labels(self) -> tuple[str, str]:
        """Of the axes, in the user's units."""
        unit = f" ({self.unit})" if self.unit else ""
        return self.argument + ("" if "units" in self.argument else unit), "acts as" + unit


def characteristics(result: Diagnosis, output: int = 0) -> list[Characteristic]:
    """The curves of the effects that were found; the middle 99 % of the values are shown."""
    from estimators.diagnosis.effects import Slot

    out, f = result.extra["outputs"][output], result.extra["finals"][output]
    channel = out.last if f is out.attribution.final else out.channel
    found = [(q, sl) for q, sl in zip(f.structure.parts, f.structure.slices(), strict=True)]
    drawn = [(q, sl) for q, sl in found if q.drawn(np.linspace(-1.0, 1.0, 3), f.p[sl]) is not None]
    if not drawn or not f.jacobian.size:
        return []
    covariance = spread(f).covariance
    covariance = np.where(np.isfinite(covariance), covariance, 0.0)  # of a threshold no derivative tells
    curves = []
    for part, sl in drawn:
        values, name = _range_of(part, f, channel)
        low, high = np.quantile(values[np.isfinite(values)], (0.005, 0.995))
        x = np.linspace(low, high, 121)
        y = part.drawn(x, f.p[sl])
        slopes = np.zeros((len(x), sl.stop - sl.start))
        for i in range(sl.stop - sl.start):
            q = f.p[sl].copy()
            step = 1e-4 * f.scales[sl.start + i]
            q[i] += step
            slopes[:, i] = (part.drawn(x, q) - y) / step
        band = 2 * np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", slopes, covariance[sl, sl], slopes), 0.0))
        train = result.extra["train"]
        unit = (
            train.output_units[output] if part.effect.slot is Slot.OUTPUT else train.input_units[part.channel]
        )
        straight = _straight(x, y) if part.effect.against != "velocity" and np.isfinite(y).all() else None
        curves.append(Characteristic(part.effect.sentence, name, unit, x, y, band, straight))
    return curves


def nonlinearity_figure(result: Diagnosis, output: int = 0) -> Figure | None:
    """Characteristics of the nonlinear effects that were found, each with a band of 2 standard errors."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    curves = characteristics(result, output)
    if not curves:
        return None
    figure = Figure(figsize=(4.6 * len(curves), 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    for axis, c in zip(figure.subplots(1, len(curves), squeeze=False)[0], curves, strict=True):
        axis.fill_between(c.x, c.y - c.band, c.y + c.band, color="C0", alpha=0.3, lw=0)
        axis.plot(c.x, c.y, color="C0", label="with its band, 2 s.e.")
        if c.straight is not None:
            axis.plot(c.x[[0, -1]], c.straight, color="0.5", lw=0.8, ls="--", label="linear")
        axis.set(xlabel=c.labels[0], ylabel=c.labels[1], title=c.sentence)
        axis.title.set_fontsize(9)
        axis.legend()
    return figure


def save_figures(result: Diagnosis, folder: str | os.PathLike[str]) -> list[Path]:
    """Write the figures of every output as PNG and PDF."""
    files = []
    figures = {}
    for i in range(result.yhat_before.shape[1]):
        figures[f"residual_{i + 1}"] = residual_figure(result, i)
        curve = nonlinearity_figure(result, i)
        if curve is not None:
            figures[f"nonlinearity_{i + 1}"] = curve
    for name, figure in figures.items():
        for kind in ("png", "pdf"):
            target = Path(folder) / f"{name}.{kind}"
            files.append(write_figure(target, figure, dpi=130))
    return files
