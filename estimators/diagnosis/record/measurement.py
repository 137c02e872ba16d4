"""What shows in the samples themselves: faults of the measurement (held, rounded, wild), and what is none (gaps, rest)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, chi2, mannwhitneyu, rankdata, spearmanr

from oed.data import Record

Array = NDArray[Any]


@dataclass(frozen=True)
class Signature:
    """A fault of the measurement found in one output.

    `key` key of the catalogue: held, quantised or outliers; `output` which output; `count` how many samples
    show it; `size` step, share or amplitude; `sentence` the evidence.
    """

    key: str
    output: int
    count: int
    size: float
    sentence: str


def rounding_step(y: Array) -> float:
    """Step of the lattice on which all samples lie, 0 if there is none.

    Shapes: y (N,).
    """
    y = y[np.isfinite(y)]
    values = np.unique(y)
    if len(values) < 2 or len(values) > 0.5 * len(y):
        return 0.0
    gaps = np.diff(values)
    top = float(np.max(np.abs(values)))
    gaps = gaps[gaps > 1e-6 * top]
    if not len(gaps):
        return 0.0
    step = float(np.min(gaps))
    step = float(np.mean(gaps[gaps < 1.5 * step]))
    off = gaps / step
    return step if np.max(np.abs(off - np.round(off))) < 0.05 else 0.0


def _longest(flags: NDArray[np.bool_]) -> int:
    """Length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False]))))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def held_samples(y: Array) -> NDArray[np.bool_]:
    """Samples that repeat the one before exactly, where values do not recur by coarseness or at an end stop.

    Shapes: y (N,), returns (N,).
    """
    held, repeats = np.zeros((2, len(y)), dtype=bool)
    repeats[1:] = y[1:] == y[:-1]
    held[:] = repeats & (y != np.max(y)) & (y != np.min(y))
    # Lost at the largest or the least value too, unless the signal rests there longer or more than once.
    for end in (np.max(y), np.min(y)):
        at = np.flatnonzero(y == end)
        if 1 < len(at) == at[-1] - at[0] + 1 <= 1 + _longest(held):
            held[at[1:]] = True
    returned = _returned_to(y)
    held &= ~returned
    steps = np.abs(np.diff(y))
    moved = steps[steps > 0]
    if len(
        moved
    ):  # a repeat is no loss where the next level of the scale is as frequent: the signal rests there
        smallest = float(np.min(moved))
        if held.sum() < 2 * np.sum(moved < 1.5 * smallest):
            held[:] = False
    fresh, again = np.unique(y[~held & ~returned]), np.unique(y[returned])
    # Values recur anyway: a coarse scale. One to which the signal comes back is one, however often it does.
    coarse = len(fresh) < 0.97 * np.sum(~held & ~returned) or len(again) > 0.03 * (len(fresh) + len(again))
    if coarse:
        held = _too_long(repeats)
    elif held.mean() < FEW:
        held &= _too_long(repeats)
    last = np.flatnonzero(held[:-1] & ~held[1:])
    # What was lost comes at once with the next sample, so that this moves no less than others; a signal that creeps does not, and
    # one that rests on a coarse scale moves by its least step.
    told = lambda way: len(last) > 0 and mannwhitneyu(steps[last], moved, alternative=way).pvalue
    if (told("greater") > CHANCE if coarse else told("less") < CREEPS) or _of_a_least_step(moved, len(y)):
        held[:] = False
    return held


STILL = 0.4
"""Share of the samples in which the reading stands at least, of a sensor that reports changes only."""
SMALL = 0.5
"""Of the median move: of moves whose sizes are as frequent as any down to none, a share of half of that is smaller."""


def _of_a_least_step(moved: Array, n: int) -> bool:
    """Whether a reading that mostly stands moves (moves,) by a least step and more, as a sensor does that reports changes only.

    Losses come at any time, and end in small moves as often as in any: they are no rarer than larger ones, so that by the median's
    half a quarter of them is smaller.
    """
    few = binom.cdf(np.sum(moved < SMALL * np.median(moved)), len(moved), 0.5 * SMALL) if len(moved) else 1.0
    return bool(len(moved) <= (1.0 - STILL) * n and few < CHANCE)


