"""Sensors of two ranges: from a level on they read another line, at once, or with hysteresis, as what changes its range by itself."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.loops.remembering import stage
from estimators.diagnosis.effects.output import KEPT
from estimators.diagnosis.effects.profiled import CROSSED, NEAREST, firm

Array = NDArray[Any]
SPLIT_AT, FEW, SPLITS = np.linspace(0.15, 0.85, 15), 3, 2
"""Quantiles of the linear model's output at which a sensor may change its range; one of so many is begun from, and how many of these are gone on from."""
GAPS = (0.0, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0)
"""Half the gap between its levels up and down, in standard deviations of the signal, that are tried."""
EDGE, FIRST = 0.05, 0.1
"""Share of the samples that either range has at least, and the first move of both levels, in standard deviations."""
APART, ROUNDS = 10.0, 12
"""Gain of one range over the other's, from which on one of them shows nothing; rounds of a level and what it parts."""
FARTHEST = 1e6
"""Standard deviations of the output, of a signal that a sensor may read: what explodes is beyond them."""
QUICK, GAINING = 5, 0.999
"""Steps of a fit before the level is looked for again, and the share of the squares that must be left for another round."""


def _ranges(x: Any, p: Array) -> Any:
    """Zero where the signal is, as a record of deviations begins in whichever range."""
    read = lambda x: x + (x > p[0]) * (p[1] + p[2] * (x - p[0]))
    return read(x) - read(0.0)


def _late_ranges(x: Array, p: Array, clock: Clock) -> Array:
    level, jump, slope, half = p
    if not 1.0 / APART < 1.0 + slope < APART:
        return np.full(len(x), np.inf)
    begins = (level + abs(half) < 0.0) * (jump - slope * level)
    return x + stage(x, half, level) * (jump + slope * (x - level)) - begins


def _lines(below: Array, above: Array) -> tuple[Array, Array, Array, Array]:
    """What a constant below and a line above leave of a difference, then both and the slope: of the sums of 1, x, d, x^2, x d and d^2, (6, ...)."""
    n, _, low, _, _, lows = below
    m, sx, sd, sxx, sxd, sdd = above
    slope = (sxd - sx * sd / m) / np.maximum(sxx - sx * sx / m, 1e-300)
    left = lows - low * low / n + sdd - sd * sd / m - slope * (sxd - sx * sd / m)
    return left, low / n, (sd - slope * sx) / m, slope


def _terms(x: Array, d: Array) -> Array:
    """(6, N) of which `_lines` takes the sums."""
    return np.stack([x**0, x, d, x * x, x * d, d * d])


def _split(x: Array, y: Array) -> Array:
    """Level, jump and slope of the two ranges, each with an offset, that leave the least of a reading (N,) of a signal (N,)."""
    order, edge = np.argsort(x), int(EDGE * len(x))
    able, d = slice(edge, -edge - 1), y - x
    sums = np.cumsum(_terms(x, d)[:, order], axis=1)
    left, low, high, slope = _lines(sums[:, able], (sums[:, -1:] - sums)[:, able])
    at = int(np.argmin(left))
    level = float(x[order[able]][at])
    return np.array([level, float(high[at] + slope[at] * level - low[at]), float(slope[at])])


def _split_late(x: Array, y: Array) -> Array:
    """The same with two levels, one up and one down: of a grid, then ever closer to the best."""
    size, terms = float(np.std(x)), _terms(x, y - x)
    whole = terms.sum(axis=1)

    def parted(level: float, half: float) -> tuple[float, Array]:
        above = terms @ stage(x, half, level)
        if not EDGE < above[0] / len(x) < 1.0 - EDGE:
            return np.inf, np.array([level, 0.0, 0.0, half])
        left, low, high, slope = _lines(whole - above, above)
        return float(left), np.array([level, high + slope * level - low, slope, half])

    key = lambda entry: entry[0]
    best = min((parted(level, half * size) for level in np.quantile(x, SPLIT_AT) for half in GAPS), key=key)
    step = FIRST * size
    while step > NEAREST * FIRST * size:
        level, half = best[1][[0, 3]]
        moves = ((a * step, b * step) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b)
        near = min((parted(level + a, max(half + b, 0.0)) for a, b in moves), key=key)
        best, step = (near, step) if near[0] < best[0] else (best, 0.5 * step)
    return best[1]


