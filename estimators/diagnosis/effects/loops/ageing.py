"""What a gain, a lag or a wall before the linear part comes to with time and use: worn, tired, warm, run in, fouled.

The gain of what is used up or warmed follows a slow hidden state; what ages follows the clock.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Grid, Nature, Sizes, Slot, level_before

Array = NDArray[Any]
SOON, SOONEST, SLOWEST = 0.4, 0.02, 0.999
"""Part of the record in which a lag does most of its change: the start, and the least; slowest pole that it is compared with."""
LAGS = ((0.03, 0.3), (0.1, 1.0), (0.7, -0.6))
"""Lags at the start of a record and by how much they grow, over the slowest time constant, that are tried."""
CHANGES = (-0.25, 0.3, 0.8)  # relative changes of a coefficient over the record that are tried
USES = (0.3, 1.0, 3.0)  # share of a gain that the mean input uses up, of what is left of it, that are tried
WEARS, WORN_BY, MOST_WOUND, MOST_WORN = (0.3, 1.0, 5.0, 25.0), (-1.0, 0.5, 1.0), 2.0, 4.0
"""What all that passes in a record adds to a resistance, a radius of 1, that is tried; the powers of it that a gain falls with, that are
tried, and the largest that it grows and falls with: what is wound grows with it itself or its root, a cake under a given pressure has
a half, a given flow through it 1, more is nearly exponential."""
AGEING = (0.05, 0.1, 0.2, 0.4, 0.8, 2.0)
"""Time constants, in records, of a gain that settles, that are tried: what it has more of itself at the start follows from each."""
RESETS, SHORTEST, LEAST_CYCLES = 24, 3.0, 1.5
"""Instants within a cycle at which a gain may begin its course anew that are tried; samples of the shortest cycle, and how many a record has at least."""
EXCHANGED, OUTSIDE, FOULS, NEARS = (0.6,), (-3.0, 3.0), (-0.3, 0.6), (0.15, 0.6)
"""Of what changes a content, the share that the input exchanges; level of the rest, in standard deviations of the input about its mean;
relative changes of the exchange's resistance in the end, and time constants in records towards it, that are tried."""
MOST_FOULED = -0.95  # of the resistance, what may be lost
SECOND_POLE = 0.3  # where each further pole of what follows a wall starts
MEMORIES = (0.05, 0.2)  # of the record: time constants of a slow state that are tried


def leaky(x: Array, time: float) -> Array:
    """Leaky integral of unit gain of a signal, with a time constant in samples; it rests where the signal stood before.

    Infinite where that is less than a sample: what follows at once is no state, and says nothing of its time.
    """
    from scipy.signal import lfilter

    if abs(time) < 1.0:
        return np.full(len(x), np.inf)
    pole = float(np.exp(-1.0 / abs(time)))
    level = level_before(x)
    return level + np.asarray(lfilter([1.0 - pole], [1.0, -pole], x - level))


