"""Optimal weights of given columns by a primal-dual interior-point method: E, and modified E.

    maximise t subject to S_b = C_b +- M_b(P) - t V_b V_b' positive semidefinite for every b, Q P <= 1, P positive semidefinite

with multipliers Z_b of S_b (the certificate, sum tr V'ZV = 1), nu and z. E (t = 1 / loss) has M_0 + M - t V V'; modified E has
M - t V V' and I - M; of parameters that no line tells of together, each group has its own. P is what the directions of a cell have of
the power, one Hermitian matrix: of one direction a weight, of all directions at a frequency whatever power there is best. The
direction is that of Nesterov and Todd: the multipliers' step is what is left of a least-squares problem for the weights' step. Solved
by an orthogonal decomposition, never by its normal equations: those lose the multipliers' digits at a gap of 1e-7."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.problem.lines import Columns
from oed.design.problem.white import told_together
from oed.design.solvers.scaled_cones import Cone, Projection, shared_step, vector
from oed.design.solvers.weights_da import Weights, inside
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
FLOOR = 1e-14
"""Of the largest cost of a direction: what a direction costs at least, where rounding leaves it nothing."""
Factors = tuple[NDArray, ...]


def eigenvalue_weights(
    columns: Columns, criterion: Criterion, constant: NDArray[np.float64], *, tolerance: float = 1e-12, max_steps: int = 60
) -> Weights:  # fmt: skip
    """Optimal weights for an E criterion: constant (n, n)."""
    V, cells = criterion.columns, alone(len(columns))
    blocks = _blocks(1.0, constant, columns.F, V, cells)
    problem = _Problem(blocks, _costs(columns.q, cells))
    w = inside(np.ones(len(columns)), columns.q.T)
    loss = criterion.loss(constant + columns.information(w))
    best, status, step = _solved(problem, problem.first(w, FIRST / loss), tolerance, max_steps)
    power = np.abs(best.P[0][:, 0, 0]) ** 2
    return Weights(power, _orthogonal(_gathered(blocks, best.Z, len(V))), best.nu, status, step)


def alone(count: int) -> tuple[NDArray[np.int64], ...]:
    """Every column a cell of its own."""
    return (np.arange(count)[:, None],)


def condition_weights(
    F_low: NDArray, V: NDArray[np.float64], F_high: NDArray, start: NDArray[np.float64], *,
    cells: tuple[NDArray[np.int64], ...] | None = None, tolerance: float = 1e-12, max_steps: int = 60,
) -> tuple[tuple[NDArray, ...], NDArray[np.float64], NDArray[np.float64], Status]:  # fmt: skip
    """Power of every cell, (K, p, p) for each size p, with the largest t of M - t V V' and I - M, factors X_low and X_high of the
    multipliers, and how it ended; M in two systems of coordinates, F_low and F_high (m, n, r), complex where cells (K, p) of columns
    have more than one: each eigenvalue has its digits in its own; start (m,)."""
    m, n, _ = F_low.shape
    cells = alone(m) if cells is None else cells
    size = np.sum(np.abs(F_high) ** 2, axis=(1, 2))
    w = start + SPREAD * float(start @ size) / m / size
    w *= 0.5 / float(np.linalg.norm(_flat(F_high * np.sqrt(w)[:, None, None]), 2)) ** 2
    low, high = (
        _blocks(1.0, np.zeros((n, n)), F_low, V, cells),
        _blocks(-1.0, np.eye(n), F_high, 0 * V, cells),
    )
    # In coordinates in which these weights tell of every direction alike: the least eigenvalue is then no rounding of the others.
    halves = [_half(block, w, cells) for block in low]
    low = tuple(block.turned(half) for block, half in zip(low, halves, strict=True))
    t = FIRST / max(float(np.linalg.norm(block.V, 2)) for block in low) ** 2
    problem = _Problem((*low, *high), tuple(np.zeros((len(g), 0, g.shape[1], g.shape[1])) for g in cells))
    best, status, _ = _solved(problem, problem.first(w, t, cells), tolerance, max_steps)
    own = tuple(np.linalg.solve(half.T, Z) for half, Z in zip(halves, best.Z, strict=False))
    X_low, X_high = _gathered(low, own, n), _gathered(high, best.Z[len(low) :], n)
    return tuple(P @ P.conj().swapaxes(1, 2) for P in best.P), _orthogonal(X_low), _orthogonal(X_high), status


def _orthogonal(Z: NDArray[np.float64]) -> NDArray[np.float64]:
    """A factor with the same square, its columns orthogonal."""
    X, size, _ = np.linalg.svd(Z)
    return np.asarray(X * size, dtype=np.float64)


def _flat(F: NDArray) -> NDArray[np.float64]:
    """Factors (.., n, r), real or complex, side by side as real ones (n, k)."""
    flat = np.moveaxis(F, -2, 0).reshape(F.shape[-2], -1)
    return np.concatenate([flat.real, flat.imag], axis=1) if np.iscomplexobj(F) else np.asarray(flat)


@dataclass(frozen=True, eq=False)
class _Iterate:
    """Factors P of the power of the cells, t and slacks s = 1 - Q P; factors of every S and of its multiplier Z; factors z of the
    multipliers of P, nu of the budgets."""

    P: Factors
    t: float
    s: NDArray[np.float64]
    S: Factors
    Z: Factors
    z: Factors
    nu: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Block:
    """S = C + sign M(P) - t V V' of the parameters `own`: the factors F (K, p, n, r) of the cells of each size."""

    own: NDArray[np.int64]
    sign: float
    constant: NDArray[np.float64]
    F: Factors
    V: NDArray[np.float64]

    def told(self, P: Factors) -> NDArray[np.float64]:
        """Factor of the information of the cells' power."""
        return np.concatenate([_flat(_turned(F, one)) for F, one in zip(self.F, P, strict=True)], axis=1)

    def turned(self, half: NDArray[np.float64]) -> "_Block":
        """In coordinates half^-1, lower triangular; the constant is none."""
        from scipy.linalg import solve_triangular

        n = len(half)
        below = lambda A: solve_triangular(half, A, lower=True)
        F = tuple(
            np.moveaxis(
                below(np.moveaxis(one, 2, 0).reshape(n, -1)).reshape(n, *np.delete(one.shape, 2)), 0, 2
            )
            for one in self.F
        )
        return _Block(self.own, self.sign, self.constant, F, below(self.V))

    def slack(self, P: Factors, t: float) -> NDArray[np.float64]:
        """The factor of S; LinAlgError where rounding leaves the cone."""
        told = self.told(P)
        S = self.constant + self.sign * (told @ told.T) - t * (self.V @ self.V.T)
        return np.asarray(np.linalg.cholesky(S), dtype=np.float64)

    def worth(self, Z: NDArray[np.float64]) -> Factors:
        """What every cell's power is worth to Z Z', (K, p, p) of each size."""
        found = []
        for F in self.F:
            G = (Z.T @ F).reshape(*F.shape[:2], -1)
            found.append(G.conj() @ G.swapaxes(1, 2))
        return tuple(found)


