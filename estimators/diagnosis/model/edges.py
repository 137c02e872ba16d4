"""Parameters that only say which samples pass them, as a level at which something switches: put in the middle of all that do as well."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.model.structure import Structure

Array = NDArray[Any]
TOUCH, FARTHEST = 1e-9, 1e-2
"""Of a parameter's scale, a move that changes the run of any that is no edge, and the farthest at which one is looked for: an edge's
scale is a million times the move that samples cross."""
NARROWED = 12
"""Halvings of a move in which an edge is first passed."""


def cell(run: Callable[[Array], Array], p: Array, at: int, scale: float) -> tuple[float, float] | None:
    """The interval of parameter `at` in which the run (N,) stays the same to the last bit; None where any move changes it, or none does."""
    here, ends = run(p), []

    def same(move: float) -> bool:
        q = p.copy()
        q[at] += move
        return bool(np.array_equal(run(q), here))

    for side in (1.0, -1.0):
        move = TOUCH * scale * side
        if not same(move):
            return None
        while same(2.0 * move):
            move *= 2.0
            if abs(move) > FARTHEST * scale:
                return None
        inside, outside = move, 2.0 * move
        for _ in range(NARROWED):
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if same(middle) else (inside, middle)
        ends.append(inside)
    high, low = ends
    # farther moves are tried at doubled distances only: between them the run may have been another, as of what turns about
    return (float(p[at]) + low, float(p[at]) + high) if same(0.5 * (low + high)) else None


def centred(run: Callable[[Array], Array], structure: Structure, p: Array, scales: Array) -> Array:
    """The parameters with every edge of an effect in the middle of its cell: where in it the edge is, no sample says."""
    for part, sl in zip(structure.parts, structure.slices(), strict=True):
        for at in range(sl.start, sl.stop) if part.effect.search is not None else ():
            if scales[at] > 0.0 and (found := cell(run, p, at, float(scales[at]))) is not None:
                p = p.copy()
                p[at] = 0.5 * (found[0] + found[1])
    return p
