"""What several inputs do together: feed a process, as two inflows a vessel or a heater beside what is around it, draw on one supply, mix, multiply.

What acts on one input leaves the others to the linear part, beside the process; these go through it, each by its weight.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before, numbered
from estimators.diagnosis.effects.loops.anew import remade
from estimators.diagnosis.effects.path import settled_through
from estimators.diagnosis.effects.process import PROCESS, Passing
from estimators.diagnosis.effects.profiled import (
    BEGUN,
    MOST_FLOWS,
    ended,
    firm,
    lean,
    of_order,
    profile,
)
from estimators.residual.algebra import delayed

Array = NDArray[Any]
FED = ("rise_and_fall", "loss", "outflow_root", "vessel", "capacity_bump", "slipping")
"""Processes of their own level, which has what feeds it for a limit."""
LEAST = 1e-9  # of a weight, by which it is moved for a derivative where it is none
DRAWS, DEMANDED = (0.2, 0.45, 1.0, 2.2, 5.0), (0.1, 0.25, 0.4, 0.55, 0.7, 0.85, 0.95)
"""Of the quotient of two inputs' mean sizes, what a unit of one draws from a common supply over a unit of the other, and the quantiles of
what they ask for together at which the supply may end, that are tried."""
SLOPES, CROSSED = (-1.0, -0.45, 0.2, 0.45, 1.0, 2.2), (0.08, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92)
"""Of the quotient of two inputs' deviations, the factors that one is set against the other by, and the quantiles of what is between them
at which the other may take over, that are tried."""
SUFFICED = 0.05  # of a record, which a supply must be enough for: one that never is divides itself by what is asked for, whatever it is
WEIGHTS = (0.001, 0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0, 1000.0)
"""Of the quotient of two inputs' means, the weights of the other in a share that are tried: at the first and the last the share is linear
in a ratio of the two, one way up or the other, to a thousandth, and no fit comes there from a weight at which both count."""
LEAST_SUM = 0.01  # of its mean, what two streams may add up to: their shares would be those of nearly none
LEAST_SLOPE = 0.05  # of that quotient: below it the other input sets no limit, and a constant does
REMADE, FURTHER = 2, (0, 1, 2)
"""Supplies that poles are made anew for, and poles that the linear part may have more than the linear model, in which what is held back
hides them."""
NOTHING = 1e-300  # a supply and what is asked of it, below which their quotient is no number


def _mixed(U: Array, channel: int, weights: Array) -> Array:
    """(N,) an input and the others, in their order, by their weights; what a search sets beside them is none of them."""
    return U[:, channel] + np.delete(U[:, : len(weights) + 1], channel, axis=1) @ weights


def _fed(e: Effect) -> Effect:
    own = len(e.parameters)

    def signal(U: Array, channel: int, p: Array, clock: Clock) -> Array:
        return e.apply(_mixed(U, channel, p[own:]), p[:own], clock)  # pyright: ignore[reportOptionalCall]

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        """What one signal would do that the inputs make by the linear model's gains; then the weights are free."""
        from estimators.diagnosis.model.fitting import fit
        from estimators.diagnosis.model.linear import fit_linear
        from estimators.diagnosis.model.structure import Part
        from estimators.diagnosis.search.candidates import Menu, augmented

        s = base.structure
        nu, plain = channel.u.shape[1], s.layout == "tf" and not s.effects
        if not plain or s.order < 1 or not 1 < nu <= MOST_FLOWS or s.inputs != tuple(range(nu)):
            return
        gains = base.p[s.order : s.order + nu * s.taps].reshape(nu, s.taps).sum(axis=1)
        j = int(np.argmax(np.abs(gains) * np.std(channel.u, axis=0)))
        if not (gains[j] and np.all(np.isfinite(gains))):
            return
        weights = np.delete(gains / gains[j], j)
        there = replace(channel, u=_mixed(channel.u, j, weights)[:, None])
        alone = fit_linear(there, replace(s, inputs=(0,)), noise=base.noise)
        found = [f for f in augmented(there, alone, Menu((e,))) if not f.structure.parts[-1].first]
        if not found:
            return
        f = min(found, key=lambda f: f.deviance)
        if not firm(base, float(np.sum(f.residual**2))):
            return
        n, taps = f.structure.order, f.structure.taps

        def widened(values: Array, elsewhere: float, more: Array) -> Array:
            """Of all inputs, the others' path beside the process so much of its own, and the weights."""
            rows = [values[n : n + taps] * (1.0 if k == j else elsewhere) for k in range(nu)]
            return np.concatenate((values[:n], *rows, values[n + taps :], more))

        p, scales = widened(f.p, 0.0, weights), widened(f.scales, 1.0, np.abs(weights) + LEAST)
        whole = replace(f.structure, inputs=s.inputs, parts=f.structure.parts[:-1]).adding(
            Part(effect, j, nu - 1)
        )
        yield fit(channel, whole, p, scales, noise=base.noise, iterations=30)

    effect = Effect(
        key=f"{e.key}_fed", cause=e.cause, nature=e.nature, slot=Slot.INPUT, trials=50, alone=True, signal=signal, search=search,
        sentence=f"several inputs feed it together: {e.sentence}", parameters=dict(e.parameters) | {"weight": "1"},
        apply=lambda x, p, clock: e.apply(x, p[:own], clock),  # pyright: ignore[reportOptionalCall]
        shape=lambda size, order: [*e.parameters.items(), *(numbered({"weight": "1"}, size) if size > 1 else [("weight", "1")])],
    )  # fmt: skip
    return effect


