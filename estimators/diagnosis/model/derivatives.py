"""Exact derivatives of a structure's output by the parameters that it is rational or linear in."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Slot
from estimators.diagnosis.model.layouts import LAYOUTS
from estimators.diagnosis.model.simulation import acted, plant_states, read_ahead, transferred
from estimators.diagnosis.model.structure import Structure

Array = NDArray[Any]
Columns = Iterator[tuple[int, Array]]  # index of a parameter, derivative (N,) of the output by it


def exact_columns(s: Structure, p: Array, u: Array, clock: Clock) -> Columns:
    """Derivatives of the simulated output that need no finite difference.

    What is added has its own; what else is exact, the plant's own parameters, passes what acts at the output: it has
    the slope of static curves as a factor, and what is linear acts on it as on the output. Shapes: p (s.size,), u (N, nu). The
    finite differences of the fit are the twin that the tests compare with.
    """
    for part, sl in zip(s.parts, s.slices(), strict=True):
        if part.effect.slopes is not None:
            yield from ((sl.start + i, d) for i, d in part.effect.slopes(p[sl], clock))
    curved = [q for q in s.parts if q.effect.slot is Slot.OUTPUT]
    if s.layout == "tanks" or any(q.effect.memory and not q.effect.linear for q in curved):
        return
    if curved and any(q.effect.slot is Slot.PATH for q in s.parts):  # the curve acts on the paths' sum
        return
    n, (u, clock) = len(u), read_ahead(s, u, clock)
    U = acted(s, p, u, clock)
    if U is None:
        return
    linear, columns = (_of_transfer if s.layout == "tf" else _of_layout)(s, p, U, clock)
    if linear is not None:
        stages = _stages(s, p, linear, clock)
        for i, column in columns:
            for stage in stages:
                column = stage(column)
            yield i, column[:n]


def _of_layout(s: Structure, p: Array, U: Array, clock: Clock) -> tuple[Array | None, Columns]:
    """The output (N,) before its curves, y = C x, and dy/dC_i = x_i."""
    X = plant_states(s, p, U, clock)
    head = LAYOUTS[s.layout][1]
    if X is None:
        return None, iter(())
    return X @ p[head : head + s.order], ((head + i, X[:, i]) for i in range(s.order))


def _of_transfer(s: Structure, p: Array, U: Array, clock: Clock) -> tuple[Array | None, Columns]:
    """The output (N,) before its curves, y = sum B_j/F u_j, and dy/df_i = -z^-i y/F, dy/db_ji = z^-(1+delay+i) u_j/F.

    An initial state adds its free response, which has the same poles.
    """
    from estimators.diagnosis.model.transfer_kernels import derived

    linear = transferred(s, p, U)
    if not math.isfinite(linear[-1]):
        return None, iter(())
    rows = derived(np.ascontiguousarray(U), linear, p[: s.order], s.delay, s.taps, s.begins is not None)
    at = [*range(s.plant_size), *(() if s.begins is None else range(s.begins.start, s.begins.stop))]
    return linear, zip(at, rows, strict=True)


def _stages(s: Structure, p: Array, x: Array, clock: Clock) -> list[Callable[[Array], Array]]:
    """What acts at the output, on small changes (N,) of what the linear part puts out, x (N,), one after the other."""
    stages: list[Callable[[Array], Array]] = []
    step = 0.0
    for part, sl in s.placed[2]:
        if part.effect.slot is not Slot.OUTPUT:
            continue
        step = step or 1e-6 * (float(np.std(x)) + 1e-300)
        y = part.apply(x, p[sl], clock)
        if part.effect.linear:
            stages.append(lambda d, part=part, q=p[sl]: part.apply(d, q, clock))
        else:
            stages.append(partial(np.multiply, (part.apply(x + step, p[sl], clock) - y) / step))
        x = y
    return stages
