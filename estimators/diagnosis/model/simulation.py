"""A linear model with effects around and inside it, as one function of one parameter vector.

    u -> input effects -> plant (+ feedback effects) -> + paths -> output effects -> + added -> y

The linear part is B/F in the shift operator with a common F per output, or, where an effect sits inside the
plant, a continuous-time layout with physical states that is integrated exactly between samples.
"""

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.model.layouts import LAYOUTS, Inside, changed_states, layout_matrices, states
from estimators.diagnosis.model.structure import Part, Structure, stable_polynomial
from estimators.residual.algebra import delayed

Array = NDArray[Any]

AHEAD = 64  # samples beyond the record, the input held, for a clock that runs ahead
MOST_FORCES = 2  # as many as `plant_kernels` takes; a test holds the two together
ENDS = 0.05
"""Of a record, at either end of which nothing is taken to change for good: a twentieth of the samples says little of a model."""
SETTLE = 2000
"""Samples at rest in which what began before a record has settled."""
FINE = 8
"""Values per sample that a play at the output follows: leaves 0.1 % of the output at 0.6 rad per sample."""

NO_START = np.zeros(0)

# states of the last models: derivatives by the output map or by effects at the output move none of them
_recent: deque[tuple[tuple[Any, ...], Array]] = deque(maxlen=8)
# what entered the last linear parts, and what left them: a fit's derivatives and what follows it begin where its errors ended
_entered: deque[tuple[tuple[Any, ...], Array, Clock, Array | None]] = deque(maxlen=8)
_left: deque[tuple[tuple[Any, ...], Array, Array]] = deque(maxlen=8)


def _plant(s: Structure, p: Array, U: Array, clock: Clock, rest: bool, start: Array | None) -> Array | None:
    if s.layout == "tf":
        f = p[: s.order]
        if not stable_polynomial(f):
            return None
        return transferred(s, p, U, rest)
    if s.layout == "tanks":
        from estimators.diagnosis.effects.kernels.recursion_kernels import tank_levels

        a, b, k1, k2, k3, brim, share, level = p[:8]
        flow = np.array([*np.exp(np.clip([a, k1, k2, k3], -40, 40)), b, brim, share])[[0, 4, 1, 2, 3, 5, 6]]
        x0 = np.abs(p[8:10] if start is None else start)
        return tank_levels(np.ascontiguousarray(U[:, 0]), flow, x0, 4)[:, 1] + level
    X = plant_states(s, p, U, clock, rest=rest, start=start)
    head = LAYOUTS[s.layout][1]
    return None if X is None else X @ p[head : head + s.order]


def transferred(s: Structure, p: Array, U: Array, rest: bool = False) -> Array:
    """Output (N,) of the transfer functions for what enters them, with the initial state of their structure unless at `rest`."""
    from estimators.diagnosis.model.transfer_kernels import rational

    begins = NO_START if rest or s.begins is None else p[s.begins]
    key = (s.order, s.taps, s.delay, p[: s.plant_size].tobytes(), begins.tobytes())
    y = next((y for known, of, y in tuple(_left) if of is U and known == key), None)
    if y is None:
        b = p[s.order : s.plant_size].reshape(len(s.inputs), s.taps)
        y = rational(np.ascontiguousarray(U), np.ascontiguousarray(b), p[: s.order], s.delay, begins)
        _left.append((key, U, y))
    return y


