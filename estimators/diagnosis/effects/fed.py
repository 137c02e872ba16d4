"""What several inputs do together: feed a process, as two inflows a vessel or a heater beside what is around it, or multiply.

What acts on one input leaves the others to the linear part, beside the process; these go through it, each by its weight.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before, numbered
from estimators.diagnosis.effects.path import settled_through
from estimators.diagnosis.effects.process import PROCESS, Passing
from estimators.diagnosis.effects.profiled import MOST_FLOWS, firm
from estimators.residual.algebra import delayed

Array = NDArray[Any]
FED = ("rise_and_fall", "loss", "outflow_root", "vessel", "capacity_bump", "slipping")
"""Processes of their own level, which has what feeds it for a limit."""
LEAST = 1e-9  # of a weight, by which it is moved for a derivative where it is none


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


SEVERAL = tuple(_fed(e) for e in PROCESS if e.key in FED and isinstance(e.apply, Passing))


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
