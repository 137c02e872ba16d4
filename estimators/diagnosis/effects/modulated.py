"""Coefficients that follow a signal: inertia, stiffness, damping or gain, with time or with a slow hidden state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Grid, Nature, Sizes, Slot, level_before

__all__ = ["MODULATED", "leaky"]

Array = NDArray[Any]
MOVING = frozenset({"oscillator", "driven", "sensed", "modes"})
STEPS = (-0.25, 0.3, 0.8)  # relative changes of a coefficient over the record that are tried
MEMORIES = (0.05, 0.2)  # of the record: time constants of a slow state that are tried


def leaky(x: Array, time: float) -> Array:
    """Leaky integral of unit gain of a signal, with a time constant in samples; it rests where the signal stood before."""
    from scipy.signal import lfilter

    pole = float(np.exp(-1.0 / max(abs(time), 0.5)))
    level = level_before(x)
    return level + np.asarray(lfilter([1.0 - pole], [1.0, -pole], x - level))


def _inertia(p, v, u, q, s, c):
    g = np.maximum(1.0 + c[0] * s, 0.05)
    return (1.0 - 1.0 / g) * (u - p - c[1] * v)


def _stiffness(p, v, u, q, s, c):
    return c[0] * s * p


def _damping(p, v, u, q, s, c):
    return c[0] * s * v


def _time(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    return clock.turn


def _heat(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """Leaky mean of the squared input; the last parameter is its time constant."""
    return leaky(U[:, 0] ** 2, p[-1])


def _with_time(s: Sizes) -> Grid:
    return [[f] for f in STEPS], [1.0]


def _with_heat(s: Sizes) -> Grid:
    size = s.su**2 + float(np.mean(s.u)) ** 2
    return [[f / size, m * len(s.u)] for f in STEPS for m in MEMORIES], [1.0 / size, float(len(s.u)) / 10.0]


def _coefficient(
    key: str, cause: str, nature: Nature, sentence: str, force: Callable[..., Any], signal: Any, starts: Any,
    parameters: dict[str, str],
) -> Effect:  # fmt: skip
    return Effect(
        key=key, cause=cause, nature=nature, slot=Slot.PLANT, sentence=sentence, force=force, signal=signal, starts=starts,
        parameters=parameters, trials=6, layouts=MOVING, family=f"modulated by {signal.__name__}",
    )  # fmt: skip


def _heated_gain(x: Array, p: Array, clock: Clock) -> Array:
    return x * (1.0 + p[0] * leaky(x**2, p[1]))


def _inertias(s: Sizes) -> Grid:
    return [[f, s.damping] for f in STEPS], [1.0, s.damping]


MODULATED = (
    _coefficient("inertia_drift", "parameter_drift", Nature.TIME, "the inertia changes steadily with time", _inertia, _time,
                 _inertias, {"slope": "1/record", "damping": "sample"}),
    _coefficient("stiffness_drift", "parameter_drift", Nature.TIME, "the stiffness changes steadily with time", _stiffness,
                 _time, _with_time, {"slope": "1/record"}),
    _coefficient("damping_drift", "parameter_drift", Nature.TIME, "the damping changes steadily with time", _damping, _time,
                 lambda s: ([[f * s.damping] for f in STEPS], [s.damping]), {"slope": "sample/record"}),
    _coefficient("stiffness_heat", "slow_hidden_state", Nature.DYNAMIC,
                 "the stiffness follows a slow state that the squared input feeds", _stiffness, _heat, _with_heat,
                 {"share": "1/u^2", "time": "sample"}),
    Effect(key="gain_heat", cause="slow_hidden_state", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=10, apply=_heated_gain,
           sentence="the gain follows a slow state that the squared input feeds: heat", starts=_with_heat,
           parameters={"share": "1/u^2", "time": "sample"}),
)  # fmt: skip
