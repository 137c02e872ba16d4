"""The linear part behind a sensor that shows its signal in some samples only: made for these, and bridged between."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.simulation import free_responses, simulate
from estimators.diagnosis.model.structure import Part, Structure

Array = NDArray[Any]
FURTHER = (0, 1)
"""Poles more than the linear model's: it had the fewest that do for what the sensor makes of the signal, and bends them to that."""
LATER = (-1, 0, 1, 2)
"""Samples of delay more than the linear model's, which a signal that is shown late or in steps bends too."""
SETTLED = 10.0
"""Time constants of the slowest pole in which a signal has settled to five parts in a hundred thousand."""
UNTOLD = 6.0
"""Of twice the log-likelihood, what chance makes of two parameters once in twenty records: what costs less, as a start at rest or another
delay, the samples do not tell."""
MOVING = 0.5
"""Share of the samples in which a signal moves fastest: behind a play they show it, off by half the gap the way it moves."""
ABOUT = 2
"""Samples on either side over which the rate is averaged: of noise a single step shows more than of a slow signal."""
GAPS = np.geomspace(0.05, 1.6, 16)
"""Half widths of a play that are looked at, in standard deviations of the output: a quarter more from one to the next."""
BEST = 6
"""Gaps and numbers of poles, by the error with the play, that are fitted on: a play's error has many minima."""
BEGUN, ENDED = 8, 25
"""Gauss-Newton steps by which a start at rest is compared, and of fits that are meant to end."""


def as_shown(
    channel: Channel,
    base: Fit,
    y: Array,
    seen: NDArray[np.bool_],
    later: tuple[int, ...] = (0,),
    begins: int = 1,
) -> Iterator[Fit]:
    """Linear fits to a signal (N,) where it was `seen`, one for each number of poles and each delay, `later` than the linear model's.

    The first samples, so many as it `begins` with, hold the start whether or not they were seen.
    """
    s = base.structure
    begun = replace(channel, y=y).without(~seen & (np.arange(len(y)) >= begins))

    def fitted(s: Structure) -> Fit:
        # what is bridged tells the poles, roughly
        f = fit_linear(replace(begun, keep=channel.keep), s, rough=True)
        return fit(begun, s, f.p, f.scales, iterations=ENDED, colour=False)

    for more in FURTHER:
        sized = replace(s, order=s.order + more, taps=s.taps + more)
        for delay in sorted({max(s.delay + d, 0) for d in later}):
            yield fitted(replace(sized, delay=delay))


def begun_at_rest(channel: Channel, f: Fit) -> Fit:
    """A linear fit that begins settled under the first input, and stays so, where the samples that count say no better: while a sensor
    stands they say nothing of the start, and how far its reading is off the signal would be a guess."""
    s, begins = f.structure, f.structure.begins
    if begins is None:
        return f
    slowest = float(np.max(np.abs(np.roots(np.concatenate(([1.0], f.p[: s.order]))))))
    lead = int(min(SETTLED / max(-np.log(slowest), SETTLED / len(channel)), len(channel)))
    padded = np.concatenate((np.repeat(channel.u[:1], lead, axis=0), channel.u))
    early = Clock(np.arange(-lead, len(channel)) + channel.clock.k[0], channel.clock.length, lead)
    bare = f.p.copy()
    bare[begins] = 0.0
    rest = simulate(s, f.p, padded, early, rest=True)[lead:] - simulate(s, bare, channel.u, channel.clock)
    bare[begins] = np.linalg.lstsq(free_responses(s, f.p, len(rest)), rest, rcond=None)[0]
    held = f.scales.copy()
    held[begins] = 0.0
    f = fit(channel, s, f.p, f.scales, iterations=BEGUN, colour=False)
    g = fit(channel, s, bare, held, iterations=BEGUN, colour=False)
    return g if g.deviance < f.deviance + UNTOLD else f


@lru_cache(maxsize=1)  # for a play that moves between the samples, and for one that moves with them
def _by_gaps(channel: Channel, base: Fit) -> list[tuple[float, Fit]]:
    """Half widths of a gap, and the linear fits to what it shows of a signal on its fast ways up and down."""
    window = np.ones(2 * ABOUT + 1) / (2 * ABOUT + 1)
    rate = np.convolve(np.gradient(channel.y), window, "same")
    seen = np.abs(rate) > np.quantile(np.abs(rate[channel.keep]), 1.0 - MOVING)
    return [
        (half, f)
        for half in GAPS * float(np.std(channel.y[channel.keep]))
        for f in as_shown(channel, base, channel.y + half * np.sign(rate), seen)
    ]


def with_play(channel: Channel, base: Fit, part: Part) -> Fit | None:
    """A fit with a play at the output, from gaps by which its way up and its way down are of one linear signal."""
    s, kept = base.structure, channel.keep
    if s.layout != "tf" or s.effects:
        return None
    size = float(np.std(channel.y[kept]))
    tried = [
        (f.structure.adding(part), np.append(f.p, half), np.append(f.scales, size))
        for half, f in _by_gaps(channel, base)
    ]

    def left(entry: tuple[Structure, Array, Array]) -> float:
        error = (channel.y - simulate(*entry[:2], channel.u, channel.clock))[kept]
        return float(error @ error) if np.all(np.isfinite(error)) else np.inf

    found = [
        fit(channel, *entry, noise=base.noise, iterations=ENDED) for entry in sorted(tried, key=left)[:BEST]
    ]
    f = min(found, key=lambda f: f.criterion)
    return f if np.isfinite(f.criterion) else None
