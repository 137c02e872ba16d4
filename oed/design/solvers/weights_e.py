"""Optimal weights of given columns by a primal-dual interior-point method: E, and modified E.

    maximise t subject to S_b = C_b +- M_b(w) - t V_b V_b' positive semidefinite for one or two b, Q w <= 1, w >= 0

with multipliers Z_b of S_b (the certificate, sum tr V'ZV = 1), nu and z. E (t = 1 / loss) has the one C = M_0; modified E has
M - t V V' and I - M. The direction is that of Nesterov and Todd (SIAM J. Optimization 8 (1998) 324-364): in coordinates in which
S and Z are the same diagonal matrix, and w and z, s and nu the same vectors, the multipliers' step is what is left of a
least-squares problem for the weights' step. Solved by an orthogonal decomposition, never by its normal equations: those lose the
multipliers' digits at a gap of 1e-7."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.problem.lines import Columns, factor_of
from oed.design.solvers.weights_da import Weights, blocks, inside, reach
from oed.errors import Status

PATIENCE = 6
"""Steps that do not halve the gap after which rounding is all that is left."""
BEFORE = 0.95
"""Share of the way to the boundary of the cone that a step goes."""
FIRST = 0.7
"""Share of the largest t that the first weights allow."""
SPREAD = 0.1
"""Share of the information that is spread over all columns to begin with, where there are weights to begin with."""
ADMISSIBLE = 1e-1
"""Gap below which the multipliers are nearly admissible: before that it need not fall."""
Factors = tuple[NDArray[np.float64], ...]


def eigenvalue_weights(
    columns: Columns, criterion: Criterion, constant: NDArray[np.float64], *, tolerance: float = 1e-12, max_steps: int = 60
) -> Weights:  # fmt: skip
    """Optimal weights for an E criterion: constant (n, n)."""
    problem = _Problem((_Block(1.0, constant, columns.F, criterion.columns),), columns.q.T)
    w = inside(np.ones(len(columns)), columns.q.T)
    loss = criterion.loss(constant + columns.information(w))
    best, status, step = _solved(problem, problem.first(w, FIRST / loss), tolerance, max_steps)
    return Weights(np.maximum(best.w, 0.0), _orthogonal(best.Z[0]), best.nu, status, step)


def condition_weights(
    F_low: NDArray[np.float64], V: NDArray[np.float64], F_high: NDArray[np.float64], start: NDArray[np.float64], *,
    tolerance: float = 1e-12, max_steps: int = 60,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], Status]:  # fmt: skip
    """Weights (m,) with the largest t of M - t V V' and I - M, factors X_low and X_high of the multipliers, and how it ended; M in
    two systems of coordinates, F_low and F_high (m, n, r): each eigenvalue has its digits in its own; start (m,)."""
    from scipy.linalg import solve_triangular

    m, n, _ = F_low.shape
    told = start * np.sum(F_high**2, axis=(1, 2))
    w = start + SPREAD * told.sum() / m / np.sum(F_high**2, axis=(1, 2))
    w *= 0.5 / float(np.linalg.norm(factor_of(F_high, w), 2)) ** 2
    # In coordinates in which these weights tell of every direction alike: the least eigenvalue is then no rounding of the others.
    half = np.linalg.qr(factor_of(F_low, w).T, mode="r").T
    F_low, V = (
        solve_triangular(half, np.moveaxis(F_low, 0, 1).reshape(n, -1), lower=True),
        solve_triangular(half, V, lower=True),
    )
    F_low = np.moveaxis(F_low.reshape(n, m, -1), 1, 0)
    t = FIRST / float(np.linalg.norm(V, 2)) ** 2
    nothing = np.zeros((n, n))
    low, high = _Block(1.0, nothing, F_low, V), _Block(-1.0, np.eye(n), F_high, 0 * V)
    problem = _Problem((low, high), np.zeros((0, m)))
    best, status, _ = _solved(problem, problem.first(w, t), tolerance, max_steps)
    X_low = solve_triangular(half, _orthogonal(best.Z[0]), lower=True, trans=1)
    return np.maximum(best.w, 0.0), X_low, _orthogonal(best.Z[1]), status


def _orthogonal(Z: NDArray[np.float64]) -> NDArray[np.float64]:
    """A factor with the same square, its columns orthogonal."""
    X, size, _ = np.linalg.svd(Z)
    return np.asarray(X * size, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Iterate:
    """Weights w, t and slacks s = 1 - Q w; factors of every S and of its multiplier Z; multipliers z of w, nu of the budgets."""

    w: NDArray[np.float64]
    t: float
    s: NDArray[np.float64]
    S: Factors
    Z: Factors
    z: NDArray[np.float64]
    nu: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Block:
    """S = C + sign M(w) - t V V': the columns' factors F (m, n, r)."""

    sign: float
    constant: NDArray[np.float64]
    F: NDArray[np.float64]
    V: NDArray[np.float64]

    @property
    def flat(self) -> NDArray[np.float64]:
        """The factors side by side (n, m r)."""
        return np.moveaxis(self.F, 0, 1).reshape(self.F.shape[1], -1)

    def slack(self, w: NDArray[np.float64], t: float) -> NDArray[np.float64]:
        """The factor of S; LinAlgError where rounding leaves the cone."""
        told = factor_of(self.F, w)
        S = self.constant + self.sign * (told @ told.T) - t * (self.V @ self.V.T)
        return np.asarray(np.linalg.cholesky(S), dtype=np.float64)

    def worth(self, Z: NDArray[np.float64]) -> NDArray[np.float64]:
        """tr(A_k Z Z') of every column."""
        return np.sum((Z.T @ self.flat) ** 2, axis=0).reshape(len(self.F), -1).sum(axis=1)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The blocks and the budgets' shares (J, m)."""

    blocks: tuple[_Block, ...]
    Q: NDArray[np.float64]

    def slacks(self, w: NDArray[np.float64], t: float) -> Factors:
        """Factors of every S."""
        return tuple(block.slack(w, t) for block in self.blocks)

    def balance(self, Z: Factors) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What every column is worth to M - t V V', and what it takes of I - M."""
        gains = [block.worth(one) for block, one in zip(self.blocks, Z, strict=True)]
        return gains[0], sum(gains[1:], np.zeros(len(gains[0])))

    def first(self, w: NDArray[np.float64], t: float) -> _Iterate:
        """An iterate well inside, with equal weights: near the optimum of other columns it takes more steps."""
        Q = self.Q
        S = self.slacks(w, t)
        Z = tuple(np.asarray(np.linalg.inv(one).T, dtype=np.float64) for one in S)
        size = np.linalg.norm(Z[0].T @ self.blocks[0].V)
        Z = tuple(one / size for one in Z)
        worth, taken = self.balance(Z)
        nu = np.full(len(Q), float(worth @ w) / max(len(Q), 1))
        least = 0.1 * float(worth @ w) / len(w) / (1.0 if len(Q) else w)
        return _Iterate(w, t, 1 - Q @ w, S, Z, np.maximum(Q.T @ nu + taken - worth, least), nu)

    def gap(self, now: _Iterate) -> float:
        """Relative gap between t and the bound of the multipliers, made admissible; infinite where t, which is free, has no loss."""
        if now.t <= 0.0:
            return np.inf
        worth, taken = self.balance(now.Z)
        price = float((worth / (self.Q.T @ now.nu + taken)).max())
        fixed = [float(np.sum(Z * (b.constant @ Z))) for b, Z in zip(self.blocks, now.Z, strict=True)]
        most = price * (now.nu.sum() + sum(fixed[1:])) + fixed[0]
        return float(most / np.sum((self.blocks[0].V.T @ now.Z[0]) ** 2) / now.t - 1)

    def next(self, now: _Iterate) -> _Iterate:
        """One predictor-corrector step; LinAlgError where rounding leaves the cone."""
        from scipy.linalg import solve_triangular

        n, m = len(self.blocks[0].V), len(now.w)
        upper = np.triu_indices(n)
        twice = np.where(upper[0] == upper[1], 1.0, np.sqrt(2.0))
        vector = lambda A: A[..., upper[0], upper[1]] * twice
        N, count = len(upper[0]), len(self.blocks)

        def matrix(v: NDArray[np.float64]) -> NDArray[np.float64]:
            A = np.zeros((n, n))
            A[upper] = v / twice
            return A + np.triu(A, 1).T

        x, y = np.concatenate([now.w, now.s]), np.concatenate([now.z, now.nu])
        root, unit = np.sqrt(x * y), np.sqrt(x / y)
        B = np.zeros((count * N + len(x), m + 1))
        downs, lams = [], []
        for k, (block, S, Z) in enumerate(zip(self.blocks, now.S, now.Z, strict=True)):
            # R'ZZ'R = R^-1 SS'R^-T = diag(lam); the pairs of vectors alike.
            U, lam, _ = np.linalg.svd(Z.T @ S)
            down = (Z @ U / np.sqrt(lam)).T  # R^-1
            half, turned = blocks(down @ block.flat, block.F.shape[2]), down @ block.V
            B[k * N : (k + 1) * N, :m] = block.sign * vector(half @ half.swapaxes(1, 2)).T
            B[k * N : (k + 1) * N, m] = -vector(turned @ turned.T)
            downs.append(down)
            lams.append(lam)
        end = count * N
        B[end : end + m, :m] = np.diag(1 / unit[:m])
        B[end + m :, :m] = -self.Q / unit[m:, None]
        if not np.isfinite(B).all():
            raise np.linalg.LinAlgError("rounding has left the cone")
        basis, T = np.linalg.qr(B)
        price = basis @ solve_triangular(T, np.eye(m + 1)[m], trans=1)
        parts = [slice(k * N, (k + 1) * N) for k in range(count)]
        here = np.concatenate([*(vector(np.diag(lam)) for lam in lams), root])

        def step(target: float, C: list[NDArray], c: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
            """The changes of the slacks and of the multipliers, in these coordinates."""
            cones = [
                vector(target * np.eye(n) - np.diag(lam**2) - one) / (vector(lam[:, None] + lam) / twice / 2)
                for lam, one in zip(lams, C, strict=True)
            ]
            wanted = np.concatenate([*cones, (target - root**2 - c) / root])
            ahead = basis @ (basis.T @ (here + wanted)) + price
            return ahead, wanted - ahead

        def reaches(d: NDArray[np.float64]) -> float:
            lowest = min(
                float(np.linalg.eigvalsh(matrix(d[part]) / np.sqrt(np.outer(lam, lam)))[0])
                for part, lam in zip(parts, lams, strict=True)
            )
            return min(-1 / lowest if lowest < 0 else np.inf, reach(root, d[end:]))

        mu = float(here @ here) / (count * n + len(x))
        a, b = step(0.0, [np.zeros((n, n))] * count, np.zeros(len(x)))
        p, q = min(1.0, reaches(a)), min(1.0, reaches(b))
        after = float((here + p * a) @ (here + q * b)) / (count * n + len(x))
        C = [matrix(a[part]) @ matrix(b[part]) for part in parts]
        a, b = step(mu * min(1.0, after / mu) ** 3, [(one + one.T) / 2 for one in C], a[end:] * b[end:])
        p, q = min(1.0, BEFORE * reaches(a)), min(1.0, BEFORE * reaches(b))
        dy = solve_triangular(T, basis.T @ a)
        w, t = now.w + p * dy[:m], now.t + p * dy[m]
        z = y + q * b[end:] / unit
        Z = tuple(
            down.T @ np.linalg.cholesky(np.diag(lam) + q * matrix(b[part]))
            for down, lam, part in zip(downs, lams, parts, strict=True)
        )
        return _Iterate(w, t, 1 - self.Q @ w, self.slacks(w, t), Z, z[:m], z[m:])


def _solved(
    problem: _Problem, now: _Iterate, tolerance: float, max_steps: int
) -> tuple[_Iterate, Status, int]:
    """The iterate of the least gap, how it ended, and after how many steps."""
    best, status, step, least, reference, stalled = now, Status.MAX_ITERATIONS, 0, np.inf, np.inf, 0
    while step < max_steps:
        step += 1
        gap = problem.gap(now)
        if gap < least:
            least, best = gap, now
        stalled, reference = (
            (0, least) if least < 0.5 * reference or least > ADMISSIBLE else (stalled + 1, reference)
        )
        if least <= tolerance or stalled == PATIENCE:
            status = Status.CONVERGED if least <= tolerance else Status.INACCURATE
            break
        try:
            now = problem.next(now)
        except np.linalg.LinAlgError:
            status = Status.INACCURATE
            break
    return best, status, step
