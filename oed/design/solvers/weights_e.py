"""Optimal weights of given columns by a primal-dual interior-point method: E.

    maximise t subject to S = M(w) - t V V' positive semidefinite, Q w <= 1, w >= 0   (t = 1 / loss)

with multipliers Z of S (the certificate, tr V'ZV = 1), nu and z. The direction is that of Nesterov and Todd (SIAM J.
Optimization 8 (1998) 324-364): in coordinates in which S and Z are the same diagonal matrix, and w and z, s and nu
the same vectors, the multipliers' step is what is left of a least-squares problem for the weights' step. Solved by an
orthogonal decomposition, never by its normal equations: those lose the multipliers' digits at a gap of 1e-7."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.problem.lines import Columns
from oed.design.solvers.weights_da import Weights, blocks, inside, reach
from oed.errors import Status

PATIENCE = 6
"""Steps that do not halve the gap after which rounding is all that is left."""
BEFORE = 0.95
"""Share of the way to the boundary of the cone that a step goes."""


def eigenvalue_weights(
    columns: Columns, criterion: Criterion, constant: NDArray[np.float64], *, tolerance: float = 1e-12, max_steps: int = 60
) -> Weights:  # fmt: skip
    """Optimal weights for an E criterion: constant (n, n)."""
    m, n, r = columns.F.shape
    flat = np.moveaxis(columns.F, 0, 1).reshape(n, m * r)
    problem = _Problem(columns, constant, flat, columns.q.T, criterion.columns)
    now = best = problem.first(criterion)
    status, step, least, reference, stalled = Status.MAX_ITERATIONS, 0, np.inf, np.inf, 0
    while step < max_steps:
        step += 1
        gap = problem.gap(now)
        if gap < least:
            least, best = gap, now
        stalled, reference = (0, least) if least < 0.5 * reference else (stalled + 1, reference)
        if least <= tolerance or stalled == PATIENCE:
            status = Status.CONVERGED if least <= tolerance else Status.INACCURATE
            break
        try:
            now = problem.next(now)
        except np.linalg.LinAlgError:
            status = Status.INACCURATE
            break
    X, size, _ = np.linalg.svd(best.Z)
    return Weights(np.maximum(best.w, 0.0), X * size, best.nu, status, step)


@dataclass(frozen=True, eq=False)
class _Iterate:
    """Weights w, t and slacks s = 1 - Q w; factors of S and of its multiplier Z; multipliers z of w, nu of the budgets."""

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

    def slack(self, w: NDArray[np.float64], t: float) -> NDArray[np.float64]:
        """The factor of S; LinAlgError where rounding leaves the cone."""
        S = self.constant + self.columns.information(w) - t * (self.V @ self.V.T)
        return np.asarray(np.linalg.cholesky(S), dtype=np.float64)

    def worth(self, Z: NDArray[np.float64]) -> NDArray[np.float64]:
        """tr(A_k Z Z') of every column."""
        return np.sum((Z.T @ self.flat) ** 2, axis=0).reshape(self.Q.shape[1], -1).sum(axis=1)

    def first(self, criterion: Criterion) -> _Iterate:
        """An iterate well inside, with equal weights: near the optimum of other columns it takes more steps."""
        Q, V = self.Q, self.V
        w = inside(np.ones(Q.shape[1]), Q)
        t = 0.7 / criterion.loss(self.constant + self.columns.information(w))
        S = self.slack(w, t)
        Z = np.asarray(np.linalg.inv(S).T, dtype=np.float64)
        Z /= np.linalg.norm(Z.T @ V)
        worth = self.worth(Z)
        nu = np.full(len(Q), float(worth @ w) / len(Q))
        return _Iterate(
            w, t, 1 - Q @ w, S, Z, np.maximum(Q.T @ nu - worth, 0.1 * float(worth @ w) / len(w)), nu
        )

    def gap(self, now: _Iterate) -> float:
        """Relative gap between t and the bound of the multipliers, made admissible; infinite where t, which is free, has no loss."""
        if now.t <= 0.0:
            return np.inf
        worth = self.worth(now.Z)
        price = float((worth / (self.Q.T @ now.nu)).max())
        fixed = float(np.sum(now.Z * (self.constant @ now.Z)))
        return float((price * now.nu.sum() + fixed) / np.sum((self.V.T @ now.Z) ** 2) / now.t - 1)

    def next(self, now: _Iterate) -> _Iterate:
        """One predictor-corrector step; LinAlgError where rounding leaves the cone."""
        from scipy.linalg import solve_triangular

        n, m, r = len(self.V), len(now.w), self.columns.F.shape[2]
        # R'ZZ'R = R^-1 SS'R^-T = diag(lam); the pairs of vectors alike.
        U, lam, _ = np.linalg.svd(now.Z.T @ now.S)
        down = (now.Z @ U / np.sqrt(lam)).T  # R^-1
        x, y = np.concatenate([now.w, now.s]), np.concatenate([now.z, now.nu])
        root, unit = np.sqrt(x * y), np.sqrt(x / y)
        upper = np.triu_indices(n)
        twice = np.where(upper[0] == upper[1], 1.0, np.sqrt(2.0))
        vector = lambda A: A[..., upper[0], upper[1]] * twice

        def matrix(v: NDArray[np.float64]) -> NDArray[np.float64]:
            A = np.zeros((n, n))
            A[upper] = v / twice
            return A + np.triu(A, 1).T

        half, turned = blocks(down @ self.flat, r), down @ self.V
        B = np.zeros((len(upper[0]) + len(x), m + 1))
        N = len(upper[0])
        B[:N, :m] = vector(half @ half.swapaxes(1, 2)).T
        B[:N, m] = -vector(turned @ turned.T)
        B[N : N + m, :m] = np.diag(1 / unit[:m])
        B[N + m :, :m] = -self.Q / unit[m:, None]
        basis, T = np.linalg.qr(B)
        price = basis @ solve_triangular(T, np.eye(m + 1)[m], trans=1)
        here = np.concatenate([vector(np.diag(lam)), root])
        sums = vector(lam[:, None] + lam) / twice / 2

        def step(target: float, C: NDArray[np.float64], c: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
            """The changes of the slacks and of the multipliers, in these coordinates."""
            wanted = np.concatenate(
                [vector(target * np.eye(n) - np.diag(lam**2) - C) / sums, (target - root**2 - c) / root]
            )
            ahead = basis @ (basis.T @ (here + wanted)) + price
            return ahead, wanted - ahead

        def reaches(d: NDArray[np.float64]) -> float:
            lowest = float(np.linalg.eigvalsh(matrix(d[:N]) / np.sqrt(np.outer(lam, lam)))[0])
            return min(-1 / lowest if lowest < 0 else np.inf, reach(root, d[N:]))

        mu = float(here @ here) / (n + len(x))
        a, b = step(0.0, np.zeros((n, n)), np.zeros(len(x)))
        p, q = min(1.0, reaches(a)), min(1.0, reaches(b))
        after = float((here + p * a) @ (here + q * b)) / (n + len(x))
        C = matrix(a[:N]) @ matrix(b[:N])
        a, b = step(mu * min(1.0, after / mu) ** 3, (C + C.T) / 2, a[N:] * b[N:])
        p, q = min(1.0, BEFORE * reaches(a)), min(1.0, BEFORE * reaches(b))
        dy = solve_triangular(T, basis.T @ a)
        w, t = now.w + p * dy[:m], now.t + p * dy[m]
        z = y + q * b[N:] / unit
        factor = np.linalg.cholesky(np.diag(lam) + q * matrix(b[:N]))
        return _Iterate(w, t, 1 - self.Q @ w, self.slack(w, t), down.T @ factor, z[:m], z[m:])