def _blocks(
    sign: float, constant: NDArray[np.float64], F: NDArray, V: NDArray[np.float64], cells: tuple[NDArray[np.int64], ...]
) -> tuple[_Block, ...]:  # fmt: skip
    """One for each group of parameters that nothing tells of together: F (m, n, r)."""
    group = told_together(np.concatenate([_flat(F).T, V.T, constant]))
    found = []
    for k in range(group.max() + 1):
        own = np.flatnonzero(group == k)
        told = F[:, own]
        told = told[:, :, np.any(told != 0, axis=(0, 1))]
        # A cell of one direction needs real factors only.
        parts = [told[one] for one in cells]
        parts = [
            np.concatenate([part.real, part.imag], axis=3)
            if part.shape[1] == 1 and np.iscomplexobj(part)
            else part
            for part in parts
        ]
        found.append(
            _Block(
                own, sign, constant[np.ix_(own, own)], tuple(parts), V[own][:, np.any(V[own] != 0, axis=0)]
            )
        )
    return tuple(found)


def _costs(q: NDArray[np.float64], cells: tuple[NDArray[np.int64], ...]) -> Factors:
    """What a cell's directions, at right angles, use of every budget, (K, J, p, p) of each size: q (m, J)."""
    return tuple(q[one].swapaxes(1, 2)[..., None] * np.eye(one.shape[1]) for one in cells)


