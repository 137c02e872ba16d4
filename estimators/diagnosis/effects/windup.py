"""A loop whose actuator is limited, seen from its set point: the integrator winds up while the limit holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.profiled import BEGUN, _ended, _firm, _profile

Array = NDArray[Any]
PACES, WIDTHS = (0.5, 1.0, 2.0, 4.0), (0.5, 0.7, 0.9, 1.2, 1.7, 2.5)
"""Of the linear model's slowest poles, how fast the loop without its limit is taken to be; and half the distance of the limits,
of half the set point's range: narrower than one, some levels are never reached, wider, only transients are cut."""
OPEN = (0.03, 0.1, 0.25, 0.45)
"""Share of the loop's damping that is the plant's own: the rest is the controller's doing."""
QUICK = 0.2
"""Pole of the filter behind the loop that the shapes are tried with."""
DAMPINGS = (0.4, 0.7, 1.2)
"""Of the loop without its limit, as the linear model of a loop that winds up is no guide to it."""


def _loop(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.recursion_kernels import wound_up

    pace, proportional, integral = (abs(float(v)) for v in p[:3])
    return wound_up(
        np.ascontiguousarray(x), pace, proportional, integral, float(p[3]), float(p[4]), level_before(x)
    )


def _shapes(slowest: float, low: float, high: float) -> Iterator[list[float]]:
    """A loop of natural frequency w and damping z, its plant's pole a: a (1 + Kp) = 2 z w, a Ki = w^2."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    for faster in PACES:
        for z in DAMPINGS:
            for share in OPEN:
                w = faster * slowest
                a = 2.0 * z * w * share
                for wide in WIDTHS:
                    yield [a, 2.0 * z * w / a - 1.0, w * w / a, middle - wide * half, middle + wide * half]


def _loops(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The shapes with nothing but a gain and a short filter behind them, as the loop has the poles."""
    from estimators.diagnosis.model.structure import Part

    s = base.structure
    if s.layout != "tf" or len(s.inputs) != 1 or s.order < 1:
        return
    roots = np.roots(np.concatenate(([1.0], base.p[: s.order])))
    slowest = float(np.clip(-np.log(np.abs(roots).max(initial=1e-3) + 1e-12), 0.3 / len(channel), 1.0))
    u = channel.u[:, s.inputs[0]]
    part, size = Part(WINDUP, s.inputs[0]), float(np.std(u))
    few = replace(s, order=1, taps=2)
    p, scales = np.zeros(few.size), np.zeros(few.size)
    for now, then in zip(few.slices(), s.slices(), strict=True):
        many = now.stop - now.start
        p[now], scales[now] = base.p[then][:many], base.scales[then][:many]
    p[:3], scales[:3] = [-QUICK, 0.0, 0.0], [1.0, *[float(np.std(channel.y)) / (size + 1e-300)] * 2]
    bare = replace(base, structure=few, p=p, scales=scales)
    tried = _profile(channel, bare, part, _shapes(slowest, float(u.min()), float(u.max())))
    if tried and _firm(base, tried[0][0]):
        yield from _ended(
            channel, bare, part, (q for _, q in tried[:BEGUN]), [slowest, 1.0, slowest, size, size]
        )


WINDUP = Effect(
    key="wind_up", cause="wind_up", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, two_sided=False,
    sentence="a loop of its own follows the input, its actuator is limited, and its integrator winds up",
    parameters={"plant": "1/sample", "proportional": "1", "integral": "1/sample", "low": "u", "high": "u"},
    apply=_loop, search=_loops,
)  # fmt: skip
