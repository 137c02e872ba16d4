"""Designs for a set of plants: the optimum depends on the plant that is not known yet.

The information about several plants, side by side, is block diagonal, and so every robust design is an ordinary one:
average  sum_j p_j loss_j    A, c: one A criterion of the stacked sqrt(p_j) V_j;  D: the geometric mean
minimax  max_j loss_j        A, c: a G criterion with one combination per plant;  D: the same of determinants (W);
                             E: the E of all together"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.covariances import on_one_thread
from oed.criteria import Criterion
from oed.criteria.determinant import Determinant
from oed.criteria.eigenvalue import LargestEigenvalue
from oed.criteria.trace import Trace
from oed.criteria.worst import WorstDeterminant, WorstTrace
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.design import Design
from oed.design.problem.information_maps import InformationMap, information_map
from oed.errors import InputError


def stacked_map(models: Sequence[Any]) -> InformationMap:
    """Block-diagonal information of several plants under the same input."""
    maps = [information_map(model) for model in models]
    if not maps:
        raise InputError("a robust design needs at least one plant; none was given.")
    if len({m.n_inputs for m in maps}) > 1:
        raise InputError(f"the plants have {[m.n_inputs for m in maps]} inputs; the numbers must agree.")

    def factor(omega: NDArray) -> NDArray[np.complex128]:
        parts = [m.factor(omega) for m in maps]
        n, r = (np.cumsum([0] + [p.shape[axis] for p in parts]) for axis in (1, 2))
        D = np.zeros((len(omega), n[-1], r[-1], maps[0].n_inputs), dtype=complex)
        for k, part in enumerate(parts):
            D[:, n[k] : n[k + 1], r[k] : r[k + 1]] = part
        return D

    from scipy.linalg import block_diag

    return InformationMap(
        names=tuple(f"p{k + 1}.{name}" for k, m in enumerate(maps) for name in m.names),
        n_inputs=maps[0].n_inputs,
        factor=factor,
        gain=lambda omega: np.concatenate([m.gain(omega) for m in maps], axis=1),
        constant=np.asarray(block_diag(*[m.constant for m in maps]), dtype=np.float64),
        resonances=np.concatenate([m.resonances for m in maps]),
        dt=maps[0].dt,
    )


@on_one_thread
def robust_design(
    models: Sequence[Any],
    criterion: str | Criterion = "D",
    *,
    how: str = "average",
    weights: ArrayLike | None = None,
    **options: Any,
) -> Design:
    """One input for several plants: best on average, or for the worst of them.

    Parameters
    ----------
    models : sequence
        The plants that are possible.
    criterion : str or Criterion
        D, A, E, a c-type name, or a Criterion (applied to every plant).
    how : {"average", "minimax"}
        The mean of the losses (of D: their geometric mean), or the largest.
    weights : array_like, optional
        (J,) prior probabilities for the average of A and c; equal by default.
    **options : object
        As for `solve_design`: input_power, band, tolerance, ...

    Returns
    -------
    Design
        Its loss is the average or the largest; its certificate bounds that of every other spectrum.

    Raises
    ------
    InputError
        If the pair of criterion and kind is not convex in this form.
    """
    from oed.design.solve import solve_design

    together = stacked_map(models)
    own = [criterion_of(criterion, model, information_map(model)) for model in models]
    sizes = np.cumsum([0] + [c.n for c in own])
    p = np.full(len(own), 1 / len(own)) if weights is None else np.asarray(weights, dtype=float)
    if p.shape != (len(own),) or (p < 0).any() or not np.isclose(p.sum(), 1):
        raise InputError(f"the weights are {weights}; give one per plant, at least 0, with the sum 1.")
    kind, name = own[0].kind, f"{own[0].name}, {how} of {len(own)}"
    embedded = []
    for c, start in zip(own, sizes[:-1], strict=True):
        V = np.zeros((together.n, c.columns.shape[1]))
        V[start : start + c.n] = c.columns
        embedded.append(V)
    if how == "average" and kind == "A":
        if len({V.shape[1] for V in embedded}) > 1:
            raise InputError("the plants' criteria weigh different numbers of combinations; they must agree.")
        whole = Trace(np.sum([np.sqrt(q) * V for q, V in zip(p, embedded, strict=True)], axis=0), name)
    elif how == "average" and kind == "D" and weights is None:
        whole = Determinant(np.concatenate(embedded, axis=1), name)
    elif how == "minimax" and kind in ("A", "D"):
        if len({V.shape[1] for V in embedded}) > 1:
            raise InputError(
                f"the plants' criteria weigh {[V.shape[1] for V in embedded]} combinations; the numbers must agree: "
                "give all plants as many unknown parameters."
            )
        whole = (WorstTrace if kind == "A" else WorstDeterminant)(np.stack(embedded), name)
    elif how == "minimax" and kind == "E":
        whole = LargestEigenvalue(np.concatenate(embedded, axis=1), name)
    else:
        raise InputError(
            f"the {how} of the criterion {own[0].name} is not available; there are average D, A, c and minimax D, A, c, E."
        )
    return solve_design(together, whole, **options)
