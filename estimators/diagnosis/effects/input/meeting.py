"""Two inputs that meet behind lags of their own: one is the gain of what the other drives, or says how fast that is lost.

A linear model has gains of each, and poles for both: what it leaves goes with the product of the two lags, whatever the law.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, combinations, permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.loops.ageing import leaky
from estimators.diagnosis.effects.profiled import (
    BEGUN,
    ENDED,
    MOST_FLOWS,
    firm,
    gained,
    lean,
    left_over,
    profile,
    quick_behind,
)
from estimators.residual.algebra import delayed

Array = NDArray[Any]
LAGS = (0.1, 2.0, 6.0, 18.0, 54.0)
"""Samples by which either input may lag, that are tried: a fit finds what lies between, and from none there is no way up."""
QUICKEST, FASTEST = 0.01, 5.0
"""Lag in samples below which there is none, and rate per sample above which all has settled within one."""
PROMISED = 40.0
"""Likelihood ratio that the product of two lags must promise over products at once: chance over those that are tried reaches 20."""
LEAST_LAG, AT_ONCE = 0.5, 3.0  # lag in samples that is one, and rate per sample of a loss that is at once
TOLD = 3  # lags in samples of a product, behind the linear model's poles, that the residual is told by
POWERS = (1.0, 2.0, 0.5, 0.0, -1.0)
"""Laws of a growth: in proportion, its square, its root, an exponential, one over a falling line."""
LOSSES = ((1.0, 0.0), (0.0, 0.0), (1.0, 1.0), (1.0, 2.0), (2.0, 0.5))
"""Of what is lost at a rate that another input sets, the law of that rate, and with which power of it the input drives: with none where a
reaction consumes or a stream cools, as fast where a flow carries both in and out, with the square where air flows by; with
the root of a loss by the square, where a field both drives and brakes a motor."""
SLOPES = (-1.0, -0.4, 0.4, 1.0)
"""Of one over twice an input's standard deviation, the slopes of a loss that are tried."""
RATES, OWN = (0.02, 0.06, 0.2, 0.6), (0.1, 4.0)
"""Rates per sample of a loss, and lags in samples of what it is lost from, that are tried."""
STEPS, LAST = 16, 3
"""Steps that a start is followed for, in which a lag may halve and double again, and starts that are fitted to the end."""
HALF = 0.5  # of a loss, what an exponential is at first
LEAST = 1e-300  # a size of an input without which no quotient is a number
MOSTLY = 0.9  # of a loss, what another input at first sets, where that need not be all
SLIGHT = 0.05  # of its spread, by which what is lost is at first taken to move the other input


def _pair(U: Array, channel: int, other: float) -> tuple[Array, Array]:
    return np.ascontiguousarray(U[:, channel]), np.ascontiguousarray(U[:, int(other) - 1])


def _lags(p: Array) -> Array:
    return np.maximum(np.abs(p), QUICKEST)