def _too_long(repeats: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) repeats in rows that are too long for a scale whose values recur by chance as often as single ones show."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], repeats.astype(int), [0]))))
    first, length = edges[::2], np.diff(edges)[::2]
    chance = (1 + np.sum(length == 1)) / max(1, np.sum(~repeats))
    out = np.zeros(len(repeats), dtype=bool)
    for at, size in zip(first, length, strict=True):
        out[at : at + size] = len(repeats) * chance**size < CREEPS
    return out


FEW = 0.01
"""Share of repeated samples below which single ones are no losses: interpolation and editing leave some, and nothing hangs on them."""
CREEPS = 0.05
"""Significance from which on moves after repeated samples are smaller than others: after losses they are larger, which one set
of three in three hundred hides; and the number of rows by chance below which a row of repeats is none."""


def _returned_to(y: Array) -> NDArray[np.bool_]:
    """(N,) samples whose value stands at another place of the record too: the signal rests there, as a plant by night."""
    _, where, count = np.unique(y, return_inverse=True, return_counts=True)
    first, last = np.full(len(count), len(y)), np.zeros(len(count), dtype=int)
    np.minimum.at(first, where, np.arange(len(y)))
    np.maximum.at(last, where, np.arange(len(y)))
    return (last - first >= count)[where]


RESTING = 8
"""Samples of unmoved input and output from which on a system rests; losses in a row are seldom so many."""


def resting_samples(u: Array, y: Array, least: int = RESTING) -> NDArray[np.bool_]:
    """(N,) samples at which neither the inputs (N, nu) nor the output move: from the start, or for `least` samples and more.

    A system at rest repeats its output; nothing is lost there. It does not leave its rest by a large move before an input moves.
    """
    still, unmoved = np.zeros((2, len(y) + 1), dtype=bool)
    unmoved[1:-1] = np.all(u[1:] == u[:-1], axis=1)
    steps = np.abs(np.diff(y, append=y[-1:]))
    still[1:-1] = unmoved[1:-1] & (steps[:-1] == 0)
    usual = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    edges = np.flatnonzero(np.diff(still.astype(int)))
    out = np.zeros(len(y), dtype=bool)
    for first, stop in zip(edges[::2] + 1, edges[1::2] + 1, strict=True):
        comes = unmoved[stop] and steps[stop - 1] > usual
        out[first:stop] = (stop - first >= least and not comes) or first == 1
    return out


REFRESHES = 20
"""Changes of a signal that all lie on one lattice of samples from which on it is read anew only there: by chance, on every other
sample, once in half a million records."""


def refreshed_every(u: Array, y: Array) -> int:
    """Samples between the times at which an output (N,) is read anew; 1 where it changes at others too, too seldom to tell, or only
    as the inputs (N, nu) do: one that follows at once on a coarse scale moves no oftener."""
    lattice = lambda *x: int(np.gcd.reduce(np.diff(np.concatenate([np.flatnonzero(np.diff(v)) for v in x]))))
    if np.count_nonzero(np.diff(y)) < REFRESHES or (every := lattice(y)) == 1:
        return 1
    return 1 if lattice(*u.T) % every == 0 else every


def lost_samples(u: Array, y: Array) -> NDArray[np.bool_]:
    """(N,) samples of an output (N,) that are no readings: they show the last one, at any time, and the system does not rest at
    inputs (N, nu)."""
    every = refreshed_every(u, y)
    if every == 1:
        held = held_samples(y)
        held &= ~_in_motion(u, y, held)
    else:
        held = np.concatenate(([False], y[1:] == y[:-1]))
    return held & ~resting_samples(u, y, max(RESTING, 2 * every - 1))


