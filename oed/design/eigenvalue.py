"""Optimal weights of given columns by a primal-dual interior-point method: E.

    maximise t subject to S = M(w) - t V V' positive semidefinite, Q w <= 1, w >= 0   (t = 1 / loss)

with multipliers Z of S (the certificate, tr V'ZV = 1), nu and z. The direction is that of Helmberg, Rendl,
Vanderbei and Wolkowicz (SIAM J. Optimization 6 (1996) 342-361): dZ = mu S^-1 - Z - sym(S^-1 dS Z), whose normal
equations tr(A_k S^-1 A_l Z) are entrywise products of two Gram matrices of the columns' factors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.columns import Columns
from oed.design.interior import Weights, blocks, gathered, inside, reach
from oed.errors import Status

__all__ = ["eigenvalue_weights"]


def _psd_reach(L: NDArray[np.float64], dS: NDArray[np.float64]) -> float:
    """Largest step that keeps L L' + step dS positive semidefinite."""
    from scipy.linalg import solve_triangular

    half = solve_triangular(L, solve_triangular(L, dS, lower=True).T, lower=True)
    lowest = float(np.linalg.eigvalsh((half + half.T) / 2)[0])
    return -1 / lowest if lowest < 0 else np.inf


def eigenvalue_weights(
    columns: Columns,
    criterion: Criterion,
    constant: NDArray[np.float64],
    *,
    start: NDArray[np.float64] | None = None,
    tolerance: float = 1e-12,
    max_steps: int = 60,
) -> Weights:
    """Optimal weights for an E criterion.

    Parameters
    ----------
    columns : Columns
        The candidate lines.
    criterion : Criterion
        Of kind E.
    constant : ndarray
        (n, n) information M_0.
    start : ndarray, optional
        (m,) weights to start from.
    tolerance : float
        Relative complementarity at which to stop.
    max_steps : int
        Iteration limit.

    Returns
    -------
    Weights
        Weights, X with X X' = Z, and the budgets' multipliers.
    """
    from scipy.linalg import solve_triangular

    m, n, r = columns.F.shape
    Q, V = columns.q.T, criterion.columns
    flat = np.moveaxis(columns.F, 0, 1).reshape(n, m * r)
    w = inside(np.ones(m) if start is None else start, Q)
    M = constant + columns.information(w)
    t = 0.7 / criterion.loss(M)
    S = M - t * (V @ V.T)
    L = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
    Y = np.linalg.inv(S)
    Z = Y / np.trace(V.T @ Y @ V)
    s = 1 - Q @ w
    worth = np.einsum("nk,nk->k", flat, Z @ flat).reshape(m, r).sum(axis=1)
    nu = np.full(len(Q), float(worth @ w) / len(Q))
    z = np.maximum(Q.T @ nu - worth, 0.1 * float(worth @ w) / m)
    # tr(A_k S^-1 A_l Z) entry by entry, or as products of n x n blocks: whichever is less work.
    few, transposed = n * n <= r * r * (2 * n + 20), blocks(flat, r).swapaxes(1, 2)
    count, status, step = m + len(Q) + n, Status.MAX_ITERATIONS, 0
    while step < max_steps:
        step += 1
        mu = (w @ z + s @ nu + np.sum(S * Z)) / count
        dual = Q.T @ nu - worth - z
        if mu * count <= tolerance * t and np.abs(dual * w).sum() <= tolerance * t:
            status = Status.CONVERGED
            break
        target = mu * (0.1 if step % 4 else 0.3)
        half = solve_triangular(L, flat, lower=True)
        ZF, ZV = Z @ flat, Z @ V
        YV = np.linalg.solve(L.T, np.linalg.solve(L, V))
        if few:
            G = blocks(half, r) @ transposed
            H = G.reshape(m, -1) @ (G @ Z).reshape(m, -1).T
        else:
            H = gathered((half.T @ half) * (flat.T @ ZF), r)
        h = np.sum((flat.T @ YV) * (flat.T @ ZV), axis=1).reshape(m, r).sum(axis=1)
        g = float(np.sum((V.T @ YV) * (V.T @ ZV)))
        left = np.zeros((m + 1, m + 1))
        left[:m, :m] = H + np.diag(z / w) + (Q.T * (nu / s)) @ Q
        left[:m, m] = left[m, :m] = -h
        left[m, m] = g
        spread = np.sum(half**2, axis=0).reshape(m, r).sum(axis=1)
        right = np.concatenate(
            [target * (spread + 1 / w - Q.T @ (1 / s)), [1 - target * float(np.trace(V.T @ YV))]]
        )
        try:
            solution = np.linalg.solve(left, right)
        except np.linalg.LinAlgError:
            break
        dw, dt = np.asarray(solution[:m], dtype=np.float64), float(solution[m])
        dS = (flat * np.repeat(dw, r)) @ flat.T - dt * (V @ V.T)
        Y = np.linalg.inv(L)
        Y = Y.T @ Y
        turned = Y @ dS @ Z
        dZ = target * Y - Z - (turned + turned.T) / 2
        ds = -Q @ dw
        dz = target / w - z - z / w * dw
        dnu = target / s - nu - nu / s * ds
        try:
            ahead = min(1.0, 0.95 * _psd_reach(L, dS), 0.95 * reach(w, dw), 0.95 * reach(s, ds))
            behind = min(
                1.0,
                0.95 * _psd_reach(np.asarray(np.linalg.cholesky(Z)), dZ),
                0.95 * reach(z, dz),
                0.95 * reach(nu, dnu),
            )
            w, t, s = w + ahead * dw, t + ahead * dt, s + ahead * ds
            S = constant + columns.information(w) - t * (V @ V.T)
            L = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
        except np.linalg.LinAlgError:
            break
        Z, z, nu = Z + behind * dZ, z + behind * dz, nu + behind * dnu
        worth = np.einsum("nk,nk->k", flat, Z @ flat).reshape(m, r).sum(axis=1)
    values, vectors = np.linalg.eigh(Z)
    X = vectors * np.sqrt(np.clip(values, 0, None))
    return Weights(np.maximum(w, 0.0), X[:, ::-1], nu, status, step)