def _product(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """p: level, two lags, slope; the other input, from 1, its centre, the power."""
    from estimators.diagnosis.effects.kernels.meeting_kernels import met

    if not np.all(np.isfinite(p)):
        return np.full(len(U), np.inf)
    one, other = _pair(U, channel, p[4])
    law = np.array([p[0], p[3], p[5], p[6]])
    return met(one, other, law, _lags(p[1:3]), (level_before(one), level_before(other)))


def lost_by(p: Array) -> Array | None:
    """(7,) the law of a loss; None where its rate or its share is none, or a number is missing."""
    law = np.array([abs(p[0]), *p[4:7], *p[8:11]])
    return law if np.all(np.isfinite(p)) and 0.0 < law[0] < FASTEST and 0.0 < law[2] <= 1.0 else None


def _lost(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """p: rate, level, two lags, slope, share, rise; the other input, from 1, its centre, power and drive."""
    from estimators.diagnosis.effects.kernels.meeting_kernels import at_rest, lost

    if (law := lost_by(p)) is None:
        return np.full(len(U), np.inf)
    one, other = _pair(U, channel, p[7])
    w, v = level_before(one) - p[1], level_before(other)
    x, v = at_rest(w, v, law)
    return (
        lost(one - p[1], other, law, _lags(p[2:4]), (w, x, v)) if np.isfinite(x) else np.full(len(U), np.inf)
    )


def _late(x: Array, lag: float) -> Array:
    """A signal behind a lag that had settled on its level before."""
    return x if lag < 1.0 else leaky(x, lag)


def _promises(channel: Any, base: Any, j: int, k: int) -> float:
    """The largest likelihood ratio that products of two lags, bent or not, promise behind the linear model's poles over that of products
    at once, its parameters taken out: what needs no lag has names of its own."""
    s, (r, Q) = base.structure, left_over(channel, base)
    noise, keep = np.concatenate(([1.0], base.noise)), channel.keep
    den = np.concatenate(([1.0], base.p[: s.order]))

    def promised(w: Array, v: Array) -> float:
        bent = (np.asarray(lfilter(noise, den, z - np.mean(z)))[:, None] for z in (w * v, w * v**2, w**2 * v))
        X = np.where(keep[:, None], np.hstack([delayed(x, range(1, TOLD + 1)) for x in bent]), 0.0)
        X -= Q @ (Q.T @ X)
        left = r - X @ np.linalg.lstsq(X, r, rcond=1e-9)[0]
        return gained(base.n, float(r @ r), float(left @ left))

    one, other = (channel.u[:, i] - np.mean(channel.u[:, i]) for i in (j, k))
    late = ([_late(x, lag) for lag in LAGS] for x in (one, other))
    return max(promised(w, v) for w, v in product(*late)) - promised(one, other)


def _met(channel: Any, base: Any, j: int, k: int) -> list[tuple[float, Array]]:
    """(sum of squares, level, lags, slope) of products in proportion: of each two lags, the poles and gains of both inputs and of their
    product are made anew, and tell the slope."""
    from estimators.diagnosis.model.linear import fresh_poles, numerators

    s, keep, found = base.structure, channel.keep, []
    m, at = len(s.inputs), s.inputs.index(j)
    bare, y = replace(s, parts=(), inputs=tuple(range(m + 1))), channel.y - np.mean(channel.y[keep])
    for lags in product(LAGS, LAGS):
        w, v = (
            _late(channel.u[:, i] - np.mean(channel.u[:, i]), lag)
            for i, lag in zip((j, k), lags, strict=True)
        )
        U = np.column_stack((channel.u[:, list(s.inputs)], w * v))
        U[:, at] = w
        U -= np.mean(U[keep], axis=0)
        f = fresh_poles(channel.y, U, bare, keep, begun=True)
        b = numerators(y, U, f, s.taps, s.delay, keep)
        X = np.asarray(lfilter([1.0], np.concatenate(([1.0], f)), U, axis=0))
        X = np.hstack([delayed(x[:, None], range(1 + s.delay, s.taps + s.delay + 1)) for x in X.T])
        rows = b.reshape(m + 1, s.taps)
        left = float(np.sum((y - X @ b)[keep] ** 2))
        own, both = rows[at].sum(), rows[-1].sum()
        if np.isfinite(left) and own:
            found.append((left, np.array([0.0, *lags, both / own])))
    return sorted(found, key=lambda entry: entry[0])


def _ended(channel: Any, base: Any, starts: list[tuple[Any, Array, Array]]) -> Iterator[Any]:
    """The best of starts of any law after a few steps, fitted to the end."""
    from estimators.diagnosis.model.fitting import fit

    begun = [fit(channel, s, p, z, noise=base.noise, iterations=STEPS, colour=False) for s, p, z in starts]
    for f in sorted(begun, key=lambda f: f.deviance)[:LAST]:
        if np.isfinite(f.deviance):
            yield fit(channel, f.structure, f.p, f.scales, noise=base.noise, iterations=30)


def _products(channel: Any, base: Any, j: int, k: int) -> Iterator[Any]:
    """Products by every law, from the lags and slopes that proportion tells best."""
    from estimators.diagnosis.effects.loops.anew import remade
    from estimators.diagnosis.model.structure import Part

    u, v = channel.u[:, j], channel.u[:, k]
    centre, size = float(np.mean(v)), float(np.std(v))
    s = base.structure.adding(Part(PRODUCT_OF_LAGS, j))
    scales = np.concatenate((base.scales, [np.std(u), 1.0, 1.0, 1.0 / size, 0.0, 0.0, 0.0]))
    shapes = [q for _, q in _met(channel, base, j, k)[:BEGUN]]
    tried = [
        (*remade(channel, s, np.concatenate((base.p, q, [k + 1.0, centre, power]))), power)
        for q, power in product(shapes, POWERS)
    ]
    best = [sorted((t for t in tried if t[2] == power), key=lambda t: t[0])[:ENDED] for power in POWERS]
    starts = [(s, p, scales) for left, p, _ in chain(*best) if np.isfinite(left)]
    yield from _ended(channel, base, starts)


def _losses(channel: Any, base: Any, j: int, k: int) -> Iterator[Any]:
    """Losses by every law, before a quick linear part; of what the best leaves, what is lost may move the other input."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.structure import Part

    u, v = channel.u[:, j], channel.u[:, k]
    centre, size = float(np.mean(v)), float(np.std(v))
    rise = size / (float(np.std(u)) + abs(float(np.mean(u))) + LEAST)
    part, quick = Part(LOSS_BY_LAG, j), quick_behind(channel, base)[0]
    structure = quick.structure.adding(part)
    shapes = (
        [rate, 0.0, own, lag, slope / size, HALF if power == 0.0 else 1.0, 0.0, k + 1.0, centre, power, drive]
        for (power, drive), rate, own, lag, slope in product(LOSSES, RATES, OWN, LAGS[:-1], SLOPES)
    )
    tried, starts = profile(channel, quick, part, shapes), []
    for law in LOSSES:
        free = np.array([0.05, float(np.std(u)), 1.0, 1.0, 1.0 / size, 0.1 * (law[0] == 0.0), *np.zeros(5)])
        best = [p for _, p in tried if tuple(p[-2:]) == law][:ENDED]
        starts += [(structure, p, np.concatenate((quick.scales, free))) for p in best]
    for f in _ended(channel, base, starts):
        yield f
        p, scales, own = f.p.copy(), f.scales.copy(), f.structure.slices()[-1]
        scales[own][1] = float(np.std(u))
        if p[-1] == 0.0:
            p[own][6], scales[own][6] = SLIGHT * rise, rise
        else:
            p[own][5], scales[own][5] = MOSTLY, 0.1
        yield fit(channel, f.structure, p, scales, noise=base.noise, iterations=30)


def _remembers(f: Any) -> bool:
    """Whether either input of a product lags, and a loss takes its time: else it is the product of two inputs, which has its own name."""
    part, q = f.structure.parts[-1], np.abs(f.p[f.structure.slices()[-1]])
    return bool(q[0] < AT_ONCE if part.effect is LOSS_BY_LAG else max(q[1:3]) > LEAST_LAG)


def _searched(own: Any) -> Any:
    """The search of every two inputs whose lags' product promises something."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        s, U = base.structure, channel.u
        if s.layout != "tf" or s.order < 1 or not 1 < U.shape[1] <= MOST_FLOWS:
            return
        moving = np.flatnonzero(np.ptp(U, axis=0)).tolist()
        for pair in combinations(moving, 2):
            if not set(pair) & set(s.inputs) or _promises(channel, base, *pair) < PROMISED:
                continue
            for j, k in permutations(pair):
                made = own(channel, base, j, k) if j in s.inputs else ()
                better = (f for f in made if firm(base, float(np.sum(f.residual**2))))
                yield from (f for f in lean(channel, better) if _remembers(f))

    return search


PRODUCT_OF_LAGS = Effect(
    key="product_of_lags", cause="product_of_inputs", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=100, alone=True,
    sentence="one input is the gain of another, each behind a lag of its own, by a power or an exponential of it",
    parameters={"level": "u", "lag": "sample", "other_lag": "sample", "slope": "1/u", "other": "1", "centre": "u", "power": "1"},
    apply=lambda x, p, clock: x - p[0], signal=_product, search=_searched(_products),
)  # fmt: skip
LOSS_BY_LAG = Effect(
    key="loss_by_lag", cause="bilinear", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=300, alone=True,
    sentence="another input, behind a lag of its own, says how fast what this one drives is lost, and with it how strongly it drives: "
    "a reaction's temperature, a flow, an air speed",
    parameters={"rate": "1/sample", "level": "u", "lag": "sample", "other_lag": "sample", "slope": "1/u", "share": "1", "rise": "1", "other": "1",
                "centre": "u", "power": "1", "drive": "1"},
    apply=lambda x, p, clock: x, signal=_lost, search=_searched(_losses),
)  # fmt: skip
MEETING = (PRODUCT_OF_LAGS, LOSS_BY_LAG)
