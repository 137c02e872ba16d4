"""Sensors that lose what they read while it moves too fast, and show their last good reading: an echo, an image, a target."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.output import KEPT
from estimators.diagnosis.effects.profiled import FIRM, firm, gained, left_over
from estimators.diagnosis.effects.sensing.sensors import settled

Array = NDArray[Any]
LOST_FROM = np.linspace(0.5, 0.98, 13)
"""Quantiles of the linear model's steps from sample to sample at which a sensor may lose what it reads, where no repeats say."""
JUMPS, STANDS = (0.8, 0.9, 0.95), 0.3
"""Quantiles of the reading's steps from which on one may be a jump back to the signal, and the part of it that a reading that stands
before moves at most."""
LIMITS = np.concatenate((np.linspace(0.1, 0.9, 17), np.linspace(0.91, 1.0, 19)))
"""Quantiles of a signal's rates that are tried as the limit; then the rates between the two next to the best."""
SIZES, EARLY = (1, 3), (0, 1, 2)
"""Poles, and one more, and samples of delay that are tried beside the linear model's where repeats say what is read."""
INSTANTS = (0.0, 0.5)
"""Samples after the middle of a step, of which the rate may count: that of the step itself, and at its end."""
BEGUN, ROUNDS, FURTHER, GAINING = 2, 5, 60, 0.999
"""Starts that are gone on from; rounds of a limit and a linear part for what is read then; rates between two quantiles, at most;
and the share of the squares that must be left for another round."""


def _rates(x: Array, instant: float) -> Array:
    """(N,) sizes of the rate, that of each step carried on by the last two to a later instant."""
    steps = np.diff(x, prepend=x[:1])
    return np.abs(steps + instant * np.diff(steps, prepend=0.0))


def _last_good(x: Array, good: Array) -> Array:
    return x[np.maximum.accumulate(np.where(good, np.arange(len(x)), 0))]


def _kept(x: Array, p: Array, clock: Clock) -> Array:
    x = settled(x, clock)
    return _last_good(x, _rates(x, float(p[1])) <= abs(float(p[0])))


def _limit(channel: Any, x: Array, instant: float) -> tuple[float, float, float]:
    """The sum of squares that the best limit leaves of a signal (N,), the limit, between two rates, and the instant."""
    rates = _rates(x, instant)

    def best(limits: Array) -> tuple[float, float, float]:
        left = lambda limit: float(np.sum((channel.y - _last_good(x, rates <= limit))[channel.keep] ** 2))
        return min((left(limit), float(limit), instant) for limit in limits)

    grid = np.quantile(rates, LIMITS)
    found = best(grid)
    at = int(np.argmin(np.abs(grid - found[1])))
    near = np.sort(rates[(rates >= grid[max(at - 1, 0)]) & (rates <= grid[min(at + 1, len(grid) - 1)])])
    middles = 0.5 * (near[1:] + near[:-1])
    return min(found, best(middles[:: len(middles) // FURTHER + 1])) if len(middles) else found


def _promising(channel: Any, base: Any) -> list[NDArray[np.bool_]]:
    """Samples (N,) that may be held, where the residual has much in common with what a sensor does that shows none of the linear
    model's quick motion: that motion, and readings that stand until they jump."""
    x, (r, Q) = channel.y - base.residual, left_over(channel, base)
    rates, found = _rates(x, 0.0), []
    for limit in np.quantile(rates[channel.keep], LOST_FROM):
        d = np.where(channel.keep, _last_good(x, rates <= limit) - x, 0.0)
        d -= Q @ (Q.T @ d)
        common = float(d @ r) ** 2 / max(float(d @ d), 1e-300) if d @ r > 0.0 else 0.0
        found.append((gained(base.n, float(r @ r), float(r @ r) - common), limit))
    promise, limit = max(found)
    if promise < FIRM:
        return []
    steps = np.abs(np.diff(channel.y, prepend=channel.y[:1]))
    return [rates > limit, *(_standing(steps, float(np.quantile(steps, q))) for q in JUMPS)]


def _standing(steps: Array, jump: float) -> NDArray[np.bool_]:
    """(N,) samples that stand until a jump."""
    held, still = np.zeros(len(steps), dtype=bool), steps < STANDS * jump
    for k in range(len(steps) - 2, 0, -1):
        held[k] = still[k] and (held[k + 1] or steps[k + 1] > jump)
    return held


# criterion, linear fit, squares left with a limit and its instant
_Made = tuple[float, Any, tuple[float, float, float]]
NONE: _Made = (np.inf, None, (np.inf, 0.0, 0.0))


def _first(entry: _Made) -> float:
    return entry[0]


def _made(channel: Any, base: Any, held: NDArray[np.bool_], later: tuple[int, ...]) -> _Made:
    """The best linear model of what is not held, with the limit that leaves least."""
    from estimators.diagnosis.model.shown import as_shown
    from estimators.diagnosis.model.simulation import simulate

    best = NONE
    if np.mean(channel.keep & ~held) > 1.0 - KEPT:
        for f in as_shown(channel, base, channel.y, ~held, (-base.structure.delay, *later)):
            x = simulate(f.structure, f.p, channel.u, channel.clock)
            if np.all(np.isfinite(x)):
                shape = min(_limit(channel, x, instant) for instant in INSTANTS)
                price = base.n * np.log(max(shape[0], 1e-300)) + f.size * np.log(base.n)
                best = min(best, (price, f, shape), key=_first)
    return best


def _again(channel: Any, base: Any, best: _Made) -> _Made:
    """The same of what the limit says is not held, for as long as the squares fall."""
    from estimators.diagnosis.model.shown import LATER
    from estimators.diagnosis.model.simulation import simulate

    for _ in range(ROUNDS if firm(base, best[2][0]) else 0):
        _, f, (left, limit, instant) = best
        x = simulate(f.structure, f.p, channel.u, channel.clock)
        more = _made(channel, base, _rates(x, instant) > limit, LATER)
        if not more[2][0] < GAINING * left:
            break
        best = more
    return best


def _lost(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A linear model of the samples that are read, the limit by which it leaves least, and, where no repeats say which are read, so
    again with what that tells."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.shown import LATER
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.record.measurement import held_in_motion

    s = base.structure
    if s.layout != "tf" or s.effects or np.mean(channel.keep) < KEPT:
        return
    told = held_in_motion(channel.u, channel.y)
    if told.any():
        # what is held looks late, and like more poles than the signal has
        sizes = SIZES if s.order <= SIZES[-1] else (*SIZES, s.order)
        forms = (replace(s, order=n, taps=n) for n in sizes)
        ways = (*(d - s.delay for d in EARLY), *LATER)
        found = [_made(channel, replace(base, structure=form), told, ways) for form in forms]
    else:
        starts = sorted((_made(channel, base, held, (0,)) for held in _promising(channel, base)), key=_first)
        found = [_again(channel, base, best) for best in starts[:BEGUN]]
    _, f, (left, *shape) = min(found, key=_first, default=NONE)
    if f is not None and firm(base, left):
        # the linear model's noise is mostly what is held, and would draw the fit from the rest
        new, scales = f.structure.adding(Part(LOST_IN_MOTION, s.inputs[0])), np.append(f.scales, [0.0, 0.0])
        yield fit(channel, new, np.append(f.p, shape), scales, iterations=10)


LOST_IN_MOTION = Effect(
    key="held_in_motion", cause="dropouts", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, trials=60,
    sentence="the sensor loses what it reads while that moves by more than a limit, and shows its last good reading", apply=_kept,
    parameters={"limit": "y/sample", "instant": "sample"}, search=_lost,
)  # fmt: skip
