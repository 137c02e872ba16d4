"""Optimal weights of given columns by a primal-dual interior-point (Newton) method: D and A.

    minimise f(w) = log det(V' M^-1 V)  or  trace(V' M^-1 V),   M = M_0 + sum_k w_k F_k F_k',
    subject to Q w <= 1, w >= 0.

With Y = M^-1 and P = X X' (X the certificate direction), df/dw_k = -tr(F_k' P F_k) and
d2f/dw_k dw_l = 2 tr(A_k P A_l Y) - [D] tr(A_k P A_l P); both are entrywise products of small Gram matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.columns import Columns
from oed.errors import Status

__all__ = ["Weights", "inside", "interior_point", "reach"]


@dataclass(frozen=True, eq=False)
class Weights:
    """Optimal weights of a set of columns, with their dual.

    Attributes
    ----------
    w : ndarray
        (m,) weights.
    X : ndarray
        (n, s) certificate direction.
    nu : ndarray
        (J,) multipliers of the budgets.
    status : Status
        How the solver ended.
    steps : int
        Iterations.
    """

    w: NDArray[np.float64]
    X: NDArray[np.float64]
    nu: NDArray[np.float64]
    status: Status
    steps: int


def interior_point(
    columns: Columns,
    criterion: Criterion,
    constant: NDArray[np.float64],
    *,
    start: NDArray[np.float64] | None = None,
    tolerance: float = 1e-13,
    max_steps: int = 80,
) -> Weights:
    """Optimal weights for a D or A criterion.

    Parameters
    ----------
    columns : Columns
        The candidate lines.
    criterion : Criterion
        Of kind D or A.
    constant : ndarray
        (n, n) information M_0.
    start : ndarray, optional
        (m,) weights to start from.
    tolerance : float
        Complementarity per column, relative to the budget's price, at which to stop.
    max_steps : int
        Iteration limit.

    Returns
    -------
    Weights
        Weights and multipliers.
    """
    m, n, r = columns.F.shape
    Q = columns.q.T
    flat = np.moveaxis(columns.F, 0, 1).reshape(n, m * r)
    w = inside(np.ones(m) if start is None else start, Q)
    M = constant + (flat * np.repeat(w, r)) @ flat.T
    loss = 1.0 if criterion.kind == "D" else criterion.loss(M)
    scale = 1 / loss if np.isfinite(loss) else 1.0  # singular to rounding at the start: no natural size
    gradient, hessian, X = _derivatives(flat, r, M, criterion, scale)
    worth = max(float(-gradient @ w), 1e-300)
    nu = np.full(len(Q), worth / len(Q))
    s = 1 - Q @ w
    z = np.maximum(gradient + Q.T @ nu, 0.1 * worth / m)
    status = Status.MAX_ITERATIONS
    for step in range(1, max_steps + 1):
        mu = (w @ z + s @ nu) / (m + len(Q))
        dual = gradient + Q.T @ nu - z
        total = float(nu.sum())
        if mu * (m + len(Q)) <= tolerance * total and np.abs(dual * w).sum() <= tolerance * total:
            status = Status.CONVERGED
            break
        target = mu * (0.1 if step % 4 else 0.3)
        left = hessian + (Q.T * (nu / s)) @ Q
        left[np.diag_indices(m)] += z / w
        right = -(gradient - target / w + Q.T @ (target / s))
        try:
            dw = np.linalg.solve(left, right)
        except np.linalg.LinAlgError:
            break
        ds = -Q @ dw
        dz = target / w - z - z / w * dw
        dnu = target / s - nu - nu / s * ds
        ahead = min(1.0, 0.99 * reach(w, dw), 0.99 * reach(s, ds))
        ahead_dual = min(1.0, 0.99 * reach(z, dz), 0.99 * reach(nu, dnu))
        for _ in range(30):
            trial, slack = w + ahead * dw, s + ahead * ds
            M = constant + (flat * np.repeat(trial, r)) @ flat.T
            try:
                new = _derivatives(flat, r, M, criterion, scale)
            except np.linalg.LinAlgError:
                ahead *= 0.5
                continue
            # Along the step the barrier function must not turn up more than it went down at the start.
            slope_old = float((gradient - target / w + Q.T @ (target / s)) @ dw)
            slope_new = float((new[0] - target / trial + Q.T @ (target / slack)) @ dw)
            if slope_new <= 0.9 * abs(slope_old) + 1e-14:
                break
            ahead *= 0.5
        else:
            break
        z_new, nu_new = z + ahead_dual * dz, nu + ahead_dual * dnu
        if not all(np.isfinite(x).all() for x in (trial, slack, z_new, nu_new, *new)):
            status = Status.NOT_FINITE  # the last finite point is kept
            break
        w, s, z, nu = trial, slack, z_new, nu_new
        gradient, hessian, X = new
    return Weights(w, X / np.sqrt(scale), nu / scale, status, step)


def inside(w: NDArray[np.float64], Q: NDArray[np.float64]) -> NDArray[np.float64]:
    """A strictly feasible point near w.

    Parameters
    ----------
    w : ndarray
        (m,) weights, at least 0.
    Q : ndarray
        (J, m) shares of the budgets.

    Returns
    -------
    ndarray
        (m,) positive, Q w < 1.
    """
    w = np.maximum(w, 1e-3 * w.sum() / len(w))
    return w * (0.95 / (Q @ w).max())


def reach(x: NDArray[np.float64], dx: NDArray[np.float64]) -> float:
    """Largest step that keeps x + step dx at least 0.

    Parameters
    ----------
    x : ndarray
        Positive.
    dx : ndarray
        Direction.

    Returns
    -------
    float
        The step; infinite where nothing goes down.
    """
    down = dx < 0
    return float(np.min(-x[down] / dx[down])) if down.any() else np.inf


def _derivatives(
    flat: NDArray[np.float64], r: int, M: NDArray[np.float64], criterion: Criterion, scale: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Gradient (m,), Hessian (m, m) and certificate direction, all in the scaled objective."""
    m, V = flat.shape[1] // r, criterion.columns
    inverse = np.asarray(np.linalg.inv(np.linalg.cholesky(M)), dtype=np.float64)
    half = inverse @ flat
    CY = half.T @ half
    if criterion.kind == "D" and V.shape[1] == len(V):
        # X X' = M^-1 whatever V: the priced columns are the ones that are there already.
        return -_blocks(half, r), (CY**2).reshape(m, r, m, r).sum(axis=(1, 3)), np.asarray(inverse.T)
    if criterion.kind == "A":
        X = inverse.T @ (inverse @ V) * np.sqrt(scale)
    else:
        X = criterion.direction(M)
    priced = X.T @ flat
    CP = priced.T @ priced
    product = CP * (2 * CY - CP if criterion.kind == "D" else 2 * CY)
    return -_blocks(priced, r), product.reshape(m, r, m, r).sum(axis=(1, 3)), X


def _blocks(priced: NDArray[np.float64], r: int) -> NDArray[np.float64]:
    """Squares summed over the rows and the r entries of every column."""
    return np.einsum("nk,nk->k", priced, priced).reshape(-1, r).sum(axis=1)
