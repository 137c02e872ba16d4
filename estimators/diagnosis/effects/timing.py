"""Clocks that disagree: the output's runs off from the input's, or samples of it are lost.

Where y is late by d(t), the residual is -d(t) dy/dt; here the measured output is put back on the input's clock and the
linear model made anew, as a model of the whole record has smeared its poles over the delays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot

__all__ = ["TIMING"]

Array = NDArray[Any]
SHIFTS = (0.5, 1.0, 1.8, 2.8, 4.0, 5.5)  # samples by which the clocks are apart in the end
JUMPS = (1.0, 2.0, 3.0, 5.0)  # samples lost at once
TIMES = 12  # of a jump, over the record


def _read(y: Array, at: Array) -> Array:
    """Values between the samples by a cubic spline; the first and the last value beyond the ends."""
    from scipy.interpolate import CubicSpline

    k = np.arange(len(y), dtype=float)
    return np.asarray(CubicSpline(k, y)(np.clip(at, 0.0, k[-1])))


def _drifted(y: Array, p: Array, clock: Clock) -> Array:
    return _read(y, np.arange(len(y)) + p[0] * clock.k)


def _jumped(y: Array, p: Array, clock: Clock) -> Array:
    return _read(y, np.arange(len(y)) + p[0] * np.clip(clock.k - p[1], 0.0, 1.0))


def _mended(
    effect: Callable[[], Effect], shapes: Callable[[int], list[list[float]]]
) -> Callable[..., Iterator[Any]]:
    """Fits from the best shapes, each with the poles that the output has once its shape is undone."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.fitting import fit
        from estimators.diagnosis.model.linear import fit_linear
        from estimators.diagnosis.model.structure import Part

        s, n = base.structure, len(channel)
        if s.layout != "tf" or s.effects or not channel.keep.all():
            return
        k, found = np.arange(n, dtype=float), []
        e = effect()
        for shape in shapes(n):
            when = (
                e.apply(k, np.array(shape), channel.clock) if e.apply is not None else k
            )  # what each sample shows
            back = np.interp(k, when, k) if np.all(np.diff(when) > 0) else k - (when - k)
            f = fit_linear(replace(channel, y=_read(channel.y, back)), s, rough=True)
            found.append((f.deviance, shape, f.p))
        part = Part(e, s.inputs[0])
        for _, shape, p in sorted(found, key=lambda entry: entry[0])[:2]:
            scales = np.concatenate((base.scales, [1.0 / n, 1.0] if len(shape) == 1 else [1.0, 1.0]))[
                : len(p) + len(shape)
            ]
            yield fit(
                channel, s.adding(part), np.concatenate((p, shape)), scales, noise=base.noise, iterations=25
            )

    return search


DRIFT = Effect(
    key="clock_drift", cause="clock_drift", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, ahead=True, trials=12,
    sentence="the clock of the output runs off from that of the input", parameters={"drift": "1"}, apply=_drifted,
    search=_mended(lambda: DRIFT, lambda n: [[sign * d / n] for d in SHIFTS for sign in (1.0, -1.0)]),
)  # fmt: skip
LOST = Effect(
    key="lost_samples", cause="lost_samples", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, ahead=True, trials=0.1,
    per_sample=True, sentence="samples of the output are lost, or come twice, and what follows is out of step",
    parameters={"samples": "1", "time": "sample"}, apply=_jumped,
    search=_mended(lambda: LOST, lambda n: [[sign * d, t * n] for t in np.linspace(0.08, 0.92, TIMES) for d in JUMPS[:2]
                                            for sign in (1.0, -1.0)]),
)  # fmt: skip

TIMING = (DRIFT, LOST)
