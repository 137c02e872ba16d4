"""A drive that takes its command over at scans of its own only, by a clock that need not be the record's."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.loops.anew import remade
from estimators.diagnosis.effects.profiled import AROUND, descended, ended, firm

Array = NDArray[Any]

SCANS = 40
"""Samples between scans of a drive, at most: where they are further apart the record shows it by itself."""
FINE = 4
"""Frequencies of scans looked at per one that a record's length tells apart: between two of them a quarter of a turn is lost at its ends."""
LOOKED, ASIDE, KEPT = 24, (-0.5, 0.0, 0.5), 2
"""Of their lines, the strongest, each of which has poles of its own made in three phases: the linear model's stand for the scans too. And of
these, how many are moved to where no other place is better."""


def _scanned(x: Array, p: Array, clock: Clock) -> Array:
    """What the last scan has taken over, every p[0] samples, one of them at time p[1] in samples: in a sample within which a scan falls,
    the mean of what it held until then and what it holds from then on, as far as a sample's plant tells them apart."""
    every, phase = float(p[0]), float(p[1])
    if not 2.0 <= every <= SCANS:
        return np.full(len(x), np.inf)
    k = np.rint(clock.k)
    last = phase + every * np.floor((k - phase) / every)
    taken = np.floor(last).astype(np.int64) - int(k[0])
    held = np.where(taken < 0, level_before(x), x[np.maximum(taken, 0)])
    until = np.minimum(last + every - k, 1.0)
    return until * held + (1.0 - until) * x


def _lines(u: Array, back: Array) -> list[tuple[float, float]]:
    """Periods and phases of scans of an input whose ages answer `back`, a residual taken back through the plant; the strongest first.

    A scan's age turns the input of each lag on and off periodically: what its first harmonic explains is read off the spectra of
    the residual times the lagged inputs, for every period at once. Phases are read in the middle of the record, where the
    period that is between two lines moves them least.
    """
    n, longest = len(u), min(SCANS, len(u) // SCANS)
    size = FINE * 2 ** int(np.ceil(np.log2(n)))
    line = np.arange(-(-size // longest), size // 2 + 1)
    f, lags = line / size, np.arange(longest)
    turns = np.exp(-2j * np.pi * np.outer(lags, f)) * (lags[:, None] < 1.0 / f)
    pasts = np.array([np.concatenate((np.full(a, u[0]), u[: n - a])) for a in lags])
    told = np.sum(turns * np.fft.rfft(back * pasts, size)[:, line].conj(), axis=0)
    alike = toeplitz([float(u[a:] @ u[: n - a]) for a in lags])
    score = np.abs(told) ** 2 / np.maximum(np.sum(turns.conj() * (alike @ turns), axis=0).real, 1e-300)
    inner = score[1:-1]
    peaks = 1 + np.flatnonzero((inner > score[:-2]) & (inner >= score[2:]))
    found = []
    for i in peaks[np.argsort(-score[peaks])[:LOOKED]]:
        left, top, right = np.sqrt(score[i - 1 : i + 2])
        there = f[i] + 0.5 * (left - right) / (left - 2.0 * top + right) / size
        turned = np.angle(told[i] * np.exp(-1j * np.pi * f[i] * n)) / (2.0 * np.pi * there)
        found.append((1.0 / there, (turned + 0.5 + 0.5 * n) % (1.0 / there)))
    return found


def _closer(channel: Any, structure: Any, best: tuple[float, Array]) -> tuple[float, Array]:
    """(sum of squares, parameters) with the scans moved closer: their period about the middle of the record, all of them together, or both."""
    half = 0.5 * len(channel)
    middle = channel.clock.k[0] + half

    def around(p: Array, size: float) -> Iterator[tuple[float, Array]]:
        every, at = p[-2:]
        period = 0.5 * size * every / half * every  # moves the scans at the ends by half a period
        for a, b in AROUND:
            shape = every + a * period, at - a * period * np.rint((middle - at) / every) + 0.5 * b * size
            yield remade(channel, structure, np.concatenate((p[:-2], shape)))

    return descended(around, best)


def _scans(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The periods and phases that a spectrum tells, whole ones beside them, then closer to the best."""
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Part

    s, n = base.structure, len(channel)
    if s.layout != "tf" or s.effects or n // SCANS < 2:
        return
    for j in s.inputs:
        part, u = Part(SCANNED, j), channel.u

        def ran(x: Array, j: int = j, u: Array = u) -> Array:
            return simulate(s, base.p, np.column_stack((*u.T[:j], x, *u.T[j + 1 :])), channel.clock)

        e, level = np.where(channel.keep, base.residual, 0.0), float(np.mean(u[:, j]))
        lines = _lines(u[:, j] - level, np.flip(ran(np.flip(e)) - ran(np.zeros(n))))
        lines = [(every, channel.clock.k[0] + at) for every, at in lines]
        whole = [(np.rint(every), np.rint(at)) for every, at in lines if 2.0 <= np.rint(every) <= SCANS]
        for delay in sorted({0, s.delay}) if lines else ():  # what is scanned looks late to a linear model
            bare, found = replace(base, structure=replace(s, delay=delay)), []
            new = bare.structure.adding(part)
            for places, aside in ((lines, ASIDE), (whole, 2.0 * np.array(ASIDE))):
                shapes = ([every, at + off] for every, at in places for off in aside)
                tried = (remade(channel, new, np.concatenate((base.p, shape))) for shape in shapes)
                found += sorted(tried, key=lambda entry: entry[0])[:KEPT]
            if not firm(base, min(error for error, _ in found)):
                continue
            close = sorted((_closer(channel, new, best) for best in found), key=lambda entry: entry[0])
            yield from ended(channel, bare, part, [p for _, p in close], [0.0, 0.0])


SCANNED = Effect(
    key="input_scanned", cause="held_between_scans", nature=Nature.SAMPLING, slot=Slot.INPUT, trials=1e5, search=_scans,
    sentence="the input is taken over at scans of their own only, every so many samples, and kept until the next",
    parameters={"period": "sample", "phase": "sample"}, apply=_scanned,
)  # fmt: skip
"""Trials: of a thousand samples six thousand periods can be told apart, and some ten phases of each."""
