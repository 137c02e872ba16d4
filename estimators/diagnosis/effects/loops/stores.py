"""What the input fills: a tank, a queue, a stem between its ends; and what loses by a way that saturates: a drug, a substrate, a channel."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.input import kept
from estimators.diagnosis.effects.loops.limited import NEAR, shaped

Array = NDArray[Any]
LEAKS = (0.0, 0.3, 1.0)
"""Of the linear model's slowest pole, how fast a store is taken to leak: its ends cut its time short."""
LEVELS = np.linspace(0.0, 1.0, 18)[1:-1]
"""Of the input's range, where a store without a leak may stand still: a tenth off, it is at the other end most of the time."""
FULL, FILLED = (0.1, 0.25, 0.5), (0.0, 0.1, 0.3, 1.0)
"""Of the way that it would go from one end without the other, where the other may be; and where between them it stood at first."""


def ends_of(p: Array, ends: tuple[float, float]) -> tuple[float, float, float]:
    """The empty and the full level, and where between them the parameters say that it stood: where both ends are finite, the upper one is
    the parameter before the last."""
    low, high = ends[0], abs(float(p[2])) if len(p) > 3 else ends[1]
    return low, high, min(max(float(p[-1]), low), high)


def _stored(ends: tuple[float, float]) -> Any:
    """What is in a store between two ends, of which an infinite one is none."""

    def run(x: Array, p: Array, clock: Clock) -> Array:
        from estimators.diagnosis.effects.kernels.loop_kernels import stored

        fill = lambda x, p: stored(x, abs(float(p[0])), float(p[1]), np.array(ends_of(p, ends)), clock.lead)
        return kept(fill, x, p, (ends, clock.lead))

    return run


def _between(low: float, high: float) -> Any:
    def shapes(slowest: float, u: Array) -> Iterator[list[float]]:
        from estimators.diagnosis.effects.kernels.loop_kernels import stored

        for share, level in product(LEAKS, float(u.min()) + float(np.ptp(u)) * LEVELS):
            leak = share * slowest
            end = np.array([low, np.inf if low == 0.0 else high, 0.0])
            way = float(np.ptp(stored(np.ascontiguousarray(u), leak, level, end, 0)))
            if not 0.0 < way < np.inf:
                continue
            if np.isfinite(low) and np.isfinite(high):
                yield from ([leak, level, full * way, at * full * way] for full, at in product(FULL, FILLED))
            else:
                yield from ([leak, level, (1.0 if low == 0.0 else -1.0) * at * way] for at in FILLED)

    return shapes


def _store(key: str, sentence: str, low: float, high: float) -> Effect:
    both = np.isfinite(low) and np.isfinite(high)
    parameters = (
        {"leak": "1/sample", "level": "u"} | ({"full": "u sample"} if both else {}) | {"start": "u sample"}
    )
    effect = Effect(
        key=key, cause="state_saturation", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=_stored((low, high)), sentence=sentence,
        parameters=parameters,
        search=shaped(
            lambda: effect, _between(low, high), lambda slowest, su: [slowest, su, *[su / slowest] * (len(parameters) - 2)],
            NEAR, np.eye(len(parameters)),
        ),
    )  # fmt: skip
    return effect


WORDS = "the input fills a store, a tank, a queue, a stem between stops, {}"
STORES: dict[Effect, tuple[float, float]] = {
    _store(key, WORDS.format(ends), low, high): (low, high)
    for key, ends, low, high in (
        ("store", "that gets no emptier and no fuller than at its ends", 0.0, 1.0),
        ("store_empty", "that gets no emptier than at its end", 0.0, np.inf),
        ("store_full", "that gets no fuller than at its end", -np.inf, 0.0),
    )
}
"""The effects, and the ends of each; where both are finite, the upper one is a parameter."""

CLEARS, SATURATES, HALVES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0), (0.6, 0.95), (0.3, 1.0, 3.0)
ASIDE = ((0.0, 0.5), (0.3, 0.3), (1.0, 0.5), (2.0, 1.0))
"""Of the linear model's slowest pole, how fast a little of a content is cleared; the share of that by the way that saturates; the content
at which it clears half as well, in sizes of the input; and of those rates, those to a second content and back, that are tried."""
LEAST_HALF = 1e-12  # content below which nothing is one
SWIFTEST = 4.0  # rate per sample, above which the steps within a sample are too coarse


def of_clearance(p: Array) -> Array:
    """Rate, clearance by the other ways and by the one that saturates, its half, rates to a second content and back.

    A little of the content is cleared at the rate itself: its unit is the input's.
    """
    rate, limit, half, out, back = np.abs(p)
    half = max(half, LEAST_HALF)
    return np.array([rate, 1.0 - limit / half, limit, half, out, back])


def cleared_at(level: float, known: Array) -> float:
    """Content at which as much is cleared as comes; infinite where none is."""
    share, limit, half = known[1:4]
    b, c = share * half + limit - abs(level), abs(level) * half
    root = b**2 + 4.0 * share * c
    below = b + np.sqrt(root) if root >= 0.0 else 0.0
    return float(np.copysign(2.0 * c / below, level)) if below > 0.0 else (np.inf if c else 0.0)


def _cleared(x: Array, p: Array) -> Array:
    from estimators.diagnosis.effects.kernels.loop_kernels import eliminated

    known = of_clearance(p)
    start = cleared_at(level_before(x), known)
    if not (np.isfinite(start) and max(known[0], known[4], known[5]) < SWIFTEST):
        return np.full(len(x), np.inf)
    return eliminated(x, known, start)


def _clearances(slowest: float, u: Array) -> Iterator[list[float]]:
    size = abs(float(np.mean(u))) + float(np.std(u)) + 1e-300
    for clears, share, half, (out, back) in product(CLEARS, SATURATES, HALVES, ASIDE):
        rate = clears * slowest
        yield [rate, share * half * size, half * size, out * rate, back * rate]


CLEARED: Effect = Effect(
    key="loss_saturating", cause="nonlinear_loss", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=lambda x, p, clock: kept(_cleared, x, p),
    sentence="it loses by a way that saturates, m x / (k + x), beside one in proportion and a second content that it exchanges with: elimination "
    "(Michaelis and Menten), growth (Monod), adsorption (Langmuir)",
    parameters={"rate": "1/sample", "limit": "u", "half": "u", "out": "1/sample", "back": "1/sample"}, family="losses",
    search=shaped(lambda: CLEARED, _clearances, lambda slowest, su: [slowest, su, su, slowest, slowest], NEAR, np.eye(5)),
)  # fmt: skip
