"""Optimal weights of given columns by a primal-dual interior-point method: G, the worst of several.

    minimise t subject to f_k(w) = trace(V_k' M(w)^-1 V_k) <= t, Q w <= 1, w >= 0

with multipliers lambda_k >= 0 that sum to 1: they weight the combinations, and with them the problem is an A
design, which gives the certificate X = M^-1 [sqrt(lambda_k) V_k].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.columns import Columns
from oed.design.interior import Weights, inside, reach
from oed.errors import Status

__all__ = ["minimax_weights"]


def minimax_weights(
    columns: Columns,
    criterion: Criterion,
    constant: NDArray[np.float64],
    *,
    start: NDArray[np.float64] | None = None,
    tolerance: float = 1e-12,
    max_steps: int = 80,
) -> Weights:
    """Optimal weights for a G criterion.

    Parameters
    ----------
    columns : Columns
        The candidate lines.
    criterion : Criterion
        Of kind G.
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
        Weights, X and the budgets' multipliers.
    """
    m, n, r = columns.F.shape
    K, _, size = criterion.V.shape
    Q, V = columns.q.T, criterion.columns
    flat = np.moveaxis(columns.F, 0, 1).reshape(n, m * r)

    def derivatives(w: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """f (K,), df (K, m), and Y = M^-1."""
        M = constant + columns.information(w)
        np.linalg.cholesky(M)
        Y = np.linalg.inv(M)
        half = V.T @ (Y @ flat)
        f = np.einsum("nk,nk->k", V, Y @ V).reshape(K, size).sum(axis=1)
        return f, -np.sum((half**2).reshape(K, size, m, r), axis=(1, 3)), (Y + Y.T) / 2

    w = inside(np.ones(m) if start is None else start, Q)
    f, df, Y = derivatives(w)
    t, lam = 1.05 * float(f.max()), np.full(K, 1.0 / K)
    s = 1 - Q @ w
    nu = np.full(len(Q), t / len(Q))
    z = np.maximum(df.T @ lam + Q.T @ nu, 0.1 * t / m)
    slack, count, status, step = t - f, K + m + len(Q), Status.MAX_ITERATIONS, 0
    while step < max_steps:
        step += 1
        mu = (lam @ slack + w @ z + s @ nu) / count
        dual = df.T @ lam + Q.T @ nu - z
        error = max(np.abs(dual * w).sum() / t, abs(1 - lam.sum()), np.abs(t - f - slack).max() / t)
        if mu * count <= tolerance * t and error <= tolerance:
            status = Status.CONVERGED
            break
        target = mu * (0.1 if step % 4 else 0.3)
        P = (Y @ V) * np.repeat(lam, size)
        P = P @ (V.T @ Y)
        H = 2 * ((flat.T @ P @ flat) * (flat.T @ Y @ flat)).reshape(m, r, m, r).sum(axis=(1, 3))
        # Unknowns dw, dt; slack and multipliers eliminated: dslack = dt - df dw + (t - f - slack).
        off = t - f - slack
        ratio = lam / slack
        J = np.concatenate([df, -np.ones((K, 1))], axis=1)
        left = (J.T * ratio) @ J
        left[:m, :m] += H + np.diag(z / w) + (Q.T * (nu / s)) @ Q
        lam_next = target / slack - ratio * off
        right = -np.concatenate([df.T @ lam_next + Q.T @ (target / s) - target / w, [1 - lam_next.sum()]])
        try:
            solution = np.linalg.solve(left, right)
        except np.linalg.LinAlgError:
            break
        dw, dt = np.asarray(solution[:m], dtype=np.float64), float(solution[m])
        dslack = dt - df @ dw + off
        dlam = target / slack - lam - ratio * dslack
        ds = -Q @ dw
        dz, dnu = target / w - z - z / w * dw, target / s - nu - nu / s * ds
        ahead = min(1.0, 0.95 * reach(w, dw), 0.95 * reach(s, ds), 0.95 * reach(slack, dslack))
        behind = min(1.0, 0.95 * reach(lam, dlam), 0.95 * reach(z, dz), 0.95 * reach(nu, dnu))
        try:
            for _ in range(25):
                new = derivatives(w + ahead * dw)
                # The true slack must stay positive too, or the linearisation was trusted too far.
                if np.all(t + ahead * dt - new[0] > -0.5 * np.abs(slack) - 1e-12 * t):
                    break
                ahead *= 0.6
        except np.linalg.LinAlgError:
            break
        w, t, s = w + ahead * dw, t + ahead * dt, s + ahead * ds
        f, df, Y = new
        slack = np.maximum(t - f, 0.05 * (slack + ahead * dslack))
        lam, z, nu = lam + behind * dlam, z + behind * dz, nu + behind * dnu
    weight = np.clip(lam, 0, None) / lam.sum()
    return Weights(w, criterion.direction(constant + columns.information(w), weight), nu, status, step)
