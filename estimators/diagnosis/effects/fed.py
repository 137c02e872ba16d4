"""Processes that several inputs feed together: a vessel with two inflows, a heater beside what is around it.

What acts on one input leaves the others to the linear part, beside the process; these go through it, each by its weight.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Slot, numbered
from estimators.diagnosis.effects.process import PROCESS, Passing
from estimators.diagnosis.effects.profiled import MOST_FLOWS, firm

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
