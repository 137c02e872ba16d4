"""A linear model with effects around and inside it, as one function of one parameter vector.

    u -> input effects -> plant (+ feedback effects) -> + paths -> output effects -> + added -> y

The linear part is B/F in the shift operator with a common F per output, or, where an effect sits inside the
plant, a continuous-time layout with physical states that is integrated exactly between samples.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.catalogue import Clock
from estimators.diagnosis.model.layouts import CHANGES, COEFFICIENTS, LAYOUTS, changed_states, states
from estimators.diagnosis.model.structure import Structure

__all__ = ["acted", "free_responses", "plant_states", "sandwiched", "simulate", "stable_polynomial"]

Array = NDArray[Any]

FINE = (
    8  # values per sample that a play at the output follows: leaves 0.1 % of the output at 0.6 rad per sample
)

_PLANT_SLOTS = {
    "stiffness_cubic": (1,), "stiffness": (0, 1), "drag": (3,), "bilinear": (4,), "coulomb": (5,),
    "coulomb_asymmetric": (5, 8), "stribeck": (5, 6, 7), "stiffness_square": (2,), "stiffness_quintic": (1, 9),
    "stiffness_upper": (10, 11), "stiffness_lower": (12, 13), "stiffness_gap": (10, 11), "position_damping": (14,),
    "hysteretic_spring": (15, 16), "bilinear_driven": (17,), "end_stop": (18,),
}  # fmt: skip


def stable_polynomial(f: Array, limit: float = 0.99999) -> bool:
    """Whether 1 + f1 z^-1 + ... has all its roots inside the circle of radius `limit`.

    Parameters
    ----------
    f : ndarray
        (nf,) denominator coefficients after the leading 1.
    limit : float
        Radius.

    Returns
    -------
    bool
        Whether it is stable.
    """
    a = [1.0, *f.tolist()]  # few numbers: plain floats are quicker than arrays
    if not all(map(math.isfinite, a)):
        return False
    for m in range(len(f), 0, -1):  # Schur-Cohn step-down
        k = a[m]
        if abs(k) >= limit:
            return False
        a = [(a[i] - k * a[m - i]) / (1.0 - k * k) for i in range(m)]
    return True


# states of the last models: derivatives by the output map or by effects at the output move none of them
_recent: deque[tuple[tuple[Any, ...], Array]] = deque(maxlen=8)


def _plant(s: Structure, p: Array, U: Array, clock: Clock, rest: bool, start: Array | None) -> Array | None:
    if s.layout == "tf":
        f = p[: s.order]
        if not stable_polynomial(f):
            return None
        from estimators.diagnosis.effects.recursion_kernels import rational

        b = p[s.order : s.plant_size].reshape(len(s.inputs), s.taps)
        return rational(np.ascontiguousarray(U), np.ascontiguousarray(b), f, s.delay)
    if s.layout == "tanks":
        from estimators.diagnosis.effects.recursion_kernels import tank_levels

        a, b, k1, k2, k3, brim, share, level = p[:8]
        flow = np.array([*np.exp(np.clip([a, k1, k2, k3], -40, 40)), b, brim, share])[[0, 4, 1, 2, 3, 5, 6]]
        x0 = np.abs(p[8:10] if start is None else start)
        return tank_levels(np.ascontiguousarray(U[:, 0]), flow, x0, 4)[:, 1] + level
    X = plant_states(s, p, U, clock, rest=rest, start=start)
    head = LAYOUTS[s.layout][1]
    return None if X is None else X @ p[head : head + s.order]


def plant_states(
    s: Structure, p: Array, U: Array, clock: Clock, *, rest: bool = False, start: Array | None = None
) -> Array | None:
    """States of a physical layout with the effects inside it.

    Parameters
    ----------
    s : Structure
        The model's form, its layout neither "tf" nor "tanks".
    p : ndarray
        Its parameters.
    U : ndarray
        (N, inputs) what enters it.
    clock : Clock
        Sample numbers.
    rest : bool
        A second experiment: no initial state.
    start : ndarray, optional
        (s.order,) state at the start of a second experiment.

    Returns
    -------
    ndarray or None
        (N, s.order); None where they overflow.
    """
    n_rates = LAYOUTS[s.layout][1]
    c = np.zeros(COEFFICIENTS)
    c[7] = 1.0
    active = False
    for part, sl in zip(s.parts, s.slices(), strict=True):
        for where, value in zip(_PLANT_SLOTS.get(part.key, ()), p[sl], strict=False):
            c[where] = abs(value) if where in (3, 5, 7, 16, 18) else value
            active = True
        if part.key == "stiffness_gap":
            c[11:14] = abs(c[11]), c[10], -abs(c[11])
        if part.key == "hysteretic_spring":
            c[16] = max(c[16], 1e-9)
            c[15] /= c[16]
    c[7] = max(c[7], 1e-9)
    c[8] = min(max(float(c[8]), -1.0), 1.0)
    if not active:
        c[7] = 0.0
    u = U[:, 0] if s.delay == 0 else np.concatenate((np.zeros(s.delay), U[: -s.delay, 0]))
    change = [(part.key, p[sl]) for part, sl in zip(s.parts, s.slices(), strict=True) if part.key in CHANGES]
    x0 = np.zeros(s.order) if start is None else np.array(start, dtype=float)
    if not rest:
        for part, sl in zip(s.parts, s.slices(), strict=True):
            x0 = p[sl].copy() if part.key == "initial" else x0
    moved = b"" if not change else change[0][0].encode() + change[0][1].tobytes() + clock.k[:1].tobytes()
    key = (s.layout, p[:n_rates].tobytes(), c.tobytes(), x0.tobytes(), moved, u.tobytes())
    X = next((kept for known, kept in tuple(_recent) if known == key), None)
    if X is None:
        if change:
            X = changed_states(s.layout, p[:n_rates], u, c, *change[0], clock, x0)
        else:
            X = states(s.layout, p[:n_rates], u, c, x0)
        _recent.append((key, X))
    if not math.isfinite(X[-1, 0]):
        return None
    return X


def sandwiched(u: Array, p: Array, order: int) -> Array:
    """First block (unit first tap, denominator then numerator) and broken line of a Wiener-Hammerstein model.

    Parameters
    ----------
    u : ndarray
        (N,) input.
    p : ndarray
        Denominator, numerator, then slopes and corners.
    order : int
        Order of the first block.

    Returns
    -------
    ndarray
        (N,) what enters the second block.
    """
    from estimators.diagnosis.effects.recursion_kernels import hinges

    x = lfilter(np.concatenate(([1.0], p[order : 2 * order])), np.concatenate(([1.0], p[:order])), u)
    return hinges(x, p[2 * order :])


def _inside(at: float, n: int) -> bool:
    """Whether a change lies well within the record: at its very ends it would be another effect."""
    return 0.02 * n < at < 0.98 * n


def acted(s: Structure, p: Array, u: Array, clock: Clock, *, rest: bool = False) -> Array | None:
    """What enters the linear part: the inputs after the effects that act on them.

    Parameters
    ----------
    s : Structure
        The model's form.
    p : ndarray
        (s.size,) its parameters.
    u : ndarray
        (N, nu) all inputs of the record.
    clock : Clock
        Sample numbers.
    rest : bool
        A second experiment: changes may lie outside it.

    Returns
    -------
    ndarray or None
        (N, inputs of this output); None where the parameters are not admissible.
    """
    n = len(u)
    U = u[:, list(s.inputs)]  # a copy
    for part, sl in zip(s.parts, s.slices(), strict=True):
        e = part.effect
        if e.per_sample and part.key != "tones" and not rest and not _inside(p[sl][-1], n):
            return None
        if e.slot == "input" and e.apply is not None:
            j = s.inputs.index(part.channel)
            if part.key == "delay" and (p[sl][0] < 0 or p[sl][0] > n / 4):
                return None
            U[:, j] = e.apply(U[:, j], p[sl], clock)
        elif part.key == "sandwich":
            order = part.size % 100
            if not stable_polynomial(p[sl][:order]):
                return None
            j = s.inputs.index(part.channel)
            U[:, j] = sandwiched(U[:, j], p[sl], order)
    return U


def simulate(
    s: Structure, p: Array, u: Array, clock: Clock, *, rest: bool = False, start: Array | None = None
) -> Array:
    """Output of a structure.

    Parameters
    ----------
    s : Structure
        The model's form.
    p : ndarray
        (s.size,) its parameters.
    u : ndarray
        (N, nu) all inputs of the record.
    clock : Clock
        Sample numbers on the common clock.
    rest : bool
        A second experiment: no initial state, and a disturbance that began earlier has settled.
    start : ndarray, optional
        (s.order,) state of a physical layout at the start of a second experiment.

    Returns
    -------
    ndarray
        (N,) simulated output; infinite where the parameters make no stable model.
    """
    n = len(u)
    settle = 0
    if rest and any(part.key == "step_input" for part in s.parts):
        settle = 2000
        u = np.concatenate((np.zeros((settle, u.shape[1])), u))
        clock = Clock(np.concatenate((np.full(settle, clock.k[0]), clock.k)), clock.length)
    U = acted(s, p, u, clock, rest=rest)
    if U is None:
        return np.full(n, np.inf)
    slices = s.slices()
    y = _plant(s, p, U, clock, rest, start)
    if y is None:
        return np.full(n, np.inf)
    for part, sl in zip(s.parts, slices, strict=True):
        if part.effect.slot == "path":
            half = part.count(s.order) // 2
            b, f = p[sl][:half], p[sl][half:]
            if not stable_polynomial(f):
                return np.full(n, np.inf)
            lead = np.zeros(1 + s.delay)
            y = y + lfilter(np.concatenate((lead, b)), np.concatenate(([1.0], f)), u[:, part.channel])
        elif part.effect.slot == "start" and not rest and s.layout == "tf":
            impulse = np.zeros(len(y))
            impulse[: s.order] = p[sl]
            y = y + lfilter([1.0], np.concatenate(([1.0], p[: s.order])), impulse)
    first = True  # of the effects at the output
    for slot in ("output", "added"):
        for part, sl in zip(s.parts, slices, strict=True):
            if part.effect.slot == slot and part.effect.apply is not None:
                played = _played(s, p, U, p[sl]) if first and part.key == "backlash_output" else None
                y = part.effect.apply(y, p[sl], clock) if played is None else played
                first = False
    return y[settle:]


def _played(s: Structure, p: Array, U: Array, width: Array) -> Array | None:
    """Output of the linear part through a play that follows it between the samples; None where it is not known there."""
    if s.layout != "tf" or any(part.effect.slot in ("path", "start") for part in s.parts):
        return None
    from estimators.diagnosis.effects.recursion_kernels import play
    from estimators.diagnosis.model.intersample import between_samples

    b = p[s.order : s.plant_size].reshape(len(s.inputs), s.taps)
    fine = between_samples(U, b, p[: s.order], s.delay, FINE)
    return None if fine is None else np.ascontiguousarray(play(fine.ravel(), abs(width[0]))[::FINE])


def free_responses(s: Structure, p: Array, n: int) -> Array:
    """Responses to the parameters of an initial state, one column each, with the effects inside the plant left out.

    Parameters
    ----------
    s : Structure
        The model's form.
    p : ndarray
        Its parameters.
    n : int
        Samples.

    Returns
    -------
    ndarray
        (n, s.order).
    """
    if s.layout == "tf":
        impulse = np.zeros(n)
        impulse[0] = 1.0
        g = lfilter([1.0], np.concatenate(([1.0], p[: s.order])), impulse)
        return np.stack([np.concatenate((np.zeros(i), g[: n - i])) for i in range(s.order)], axis=1)
    head = LAYOUTS[s.layout][1]
    rest = np.zeros(n)
    return np.stack(
        [
            states(s.layout, p[:head], rest, np.zeros(COEFFICIENTS), x0) @ p[head : head + s.order]
            for x0 in np.eye(s.order)
        ],
        axis=1,
    )
