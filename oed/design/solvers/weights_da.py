"""Optimal weights of given columns by a primal-dual interior-point (Newton) method: D, A and what is smooth like them.

    minimise f(w) = log det(V' M^-1 V)  or  trace(V' M^-1 V),   M = M_0 + sum_k w_k F_k F_k',
    subject to Q w <= 1, w >= 0.

With Y = M^-1 and P = X X' (X the certificate direction), df/dw_k = -tr(F_k' P F_k) and
d2f/dw_k dw_l = 2 tr(A_k P A_l Y) - c tr(A_k P A_l P), c the criterion's curvature (1 for D, 0 for A); both are entrywise products of small Gram matrices.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.criteria.determinant import Determinant
from oed.design.problem.lines import Columns
from oed.errors import SolverFailure, Status


@dataclass(frozen=True, eq=False)
class Weights:
    """Optimal weights of a set of columns, with their dual. `w` (m,) weights; `X` (n, s) certificate
    direction; `nu` (J,) multipliers of the budgets; `status` how the solver ended; `steps` iterations."""

    w: NDArray[np.float64]
    X: NDArray[np.float64]
    nu: NDArray[np.float64]
    status: Status
    steps: int


def interior_point(
    columns: Columns, criterion: Criterion, constant: NDArray[np.float64], *,
    start: NDArray[np.float64] | None = None, tolerance: float = 1e-13, max_steps: int = 80,
) -> Weights:  # fmt: skip
    """Optimal weights for a smooth criterion: constant (n, n), start (m,)."""
    m, n, r = columns.F.shape
    Q = columns.q.T
    flat = np.moveaxis(columns.F, 0, 1).reshape(n, m * r)
    # Weights and slacks s = 1 - Q w in one vector x, their multipliers z and nu in one vector y.
    x = np.empty(m + len(Q))
    x[:m] = inside(np.ones(m) if start is None else start, Q)
    x[m:] = 1 - Q @ x[:m]
    M = constant + (flat * np.repeat(x[:m], r)) @ flat.T
    # A trace has no natural size: its value at the start is the unit.
    scale = 1.0
    try:
        if not criterion.logarithmic:
            half = _inverse_root(M) @ criterion.columns
            scale = 1 / criterion.of_covariance(half.T @ half)
        gradient, hessian, X = _derivatives(flat, r, M, criterion, scale)
    except np.linalg.LinAlgError:
        raise SolverFailure(
            "the information of all lines together has no inverse in double precision: the sizes of the plant's gains or its "
            "poles are too far apart for this criterion; scale its channels, or leave parameters out of `free`."
        ) from None
    worth = max(float(-gradient @ x[:m]), 1e-300)
    y = np.empty_like(x)
    y[m:] = worth / len(Q)
    y[:m] = np.maximum(gradient + y[m:] @ Q, 0.1 * worth / m)
    status = Status.MAX_ITERATIONS
    for step in range(1, max_steps + 1):
        gap = float(x @ y)
        dual = gradient + y[m:] @ Q - y[:m]
        total = float(y[m:].sum())
        if gap <= tolerance * total and np.abs(dual) @ x[:m] <= tolerance * total:
            status = Status.CONVERGED
            break
        target = gap / len(x) * (0.1 if step % 4 else 0.3)
        ratio, pull = y / x, target / x
        left = hessian + (Q.T * ratio[m:]) @ Q
        left.flat[:: m + 1] += ratio[:m]
        slope = gradient - pull[:m] + pull[m:] @ Q
        dx = np.empty_like(x)
        try:
            dx[:m] = _solved(left, -slope)
        except np.linalg.LinAlgError:
            break
        dx[m:] = -(Q @ dx[:m])
        dy = pull - y - ratio * dx
        ahead, ahead_dual = min(1.0, 0.99 * reach(x, dx)), min(1.0, 0.99 * reach(y, dy))
        slope_old = abs(float(slope @ dx[:m]))
        for _ in range(30):
            trial = x + ahead * dx
            M = constant + (flat * np.repeat(trial[:m], r)) @ flat.T
            try:
                new = _derivatives(flat, r, M, criterion, scale)
            except np.linalg.LinAlgError:
                ahead *= 0.5
                continue
            # Along the step the barrier function must not turn up more than it went down at the start.
            if float(new[0] @ dx[:m] - target * np.sum(dx / trial)) <= 0.9 * slope_old + 1e-14:
                break
            ahead *= 0.5
        else:
            break
        y_new = y + ahead_dual * dy
        if not np.isfinite(trial @ y_new + new[0].sum() + new[1].sum() + new[2].sum()):
            status = Status.NOT_FINITE  # the last finite point is kept
            break
        x, y = trial, y_new
        gradient, hessian, X = new
    return Weights(x[:m], X / np.sqrt(scale), y[m:] / scale, status, step)


def _solved(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution of a system that is positive definite, but perhaps not to rounding."""
    from scipy.linalg.lapack import dposv

    _, solution, info = dposv(left, right)
    return np.asarray(np.linalg.solve(left, right) if info else solution, dtype=np.float64)


