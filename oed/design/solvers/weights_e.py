"""Optimal weights of given columns by a primal-dual interior-point method: E.

    maximise t subject to S = M(w) - t V V' positive semidefinite, Q w <= 1, w >= 0   (t = 1 / loss)

with multipliers Z of S (the certificate, tr V'ZV = 1), nu and z. The direction is that of Helmberg, Rendl,
Vanderbei and Wolkowicz (SIAM J. Optimization 6 (1996) 342-361): dZ = mu S^-1 - Z - sym(S^-1 dS Z), whose normal
equations tr(A_k S^-1 A_l Z) are entrywise products of two Gram matrices of the columns' factors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.covariances import square_root
from oed.criteria import Criterion
from oed.design.problem.lines import Columns
from oed.design.solvers.weights_da import Weights, blocks, gathered, inside, reach
from oed.errors import Status

PATIENCE = 3
"""Steps that do not come nearer after which rounding is all that is left."""
BEFORE = 0.95
"""Share of the way to the boundary of the cone that a step goes."""


def _psd_reach(L: NDArray[np.float64], dS: NDArray[np.float64]) -> float:
    """Largest step that keeps L L' + step dS positive semidefinite."""
    from scipy.linalg import solve_triangular

    half = solve_triangular(L, solve_triangular(L, dS, lower=True).T, lower=True)
    lowest = float(np.linalg.eigvalsh((half + half.T) / 2)[0])
    return -1 / lowest if lowest < 0 else np.inf


def eigenvalue_weights(
    columns: Columns, criterion: Criterion, constant: NDArray[np.float64], *,
    start: NDArray[np.float64] | None = None, tolerance: float = 1e-12, max_steps: int = 60,
) -> Weights:  # fmt: skip
    """Optimal weights for an E criterion: constant (n, n), start (m,)."""
    m, n, r = columns.F.shape
    Q, V = columns.q.T, criterion.columns
    problem = _Problem(columns, constant, np.moveaxis(columns.F, 0, 1).reshape(n, m * r), Q, V)
    now = problem.first(inside(np.ones(m) if start is None else start, Q), criterion)
    status, step, left, stalled = Status.MAX_ITERATIONS, 0, np.inf, 0
    while step < max_steps:
        step += 1
        mu = float(now.w @ now.z + now.s @ now.nu + np.sum(now.S * now.Z)) / problem.count
        dual = Q.T @ now.nu - problem.worth(now.Z) - now.z
        off = float(np.abs(dual * now.w).sum()) / now.t
        if mu * problem.count <= tolerance * now.t:
            stalled = 0 if off < left else stalled + 1
            if min(off, left) <= tolerance or stalled == PATIENCE:
                status = Status.CONVERGED if off <= tolerance else Status.INACCURATE
                break
            left = min(left, off)
        try:
            now = problem.next(now, mu)
        except np.linalg.LinAlgError:
            break
    return Weights(np.maximum(now.w, 0.0), square_root(now.Z)[:, ::-1], now.nu, status, step)


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
class _Step:
    """Changes of the parts of an iterate of the same names."""

    w: NDArray[np.float64]
    t: float
    s: NDArray[np.float64]
    S: NDArray[np.float64]
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

    def next(self, now: _Iterate, mu: float) -> _Iterate:
        """One predictor-corrector step from complementarity mu; LinAlgError where rounding leaves the cone."""
        from scipy.linalg.lapack import dgetrf, dgetrs

        left, towards = self._normal_equations(now)
        root = np.asarray(np.linalg.inv(now.L), dtype=np.float64)
        half = np.asarray(np.linalg.cholesky(now.Z), dtype=np.float64)
        Y = root.T @ root
        lu, pivots, singular = dgetrf(left)
        if singular:
            raise np.linalg.LinAlgError

        def step(target: float, bent: _Step | None) -> _Step:
            right = target * towards
            right[-1] += 1
            C, cz, cs = np.zeros(Y.shape), np.zeros(len(now.w)), np.zeros(len(now.s))
            if bent is not None:  # what the predictor's changes do to one another
                C = Y @ bent.S @ bent.Z
                C, cz, cs = (C + C.T) / 2, bent.w * bent.z / now.w, bent.s * bent.nu / now.s
                right -= np.append(self.worth(C) + cz - self.Q.T @ cs, -np.sum(self.V * (C @ self.V)))
            solution = np.asarray(dgetrs(lu, pivots, right)[0], dtype=np.float64)
            dw, dt = solution[:-1], float(solution[-1])
            dS = (self.flat * np.repeat(dw, self.flat.shape[1] // len(dw))) @ self.flat.T - dt * (
                self.V @ self.V.T
            )
            turned = Y @ dS @ now.Z
            ds = -self.Q @ dw
            return _Step(
                dw, dt, ds, dS,
                target * Y - now.Z - (turned + turned.T) / 2 - C,
                target / now.w - now.z - now.z / now.w * dw - cz,
                target / now.s - now.nu - now.nu / now.s * ds - cs,
            )  # fmt: skip

        def reaches(d: _Step) -> tuple[float, float]:
            ahead = min(_psd_reach(now.L, d.S), reach(now.w, d.w), reach(now.s, d.s))
            return ahead, min(_psd_reach(half, d.Z), reach(now.z, d.z), reach(now.nu, d.nu))

        d = step(0.0, None)
        p, q = (min(1.0, length) for length in reaches(d))
        after = (now.w + p * d.w) @ (now.z + q * d.z) + (now.s + p * d.s) @ (now.nu + q * d.nu)
        after += np.sum((now.S + p * d.S) * (now.Z + q * d.Z))
        d = step(mu * min(1.0, float(after) / (mu * self.count)) ** 3, d)
        p, q = (min(1.0, BEFORE * length) for length in reaches(d))
        w, t = now.w + p * d.w, now.t + p * d.t
        S = self.constant + self.columns.information(w) - t * (self.V @ self.V.T)
        L = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
        return _Iterate(w, t, now.s + p * d.s, S, L, now.Z + q * d.Z, now.z + q * d.z, now.nu + q * d.nu)

    @property
    def count(self) -> int:
        """Number of complementary pairs."""
        return self.Q.shape[1] + len(self.Q) + len(self.constant)

    def _normal_equations(self, now: _Iterate) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix for the steps of w and t together, and what complementarity 1 has on the right-hand side."""
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
        right[:m] = spread + 1 / now.w - Q.T @ (1 / now.s)
        right[m] = -float(np.trace(V.T @ YV))
        return left, right
