"""Two inputs that meet behind lags of their own, as parts of a step."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.input.meeting import QUICKEST, lost_by
from estimators.diagnosis.effects.kernels.meeting_kernels import LOWEST, SLOWEST, STEEPEST, WITHIN, at_rest
from estimators.diagnosis.effects.symbols.wiring import Wiring

Array = NDArray[Any]


def _growth(ca: Any, d: Any, slope: float, power: float) -> Any:
    if power == 0.0:
        return ca.exp(ca.fmin(ca.fmax(slope * d, -STEEPEST), STEEPEST))
    base = 1.0 + slope * d / power
    return base if power == 1.0 else base * base if power == 2.0 else ca.fmax(base, LOWEST) ** power


def _left(lags: Array) -> list[tuple[float, float]]:
    """Of what each lag has yet to go, the share that half a step and a whole one leave."""
    return [
        (float(np.exp(-0.5 / WITHIN / lag)), float(np.exp(-1.0 / WITHIN / lag)))
        for lag in np.maximum(np.abs(lags), QUICKEST)
    ]


def _product(w: Wiring, x: Any, p: Array, k: Any) -> Any:
    other, ((half, whole), (beside, past)) = w.u[int(p[4]) - 1], _left(p[1:3])
    s, total = w.state([w.value(x), w.value(other)]), 0.0
    one, two = s.x[0], s.x[1]
    for _ in range(WITHIN):
        gain = _growth(w.ca, other + (two - other) * beside - p[5], float(p[3]), float(p[6]))
        total += (x + (one - x) * half - p[0]) * gain / WITHIN
        one, two = x + (one - x) * whole, other + (two - other) * past
    s.after = w.ca.vertcat(one, two)
    return total


def _lost(w: Wiring, x: Any, p: Array, k: Any) -> Any:
    x, other, law = x - p[1], w.u[int(p[7]) - 1], lost_by(p)
    if law is None:
        w.refuse("its loss has no rate or no share", "simulate it")
    rate, slope, share, rise, centre, power, drive = law
    (half, whole), (beside, past) = _left(p[2:4])
    before, ca = w.value(x), w.ca
    level, two = at_rest(before, w.value(other), law)
    s, h = w.state([before, level, two]), 1.0 / WITHIN
    one, y, two = s.x[0], s.x[1], s.x[2]
    for _ in range(WITHIN):
        middle, one = x + (one - x) * half, x + (one - x) * whole
        ahead = two + (1.0 - beside) * (other + rise * _growth(ca, two - centre, slope, power) * y - two)
        grown = ca.fmax(_growth(ca, ahead - centre, slope, power), 0.0)
        loss, driven = rate * h * (1.0 - share + share * grown), rate * h * grown**drive * middle
        left = ca.exp(-loss)
        settled = driven * (1.0 - left) / ca.fmax(loss, SLOWEST)
        after = y * left + ca.if_else(loss > SLOWEST, settled, driven)
        two += (1.0 - past) * (other + rise * grown * 0.5 * (y + after) - two)
        y = after
    s.after = ca.vertcat(one, y, two)
    return y


MEETINGS: Mapping[str, Callable[[Wiring, Any, Array, Any], Any]] = {
    "product_of_lags": _product,
    "loss_by_lag": _lost,
}