def inside(w: NDArray[np.float64], Q: NDArray[np.float64]) -> NDArray[np.float64]:
    """A strictly feasible point near w: w (m,), Q (J, m) -> (m,)."""
    w = np.maximum(w, 1e-3 * w.sum() / len(w))
    return w * (0.95 / (Q @ w).max())


def reach(x: NDArray[np.float64], dx: NDArray[np.float64]) -> float:
    """Largest step that keeps x + step dx at least 0."""
    lowest = float((dx / x).min(initial=0.0))
    return -1 / lowest if lowest < 0 else np.inf


def _derivatives(
    flat: NDArray[np.float64], r: int, M: NDArray[np.float64], criterion: Criterion, scale: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Gradient (m,), Hessian (m, m) and certificate direction, all in the scaled objective."""
    V = criterion.columns
    inverse = _inverse_root(M)
    half = inverse @ flat
    curvature = criterion.curvature or 0.0
    whole = isinstance(criterion, Determinant) and V.shape[1] == len(V)
    if whole:
        # X X' = M^-1 whatever V: the priced columns are the ones that are there already
        X = np.asarray(inverse.T)
    else:
        Y = inverse.T @ (inverse @ V)
        X = criterion.turned(Y, V.T @ Y, None) * np.sqrt(scale)
    priced = half if whole else X.T @ flat
    n, s = X.shape
    if r > 2 and n * s <= r * r * (n + s + 20):
        # <G_k, G_l> with G_k = X'F_k F_k'L^-T: less work than the Gram matrices of all columns' entries.
        G = _squares(priced, half, r)
        hessian = G @ G.T
        if not whole:
            hessian *= 2.0
            if curvature:
                G = _squares(priced, priced, r)
                hessian -= curvature * G @ G.T
    else:
        CY = half.T @ half
        CP = CY if whole else priced.T @ priced
        hessian = gathered(CP * (2 * CY - curvature * CP if curvature else 2 * CY), r)
    return -_blocks(priced, r), hessian, X


def _squares(one: NDArray[np.float64], other: NDArray[np.float64], r: int) -> NDArray[np.float64]:
    """one_k other_k' of every column k, flat: (m, n s)."""
    product = blocks(one, r) @ blocks(other, r).swapaxes(1, 2)
    return product.reshape(len(product), -1)


def blocks(flat: NDArray[np.float64], r: int) -> NDArray[np.float64]:
    """The columns apart: flat (n, m r) -> (m, n, r)."""
    return flat.reshape(len(flat), -1, r).swapaxes(0, 1)


def _inverse_root(M: NDArray[np.float64]) -> NDArray[np.float64]:
    """L^-1 of M = L L'; LAPACK's own routines, for the matrices are small and the calls many."""
    from scipy.linalg.lapack import dpotrf, dtrtri

    L, info = dpotrf(M, lower=1)
    if info:
        raise np.linalg.LinAlgError("the information is not positive definite")
    return np.asarray(dtrtri(L, lower=1)[0], dtype=np.float64)


def gathered(product: NDArray[np.float64], r: int) -> NDArray[np.float64]:
    """Sums over the r x r blocks of a Gram matrix: one entry per pair of columns; product (m r, m r) -> (m,
    m)."""
    # Strided slices are several times faster than a sum over two short axes.
    rows = product[0::r].copy()
    for k in range(1, r):
        rows += product[k::r]
    sums = rows[:, 0::r].copy()
    for k in range(1, r):
        sums += rows[:, k::r]
    return sums


def _blocks(priced: NDArray[np.float64], r: int) -> NDArray[np.float64]:
    """Squares summed over the rows and the r entries of every column."""
    return np.einsum("nk,nk->k", priced, priced).reshape(-1, r).sum(axis=1)