def plant_states(
    s: Structure, p: Array, U: Array, clock: Clock, *, rest: bool = False, start: Array | None = None
) -> Array | None:
    """States of a physical layout with the effects inside it.

    Shapes: U (N, inputs), start (s.order,), returns (N, s.order).
    """
    rates = s.rates(p)
    parts = [(part, p[sl]) for part, sl in zip(s.parts, s.slices(), strict=True)]
    u = U if s.delay == 0 else np.concatenate((np.zeros((s.delay, U.shape[1])), U[: -s.delay]))
    inside = _inside(s, rates, parts, u, clock)
    if inside is None:
        return None
    change = [(part.effect.change[s.layout], q) for part, q in parts if part.effect.change is not None]
    x0 = np.zeros(s.order) if start is None else np.array(start, dtype=float)
    if not rest:
        for part, q in parts:
            x0 = q.copy() if part.effect.slot is Slot.START else x0
    moved = () if not change else (change[0][0], change[0][1].tobytes(), float(clock.k[0]))
    key = (s.layout, s.steps, rates.tobytes(), inside.mark, x0.tobytes(), moved, u.tobytes())
    X = next((kept for known, kept in tuple(_recent) if known == key), None)
    if X is None:
        if change:
            X = changed_states(s.layout, rates, u, inside, *change[0], clock, x0)
        else:
            X = states(s.layout, rates, u, inside, x0)
        _recent.append((key, X))
    if not math.isfinite(X[-1, 0]):
        return None
    return X


def joined(s: Structure, rates: Array, U: Array) -> Array:
    """(N,) the inputs of a physical layout as one that moves its position as far as all of them do, held for long."""
    if U.shape[1] == 1:
        return U[:, 0]
    A, B, _, position, _ = layout_matrices(s.layout, rates)
    further = rates[LAYOUTS[s.layout][1] :].reshape(-1, s.order)
    reach = np.stack((B, *further)) @ np.linalg.lstsq(A.T, position, rcond=None)[0]
    return U @ (reach / (reach[0] or 1.0))


def _inside(
    s: Structure, rates: Array, parts: list[tuple[Part, Array]], U: Array, clock: Clock
) -> Inside | None:
    """What the parts of a model make act inside its plant; None where it is more than the recursion takes."""
    forces, elements = [], {}
    for part, q in parts:
        if part.effect.force is not None:
            signal, own = part.effect.signal, q[part.own :]
            signals = None if signal is None else signal(U, part.channel, own, clock)
            if U.shape[1] > 1:
                u = U[:, s.inputs.index(part.channel)] if part.effect.each else joined(s, rates, U)
                signals = np.stack((np.zeros(len(u)) if signals is None else signals, u), axis=1)
            forces.append((part.effect.force, own, signals))
        if part.effect.inside is not None:
            elements |= part.effect.inside(q[part.own :])
    return Inside(tuple(forces), elements, s.steps) if len(forces) <= MOST_FORCES else None


def _within(effect: Effect, at: float, u: Array) -> bool:
    """Whether a change lies well within the record: what came before its very start or after its very end hardly shows, and what
    came after rules a later record.

    Of how a system moves nothing shows before an input does: what seems to change as inputs first move is how the level matters.
    """
    n = len(u)
    rest = 0 if effect.nature is Nature.ADDED else int(np.argmax(np.any(u != u[0], axis=1)))
    return rest + ENDS * n < at < (1.0 - ENDS) * n


def acted(s: Structure, p: Array, u: Array, clock: Clock, *, rest: bool = False) -> Array | None:
    """What enters the linear part: the inputs after the effects that act on them.

    Shapes: p (s.size,), u (N, nu), returns (N, inputs of this output).
    """
    key = (s.inputs, rest, [(part, p[sl].tobytes()) for part, sl in s.placed[0]])
    for known, of, when, U in tuple(_entered):
        if of is u and when is clock and known == key:
            return U
    U = _acted(s, p, u, clock, rest)
    _entered.append((key, u, clock, U))
    return U


def _acted(s: Structure, p: Array, u: Array, clock: Clock, rest: bool) -> Array | None:
    U = u[:, list(s.inputs)]  # a copy
    for part, sl in s.placed[0]:
        if not rest and not all(_within(part.effect, p[sl][at], u) for at in part.times(s.order)):
            return None
        if not part.enters:
            continue
        j, read = s.inputs.index(part.channel), part.effect.signal
        if part.effect.slot is not Slot.INPUT:
            U[:, j] = part.blocked(U[:, j], p[sl])
        elif read is None:
            U[:, j] = part.apply(U[:, j], p[sl], clock)
        elif part.effect.joint:
            every = u.copy()
            every[:, list(s.inputs)] = U
            U = read(every, part.channel, p[sl], clock)[:, list(s.inputs)]
        else:
            U[:, j] = read(u, part.channel, p[sl], clock)
        if not math.isfinite(U[-1, j]):
            return None
    return U


