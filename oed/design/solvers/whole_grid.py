"""The reference solver: CVXPY with Clarabel on the whole frequency grid."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.covariances import square_root
from oed.criteria import Criterion
from oed.criteria.trace import Trace
from oed.design.problem.lines import Columns, Problem
from oed.design.solvers.column_generation import Exchange, exchange
from oed.design.solvers.weights_da import Weights
from oed.errors import InputError, SolverFailure, Status


def reference_exchange(problem: Problem, *, refine: bool, tolerance: float) -> Exchange:
    """Designs on the whole grid, to which the maxima of the sensitivity function are added until the gap
    closes."""
    q = problem.map.n_inputs
    if q > 1 and not refine:
        raise InputError("the clarabel solver on a fixed grid is for one input; use solver='newton'.")
    omega = np.repeat(problem.omega, q)
    columns = problem.columns(omega, np.tile(np.eye(q, dtype=complex), (len(problem.omega), 1)))
    return exchange(
        problem,
        master=lambda problem, columns, start, accuracy: cvxpy_weights(
            columns, problem.criterion, problem.constant
        ),
        columns=columns,
        refine=refine,
        tolerance=max(tolerance, 1e-6) if refine else tolerance,
    )


def solve_cvxpy(problem: Any, accuracy: float) -> Status:
    """Solve a CVXPY problem by Clarabel."""
    import warnings

    import cvxpy as cp

    # CVXPY warns of inaccurate solutions; here the certificate is what counts, whatever the solver says.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            problem.solve(solver=cp.CLARABEL, tol_gap_abs=accuracy, tol_gap_rel=accuracy, tol_feas=accuracy)
        except cp.error.SolverError as error:
            raise SolverFailure(f"Clarabel failed: {error}") from None
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise SolverFailure(f"Clarabel stopped with status {problem.status}.")
    return Status.CONVERGED if problem.status == cp.OPTIMAL else Status.INACCURATE


def cvxpy_weights(
    columns: Columns, criterion: Criterion, constant: NDArray[np.float64], accuracy: float = 1e-11
) -> Weights:
    """Optimal weights of given columns, modelled in CVXPY: constant (n, n)."""
    import cvxpy as cp

    m, n, _ = columns.F.shape
    V = criterion.columns
    if isinstance(criterion, Trace) and not criterion.whole:
        return _elfving(columns, V, constant, accuracy)
    atoms = (columns.F @ np.swapaxes(columns.F, 1, 2)).reshape(m, n * n)
    w = cp.Variable(m, nonneg=True)
    M = cp.reshape(atoms.T @ w, (n, n), order="C") + constant
    M = (M + M.T) / 2
    budget = columns.q.T @ w <= 1
    stated = criterion.conic(cp, M, V, V @ V.T)
    if stated is None:
        raise InputError(f"the clarabel solver does not take the criterion {criterion.name}; use newton.")
    objective, largest = stated
    problem = cp.Problem(objective, [budget] if largest is None else [budget, largest])
    status = solve_cvxpy(problem, accuracy)
    weights = np.maximum(np.asarray(w.value, dtype=float), 0.0)
    nu = np.maximum(np.atleast_1d(np.asarray(budget.dual_value, dtype=float)), 0.0)
    if largest is None:
        X = criterion.direction(constant + columns.information(weights))
    else:
        X = square_root(np.asarray(largest.dual_value, dtype=float))
    return Weights(weights, X, nu, status, 0)


def _elfving(
    columns: Columns, V: NDArray[np.float64], constant: NDArray[np.float64], accuracy: float
) -> Weights:
    """The dual second-order cone programme; the weights are its multipliers."""
    import cvxpy as cp

    X = cp.Variable(V.shape)
    nu = cp.Variable(columns.q.shape[1], nonneg=True)
    m, _, r = columns.F.shape
    cost = columns.q @ nu
    turned = np.swapaxes(columns.F, 1, 2).reshape(m * r, -1)
    body = cp.reshape(turned @ X, (m, r * V.shape[1]), order="C")
    cone = cp.SOC(cost + 1, cp.hstack([cp.reshape(cost - 1, (m, 1), order="C"), 2 * body]), axis=1)
    root = square_root(constant).T
    objective = 2 * cp.sum(cp.multiply(V, X)) - cp.sum(nu) - cp.sum_squares(root @ X)
    status = solve_cvxpy(cp.Problem(cp.Maximize(objective), [cone]), accuracy)
    first, rest = (np.asarray(part, dtype=float) for part in cone.dual_value)  # type: ignore[union-attr]
    w = first.ravel() + rest.reshape(m, -1)[:, 0]
    return Weights(np.maximum(w, 0), np.asarray(X.value), np.asarray(nu.value), status, 0)
