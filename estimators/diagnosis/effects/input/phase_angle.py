"""Loads behind a thyristor or a triac that is fired late in each half wave: their power and their voltage over the firing angle.

A resistive load that is fired at an angle a takes the share 1 - a/pi + sin(2 a)/(2 pi) of its full power, and the root of it of its
full voltage. About the right angle, where the power is a half, that is an odd curve whose slope is the square of the cosine.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Grid, Sizes
from estimators.diagnosis.effects.input.acting import odd, static

Array = NDArray[Any]
SPANS = (0.4, 0.65, 0.9)
"""Of a half wave, that the record's inputs cover: of less the curve is a parabola, and who commands more sees it rest."""
PLACES = (0.3, 0.5, 0.7)
"""Of the range of the record's inputs, where the right angle is."""
STEEP = math.sqrt(2.0) / math.pi
"""Slope of the voltage at the right angle, per radian: by it the curve is brought to slope 1."""


def power(b: Any) -> Any:
    """Of an angle off the right angle, pi/4 (1 - 2 P) of the power P: of slope 1 where that is a half, level at none and at all of it."""
    b = np.clip(b, -0.5 * np.pi, 0.5 * np.pi)
    return 0.5 * b + 0.25 * np.sin(2.0 * b)


def voltage(b: Any) -> Any:
    """The same of the root mean square voltage, the root of the power; none at the right angle."""
    share = np.maximum(0.5 - 2.0 / np.pi * power(b), 0.0)
    return (math.sqrt(0.5) - np.sqrt(share)) / STEEP


def _angles(s: Sizes) -> Grid:
    low, span = float(np.min(s.u)), float(np.ptp(s.u)) + 1e-300
    return [[np.pi * f / span, low + a * span] for f in SPANS for a in PLACES], [1.0 / s.su, s.su]


def _either_way(s: Sizes) -> Grid:
    grid, sizes = _angles(s)
    return [[side * c, middle] for c, middle in grid for side in (1.0, -1.0)], sizes


PHASE_ANGLE = (
    static("phase_angle", "phase_angle_control", "a thyristor or triac controls a load by its firing angle: the power is "
           "1 - a/pi + sin(2 a)/(2 pi) of the whole, a from 0 to pi, a right angle at the centre",
           parameters={"c": "1/u", "centre": "u"}, trials=12, extends="input_tanh", apply=odd(power), starts=_angles),
    static("phase_angle_voltage", "phase_angle_control", "a thyristor or triac controls a load by its firing angle: the voltage is "
           "the root of 1 - a/pi + sin(2 a)/(2 pi) of the whole, a from 0 to pi, a right angle at the centre",
           parameters={"c": "1/u", "centre": "u"}, trials=24, extends="input_tanh", apply=odd(voltage), starts=_either_way),
)  # fmt: skip
