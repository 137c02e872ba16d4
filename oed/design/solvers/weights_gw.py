"""Optimal weights of given columns by a primal-dual interior-point method: G and W, the worst of several.

    minimise t subject to f_k(w) <= t, Q w <= 1, w >= 0,
    f_k = trace(V_k' M(w)^-1 V_k)  (G)   or   det(V_k' M(w)^-1 V_k)^(1/s)  (W), both convex in w,

with multipliers lambda_k >= 0 that sum to 1. With them it is one A design, X = M^-1 [sqrt(lambda_k) V_k], or one D
design, X = M^-1 [sqrt(lambda_k) V_k C_k^-1/2] with C_k = V_k' M^-1 V_k (where lambda_k > 0 the losses are equal).
"""

import numpy as np
from numpy.typing import NDArray

from oed.covariances import diagonal_blocks
from oed.criteria import Criterion
from oed.criteria.worst import WorstDeterminant
from oed.design.problem.lines import Columns
from oed.design.solvers.weights_da import Weights, gathered, inside, reach
from oed.errors import Status


def minimax_weights(
    columns: Columns, criterion: Criterion, constant: NDArray[np.float64], *,
    start: NDArray[np.float64] | None = None, tolerance: float = 1e-12, max_steps: int = 80,
) -> Weights:  # fmt: skip
    """Optimal weights for a G or W criterion: constant (n, n), start (m,)."""
    m, n, r = columns.F.shape
    K, _, size = criterion.V.shape
    Q, V = columns.q.T, criterion.columns
    flat = np.moveaxis(columns.F, 0, 1).reshape(n, m * r)

    worst_d = isinstance(criterion, WorstDeterminant)

    def derivatives(w: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """f (K,), df (K, m), Y = M^-1, and X_k (n, K s) with -df_k = trace(F' X_k X_k' F)."""
        M = constant + columns.information(w)
        np.linalg.cholesky(M)
        Y = np.linalg.inv(M)
        X = Y @ V
        if worst_d:
            own = np.linalg.cholesky(diagonal_blocks(V.T @ X, K))
            f = np.exp(2 * np.log(np.einsum("kss->ks", own)).mean(axis=1))
            X = np.einsum("nks,kts->nkt", X.reshape(n, K, size), np.linalg.inv(own))
            X = (X * np.sqrt(f / size)[:, None]).reshape(n, -1)
        else:
            f = np.einsum("nk,nk->k", V, X).reshape(K, size).sum(axis=1)
        half = X.T @ flat
        return f, -np.sum((half**2).reshape(K, size, m, r), axis=(1, 3)), (Y + Y.T) / 2, X

    def curvature(f: NDArray, df: NDArray, Y: NDArray, X: NDArray, lam: NDArray) -> NDArray:
        """Hessian of sum_k lambda_k f_k."""
        P = (X * np.repeat(lam, size)) @ X.T
        H = 2 * gathered((flat.T @ P @ flat) * (flat.T @ Y @ flat), r)
        if worst_d:
            # f = exp(g), g = log det / s: f (g'' + g' g'^T), and the second part of g'' is trace(A P A P) / s.
            for k in range(K):
                own = X[:, k * size : (k + 1) * size].T @ flat
                H -= (lam[k] * size / f[k]) * gathered((own.T @ own) ** 2, r)
            H += (df.T * (lam / f)) @ df
        return H

    w = inside(np.ones(m) if start is None else start, Q)
    f, df, Y, X = derivatives(w)
    t, lam = 1.1 * float(f.max()), np.full(K, 1.0 / K)
    slack, s = t - f, 1 - Q @ w
    nu = np.full(len(Q), t / len(Q))
    z = np.maximum(df.T @ lam + Q.T @ nu, 0.1 * t / m)
    count, status, step = K + m + len(Q), Status.MAX_ITERATIONS, 0

    def residual(w, df, slack, s, lam, z, nu, target):
        """Stationarity (in units of the weights) and centrality, as one vector."""
        dual = df.T @ lam + Q.T @ nu - z
        parts = (dual, [1 - lam.sum()], lam * slack - target, z * w - target, nu * s - target)
        return float(np.linalg.norm(np.concatenate(parts)))

    while step < max_steps:
        step += 1
        mu = (lam @ slack + w @ z + s @ nu) / count
        dual = df.T @ lam + Q.T @ nu - z
        if mu * count <= tolerance * t and max(np.abs(dual * w).sum() / t, abs(1 - lam.sum())) <= tolerance:
            status = Status.CONVERGED
            break
        target = mu * (0.1 if step % 4 else 0.3)
        H = curvature(f, df, Y, X, lam)
        # Unknowns dw, dt; slack and multipliers eliminated. Slack is always t - f itself.
        J = np.concatenate([df, -np.ones((K, 1))], axis=1)
        left = (J.T * (lam / slack)) @ J
        left[:m, :m] += H + np.diag(z / w) + (Q.T * (nu / s)) @ Q
        right = -np.concatenate(
            [df.T @ (target / slack) + Q.T @ (target / s) - target / w, [1 - (target / slack).sum()]]
        )
        try:
            solution = np.linalg.solve(left, right)
        except np.linalg.LinAlgError:
            break
        dw, dt = np.asarray(solution[:m], dtype=np.float64), float(solution[m])
        dslack, ds = dt - df @ dw, -Q @ dw
        dlam = target / slack - lam - lam / slack * dslack
        dz, dnu = target / w - z - z / w * dw, target / s - nu - nu / s * ds
        before = residual(w, df, slack, s, lam, z, nu, target)
        length = min(
            1.0, *(0.98 * reach(x, dx) for x, dx in ((w, dw), (s, ds), (lam, dlam), (z, dz), (nu, dnu)))
        )
        for _ in range(40):
            try:
                new = derivatives(w + length * dw)
            except np.linalg.LinAlgError:
                length *= 0.5
                continue
            left_over = t + length * dt - new[0]
            if np.all(left_over > 0.02 * slack * (1 - length)) and left_over.min() > 0:
                after = residual(
                    w + length * dw, new[1], left_over, s + length * ds, lam + length * dlam, z + length * dz,
                    nu + length * dnu, target,
                )  # fmt: skip
                if after <= (1 - 0.01 * length) * before:
                    break
            length *= 0.5
        else:
            break
        w, t, s = w + length * dw, t + length * dt, s + length * ds
        f, df, Y, X = new
        slack = t - f
        lam, z, nu = lam + length * dlam, z + length * dz, nu + length * dnu
    weight = np.clip(lam, 0, None) / lam.sum()
    return Weights(w, criterion.direction(constant + columns.information(w), weight), nu, status, step)
