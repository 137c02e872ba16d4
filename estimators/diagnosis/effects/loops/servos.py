"""Actuators that near their command with a lag, and no faster than one rate up and another down."""

from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.loops.limited import ACROSS
from estimators.diagnosis.effects.profiled import BEGUN, MOST_FLOWS, ended, firm, lean, profile

Array = NDArray[Any]
RATIOS, NEARING = (0.5, 0.7, 1.0, 1.4, 2.0), (0.0, 1.5)
"""Of the rate down to the rate up, and lags in samples, that are tried."""
SLOWEST = 0.1
"""Of the record, the longest lag of an actuator that nears its command: of a slower one a limited rate is a saturated input before an
integrator, which fits as well."""
UNLOADED, LOADS, STALLED = 4, (-0.9, -0.5, 0.0, 0.5, 0.9), 1e-3
"""Servos of one rate each way that a load is tried with; shares of their rates by which half the load's range changes them; and the
share of a rate that the heaviest load leaves."""
LEAST = 1e-300  # half a range that no quotient by it leaves without a number


def _servo(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import servo_mean

    up, down, lag = np.abs(p[:1]), np.abs(p[1:2]), abs(float(p[2]))
    if lag > SLOWEST * clock.length:
        return np.full(len(x), np.inf)
    return servo_mean(np.ascontiguousarray(x), up, down, lag, level_before(x))


@lru_cache(maxsize=MOST_FLOWS)  # of each input, for what is loaded too
def _unloaded(channel: Any, base: Any, j: int) -> list[tuple[float, Array]]:
    """The rates up and down and the lags of an actuator that an input may run into, the best first."""
    from estimators.diagnosis.model.structure import Part

    wide = float(np.ptp(channel.u[:, j]))
    shapes = [[wide / m, q * wide / m, lag] for m in ACROSS for q in RATIOS for lag in NEARING]
    return profile(channel, base, Part(SERVO, j), shapes)


def _servos(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    from estimators.diagnosis.model.structure import Part

    for j in base.structure.inputs if base.structure.layout == "tf" else ():
        tried = _unloaded(channel, base, j)
        if tried and firm(base, tried[0][0]):
            su = float(np.std(channel.u[:, j]))
            starts = (p for _, p in tried[:BEGUN])
            yield from lean(channel, ended(channel, base, Part(SERVO, j), starts, [su, su, 1.0]))


def _loaded(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """An actuator at one input whose rates up and down change with another, the one p[-1] counted from 1, from its level p[-2] on."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import servo_mean

    x, load = np.ascontiguousarray(U[:, channel]), U[:, int(p[-1]) - 1] - p[-2]
    if abs(p[2]) > SLOWEST * clock.length:
        return np.full(len(x), np.inf)
    up, down = (
        np.maximum(abs(rate) + slope * load, STALLED * abs(rate))
        for rate, slope in ((p[0], p[3]), (p[1], p[4]))
    )
    return servo_mean(x, up, down, abs(float(p[2])), level_before(x))


def _loads(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The servos of every input that come nearest, loaded by every other input: it may help one way and hinder the other."""
    from estimators.diagnosis.model.structure import Part

    s = base.structure
    if s.layout != "tf" or not 1 < len(s.inputs) <= MOST_FLOWS:
        return
    for j in s.inputs:
        su = float(np.std(channel.u[:, j]))
        near = [q[-3:] for _, q in _unloaded(channel, base, j)[:UNLOADED]]
        for k in (k for k in s.inputs if k != j):
            load, part = channel.u[:, k], Part(LOADED, j)
            middle, half = 0.5 * float(load.max() + load.min()), 0.5 * float(np.ptp(load)) + LEAST
            shapes = (
                [*q, a * q[0] / half, b * q[1] / half, middle, k + 1.0]
                for q in near
                for a, b in product(LOADS, LOADS)
            )
            tried = profile(channel, base, part, shapes)
            if tried and firm(base, tried[0][0]):
                steps = [su, su, 1.0, su / half, su / half, 0.0, 0.0]
                yield from lean(channel, ended(channel, base, part, (q for _, q in tried[:BEGUN]), steps))


SERVO = Effect(
    key="rate_limit_servo", cause="rate_limiter", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=20, reversing=True, family="rates",
    sentence="the actuator nears its command with a lag, and moves no faster than one rate up and another down",
    parameters={"up": "u/sample", "down": "u/sample", "lag": "sample"}, apply=_servo, search=_servos,
)  # fmt: skip

LOADED = Effect(
    key="rate_loaded", cause="rate_limiter", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=60, reversing=True, family="rates",
    sentence="the actuator moves no faster than one rate up and another down, and a load, another input, changes both",
    parameters={"up": "u/sample", "down": "u/sample", "lag": "sample", "up_by_load": "1/sample", "down_by_load": "1/sample",
                "level": "u", "load": "1"},
    apply=lambda x, p, clock: _loaded(np.column_stack((x, x)), 0, np.array([*p[:6], 2.0]), clock), signal=_loaded, search=_loads,
)  # fmt: skip

SERVOS = (SERVO, LOADED)