def _changing(
    effect: Callable[[], Effect], split: Callable[[Array, Array], Array]
) -> Callable[..., Iterator[Any]]:
    """A linear model of what is read less what a jump makes of it, then the level, jump and slope that leave least, and so again."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.fitting import fit
        from estimators.diagnosis.model.linear import fit_linear
        from estimators.diagnosis.model.simulation import simulate
        from estimators.diagnosis.model.structure import Part

        s, y, found = base.structure, channel.y, []
        if s.layout != "tf" or s.effects or np.mean(channel.keep) < KEPT:
            return
        e, size = effect(), float(np.std(y))
        read: Any = e.apply
        new = s.adding(Part(e, s.inputs[0]))
        at = [sl.start for part, sl in zip(s.parts, s.slices(), strict=True) if part.effect is OFFSET]
        units = [1e6 * CROSSED * size, size, 1.0, 1e6 * CROSSED * size][: len(e.parameters)]
        scales = np.concatenate((base.scales, units))

        def parted(p: Array) -> tuple[float, Array]:
            """The squares that are left, and the parameters, with the two ranges that the signal and the reading show."""
            x, p = simulate(s, p[: s.size], channel.u, channel.clock), p.copy()
            if not np.all(np.abs(x) < FARTHEST * size):
                return np.inf, p
            added = p[at].sum()  # behind the sensor
            p[s.size :] = split(x - added, y - added)
            left = y - added - read(x - added, p[s.size :], channel.clock)
            return float(left @ left), p

        def gone_on(p: Array) -> tuple[float, Array]:
            """The same after a few steps."""
            return parted(fit(channel, new, p, scales, iterations=QUICK, colour=False).p)

        def made_anew(p: Array) -> tuple[float, Array]:
            """The same of a linear part for what the upper range would have read as the lower one does."""
            x, added = simulate(s, p[: s.size], channel.u, channel.clock), p[at].sum()
            more = read(x - added, p[s.size :], channel.clock) - (x - added)
            if not np.all(np.isfinite(more)):
                return np.inf, p
            f = fit_linear(replace(channel, y=y - more), s, rough=True)
            return parted(np.concatenate((f.p, p[s.size :])))

        x = y - base.residual - base.p[at].sum()
        for level in np.quantile(x, SPLIT_AT[FEW // 2 :: FEW]):
            above = (x > level) - float(level < 0.0)
            jump = float(above @ base.residual) / max(float(above @ above), 1e-300)
            found.append(gone_on(np.concatenate((base.p, [level, jump, 0.0, 0.0][: len(units)]))))
        for best in sorted(found, key=lambda entry: entry[0])[:SPLITS]:
            for _ in range(ROUNDS):
                again = min(gone_on(best[1]), made_anew(best[1]), key=lambda entry: entry[0])
                if not again[0] < GAINING * best[0]:
                    break
                best = again
            # the linear model's noise is mostly the jumps, and would draw the fit from them
            if firm(base, best[0]):
                yield fit(channel, new, best[1], scales, iterations=10)

    return search


RANGES = Effect(
    key="output_ranges", cause="output_nonlinearity", nature=Nature.OUTPUT_STATIC, slot=Slot.OUTPUT, trials=60, curve=_ranges,
    sentence="the sensor has two ranges: above a level it reads another line, with a jump where they meet",
    apply=lambda x, p, c: _ranges(x, p), parameters={"level": "y", "jump": "y", "slope": "1"}, search=_changing(lambda: RANGES, _split),
)  # fmt: skip
AUTORANGE = Effect(
    key="output_autorange", cause="relay_with_hysteresis", nature=Nature.DYNAMIC, slot=Slot.OUTPUT, memory=True, reversing=True, trials=300,
    sentence="the sensor changes its range by itself: from one level up it reads another line, until the signal falls below a lower one",
    parameters={"level": "y", "jump": "y", "slope": "1", "half_width": "y"}, apply=_late_ranges, search=_changing(lambda: AUTORANGE, _split_late),
)  # fmt: skip
