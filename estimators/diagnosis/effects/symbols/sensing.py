"""Sensors that remember extremes, as parts of a step."""

from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.symbols.wiring import Wiring

Array = NDArray[Any]


def _sliding(w: Wiring, x: Any, p: Array, k: Any) -> Any:
    width = max(round(abs(float(p[0]))), 1)
    if width == 1:
        return x
    s = w.state(np.full(width - 1, w.value(x)))
    s.after = w.ca.vertcat(x, s.x[:-1])
    return p[1] * reduce(w.ca.fmax, [p[1] * v for v in (x, *w.ca.vertsplit(s.x))])


def _begun_anew(w: Wiring, x: Any, p: Array, k: Any) -> Any:
    every, x = max(abs(float(p[0])), 1.0), p[2] * x
    s, since = w.state(w.value(x)), k - p[1] - every * w.ca.floor((k - p[1]) / every)
    s.after = w.ca.if_else(since < 1.0, x, w.ca.fmax(s.x, x))
    return p[2] * s.after


EXTREMES: Mapping[str, Callable[[Wiring, Any, Array, Any], Any]] = {
    "window_extreme": _sliding,
    "window_begun_anew": _begun_anew,
}