def _tired(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import used_up

    use, recovery = abs(float(p[0])), abs(float(p[1])) + 1e-300
    return used_up(np.ascontiguousarray(x), use, recovery, level_before(x))


def _worn(x: Array, p: Array, clock: Clock) -> Array:
    """What has passed, in the middle of each sample, counted from the record on: an experiment begins with what is clean."""
    through = np.where(np.arange(len(x)) < clock.lead, 0.0, np.abs(x))
    passed = np.cumsum(through) - 0.5 * through
    return x * (1.0 + abs(float(p[0])) * passed) ** worn_by(p)


def worn_by(p: Array) -> float:
    """Power of what has added up that a gain goes with: negative where it falls."""
    return -float(np.clip(p[1], -MOST_WOUND, MOST_WORN))


def _settling(x: Array, p: Array, clock: Clock) -> Array:
    return x * (1.0 + p[0] * np.exp(-np.maximum(clock.turn, 0.0) / max(abs(float(p[1])), SOONEST)))


def _since_reset(clock: Clock, p: Array) -> Array:
    """Mean over each sample of 1 + a s + b s^2, s the share of a cycle of p[0] samples since it began, as it did at the time p[1]."""
    a, b = p[2:]

    def summed(t: Array) -> Array:
        s = t - np.floor(t)
        return np.floor(t) * (1.0 + a / 2.0 + b / 3.0) + s + a * s**2 / 2.0 + b * s**3 / 3.0

    t = (clock.k - p[1]) / p[0]
    return p[0] * (summed(t + 1.0 / p[0]) - summed(t))


def _cycling(x: Array, p: Array, clock: Clock) -> Array:
    if not SHORTEST <= p[0] <= clock.length / LEAST_CYCLES:
        return np.full(len(x), np.inf)
    return x * _since_reset(clock, p)


def _cycles(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """At the frequencies that the residual has in common with each input, from the instants in a cycle that explain most of it."""
    from estimators.diagnosis.effects.profiled import (
        ended,
        entering,
        firm,
        in_common,
        lean,
        left_over,
        rotating,
        through,
    )
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import renewed

    s = base.structure
    for j, u in entering(channel, base) if not s.effects else ():
        part, passed = Part(CYCLING, j), partial(through, base, j)
        (r, Q), starts = left_over(channel, base), []
        for w, *_ in rotating(channel, base, u, passed):
            every = 2.0 * np.pi / w
            begins = every * np.arange(RESETS) / RESETS
            courses = [
                _since_reset(channel.clock, np.array([every, at, *c])) - 1.0
                for c in np.eye(2)
                for at in begins
            ]
            D = passed(u[:, None] * np.stack(courses, axis=1))
            told, (a, b) = in_common(D - Q @ (Q.T @ D), r)
            for i in np.argsort(-told)[:2]:
                first = np.concatenate((base.p, [every, begins[i], a[i], b[i]]))
                starts += [first, *renewed(channel, s.adding(part), first)]
        fits = lean(channel, ended(channel, base, part, starts, [1.0, 1.0, 1.0, 1.0]))
        yield from (f for f in fits if firm(base, float(np.sum(f.residual**2))))


def _with_wear(s: Sizes) -> Grid:
    total = float(np.sum(np.abs(s.u))) + 1e-300
    return [[f / total, power] for f in WEARS for power in WORN_BY], [1.0 / total, 0.5]


def _warmed(x: Array, p: Array, clock: Clock) -> Array:
    warm = leaky(x**2, p[1])
    return x * (1.0 + p[0] * warm) if np.all(np.isfinite(warm)) else warm


def _with_use(s: Sizes) -> Grid:
    n, size = len(s.u), float(np.mean(np.abs(s.u))) + 1e-300
    return [[f / (m * n * size), 1.0 / (m * n)] for f in USES for m in MEMORIES], [
        10.0 / (n * size),
        10.0 / n,
    ]


def with_heat(s: Sizes) -> Grid:
    """Shares of the squared input and time constants of a slow state that it feeds."""
    size = s.su**2 + float(np.mean(s.u)) ** 2
    return [[f / size, m * len(s.u)] for f in CHANGES for m in MEMORIES], [1.0 / size, float(len(s.u)) / 10.0]


def _slowing(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import lagged

    times = np.abs(p[0]) - p[1] * np.expm1(-np.maximum(clock.turn, 0.0) / max(abs(float(p[2])), SOONEST))
    return lagged(np.ascontiguousarray(x), times) if times.min() >= 0.0 else np.full(len(x), np.inf)


def _slowings(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The lag takes the place of one of the linear model's poles, or of all but one: they bent to stand for what it is on average."""
    from estimators.diagnosis.effects.profiled import ended, firm
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part

    s = base.structure
    if s.layout != "tf" or s.effects or s.order < 1:
        return
    for order in sorted({1, max(s.order - 1, 1)}):
        few = fit_linear(channel, replace(s, order=order, taps=min(s.taps, order)))
        poles = np.abs(np.roots(np.concatenate(([1.0], few.p[:order]))))
        slow = -1.0 / np.log(min(max(float(poles.max()), 0.05), SLOWEST))
        begun = [np.concatenate((few.p, [a * slow, b * slow, SOON])) for a, b in LAGS]
        fits = ended(channel, few, Part(SLOWING, s.inputs[0]), begun, [slow, slow, SOON])
        yield from (f for f in fits if firm(base, float(np.sum(f.residual**2))))


def _fouling(p, v, u, q, s, c):
    return c[0] * (1.0 - s) * (u - p) + (1.0 - c[0]) * (u - c[1])


def _fouled(x: Array, p: Array, clock: Clock) -> Array:
    """x' = rate (share g (u - x) + (1 - share) (level - x)), g = 1 / (1 + more (1 - exp(-t / memory))): what exchanges with the input
    through a wall whose resistance nears an end, and with a stream of another level."""
    from estimators.diagnosis.effects.input import kept
    from estimators.diagnosis.effects.process import FASTEST
    from estimators.diagnosis.model.layouts import Inside, states

    rate, (share, level, more, memory) = abs(float(p[0])), p[1:]
    if not (0.0 < rate < FASTEST and more > MOST_FOULED and memory > 0.0):
        return np.full(len(x), np.inf)
    grown = more * -np.expm1(-np.maximum(clock.turn, 0.0) / memory)
    own, passes = min(abs(share), 1.0), 1.0 / (1.0 + np.append(grown, grown[-1:]))

    def run(x: Array, p: Array) -> Array:
        begun = own * passes[0], 1.0 - own
        start = np.array([np.average([level_before(x), level], weights=begun)])
        inside = Inside(((_fouling, np.array([own, level]), passes),))
        return states("first", np.log([rate]), np.append(x, x[-1:]), inside, start)[1:, 0]

    return kept(run, x, p, (_fouling, grown.tobytes()))


def _denser(channel: Any, fits: Iterable[Any], most: int) -> Iterator[Any]:
    """Each fit, and with one pole more after the other behind its process for as long as Schwarz's criterion falls."""
    from estimators.diagnosis.effects.profiled import of_order
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import plant_scales, relinearised

    for f in fits:
        yield f
        while (order := f.structure.order + 1) <= most:
            more, p, scales = of_order(f, order, f.structure.taps)
            p[:order] = np.polymul(np.append(1.0, f.p[: order - 1]), (1.0, -SECOND_POLE))[1:]
            p = p if (q := relinearised(channel, more, p)) is None else q
            scales[: more.plant_size] = plant_scales(more, p)
            wider = fit(channel, more, p, scales, noise=f.noise, iterations=30)
            if not wider.criterion < f.criterion:
                break
            f = wider
            yield f


def _walls(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Every input, at the rates of the linear model's poles and of most rigs, before a quick linear part, then before more poles."""
    from estimators.diagnosis.effects.process import profiled_fits
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import sizes_of

    s = base.structure
    for j in s.inputs if s.layout == "tf" and s.order else ():
        part = Part(FOULED, j)
        sizes = sizes_of(channel, base, part)
        mean = float(np.mean(channel.u[:, j]))
        shapes = product(sizes.rates, EXCHANGED, OUTSIDE, FOULS, NEARS)
        grid = ([rate, share, mean + at * sizes.su, more, near] for rate, share, at, more, near in shapes)
        yield from _denser(
            channel,
            profiled_fits(channel, base, part, grid, [max(sizes.rates), 1.0, sizes.su, 1.0, 1.0]),
            s.order,
        )


SLOWING = Effect(
    key="lag_drift", cause="parameter_drift", family="drifts", nature=Nature.TIME, slot=Slot.OUTPUT, memory=True, linear=True, trials=10,
    sentence="one lag grows with time, or shrinks, and nears an end: a sensor that is fouled", apply=_slowing, search=_slowings,
    parameters={"lag": "sample", "growth": "sample", "memory": "record"},
)  # fmt: skip

SETTLES = Effect(
    key="gain_settles", cause="gain_drift", family="drifts", nature=Nature.TIME, slot=Slot.INPUT, trials=10, apply=_settling, amplitude=0,
    sentence="the gain falls with time, or grows, and nears an end: a catalyst, a lamp that runs in",
    starts=lambda s: ([[0.05, m] for m in AGEING], [1.0, 0.1]), parameters={"more": "1", "memory": "record"},
)  # fmt: skip
WORN = Effect(
    key="gain_worn", cause="slow_hidden_state", family="heat", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=10, apply=_worn,
    sentence="the gain falls, or grows, with all that has passed since the record began: a filter that clogs, a tool, a coil that is wound",
    starts=_with_wear, parameters={"wear": "1/(u sample)", "power": "1"},
)  # fmt: skip
FOULED = Effect(
    key="exchange_fouled", cause="fouling", nature=Nature.TIME, slot=Slot.INPUT, trials=60, alone=True, family="drifts",
    sentence="a wall between the input and what it heats or fills gains resistance with time, towards an end: fouling, scale",
    parameters={"rate": "1/sample", "share": "1", "level": "u", "more": "1", "memory": "record"}, apply=_fouled, search=_walls,
)  # fmt: skip
CYCLING = Effect(
    key="gain_cycle", cause="periodic_gain", family="drifts", nature=Nature.TIME, slot=Slot.INPUT, trials=0.5, per_sample=True, apply=_cycling,
    sentence="the gain runs the same course over and over by the clock, 1 + a s + b s^2 with s from 0 to 1: what fouls and is cleaned, a battery that is changed",
    parameters={"period": "sample", "begins": "sample", "slope": "1", "bend": "1"}, search=_cycles,
)  # fmt: skip
AGED = (
    Effect(key="gain_fatigue", cause="slow_hidden_state", family="heat", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=10, apply=_tired,
           sentence="the gain is used up by the input and recovers slowly: fatigue, a depleted store", starts=_with_use,
           parameters={"use": "1/(u sample)", "recovery": "1/sample"}),
    SETTLES,
    WORN,
    Effect(key="gain_heat", cause="slow_hidden_state", family="heat", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=10,
           apply=_warmed,
           sentence="the gain follows a slow state that the squared input feeds: heat", starts=with_heat,
           parameters={"share": "1/u^2", "time": "sample"}),
    SLOWING,
    FOULED,
    CYCLING,
)  # fmt: skip