def _half(block: _Block, w: NDArray[np.float64], cells: tuple[NDArray[np.int64], ...]) -> NDArray[np.float64]:
    """L of the information L L' of weights (m,)."""
    return np.asarray(np.linalg.qr(block.told(_diagonal(w, cells)).T, mode="r").T, dtype=np.float64)


def _diagonal(w: NDArray[np.float64], cells: tuple[NDArray[np.int64], ...]) -> Factors:
    """Factors of the cells' power where no two directions go together: w (m,)."""
    return tuple(np.sqrt(w[one])[..., None] * np.eye(one.shape[1]) for one in cells)


def _gathered(blocks: tuple[_Block, ...], Z: Factors, n: int) -> NDArray[np.float64]:
    """The factors of all blocks as one (n, n)."""
    X = np.zeros((n, n))
    for block, one in zip(blocks, Z, strict=True):
        X[np.ix_(block.own, block.own)] = one
    return X


def _turned(F: NDArray, L: NDArray) -> NDArray:
    """F (K, p, n, r) of the directions that a factor (K, p, p) makes of a cell's."""
    K, p, n, r = F.shape
    return (L.swapaxes(1, 2) @ F.reshape(K, p, n * r)).reshape(K, p, n, r)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The blocks and what the cells of each size use of the budgets, (K, J, p, p)."""

    blocks: tuple[_Block, ...]
    Q: Factors

    def slacks(self, P: Factors, t: float) -> Factors:
        """Factors of every S."""
        return tuple(block.slack(P, t) for block in self.blocks)

    def left(self, P: Factors) -> NDArray[np.float64]:
        """1 - Q P of every budget."""
        used = [
            np.einsum("kjab,kac,kbc->j", Q, one.conj(), one, optimize=True).real
            for Q, one in zip(self.Q, P, strict=True)
        ]
        return np.asarray(1 - sum(used[1:], used[0]), dtype=np.float64)

    def balance(self, Z: Factors, nu: NDArray[np.float64]) -> tuple[Factors, Factors]:
        """What every cell's power is worth to the blocks that it adds to, and what it costs."""
        worth = [np.zeros(Q.shape[::2][:1] + Q.shape[2:]) for Q in self.Q]
        cost = [np.einsum("j,kjab->kab", nu, Q) for Q in self.Q]
        for block, one in zip(self.blocks, Z, strict=True):
            side = worth if block.sign > 0 else cost
            side[:] = [had + more for had, more in zip(side, block.worth(one), strict=True)]
        return tuple(worth), tuple(cost)

    def first(
        self, w: NDArray[np.float64], t: float, cells: tuple[NDArray[np.int64], ...] | None = None
    ) -> _Iterate:
        """An iterate well inside, with equal weights: near the optimum of other columns it takes more steps."""
        P, J = _diagonal(w, alone(len(w)) if cells is None else cells), self.Q[0].shape[1]
        S = self.slacks(P, t)
        Z = tuple(np.asarray(np.linalg.inv(one).T, dtype=np.float64) for one in S)
        size = np.sqrt(sum(np.sum((one.T @ block.V) ** 2) for block, one in zip(self.blocks, Z, strict=True)))
        Z = tuple(one / size for one in Z)
        worth = self.balance(Z, np.zeros(J))[0]
        inside = lambda A: [one.conj().swapaxes(1, 2) @ part @ one for one, part in zip(P, A, strict=True)]
        total = sum(float(np.einsum("kaa->", part).real) for part in inside(worth))
        nu = np.full(J, total / max(J, 1))
        z = []
        for one, spent, earned in zip(P, inside(self.balance(Z, nu)[1]), inside(worth), strict=True):
            values, vectors = np.linalg.eigh(spent - earned)
            power = np.mean(np.abs(one) ** 2 * one.shape[1], axis=(1, 2)) if J else np.ones(len(one))
            root = vectors * np.sqrt(np.maximum(values, 0.1 * total / len(w) * power[:, None]))[:, None, :]
            z.append(np.linalg.solve(one.conj().swapaxes(1, 2), root))
        return _Iterate(P, t, self.left(P), S, Z, tuple(z), nu)

    def gap(self, now: _Iterate) -> float:
        """Relative gap between t and the bound of the multipliers, made admissible; infinite where t, which is free, has no loss."""
        if now.t <= 0.0:
            return np.inf
        price = 0.0
        for worth, cost in zip(*self.balance(now.Z, now.nu), strict=True):
            values, vectors = np.linalg.eigh(cost)
            root = vectors / np.sqrt(np.maximum(values, FLOOR * values[:, -1:]))[:, None, :]
            price = max(price, float(np.linalg.eigvalsh(root.conj().swapaxes(1, 2) @ worth @ root).max()))
        fixed = {1.0: 0.0, -1.0: float(now.nu.sum())}
        for block, Z in zip(self.blocks, now.Z, strict=True):
            fixed[block.sign] += float(np.sum(Z * (block.constant @ Z)))
        size = sum(np.sum((block.V.T @ Z) ** 2) for block, Z in zip(self.blocks, now.Z, strict=True))
        return float((price * fixed[-1.0] + fixed[1.0]) / size / now.t - 1)

    def next(self, now: _Iterate) -> _Iterate:
        """One predictor-corrector step; LinAlgError where rounding leaves the cone."""
        outer = [Cone.of(S[None], Z[None]) for S, Z in zip(now.S, now.Z, strict=True)]
        outer.append(Cone.of(np.sqrt(now.s)[:, None, None], np.sqrt(now.nu)[:, None, None]))
        inner = [Cone.of(P, z) for P, z in zip(now.P, now.z, strict=True)]
        A, c = self._slopes(outer, inner)
        if not (np.isfinite(A).all() and np.isfinite(c).all()):
            raise np.linalg.LinAlgError("rounding has left the cone")
        project, cones, count = Projection(A, c), [*outer, *inner], len(outer)
        a, b, p, q = shared_step(cones, project, BEFORE)
        dx, dt = project.solved(a)
        back = np.split(b, np.cumsum([cone.size for cone in cones])[:-1])
        Z = [cone.moved(v, q, cone.down.conj().swapaxes(1, 2)) for cone, v in zip(cones, back, strict=True)]
        ahead = np.split(dx, np.cumsum([cone.size for cone in inner])[:-1])
        P, t = tuple(cone.moved(v, p, cone.up) for cone, v in zip(inner, ahead, strict=True)), now.t + p * dt
        return _Iterate(
            P, t, self.left(P), self.slacks(P, t), tuple(one[0] for one in Z[: count - 1]), tuple(Z[count:]),
            Z[count - 1][:, 0, 0] ** 2,
        )  # fmt: skip

    def _slopes(
        self, outer: list[Cone], inner: list[Cone]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What the power of the cells, and t, change of the slacks, all in the cones' coordinates: (N, M) and (N,)."""
        rows, of_t = [], []
        for block, cone in zip(self.blocks, outer, strict=False):
            down = cone.down[0]
            parts = [
                _products(down @ _turned(F, own.up), np.iscomplexobj(own.down))
                for F, own in zip(block.F, inner, strict=True)
            ]
            rows.append(np.concatenate([block.sign * vector(part, False) for part in parts]).T)
            turned = down @ block.V
            of_t.append(-cone.vector((turned @ turned.T)[None]))
        scale = outer[-1].down[:, 0, 0] ** 2
        used = []
        for Q, own in zip(self.Q, inner, strict=True):
            Q = own.up.conj().swapaxes(1, 2)[:, None] @ Q @ own.up[:, None]
            used.append(np.moveaxis(vector(Q, np.iscomplexobj(own.down)), 1, 0).reshape(Q.shape[1], own.size))
        rows.append(-scale[:, None] * np.concatenate(used, axis=1))
        return np.concatenate(rows), np.concatenate([*of_t, np.zeros(len(scale))])


def _products(H: NDArray, whole: bool) -> NDArray[np.float64]:
    """The information of every entry of a cell's power, in the order of `vector`: H (K, p, n, r) -> (K d, n, n)."""
    p, n = H.shape[1:3]
    one, other = np.triu_indices(p, 1)
    first = np.concatenate([np.arange(p), one])
    second = np.concatenate([np.arange(p), other])
    outer = H[:, first] @ H[:, second].conj().swapaxes(2, 3)
    outer = (outer + outer.swapaxes(2, 3)) / 2
    real = outer.real * np.where(first == second, 1.0, np.sqrt(2.0))[:, None, None]
    parts = [real, -np.sqrt(2.0) * outer[:, p:].imag] if whole else [real]
    return np.concatenate(parts, axis=1).reshape(-1, n, n)


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
