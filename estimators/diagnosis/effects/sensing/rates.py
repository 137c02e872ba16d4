"""A sensor that moves its reading no faster than one rate up and another down."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.profiled import BEGUN, ended, firm, profile
from estimators.diagnosis.effects.sensing.sensors import before_sensor, settled

Array = NDArray[Any]
STEEP, RATES, SIDES, LAGS = 0.98, (0.3, 0.5, 0.75), (0.7, 1.0, 1.4), (0.3, 1.0, 3.0)
"""Quantile of the linear model's own steps from sample to sample, of which a sensor's rates are parts; those parts, the rate down over that
up, and the lags in samples that are tried: a linear model bends to a limit, and is slower than what is before it."""
LEAST = 1e-6
"""Of a parameter's unit, below which it is none: a sensor without a rate never moves."""


def limits(p: Array) -> tuple[float, float, float]:
    """Rate up, rate down and lag of a sensor."""
    up, down, lag = (max(abs(float(v)), LEAST) for v in p)
    return up, down, lag


def _trailing(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import trailed

    return trailed(np.ascontiguousarray(settled(x, clock)), *limits(p))


def _limited(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """With one pole less before the sensor than the linear model has: it was one of them."""
    from estimators.diagnosis.model.structure import Part

    s = base.structure
    if s.layout != "tf" or s.effects:
        return
    steep = float(np.quantile(np.abs(np.diff(channel.y - base.residual)), STEEP)) + 1e-300
    shapes = [[f * steep, f * side * steep, lag] for f, side, lag in product(RATES, SIDES, LAGS)]
    part, found = Part(TRAILING, s.inputs[0]), []
    for delay in sorted({0, s.delay}):  # a limit makes its signal look late
        bare = before_sensor(channel, base, max(s.order - 1, 1), delay)
        starts = [q for _, q in profile(channel, bare, part, shapes)[:BEGUN]]
        found += list(ended(channel, bare, part, starts, [steep, steep, 1.0]))
    yield from (f for f in found if firm(base, float(np.sum(f.residual**2))))


TRAILING = Effect(
    key="sensor_rate", cause="rate_limiter", nature=Nature.DYNAMIC, slot=Slot.OUTPUT, memory=True, trials=50, family="rates",
    sentence="the sensor moves its reading no faster than one rate up and another down", apply=_trailing,
    parameters={"up": "y/sample", "down": "y/sample", "lag": "sample"}, search=_limited,
)  # fmt: skip
