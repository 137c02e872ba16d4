"""Exact derivatives of a structure's output by the parameters that it is rational or linear in."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Slot
from estimators.diagnosis.model.layouts import LAYOUTS
from estimators.diagnosis.model.simulation import acted, free_responses, plant_states
from estimators.diagnosis.model.structure import Structure

Array = NDArray[Any]
OFFSET = "offset"  # key of the effect; its module imports this one


def exact_columns(s: Structure, p: Array, u: Array, clock: Clock) -> Iterator[tuple[int, Array]]:
    """Derivatives of the simulated output that need no finite difference.

    In layout "tf", y = sum B_j/F u_j gives dy/db_ji = z^-(1+delay+i) u_j/F and dy/df_i = -z^-i y/F; in a
    physical layout y = C x gives dy/dC_i = x_i. Static curves at the output multiply by their slope. A constant that is
    added gives ones, an initial state its free response.

    Shapes: p (s.size,), u (N, nu).

    The finite differences of the fit are the twin that the tests compare with.
    """
    for part, sl in zip(s.parts, s.slices(), strict=True):
        if part.key == OFFSET:
            yield sl.start, np.ones(len(u))
    curved = [q for q in s.parts if q.effect.slot is Slot.OUTPUT]
    if s.layout == "tanks" or any(q.effect.memory for q in curved):
        return
    if curved and any(q.effect.slot is Slot.PATH for q in s.parts):  # the curve acts on the paths' sum
        return
    U = acted(s, p, u, clock)
    if U is None:
        return
    if s.layout != "tf":
        X = plant_states(s, p, U, clock)
        head = LAYOUTS[s.layout][1]
        if X is None:
            return
        slope = _slope(s, p, X @ p[head : head + s.order], clock)
        for i in range(s.order):
            yield head + i, X[:, i] if slope is None else X[:, i] * slope
        return
    from estimators.diagnosis.effects.recursion_kernels import rational

    n, f = len(U), p[: s.order]
    one = np.ones((1, 1))
    b = p[s.order : s.plant_size].reshape(len(s.inputs), s.taps)
    linear = rational(np.ascontiguousarray(U), np.ascontiguousarray(b), f, s.delay)
    for part, sl in zip(s.parts, s.slices(), strict=True):
        if part.effect.slot is Slot.START:  # the free response has the same poles
            impulse = np.zeros(n)
            impulse[: s.order] = p[sl]
            linear = linear + lfilter([1.0], np.concatenate(([1.0], f)), impulse)
    if not np.isfinite(linear[-1]):
        return
    slope = _slope(s, p, linear, clock)

    def late(x: Array, by: int) -> Array:
        out = np.zeros(n)
        out[by:] = x[: n - by]
        return out if slope is None else out * slope

    w = rational(np.ascontiguousarray(linear[:, None]), one, f, 0)  # one sample late already
    for i in range(s.order):
        yield i, -late(w, i)
    for part, sl in zip(s.parts, s.slices(), strict=True):
        if part.effect.slot is Slot.START:
            for i, free in enumerate(free_responses(s, p, n).T, sl.start):
                yield i, free if slope is None else free * slope
    for j in range(len(s.inputs)):
        w = rational(np.ascontiguousarray(U[:, j : j + 1]), one, f, 0)
        for i in range(s.taps):
            yield s.order + j * s.taps + i, late(w, s.delay + i)


def _slope(s: Structure, p: Array, x: Array, clock: Clock) -> Array | None:
    """Slope of the static curves at the output, one after the other; None where there are none."""
    step = 1e-6 * (float(np.std(x)) + 1e-300)
    total = None
    for part, sl in zip(s.parts, s.slices(), strict=True):
        if part.effect.slot is Slot.OUTPUT:
            y = part.apply(x, p[sl], clock)
            slope = (part.apply(x + step, p[sl], clock) - y) / step
            total = slope if total is None else total * slope
            x = y
    return total