def read_ahead(s: Structure, u: Array, clock: Clock) -> tuple[Array, Clock]:
    """The inputs (N, nu) held beyond the end of a record, and the clock, where an effect reads the output later than the clock says."""
    if not s.ahead:
        return u, clock
    later = np.concatenate((clock.k, clock.k[-1] + 1.0 + np.arange(AHEAD)))
    return np.concatenate((u, np.repeat(u[-1:], AHEAD, axis=0))), Clock(later, clock.length, clock.lead)


def simulate(
    s: Structure, p: Array, u: Array, clock: Clock, *, rest: bool = False, start: Array | None = None
) -> Array:
    """Output of a structure.

    Shapes: p (s.size,), u (N, nu), start (s.order,), returns (N,).
    """
    n = len(u)
    settle = 0
    if rest and any(part.effect.settles for part in s.parts):
        settle = SETTLE
        u = np.concatenate((np.zeros((settle, u.shape[1])), u))
        clock = Clock(
            np.concatenate((np.full(settle, clock.k[0]), clock.k)), clock.length, settle + clock.lead
        )
    u, clock = read_ahead(s, u, clock)
    U = acted(s, p, u, clock, rest=rest)
    if U is None:
        return np.full(n, np.inf)
    y = _plant(s, p, U, clock, rest, start)
    if y is None:
        return np.full(n, np.inf)
    _, beside, after = s.placed
    for part, sl in beside:
        if part.effect.apply is not None:
            y = y + part.apply(u[:, part.channel], p[sl], clock)
        elif part.effect.signal is not None:
            y = y + part.effect.signal(u, part.channel, p[sl], clock)
        else:
            half = part.count(s.order) // 2
            b, f = p[sl][:half], p[sl][half:]
            if not stable_polynomial(f):
                return np.full(n, np.inf)
            lead = np.zeros(1 + s.delay)
            y = y + lfilter(np.concatenate((lead, b)), np.concatenate(([1.0], f)), u[:, part.channel])
    for k, (part, sl) in enumerate(after):
        if part.effect.signal is not None:
            y = part.effect.signal(np.column_stack((u, y)), u.shape[1], p[sl], clock)
            continue
        played = _played(s, p, U, p[sl], clock) if part.effect.between and not k else None
        y = part.apply(y, p[sl], clock) if played is None else played
    return y[settle : settle + n]


def _played(s: Structure, p: Array, U: Array, width: Array, clock: Clock) -> Array | None:
    """Output of the linear part through a play that follows it between the samples; None where it is not known there."""
    if s.layout != "tf" or any(part.effect.slot in (Slot.PATH, Slot.START) for part in s.parts):
        return None
    from estimators.diagnosis.effects.kernels.recursion_kernels import play, settled
    from estimators.diagnosis.model.intersample import between_samples

    b = p[s.order : s.plant_size].reshape(len(s.inputs), s.taps)
    fine = between_samples(U, b, p[: s.order], s.delay, FINE)
    if fine is None:
        return None
    x = settled(fine.ravel(), FINE * clock.lead)
    return np.ascontiguousarray(play(x, abs(width[0]), x[0])[::FINE])


def free_responses(s: Structure, p: Array, n: int) -> Array:
    """Responses to the parameters of an initial state, one column each, with the effects inside the plant
    left out.

    Shapes: returns (n, s.order).
    """
    if s.layout == "tf":
        impulse = np.zeros(n)
        impulse[0] = 1.0
        g = np.asarray(lfilter([1.0], np.concatenate(([1.0], p[: s.order])), impulse))
        return delayed(g[:, None], range(s.order))
    head = LAYOUTS[s.layout][1]
    rest = np.zeros(n)
    return np.stack(
        [states(s.layout, p[:head], rest, x0=x0) @ p[head : head + s.order] for x0 in np.eye(s.order)],
        axis=1,
    )
