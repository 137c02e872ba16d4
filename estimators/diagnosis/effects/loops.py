"""Hidden loops between the input and the linear part: a limited actuator whose integrator winds up, a relay with hysteresis.

Both replace the slowest dynamics, so that the linear model is no guide to them: their shapes are profiled with a gain and a
short filter behind them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.profiled import BEGUN, CROSSED, ended, firm, of_order, profile

Array = NDArray[Any]
QUICK = 0.2
"""Pole of the filter behind a loop that the shapes are tried with."""
PACES = (0.5, 1.0, 2.0, 4.0)
"""Of the linear model's slowest pole, how fast a loop is taken to be: one that is limited looks slower than it is."""
WIDTHS = (0.5, 0.7, 0.9, 1.2, 1.7, 2.5)
"""Half the distance of the limits, of half the set point's range: narrower than one, some levels are never reached, wider, only
transients are cut."""
OPEN = (0.03, 0.1, 0.25, 0.45)
"""Share of the loop's damping that is the plant's own: the rest is the controller's doing."""
DAMPINGS = (0.4, 0.7, 1.2)
"""Of the loop without its limit, as the linear model of a loop that winds up is no guide to it."""
LEVELS = (0.1, 0.25, 0.4, 0.5, 0.6, 0.75, 0.9)
"""Of the range that the input would drive a relay's plant over, where it may switch: any two of them."""
LEAST_GAP = 0.03
"""Of the input's range, between a relay's levels: what switches at one level is a curve."""
PUSHES = (-0.6, -0.3, -0.15, 0.15, 0.3, 0.6)
"""Of the input's range, what a relay may add to it while it is on."""


def _wound_up(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.recursion_kernels import wound_up

    pace, proportional, integral = (abs(float(v)) for v in p[:3])
    return wound_up(
        np.ascontiguousarray(x), pace, proportional, integral, float(p[3]), float(p[4]), level_before(x)
    )


def _switched(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.recursion_kernels import switched

    low, high = sorted((float(p[3]), float(p[4])))
    if not high - low > LEAST_GAP * float(np.ptp(x)):
        return np.full(len(x), np.inf)
    return switched(
        np.ascontiguousarray(x), abs(float(p[0])), float(p[1]), float(p[2]), low, high, level_before(x)
    )


def _controlled(slowest: float, u: Array) -> Iterator[list[float]]:
    """A loop of natural frequency w and damping z, its plant's pole a: a (1 + Kp) = 2 z w, a Ki = w^2."""
    middle, half = 0.5 * float(u.max() + u.min()), 0.5 * float(np.ptp(u))
    for faster in PACES:
        for z in DAMPINGS:
            for share in OPEN:
                w = faster * slowest
                a = 2.0 * z * w * share
                for wide in WIDTHS:
                    yield [a, 2.0 * z * w / a - 1.0, w * w / a, middle - wide * half, middle + wide * half]


def _switching(slowest: float, u: Array) -> Iterator[list[float]]:
    """A lag that switches between two levels of what the input alone would make of it."""
    wide = float(np.ptp(u))
    for faster in PACES[:-1]:
        alone = _switched(
            u, np.array([faster * slowest, 0.0, 0.0, 0.0, 1e300]), Clock(np.arange(len(u)), len(u))
        )
        for low, high in combinations(np.quantile(alone, LEVELS), 2):
            for push in PUSHES:
                yield [faster * slowest, push * wide, 0.0, float(low), float(high)]


def _shaped(effect: Any, shapes: Any, steps: Any) -> Any:
    """The search of an effect over the shapes of a loop; `steps` sizes of its parameters for a slowest pole and an input."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterable[Any]:
        from estimators.diagnosis.model.structure import Part
        from estimators.diagnosis.search.free_runs import denominator, largest_pole

        s = base.structure
        if s.layout != "tf" or len(s.inputs) != 1 or s.order < 1:
            return
        slowest = float(
            np.clip(-np.log(max(largest_pole(denominator(base)), 1e-12)), 0.3 / len(channel), 1.0)
        )
        u = np.ascontiguousarray(channel.u[:, s.inputs[0]])
        few, p, scales = of_order(base, 1, 2)
        gain = float(np.std(channel.y)) / (float(np.std(u)) + 1e-300)
        p[:3], scales[:3] = [-QUICK, 0.0, 0.0], [1.0, gain, gain]
        bare, part = replace(base, structure=few, p=p, scales=scales), Part(effect(), s.inputs[0])
        tried = profile(channel, bare, part, shapes(slowest, u))
        if tried and firm(base, tried[0][0]):
            yield from ended(
                channel, bare, part, (q for _, q in tried[:BEGUN]), steps(slowest, float(np.std(u)))
            )

    return search


WINDUP = Effect(
    key="wind_up", cause="wind_up", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=_wound_up,
    sentence="a loop of its own follows the input, its actuator is limited, and its integrator winds up",
    parameters={"plant": "1/sample", "proportional": "1", "integral": "1/sample", "low": "u", "high": "u"},
    search=_shaped(lambda: WINDUP, _controlled, lambda slowest, su: [slowest, 1.0, slowest, su, su]),
)  # fmt: skip

RELAY = Effect(
    key="relay_feedback", cause="relay_with_hysteresis", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=100, apply=_switched,
    sentence="a relay with hysteresis, a thermostat, switches something on and off as what the input drives passes two levels",
    parameters={"rate": "1/sample", "push": "u", "share": "1", "low": "u", "high": "u"},
    search=_shaped(lambda: RELAY, _switching, lambda slowest, su: [slowest, su, 1.0, *[1e6 * CROSSED * su] * 2]),
)  # fmt: skip

LOOPS = (WINDUP, RELAY)
