"""Whole models of an output as a step in CasADi's symbols: linear, with named effects, discovered."""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Slot
from estimators.diagnosis.effects.symbols.parts import REMEDY, acted, blocked, inside_plant, rationed
from estimators.diagnosis.effects.symbols.terms import factor_term
from estimators.diagnosis.effects.symbols.wiring import Wiring

Array = NDArray[Any]


def linear(w: Wiring, inputs: tuple[int, ...], model: Any, prior: Any) -> Any:
    """Output of a linear model, started as `LinearModel.free_run` starts without a window."""
    level = w.level[list(inputs)]
    before = 0.0 * level if prior.rest else level
    m = max(len(model.den), model.num.shape[1]) - 1
    b, a = (
        np.concatenate((c, np.zeros((len(c), m + 1 - c.shape[1]))), axis=1)
        for c in (model.num, model.den[None])
    )
    past = model.before(prior, level, m)
    start = [before @ b[:, i:].sum(axis=1) - a[0, i:] @ past[: m + 1 - i] for i in range(1, m + 1)]
    return w.rational(model.num, model.den, [w.u[j] for j in inputs], model.constant, np.array(start))


def through(w: Wiring, signal: Any, behind: Any) -> Any:
    """Output of a linear model whose last input is a signal of another model."""
    own = Wiring(np.append(w.level, w.value(signal)), w.output)
    own.u, own.k = [*w.u, signal], w.k
    y = linear(own, behind.inputs, behind.model, behind.untold)
    w.states += own.states
    return y


def structured(w: Wiring, s: Any, p: Array, clock: tuple[int, int], lead: int, ahead: bool) -> Any:
    """Output of a structure after `lead` samples of the constant inputs; clock: its sample at k = 0, and its length.

    Where the input acts in the sample in which it is measured (`ahead`), the plant's states are those of the sample before.
    """
    from estimators.diagnosis.model.simulation import SETTLE

    own = Wiring(w.level, w.output)
    own.u, own.k = w.u, w.k
    k = w.k + float(clock[0])
    y = _plant(own, s, p, k - 1.0 if ahead else k, clock[1])
    y = own.ahead(y) if ahead else y
    for slot in (Slot.OUTPUT, Slot.ADDED):
        for part, sl in zip(s.parts, s.slices(), strict=True):
            if part.effect.slot is slot:
                y = acted(own, part, y, p[sl], k, clock[1])
    if any(part.effect.settles for part in s.parts):
        own.run(np.zeros((SETTLE, len(w.level))), np.full(SETTLE, -float(lead)))
    lead -= ahead
    own.run(np.tile(w.level, (max(lead, 0), 1)), np.arange(-max(lead, 0), 0.0))
    w.states += own.states
    return y


def _plant(w: Wiring, s: Any, p: Array, k: Any, length: int) -> Any:
    """Output of the linear part and the paths beside it, behind the effects that act on the inputs."""
    parts = list(zip(s.parts, s.slices(), strict=True))
    U = {j: w.u[j] for j in s.inputs}
    for part, sl in parts:
        if part.effect.joint:
            U = rationed(w, part, U, p[sl])
        elif part.effect.slot is Slot.INPUT:
            U[part.channel] = acted(w, part, U[part.channel], p[sl], k, length)
        elif part.effect.slot in (Slot.PLANT, Slot.FORM):
            U[part.channel] = blocked(w, part, U[part.channel], p[sl])
    if s.layout == "tf":
        b = p[s.order : s.plant_size].reshape(len(s.inputs), s.taps)
        num = [np.concatenate((np.zeros(1 + s.delay), row)) for row in b]
        y = w.rational(num, np.concatenate(([1.0], p[: s.order])), list(U.values()))
    else:
        y = inside_plant(w, s, p, U[s.inputs[0]])
    for part, sl in parts:
        if part.effect.slot is Slot.PATH and part.effect.apply is not None:
            y = y + acted(w, part, w.u[part.channel], p[sl], k, length)
        elif part.effect.slot is Slot.PATH and part.effect.signal is not None:
            w.refuse(f"the effect {part.key!r} has no CasADi twin", REMEDY)
        elif part.effect.slot is Slot.PATH:
            half = part.count(s.order) // 2
            b, f = (
                np.concatenate((np.zeros(1 + s.delay), p[sl][:half])),
                np.concatenate(([1.0], p[sl][half:])),
            )
            y = y + w.rational([b], f, [w.u[part.channel]])
    return y


def discovered(w: Wiring, model: Any) -> list[Any]:
    """Outputs of a discovered model, started as its `simulate` starts without a window."""
    ca, scales, asm = w.ca, model.scales, model.assembly
    (A, B, E, S, T, C, D, G), (heads, kinds, signals, constants, bounds) = asm.fill(model.theta)[:2]
    level = (w.level - scales.u) / scales.su
    now, before = [], []
    for j, by in enumerate(scales.delay.astype(int)):
        past, v = w.state(np.full(by + 1, level[j])), (w.u[j] - scales.u[j]) / scales.su[j]
        seen = ca.vertcat(v, past.x)
        past.after = seen[:-1]
        now.append(seen[by])
        before.append(seen[by + 1])
    d = ca.vertcat(1.0, *now, *(a - b for a, b in zip(now, before, strict=True)))
    x = w.state(model.start(w.level))
    s = ca.DM(S) @ x.x + ca.DM(T) @ d
    clipped = [ca.fmin(ca.fmax(s[i], low), high) for i, (low, high) in enumerate(bounds)]
    terms = [
        np.prod([factor_term(int(kinds[f]), clipped[signals[f]], *constants[2 * f : 2 * f + 2]) for f in range(a, b)])
        for a, b in pairwise(heads)
    ]  # fmt: skip
    t = ca.vertcat(*terms) if terms else ca.DM.zeros(0, 1)
    x.after = ca.DM(A) @ x.x + ca.DM(B) @ d + ca.DM(E) @ t
    y = ca.DM(C) @ x.x + ca.DM(D) @ d + ca.DM(G) @ t
    return [scales.y[i] + scales.sy[i] * y[i] for i in range(len(scales.y))]
