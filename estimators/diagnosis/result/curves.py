"""How the effects that were found act: their curves over what the record has, with bands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.diagnosis.model.errors import spread

if TYPE_CHECKING:
    from estimators.diagnosis.result.report import Diagnosis


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
