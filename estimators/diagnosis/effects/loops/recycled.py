"""What comes back after a delay and enters again: a recycle, an echo, a reflection, a controller far away.

It is linear, of no finite order: a model of a few poles follows one or two of its echoes.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks, lfilter

from estimators.diagnosis.effects.effect import Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.input import kept
from estimators.diagnosis.effects.profiled import BEGUN, ended, firm, left_over, profile, through

Array = NDArray[Any]
LEAST_DELAY, MOST_DELAY = 3, 8
"""Samples below which a delay is a coefficient of the linear model, and echoes that a record must have room for."""
FEW = 2  # poles of the linear model beside which echoes are looked for: more of them follow the echoes
PEAKS, TRIED = 3, 400
"""Delays that are fitted with each pair of lags, and at most how many are looked at for them: what went through lags is smooth."""
BRIEF = 0.5  # samples of a second lag at first: from none nothing leads away
SHARES = (0.25, 0.5, -0.25, -0.5)  # of what goes round, that comes back
MOST = 0.999  # of it: more would grow


def stays(p: Array) -> tuple[float, float]:
    """What each of the two lags keeps from one sample to the next."""
    slower, quicker = (float(np.exp(-1.0 / max(abs(t), 1e-3))) for t in p[1:3])
    return slower, quicker


def _returns(p: Array) -> tuple[Array, Array]:
    """Numerator and denominator of what comes back by what went in: two lags and a delay, what lies between two samples shared out."""
    (a, b), whole = stays(p), int(np.floor(p[3]))
    num = np.zeros(whole + 2)
    num[whole:] = float(p[0]) * (1.0 - a) * (1.0 - b) * np.array([1.0 - (p[3] - whole), p[3] - whole])
    return num, np.array([1.0, -a - b, a * b])


def _recycled(x: Array, p: Array) -> Array:
    if abs(p[0]) > MOST or not 1.0 <= p[3] < 0.5 * len(x):
        return np.full(len(x), np.inf)
    num, den = _returns(p)
    around = -num
    around[: len(den)] += den[: len(num)]
    before = level_before(x)
    return np.asarray(lfilter(den, around, x - before)) + before / (1.0 - p[0])


def _echoes(channel: Any, few: Any, j: int, lags: Array, left: tuple[Array, Array]) -> Iterator[Array]:
    """Lags and delay of the first echoes that explain most of what a linear model has `left_over`, of all delays at once."""
    from estimators.diagnosis.share.signals import late

    n, (r, Q) = len(channel), left
    num, den = _returns(np.array([1.0, *lags, 1.0]))
    once = through(few, j, np.asarray(lfilter(num, den, channel.u[:, j] - channel.u[0, j])))
    delays = np.unique(np.linspace(LEAST_DELAY, n // MOST_DELAY, TRIED).astype(int))
    D = np.stack([late(once, d) for d in delays], axis=1)
    D = np.where(channel.keep[:, None], D, 0.0)
    D -= Q @ (Q.T @ D)
    gains = (r @ D) ** 2 / np.maximum(np.sum(D**2, axis=0), 1e-12 * float(once @ once) + 1e-300)
    peaks = find_peaks(np.concatenate(([-1.0], gains, [-1.0])))[0] - 1
    for at in peaks[np.argsort(-gains[peaks])[:PEAKS]]:
        if firm(few, float(r @ r) - float(gains[at])):
            yield np.array([*lags, float(delays[at])])


def _recycling(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Echoes that a linear model of few poles leaves, by their delays; it goes round through lags like its poles, or through one."""
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.free_runs import denominator

    s, n = base.structure, len(channel)
    if s.layout != "tf" or s.effects or s.order < 1 or n < 2 * LEAST_DELAY * MOST_DELAY:
        return
    order = min(s.order, FEW)
    few = fit_linear(channel, replace(s, order=order, taps=min(s.taps, order)))
    times = np.sort(
        [-1.0 / np.log(min(max(abs(z), 0.05), 1.0 - 1.0 / n)) for z in np.roots(denominator(few))]
    )[::-1]
    slow, left = float(times[0]), left_over(channel, few)
    for j in s.inputs:
        part = Part(RECYCLE, j)
        lags = {(slow, BRIEF), (slow, float(times[-1])), (0.5 * slow, BRIEF), (BRIEF, BRIEF)}
        found = [echo for pair in sorted(lags) for echo in _echoes(channel, few, j, np.array(pair), left)]
        shapes = ([share, *echo] for echo in found for share in SHARES)
        starts = [p for _, p in profile(channel, few, part, shapes)[:BEGUN]]
        for f in ended(channel, few, part, starts, [1.0, slow, slow, 1.0]) if starts else ():
            if firm(base, float(np.sum(f.residual**2))):
                yield f


RECYCLE = Effect(
    key="recycle", cause="delayed_feedback", nature=Nature.LINEAR, slot=Slot.INPUT, trials=50,
    apply=lambda x, p, clock: kept(_recycled, x, p), search=_recycling,
    sentence="a share of what the input drives comes back after a delay, and enters with it: a recycle, an echo",
    parameters={"share": "1", "slower": "sample", "quicker": "sample", "delay": "sample"},
)  # fmt: skip