def _rationed(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """(N, nu) inputs, those that draw on a supply p[0] cut back in proportion where together they ask for more."""
    draws, limit = drawn(channel, p), max(abs(float(p[0])), NOTHING)
    asked = np.abs(U[:, : len(p)]) @ draws
    out = U.copy()
    out[:, np.flatnonzero(draws)] *= (limit / np.maximum(asked, limit))[:, None]
    return out


def drawn(channel: int, p: Array) -> Array:
    """(nu,) what a unit of each input draws, over one of its own: the others', in their order, are p[1:], none of what has no part in it."""
    return np.insert(np.abs(p[1:]), channel, 1.0)


def _supplied(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Every two inputs or more of which one acts here."""
    from estimators.diagnosis.model.structure import Part

    s, nu = base.structure, channel.u.shape[1]
    if s.layout != "tf" or not 1 < nu <= MOST_FLOWS:
        return
    size, moving = np.mean(np.abs(channel.u), axis=0) + NOTHING, np.flatnonzero(np.ptp(channel.u, axis=0))
    for group in (g for count in range(2, nu + 1) for g in combinations(moving.tolist(), count)):
        if not (own := set(group) & set(s.inputs)):
            continue
        j = min(own)
        ratios = np.delete(np.where(np.isin(np.arange(nu), group), size[j] / size, 0.0), j)
        steps = [float(np.std(np.abs(channel.u[:, j]))), *ratios]
        made = _made(channel, base, Part(SHARED, j, nu - 1), _supplies(channel.u, j, ratios), steps)
        asked = lambda f, j=j: np.abs(channel.u) @ drawn(j, f.p[-nu:])
        yield from (f for f in made if np.mean(asked(f) < abs(f.p[-nu])) > SUFFICED)


def _made(
    channel: Any, base: Any, part: Any, shapes: Iterator[list[float]], steps: list[float]
) -> Iterator[Any]:
    """The best of what several inputs do by one of them, with the linear model's poles, then with poles made anew, or more of them."""
    from estimators.diagnosis.model.linear import plant_scales

    s = base.structure
    tried = profile(channel, base, part, shapes)[:BEGUN]
    fits: list[Any] = []
    for more in FURTHER if s.order else ():
        few, p, scales = of_order(base, s.order + more, s.taps + more)
        anew = [remade(channel, few.adding(part), np.append(p, q[len(base.p) :])) for _, q in tried[:REMADE]]
        starts = [entry for entry in (*([] if more else tried), *anew) if np.isfinite(entry[0])]
        if not starts or not firm(base, min(left for left, _ in starts)):
            break
        scales[: few.plant_size] = plant_scales(few, min(starts, key=lambda entry: entry[0])[1])
        bare = replace(base, structure=few, p=p, scales=scales)
        fits += ended(channel, bare, part, (q for _, q in starts), steps)
    yield from lean(channel, sorted(fits, key=lambda f: f.criterion)[:1])


def _supplies(U: Array, j: int, ratios: Array) -> Iterator[list[float]]:
    """Supplies that end at quantiles of what is asked for by draws about given ones."""
    for draws in product(DRAWS, repeat=int(np.count_nonzero(ratios))):
        p = np.concatenate(([0.0], ratios))
        p[np.flatnonzero(p)] *= draws
        asked = np.abs(U) @ drawn(j, p)
        yield from ([float(limit), *p[1:]] for limit in np.quantile(asked, DEMANDED))


SHARED = Effect(
    key="shared_limit", cause="input_saturation", nature=Nature.INPUT_STATIC, slot=Slot.INPUT, trials=40, joint=True,
    sentence="inputs draw on a common supply: where together they ask for more than it gives, all are cut back in proportion",
    parameters={"limit": "u", "draw": "1"}, apply=lambda x, p, clock: np.clip(x, -abs(p[0]), abs(p[0])), signal=_rationed,
    search=_supplied,
    shape=lambda size, order: [("limit", "u"), *(numbered({"draw": "1"}, size) if size > 1 else [("draw", "1")])],
)  # fmt: skip


def _selected(least: bool) -> Effect:
    """The smaller (or larger) of an input and another one by a factor and an offset, in the first one's place."""
    pick, name = (np.minimum, "smaller") if least else (np.maximum, "larger")

    def signal(U: Array, channel: int, p: Array, clock: Clock) -> Array:
        return pick(U[:, channel], p[1] * U[:, int(p[0]) - 1] + p[2])

    def shapes(U: Array, j: int, k: int, slopes: Array) -> Iterator[list[float]]:
        """Factors about those by which the two move alike, offsets at quantiles of what keeps them apart."""
        for factor in slopes:
            apart = U[:, j] - factor * U[:, k]
            yield from ([k + 1.0, factor, float(offset)] for offset in np.quantile(apart, CROSSED))

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        """Every input that acts here with every other, be that heard here or not; of two that are, the first with the second says it all."""
        from estimators.diagnosis.model.structure import Part

        s, U = base.structure, channel.u
        moving = np.flatnonzero(np.ptp(U, axis=0)).tolist()
        if s.layout != "tf":
            return
        for j, k in permutations(moving, 2):
            if j not in s.inputs or (k in s.inputs and k < j):
                continue
            ratio = np.std(U[:, j]) / np.std(U[:, k])
            steps = [0.0, float(ratio), float(np.std(U[:, j]))]
            tried = shapes(U, j, k, ratio * np.array(SLOPES))
            made = _made(channel, base, Part(effect, j, 2), tried, steps)
            yield from (f for f in made if abs(f.p[-2]) > LEAST_SLOPE * ratio)

    effect = Effect(
        key=f"select_{'low' if least else 'high'}", cause="selector", nature=Nature.INPUT_STATIC, slot=Slot.INPUT, trials=40, alone=True,
        sentence=f"the {name} of two inputs acts, the other by a factor and an offset: a selector, an override, a limit that another signal sets",
        parameters={"selected": "1", "factor": "1", "offset": "u"}, signal=signal, search=search,
        apply=lambda x, p, clock: pick(x, p[2]),
    )  # fmt: skip
    return effect


def _shares(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """What share one input has of itself and another one by a weight; infinite where the two do not keep to one side of nothing."""
    one, other = U[:, channel], p[1] * U[:, int(p[0]) - 1]
    whole = one + other
    mean = float(np.mean(whole))
    if p[1] <= 0.0 or np.min(whole * mean) <= LEAST_SUM * mean**2:
        return np.full(len(U), np.inf)
    return one / whole


def _shared_out(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Every two inputs that flow one way, of which one acts here: its share, and that of the other, which leaves what the first does besides."""
    from estimators.diagnosis.model.structure import Part

    s, U = base.structure, channel.u
    if s.layout != "tf":
        return
    one_way = np.flatnonzero((np.ptp(U, axis=0) > 0.0) & (np.min(U, axis=0) * np.max(U, axis=0) >= 0.0))
    for pair in combinations(one_way.tolist(), 2):
        fits: list[Any] = []
        for j, k in permutations(pair):
            ratio = float(np.mean(U[:, j]) / np.mean(U[:, k]))
            if j in s.inputs and ratio > 0.0:
                tried = ([k + 1.0, ratio * weight] for weight in WEIGHTS)
                fits += _made(channel, base, Part(SHARE, j, 2), tried, [0.0, ratio])
        # where the pair does nothing else the two are one, and the first input's share is said
        yield from sorted(fits, key=lambda f: round(f.criterion))[:1]


SHARE = Effect(
    key="share", cause="mixing_ratio", nature=Nature.INPUT_STATIC, slot=Slot.INPUT, trials=len(WEIGHTS), alone=True,
    sentence="the share acts that one of two inputs has of both: streams that mix, a blend, a dilution, a ratio of air and fuel",
    parameters={"other": "1", "weight": "1"}, signal=_shares, search=_shared_out,
    apply=lambda x, p, clock: x / (np.abs(x) + abs(p[1]) + NOTHING),
)  # fmt: skip
SELECTORS = tuple(_selected(least) for least in (True, False))
SEVERAL = (
    SHARED,
    SHARE,
    *SELECTORS,
    *(_fed(e) for e in PROCESS if e.key in FED and isinstance(e.apply, Passing)),
)


LEAST_PRODUCT = 12.0
"""Likelihood ratio that the lags of a product must promise over the linear model, for its path to be fitted."""
HELD = ("other", "centre", "other_centre", "delay")
"""Parameters of a product that are no unknowns: which input, from 1, what the two are counted from, samples of delay."""


def _product(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """The product of two inputs, each about its centre, through a linear block of its own that had settled before."""
    other, *centres, delay = p[-len(HELD) :]
    pair = U[:, channel], U[:, int(other) - 1]
    before, both = ((x - centres[0]) * (y - centres[1]) for x, y in ([level_before(x) for x in pair], pair))
    return settled_through(p[: -len(HELD)], delay, before, both)


def _product_shape(size: int, order: int) -> list[tuple[str, str]]:
    held = zip(HELD, ("1", "u", "u", "sample"), strict=True)
    return numbered({"b": "y/u^2"}, size) + numbered({"f": "1"}, size) + list(held)


def _promise(channel: Any, base: Any, x: Array) -> float:
    """Likelihood ratio that a few lags of a signal promise behind the poles of the linear model, its parameters taken out."""
    s, keep = base.structure, channel.keep
    y = np.asarray(lfilter([1.0], np.concatenate(([1.0], base.p[: s.order])), x)) if s.layout == "tf" else x
    X = delayed(y[:, None], range(1, s.order + 3))
    Q = np.linalg.qr(base.jacobian[keep])[0] if base.jacobian.size else np.zeros((int(keep.sum()), 0))
    r, X = (z[keep] - Q @ (Q.T @ z[keep]) for z in (base.residual, X))
    left = r - X @ np.linalg.lstsq(X, r, rcond=1e-9)[0]
    return base.n * float(np.log((r @ r + 1e-300) / (left @ left + 1e-300)))


def _products(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Every two inputs whose product promises something, its path started from a linear fit to the residual."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part, Structure

    s = base.structure
    for i, j in combinations(sorted(s.inputs), 2):
        centres = np.mean(channel.u[channel.keep][:, [i, j]], axis=0)
        x = np.prod(channel.u[:, [i, j]] - centres, axis=1)
        if np.std(x) == 0.0 or _promise(channel, base, x - np.mean(x)) < LEAST_PRODUCT:
            continue
        residual = replace(channel, u=(x - np.mean(x))[:, None], y=base.residual, step=0.0)
        rough = [fit_linear(residual, Structure(n, (0,), delay=s.delay), rough=True) for n in (1, 2)]
        f = min(rough, key=lambda f: f.criterion)
        size = f.structure.order
        p = np.concatenate((base.p, f.p[size:], f.p[:size], [j + 1.0, *centres, 1.0 + s.delay]))
        scales = np.concatenate((base.scales, f.scales[size:], f.scales[:size], np.zeros(len(HELD))))
        yield fit(channel, s.adding(Part(PRODUCT, i, size)), p, scales, noise=base.noise)


PRODUCT = Effect(
    key="product_of_inputs", cause="product_of_inputs", nature=Nature.INPUT_STATIC, slot=Slot.PATH, trials=5,
    sentence="two inputs act through their product: one is the gain of the other",
    shape=_product_shape, signal=_product, search=_products,
)  # fmt: skip
