"""Optimal weights of given columns by a primal-dual interior-point method: E.

    maximise t subject to S = M(w) - t V V' positive semidefinite, Q w <= 1, w >= 0   (t = 1 / loss)

with multipliers Z of S (the certificate, tr V'ZV = 1), nu and z. The direction is that of Helmberg, Rendl,
Vanderbei and Wolkowicz (SIAM J. Optimization 6 (1996) 342-361): dZ = mu S^-1 - Z - sym(S^-1 dS Z), whose normal
equations tr(A_k S^-1 A_l Z) are entrywise products of two Gram matrices of the columns' factors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.problem.lines import Columns
from oed.design.solvers.weights_da import Weights, blocks, gathered, inside, reach
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

    Shapes: constant (n, n), start (m,).
    """
    m, n, r = columns.F.shape
    Q, V = columns.q.T, criterion.columns
    problem = _Problem(columns, constant, np.moveaxis(columns.F, 0, 1).reshape(n, m * r), Q, V)
    now = problem.first(inside(np.ones(m) if start is None else start, Q), criterion)
    count, status, step = m + len(Q) + n, Status.MAX_ITERATIONS, 0
    while step < max_steps:
        step += 1
        mu = float(now.w @ now.z + now.s @ now.nu + np.sum(now.S * now.Z)) / count
        dual = Q.T @ now.nu - problem.worth(now.Z) - now.z
        if mu * count <= tolerance * now.t and np.abs(dual * now.w).sum() <= tolerance * now.t:
            status = Status.CONVERGED
            break
        try:
            now = problem.next(now, mu * (0.1 if step % 4 else 0.3))
        except np.linalg.LinAlgError:
            break
    values, vectors = np.linalg.eigh(now.Z)
    X = vectors * np.sqrt(np.clip(values, 0, None))
    return Weights(np.maximum(now.w, 0.0), X[:, ::-1], now.nu, status, step)


@dataclass(frozen=True, eq=False)
class _Iterate:
    """Weights w, t and slacks s = 1 - Q w; S = L L'; multipliers Z of S, z of w and nu of the budgets."""

    w: NDArray[np.float64]
    t: float
    s: NDArray[np.float64]
    S: NDArray[np.float64]
    L: NDArray[np.float64]
    Z: NDArray[np.float64]
    z: NDArray[np.float64]
    nu: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Problem:
    """Columns, M_0, the columns' factors side by side (n, m r), the budgets' shares (J, m) and V."""

    columns: Columns
    constant: NDArray[np.float64]
    flat: NDArray[np.float64]
    Q: NDArray[np.float64]
    V: NDArray[np.float64]

    def worth(self, Z: NDArray[np.float64]) -> NDArray[np.float64]:
        """tr(A_k Z) of every column."""
        return np.einsum("nk,nk->k", self.flat, Z @ self.flat).reshape(self.Q.shape[1], -1).sum(axis=1)

    def first(self, w: NDArray[np.float64], criterion: Criterion) -> _Iterate:
        """An iterate inside, from weights inside."""
        Q, V = self.Q, self.V
        M = self.constant + self.columns.information(w)
        t = 0.7 / criterion.loss(M)
        S = M - t * (V @ V.T)
        L = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
        Y = np.asarray(np.linalg.inv(S), dtype=np.float64)
        Z = np.asarray(Y / np.trace(V.T @ Y @ V), dtype=np.float64)
        worth = self.worth(Z)
        nu = np.full(len(Q), float(worth @ w) / len(Q))
        z = np.maximum(Q.T @ nu - worth, 0.1 * float(worth @ w) / len(w))
        return _Iterate(w, t, 1 - Q @ w, S, L, Z, z, nu)

    def next(self, now: _Iterate, target: float) -> _Iterate:
        """One step towards complementarity `target`; LinAlgError where rounding leaves the cone."""
        Q, V, flat = self.Q, self.V, self.flat
        m, r = len(now.w), flat.shape[1] // len(now.w)
        solution = np.asarray(np.linalg.solve(*self._normal_equations(now, target)), dtype=np.float64)
        dw, dt = solution[:m], float(solution[m])
        dS = (flat * np.repeat(dw, r)) @ flat.T - dt * (V @ V.T)
        root = np.asarray(np.linalg.inv(now.L), dtype=np.float64)
        Y = root.T @ root
        turned = Y @ dS @ now.Z
        dZ = target * Y - now.Z - (turned + turned.T) / 2
        ds = -Q @ dw
        dz = target / now.w - now.z - now.z / now.w * dw
        dnu = target / now.s - now.nu - now.nu / now.s * ds
        ahead = min(1.0, 0.95 * _psd_reach(now.L, dS), 0.95 * reach(now.w, dw), 0.95 * reach(now.s, ds))
        half = np.asarray(np.linalg.cholesky(now.Z), dtype=np.float64)
        behind = min(1.0, 0.95 * _psd_reach(half, dZ), 0.95 * reach(now.z, dz), 0.95 * reach(now.nu, dnu))
        w, t = now.w + ahead * dw, now.t + ahead * dt
        S = self.constant + self.columns.information(w) - t * (V @ V.T)
        L = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
        s, Z = now.s + ahead * ds, now.Z + behind * dZ
        return _Iterate(w, t, s, S, L, Z, now.z + behind * dz, now.nu + behind * dnu)

    def _normal_equations(
        self, now: _Iterate, target: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix and right-hand side for the steps of w and t together."""
        from scipy.linalg import solve_triangular

        Q, V, flat, L, Z = self.Q, self.V, self.flat, now.L, now.Z
        n, m, r = len(flat), len(now.w), flat.shape[1] // len(now.w)
        half = np.asarray(solve_triangular(L, flat, lower=True), dtype=np.float64)
        ZF, ZV = Z @ flat, Z @ V
        YV = np.asarray(np.linalg.solve(L.T, np.linalg.solve(L, V)), dtype=np.float64)
        # tr(A_k S^-1 A_l Z) entry by entry, or as products of n x n blocks: whichever is less work.
        if n * n <= r * r * (2 * n + 20):
            G = blocks(half, r) @ blocks(flat, r).swapaxes(1, 2)
            H = G.reshape(m, -1) @ (G @ Z).reshape(m, -1).T
        else:
            H = gathered((half.T @ half) * (flat.T @ ZF), r)
        h = np.sum((flat.T @ YV) * (flat.T @ ZV), axis=1).reshape(m, r).sum(axis=1)
        left = np.zeros((m + 1, m + 1))
        left[:m, :m] = H + np.diag(now.z / now.w) + (Q.T * (now.nu / now.s)) @ Q
        left[:m, m] = left[m, :m] = -h
        left[m, m] = float(np.sum((V.T @ YV) * (V.T @ ZV)))
        right = np.empty(m + 1)
        spread = np.sum(half**2, axis=0).reshape(m, r).sum(axis=1)
        right[:m] = target * (spread + 1 / now.w - Q.T @ (1 / now.s))
        right[m] = 1 - target * float(np.trace(V.T @ YV))
        return left, right
