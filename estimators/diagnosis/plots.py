"""Figures of a diagnosis: residual before and after, in time, against its revealing variable, in frequency."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from estimators.diagnosis.report import Diagnosis

__all__ = ["residual_figure", "save_figures"]


def _binned(x: Any, r: Any, bins: int = 25) -> tuple[Any, Any, Any]:
    """Mean of r in bins of equal count of x, and its standard error."""
    order = np.argsort(x)
    groups = np.array_split(order, min(bins, max(2, len(x) // 20)))
    return (
        np.array([x[g].mean() for g in groups]),
        np.array([r[g].mean() for g in groups]),
        np.array([r[g].std() / np.sqrt(len(g)) for g in groups]),
    )


def residual_figure(result: Diagnosis, output: int = 0) -> Figure:
    """Residual on the test record before and after, four ways.

    Parameters
    ----------
    result : Diagnosis
        What `diagnose` returned.
    output : int
        Which output.

    Returns
    -------
    matplotlib.figure.Figure
        Time, spectrum, mean against the simulated output with its band, mean against its velocity.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    test = result.extra["test"]
    y = np.nan_to_num(test.y[:, output])
    pairs = [("before", result.yhat_before[:, output], "C1"), ("after", result.yhat_after[:, output], "C0")]
    figure = Figure(figsize=(9, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    (time, spectrum), (level, velocity) = figure.subplots(2, 2)
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
        for axis, x in ((level, simulated), (velocity, np.gradient(simulated) / test.dt)):
            centre, mean, error = _binned(x, r)
            axis.errorbar(centre, mean, 2 * error, color=colour, fmt=".-", lw=0.8, label=label)
    time.set(xlabel="time [s]", ylabel=f"residual of {name}", title="in time")
    spectrum.set(xlabel="frequency [Hz]", ylabel="power", title="in frequency")
    level.set(xlabel=f"simulated {name}", ylabel="mean residual, 2 s.e.", title="against the level")
    velocity.set(
        xlabel=f"velocity of {name} [1/s]", ylabel="mean residual, 2 s.e.", title="against the velocity"
    )
    time.legend()
    figure.suptitle(f"{result.effect}: {result.rmse_before} -> {result.rmse_after}")
    return figure


def save_figures(result: Diagnosis, folder: str | os.PathLike[str]) -> list[Path]:
    """Write the figures of every output as PNG and PDF.

    Parameters
    ----------
    result : Diagnosis
        What `diagnose` returned.
    folder : path
        An existing folder.

    Returns
    -------
    list of Path
        The files.
    """
    files = []
    for i in range(result.yhat_before.shape[1]):
        figure = residual_figure(result, i)
        for kind in ("png", "pdf"):
            target = Path(folder) / f"residual_{i + 1}.{kind}"
            part = target.with_suffix(f".part.{kind}")
            figure.savefig(part, dpi=130)
            os.replace(part, target)
            files.append(target)
    return files
