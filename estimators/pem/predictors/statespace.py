"""Where the search for the parameters of a state-space model begins."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.pem.subspace.hankel import lagged
from estimators.residual.algebra import thin_svd
from oed.errors import InputError
from oed.models.model import Polynomial, StateSpace


def subspace_start(
    structure: StateSpace, signals: list[tuple[NDArray, NDArray]], past: int, future: int
) -> NDArray[np.float64]:
    """Parameters by a subspace method: the predictor's Markov parameters by least squares, their Hankel
    matrix factored, the states regressed (Chiuso 2007, Automatica 43, 1034: PBSID); returns (n,)."""
    ny, nu, n = structure.n_outputs, structure.n_inputs, structure.order
    back, now_y, now_u = [], [], []
    for y, u in signals:
        joint = np.column_stack([u, y])
        back.append(lagged(joint, past, 0, len(y) - past))
        now_y.append(y[past:])
        now_u.append(u[past:])
    Z, Y, U = (np.concatenate(x) for x in (back, now_y, now_u))
    direct = U if structure.feedthrough else U[:, :0]
    regressor = np.column_stack([Z, direct])
    markov = np.linalg.lstsq(regressor, Y, rcond=1e-10)[0].T  # [Phi_1 ... Phi_p, D]
    width, future = nu + ny, min(future, past)
    D = markov[:, past * width :] if structure.feedthrough else np.zeros((ny, nu))
    rows = [
        np.hstack([markov[:, k * width : past * width], np.zeros((ny, k * width))]) for k in range(future)
    ]
    _, singular, right = thin_svd(np.vstack(rows) @ Z.T)
    X = (np.sqrt(singular[:n, None]) * right[:n]).T
    C = np.linalg.lstsq(X, Y - U @ D.T, rcond=None)[0].T
    E = Y - U @ D.T - X @ C.T
    edges = np.cumsum([len(y) for y in now_y])
    keep = np.setdiff1d(np.arange(len(X)), edges - 1)
    left = np.column_stack([X, U, E])[keep]
    ABK = np.linalg.lstsq(left, X[keep + 1], rcond=None)[0].T
    A, B, K = ABK[:, :n], ABK[:, n : n + nu], ABK[:, n + nu :]
    K = _stabilised(A, C, K) if structure.noise else np.zeros((n, ny))
    return structure.theta_of(A, B, C, D, K)


def subspace_candidates(structure: StateSpace, problem: Any) -> list[NDArray[np.float64]]:
    """Starts by the subspace method with several horizons: returns (n + levels,)."""
    nu, ny = structure.n_inputs, structure.n_outputs
    signals = [(d[:, nu : nu + ny], d[:, :nu]) for d in problem.records()]
    shortest, total = min(len(y) for y, _ in signals), problem.n_samples
    most = max(2, min(shortest // 3, total // (4 * (nu + ny))))
    found = []
    for past in sorted({min(most, p) for p in (structure.order + 2, 10, 20, 30)}):
        try:
            theta = subspace_start(structure, signals, past, max(past // 2, -(-structure.order // ny) + 1))
        except (InputError, np.linalg.LinAlgError):
            continue
        found.append(np.concatenate([theta, np.zeros(problem.n_parameters - structure.n)]))
    return found


def state_space_of_armax(structure: StateSpace, armax: Polynomial, theta: NDArray) -> NDArray[np.float64]:
    """Parameters of the state-space model that is an ARMAX model of one output: returns (structure.n,)."""
    row, n = armax.coefficients(theta)[0], structure.order
    a, c = row["a"][0], row["c"][0]
    A = np.zeros((n, n))
    A[:, 0] = -a[1:]
    A[range(n - 1), range(1, n)] = 1.0
    C = np.zeros((1, n))
    C[0, 0] = 1.0
    b = np.column_stack([np.pad(x, (0, n + 1 - len(x))) for x in row["b"]])
    D = b[:1]
    B = b[1:] - a[1:, None] * D
    return structure.theta_of(A, B, C, D, (c[1:] - a[1:])[:, None])


def _stabilised(A: NDArray, C: NDArray, K: NDArray) -> NDArray:
    """K shrunk until A - K C is stable; the stationary Kalman gain of a stable A is at the end of the way."""
    for _ in range(30):
        if np.abs(np.linalg.eigvals(A - K @ C)).max() < 0.999:
            break
        K = 0.8 * K
    return K
