"""Optimal weights of given columns as cone programmes, handed to Clarabel: A and c (Elfving's dual), E, G.

A and c, by the dual, which is exact also where the optimal information is singular:

    maximise 2 tr(V'X) - tr(X' M_0 X) - sum_j nu_j   over X (n, s) and nu >= 0
    subject to |F_k' X|_F^2 <= nu' q_k at every column;   the weights w_k are the multipliers.

E, by the linear matrix inequality M(w) >= t V V' (t = 1 / loss), whose multiplier is Z."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.covariances import square_root
from oed.criteria import Criterion
from oed.design.problem.lines import Columns
from oed.design.solvers.weights_da import Weights
from oed.errors import SolverFailure, Status


def _solve(P: Any, q: NDArray, A: Any, b: NDArray, cones: list, tolerance: float) -> Any:
    import clarabel

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    settings.max_iter = 200
    settings.max_threads = 1
    return clarabel.DefaultSolver(P, q, A, b, cones, settings).solve()


def _status(solution: Any) -> Status:
    name = str(solution.status)
    if name == "Solved":
        return Status.CONVERGED
    if name in ("AlmostSolved", "InsufficientProgress", "MaxIterations", "NumericalError"):
        return Status.INACCURATE
    raise SolverFailure(
        f"Clarabel stopped with {name}; the columns cannot meet the demand: widen the band or refine the grid."
    )


def elfving(
    columns: Columns, criterion: Criterion, constant: NDArray[np.float64], *, tolerance: float = 1e-12
) -> Weights:
    """Optimal weights for an A or c criterion through the dual second-order cone programme: constant (n, n).
    Source: G. Elfving, Annals of Mathematical Statistics 23 (1952) 255-262; G. Sagnol, Journal of Statistical
    Planning and Inference 141 (2011) 1684-1708, for A and several outputs."""
    import clarabel
    from scipy import sparse

    V = criterion.columns
    (n, s), (m, _, r), J = V.shape, columns.F.shape, columns.q.shape[1]
    # Variables: X column by column (n s), then nu (J). Per column the cone (tau + 1, tau - 1, 2 F'X), tau = nu'q.
    P = sparse.triu(
        sparse.block_diag([sparse.kron(sparse.eye(s), 2 * constant), sparse.csc_matrix((J, J))]), format="csc"
    )
    objective = np.concatenate([-2 * V.T.ravel(), np.ones(J)])
    size = 2 + r * s
    rows = np.zeros((m, size, n * s + J))
    rows[:, 0, n * s :] = rows[:, 1, n * s :] = -columns.q
    turned = -2 * np.swapaxes(columns.F, 1, 2)
    for k in range(s):
        rows[:, 2 + k * r : 2 + (k + 1) * r, k * n : (k + 1) * n] = turned
    offset = np.zeros((m, size))
    offset[:, 0], offset[:, 1] = 1.0, -1.0
    positive = np.concatenate([np.zeros((J, n * s)), -np.eye(J)], axis=1)
    A = sparse.csc_matrix(np.concatenate([rows.reshape(m * size, -1), positive]))
    b = np.concatenate([offset.ravel(), np.zeros(J)])
    cones = [clarabel.SecondOrderConeT(size)] * m + [clarabel.NonnegativeConeT(J)]
    solution = _solve(P, objective, A, b, cones, tolerance)
    status = _status(solution)
    x = np.array(solution.x)
    dual = np.array(solution.z)[: m * size].reshape(m, size)
    w = np.maximum(dual[:, 0] + dual[:, 1], 0.0)
    return Weights(w, x[: n * s].reshape(s, n).T, np.maximum(x[n * s :], 0), status, int(solution.iterations))


def largest_eigenvalue(
    columns: Columns, criterion: Criterion, constant: NDArray[np.float64], *, tolerance: float = 1e-12
) -> Weights:
    """Optimal weights for an E criterion: maximise t such that M(w) - t V V' is positive semidefinite."""
    V, F, Q = criterion.columns, columns.F, columns.q.T
    (m, n, _), J = F.shape, len(Q)
    atoms = F @ np.swapaxes(F, 1, 2)
    # Variables w (m), t. Slack: svec(M_0 + sum w A - t V V'), 1 - Q w, w.
    psd = np.concatenate([-svec(atoms).T, svec((V @ V.T)[None]).T], axis=1)
    budget = np.concatenate([Q, np.zeros((J, 1))], axis=1)
    positive = np.concatenate([-np.eye(m), np.zeros((m, 1))], axis=1)
    objective = np.zeros(m + 1)
    objective[-1] = -1.0
    solution, x, z, status = linear_matrix_programme(
        objective,
        [psd, np.concatenate([budget, positive])],
        [svec(constant[None])[0], np.ones(J), np.zeros(m)],
        [n],
        tolerance,
    )
    k = n * (n + 1) // 2
    X = square_root(smat(z[:k], n))
    w = np.maximum(x[:m], 0.0)
    return Weights(w, X, np.maximum(z[k : k + J], 0), status, int(solution.iterations))


def linear_matrix_programme(
    objective: NDArray[np.float64],
    blocks: list[NDArray[np.float64]],
    offsets: list[NDArray[np.float64]],
    sizes: list[int],
    tolerance: float,
) -> tuple[Any, NDArray[np.float64], NDArray[np.float64], Status]:
    """Minimise objective' x subject to offset - block x in each cone, by Clarabel: objective (m,)."""
    import clarabel
    from scipy import sparse

    cones = [clarabel.PSDTriangleConeT(n) for n in sizes] + [clarabel.NonnegativeConeT(len(blocks[-1]))]
    A, m = sparse.csc_matrix(np.concatenate(blocks)), len(objective)
    solution = _solve(sparse.csc_matrix((m, m)), objective, A, np.concatenate(offsets), cones, tolerance)
    return solution, np.array(solution.x), np.array(solution.z), _status(solution)


def svec(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Upper triangles column by column, off-diagonal entries times sqrt 2: matrices (k, n, n)."""
    n = matrices.shape[1]
    j, i = np.tril_indices(n)
    return matrices[:, i, j] * np.where(i == j, 1.0, np.sqrt(2))


def smat(vector: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """The symmetric matrix of one row of `svec`: returns (n, n)."""
    j, i = np.tril_indices(n)
    matrix = np.zeros((n, n))
    matrix[i, j] = matrix[j, i] = vector / np.where(i == j, 1.0, np.sqrt(2))
    return matrix
