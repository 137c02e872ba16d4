"""Sensors whose gain changes: with a slow envelope of what they read, or periodically."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.output import KEPT
from estimators.diagnosis.effects.profiled import SWAY, ended, firm, rotating, swaying, waved
from estimators.diagnosis.effects.sensing.foretold import by_size
from estimators.diagnosis.effects.sensing.sensors import settled

Array = NDArray[Any]
LEAST = 0.1
"""Gain of a sensor from which on what it shows says what it reads: a periodic one may pass zero."""


def law_of(p: Array) -> tuple[float, float, float, float]:
    """Share, power and the two time constants of automatic gain, of any parameters that a search may ask for."""
    share, power, rises, falls = (abs(float(v)) for v in p[:4])
    return share, power, max(rises, 1e-3), max(falls, 1e-3)


def _levelled(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import levelled

    return levelled(np.ascontiguousarray(settled(x, clock) - p[4]), *law_of(p)) + p[4]


LEVELLED = Effect(
    key="automatic_gain", cause="automatic_gain", nature=Nature.DYNAMIC, slot=Slot.OUTPUT, memory=True, trials=50,
    sentence="the sensor's gain falls as the mean size of what it has read of late grows: automatic gain control, a compressor",
    parameters={"share": "1/y", "power": "1", "rises": "sample", "falls": "sample", "level": "y"}, apply=_levelled,
    search=by_size(lambda: LEVELLED),
)  # fmt: skip


def _carried(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """At the frequencies that the residual has in common with what is read, with poles of the output once its gain is steady again."""
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part

    s, n, whiten = base.structure, len(channel), np.concatenate(([1.0], base.noise))
    if s.layout != "tf" or s.effects or n < 100 or np.mean(channel.keep) < KEPT:
        return
    starts: list[Array] = []
    passed = lambda x: np.asarray(lfilter(whiten, [1.0], x, axis=0))
    for shape in rotating(channel, base, channel.y - base.residual, passed):
        steady = replace(channel, y=channel.y / np.maximum(swaying(np.ones(n), shape, channel.clock), LEAST))
        starts += [np.append(p, shape) for p in (base.p, fit_linear(steady, s, rough=True).p)]
    for f in ended(channel, base, Part(CARRIED), starts, [1.0 / n, 1.0, 1.0]):
        if firm(base, float(np.sum(f.residual**2))):
            yield from waved(channel, f)


CARRIED = replace(
    SWAY, key="output_gain_periodic", slot=Slot.OUTPUT, search=_carried,
    sentence="the sensor's gain changes periodically: (1 + a cos(w t) + b sin(w t)), with harmonics where there are some",
)  # fmt: skip