def held_in_motion(u: Array, y: Array) -> NDArray[np.bool_]:
    """(N,) samples of an output (N,) that show the last reading while it moves quickly: a model can say which they are. Where it
    comes back as an input (N, nu) moves, it has not rested until then."""
    return _in_motion(u, y, held_samples(y)) if refreshed_every(u, y) == 1 else np.zeros(len(y), dtype=bool)


def _in_motion(u: Array, y: Array, held: NDArray[np.bool_]) -> NDArray[np.bool_]:
    moving = held & ~resting_samples(u, y, len(y))  # but for a rest at the start
    return moving if _quick(y, moving) else np.zeros(len(y), dtype=bool)


ROWS, WINDOWS, QUICK = 8, 20, 0.85
"""Rows of repeats, and as long stretches of readings, from which on their rates are compared; and the mean share of the stretches that
moved less: of eight rows that come at any time chance makes it that once in three thousand records."""


def _quick(y: Array, held: NDArray[np.bool_]) -> bool:
    """Whether a signal moved more during rows of repeats than in as many readings elsewhere: it was lost for its rate."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], held.astype(int), [0]))))
    rows = [(a - 1, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b < len(y)]
    if len(rows) < ROWS:
        return False
    stretches = np.diff(np.concatenate(([0], edges, [len(y)])))[::2]  # of readings
    # rows that are longer than any stretch are held to the longest that there are enough of
    sizes = np.arange(1, max(int(stretches.max()), 2))
    most = int(np.sum([np.sum(np.maximum(stretches - size, 0)) >= WINDOWS for size in sizes]))
    before, moved = np.cumsum(held), {}
    for size in {min(b - a, most) for a, b in rows} - {0}:
        good = ~held[:-size] & (before[size:] == before[:-size])
        moved[size] = np.sort(np.abs(y[size:] - y[:-size])[good]) / size
    rates = [(moved.get(min(b - a, most), np.zeros(0)), abs(y[b] - y[a]) / (b - a)) for a, b in rows]
    return most > 0 and float(np.mean([np.searchsorted(m, rate) / len(m) for m, rate in rates])) > QUICK


def at_reversals(wild: NDArray[np.bool_], simulated: Array) -> bool:
    """Whether wild samples lie where a signal turns more often than chance lets them (p < 0.001).

    Faults do not know of the motion: the number of them within one sample of a turning point is binomial.
    """
    direction = np.sign(np.diff(simulated, prepend=simulated[:1]))
    moving = np.flatnonzero(direction)
    turned = np.zeros(len(simulated), dtype=bool)
    other = direction[moving[1:]] != direction[moving[:-1]]
    turned[moving[:-1][other]] = True
    turned[moving[1:][other]] = True
    near = np.convolve(turned, np.ones(3), "same") > 0
    hits = int(np.sum(wild & near))
    return bool(binom.sf(hits - 1, int(wild.sum()), float(near.mean())) < 1e-3)


CHANCE = 1e-4
"""Probability, for each signal asked, below which wild samples lie where it is large or quick by no accident."""


def at_extremes(wild: NDArray[np.bool_], u: Array, simulated: Array) -> bool:
    """Whether wild samples (N,) lie where the inputs (N, nu) or the simulated output (N,) are high, low or quick.

    Faults come at any time: their ranks are uniform, and minus twice the sum of their logarithms is chi-squared (Fisher). What a
    model cannot follow comes where it is asked for most.
    """
    n, ends = len(wild), (simulated, -simulated, *u.T, *-u.T)
    signals = (*ends, *(np.abs(np.diff(s, prepend=s[:1])) for s in (simulated, *u.T)))
    told = (-2.0 * np.sum(np.log((n + 0.5 - rankdata(s)[wild]) / n)) for s in signals)
    return any(chi2.sf(value, 2 * int(wild.sum())) < CHANCE for value in told)


def wild_samples(residual: Array, keep: NDArray[np.bool_], limit: float = 5.0) -> NDArray[np.bool_]:
    """Isolated samples whose residual stands out from its neighbours' by more than Gaussian noise could.

    The statistic is the residual minus the median of its six neighbours, in robust standard deviations of
    that difference; it must also stand out from the residual's own spread. With limit 5 about one record of a
    thousand with 1000 Gaussian samples shows one.

    Shapes: residual (N,), returns (N,).
    """
    n = len(residual)
    r = np.where(keep, residual, np.nan)
    shifted = np.full((6, n), np.nan)
    for row, d in enumerate((-3, -2, -1, 1, 2, 3)):
        if d < 0:
            shifted[row, -d:] = r[:d]
        else:
            shifted[row, : n - d] = r[d:]
    with np.errstate(all="ignore"):
        centre = np.nanmedian(np.where(np.isfinite(shifted), shifted, np.nanmedian(r)), axis=0)
    d = np.where(np.isfinite(r), r - centre, 0.0)
    spread = 1.4826 * np.median(np.abs(d[keep])) + 1e-300
    local = np.array(spread)
    if n >= 60:  # a model error comes in bursts: the spread around the sample counts too
        window = np.lib.stride_tricks.sliding_window_view(np.pad(np.abs(d), 20, mode="reflect"), 41)
        local = 1.4826 * np.median(window, axis=1)
    own = 1.4826 * np.median(np.abs(r[keep] - np.median(r[keep]))) + 1e-300
    return (
        (np.abs(d) > limit * np.maximum(spread, local))
        & (np.abs(np.where(np.isfinite(r), r, 0.0)) > 4.0 * own)
        & keep
    )


LONG_REST = 10
"""Samples of rest before the input starts that are worth a word: some loggers repeat their first sample once or twice."""


GOES = 0.9
"""Rank correlation of an input with the clock from which on what changes with time is not told from what depends on the level."""


def goes_with_clock(records: Sequence[Record]) -> bool:
    """Whether an input only rises, or only falls, through every record: a ramp, or a staircase."""
    return all(
        np.abs([spearmanr(u, np.arange(len(u))).statistic for u in r.u.T if np.ptp(u) > 0]).max(initial=0.0)
        > GOES
        for r in records
    )


TWO_LEVELS = 0.97
"""Of the samples of an input that is switched between two levels: it may rest at a third before it begins."""


def switched(x: NDArray[Any]) -> bool:
    """Whether a signal has two levels: every function of it is a straight line there, and anything elsewhere."""
    return float(np.sort(np.unique(x, return_counts=True)[1])[-2:].sum()) > TWO_LEVELS * len(x)


def observations(records: Sequence[Record]) -> tuple[str, ...]:
    """Sentences on what is missing from the records and on rest before their inputs start: facts, no faults."""
    said = []
    for k, record in enumerate(records, 1):
        which, n = f" in record {k}" if len(records) > 1 else "", len(record)
        for name, y in zip(record.output_names, record.y.T, strict=True):
            edges = np.flatnonzero(np.diff(np.concatenate(([0], ~np.isfinite(y), [0]))))
            if len(edges):
                gaps = edges[1::2] - edges[::2]
                said.append(
                    f"{name}: {gaps.sum()} of {n} samples are missing{which}, {gaps.max()} in a row at most"
                )
        moved = np.flatnonzero((record.u != record.u[:1]).any(axis=1))
        if len(moved) and moved[0] >= LONG_REST:
            said.append(f"the input rests for the first {moved[0]} of {n} samples{which}")
    if goes_with_clock(records):
        said.append(
            "the input goes with the clock: what changes with time cannot be told from what depends on the level, and is not looked for"
        )
    return tuple(said)


def without_faults(record: Record, kept: Sequence[NDArray[np.bool_]]) -> Record:
    """The record, its samples that are no measurement, by output those (n,) not `kept`, as missing; itself where there are none."""
    y = record.y.copy()
    for column, keep in zip(y.T, kept, strict=True):
        column[: len(keep)][~keep] = np.nan
    return record if np.isfinite(y).sum() == np.isfinite(record.y).sum() else record.replace(y=y)
