"""Curves of sensors that bend one way all along: the logarithm and what goes with a reciprocal.

A constant before one of them is one of it with another parameter, behind another gain and before another constant.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Grid, Sizes
from estimators.diagnosis.effects.output import sensor

Array = NDArray[Any]
NEAREST = 0.02
"""Distance to the pole of a hyperbola, over that at zero, below which it goes on straight: a fiftieth is a slope of 2500."""
REACHED = (0.5, 0.9)
"""Of the way to its pole, the largest reading that is tried."""


def _logarithm(x: Any, p: Array, clock: Clock) -> Any:
    """log(1 + c x)/c, of slope 1 at zero and the identity for no c; flat where there is none."""
    return x if p[0] == 0.0 else np.log1p(np.maximum(p[0] * x, 1e-9 - 1.0)) / p[0]


def _hyperbola(x: Any, p: Array, clock: Clock) -> Any:
    """x/(1 - c x), of slope 1 at zero."""
    return x / np.maximum(1.0 - p[0] * x, NEAREST)


def _scale(s: Sizes) -> float:
    middle = float(np.median(s.y))
    return 1.0 / float(np.copysign(max(abs(middle), s.sy), middle))


def _bends(s: Sizes) -> Grid:
    return [[f * _scale(s)] for f in (0.3, 1.0, 4.0, 20.0)], [abs(_scale(s))]


def _poles(s: Sizes) -> Grid:
    """A pole beyond either end of what is read, or on the other side of zero."""
    ends = [end for end in (float(np.max(s.y)), float(np.min(s.y))) if abs(end) >= s.sy]
    grid = [[f / end] for end in ends for f in REACHED] + [[-f * _scale(s)] for f in (1.0, 4.0)]
    return grid, [abs(_scale(s))]


CURVES = (
    sensor("output_logarithm", "the sensor reads the logarithm of what it sees, log(1 + c y)/c", {"c": "1/y"}, 4, apply=_logarithm,
           starts=_bends),
    sensor("output_ratio", "the sensor saturates as a ratio: y/(1 + c |y|)", {"c": "1/y"}, 4,
           apply=lambda x, p, c: x / (1.0 + np.abs(p[0] * x)), starts=_bends),
    sensor("output_hyperbola", "the sensor reads a hyperbola, y/(1 - c y): the reciprocal of a gap, of a distance, a divider", {"c": "1/y"}, 6,
           apply=_hyperbola, starts=_poles),
)  # fmt: skip
