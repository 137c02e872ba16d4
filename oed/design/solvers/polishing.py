"""The last digits: Newton's method on the optimality conditions of the support itself.

Every loss is max over X of numerator(X) / tr(X' M X), so that the optimum is a saddle point of

    L = log numerator(X) - tr(X' M X) + sum_j nu_j (sum_i a_i^* Q_j(w_i) a_i - 1),   M = M_0 + sum_i Re D_i a_i (D_i a_i)^*

in the frequencies w_i, the complex amplitudes a_i, the multipliers nu and the certificate direction X. Where M is
nonsingular and the loss smooth (D, A of all parameters) X is solved for beforehand. Each step solves with the exact
second derivatives in the least-squares sense (phases are free, X may be), so that it converges quadratically."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.problem.lines import Columns, Problem, snapped, within_bands

_STENCIL = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
_FIRST = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12
_SECOND = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / 12
LARGEST = 1200
"""Unknowns: beyond them a step takes longer than a round of column generation."""
STEPS = 15
"""Newton steps; from a support that is right it takes three to six."""
STRIDE = 0.3
"""Most that a line moves in a step, in units of the distance over which the plant changes."""
DEPENDENT = 1e-11
"""Combinations of unknowns that move the conditions by less than this share are left alone: phases and rotations.
Where a step gains nothing, so are those whose share is below that of what the conditions are off by: all that they show may be it."""
HALVINGS = 6
GAINED = 0.5
"""Share of the norm of the conditions down to which a step is worth no other."""
AT_EDGES = 3
"""Times that lines which Newton's method drove out of the band are put at its end."""
OUTSIDE = 1e-12
LEAST = 1e-3
"""Of all that it tells: a line that tells the certificate's direction less than this, as it tells of other channels, has no unit of
its own, for what it tells of that is rounding."""
SPENT = 1e-15
ROUNDING = 1e-9
"""Norm of the conditions below which a step that gains no digit is the last: rounding is all that is left."""


@dataclass(frozen=True, eq=False)
class Polished:
    """Support, weights and certificate after Newton's method. `columns` one per line and direction; `w`
    weights within the budgets; `X, nu` certificate; `residual` norm of the optimality conditions."""

    columns: Columns
    w: NDArray[np.float64]
    X: NDArray[np.float64]
    nu: NDArray[np.float64]
    residual: float


@dataclass(frozen=True, eq=False)
class Point:
    """Frequencies (m,), amplitudes as reals (m, 2 q), multipliers (J,) and X (n, s)."""

    omega: NDArray[np.float64]
    z: NDArray[np.float64]
    nu: NDArray[np.float64]
    X: NDArray[np.float64]

    @property
    def power(self) -> NDArray[np.float64]:
        """Of every line (m,)."""
        return np.sum(self.z**2, axis=1)


@dataclass(frozen=True, eq=False)
class LinesPart:
    """M and X, and of the unknowns of the lines, p in all: slope of the Lagrangian (p,), use of the budgets (J,), what weighs the rows
    (p,); second derivatives with X held (p, p), slopes of the budgets (J, p), and dM X (p, n, s)."""

    M: NDArray[np.float64]
    X: NDArray[np.float64]
    slope: NDArray[np.float64]
    used: NDArray[np.float64]
    weigh: NDArray[np.float64]
    own: Any = None
    steep: Any = None
    turned: Any = None


class System:
    """The optimality conditions and their derivatives, in units in which a relative change of anything is a number."""

    def __init__(
        self,
        problem: Problem,
        columns: Columns,
        w: NDArray,
        X: NDArray,
        nu: NDArray,
        signs: NDArray,
        solved: bool = False,
    ) -> None:
        self.problem, self.criterion, self.signs = problem, problem.criterion, signs
        self.reduced = self.criterion.smooth or solved
        self.unit = problem.length_scale(columns.omega)
        # There the error of the five points, 4 h^4 beside a pole at the distance of a unit, is that of rounding over h.
        self.stride = (max(problem.lost, np.finfo(float).eps) / 4) ** 0.2
        edges = np.array(problem.bands).ravel()
        real = (columns.omega < 1e-12) | (columns.omega > np.pi - 1e-12)
        self.active = (nu > 1e-9 * nu.sum()) & (columns.q.T @ w > 1 - 1e-6)
        m, q = columns.direction.shape
        free = np.ones((m, 1 + 2 * q), dtype=bool)
        free[:, 0] = np.abs(columns.omega[:, None] - edges).min(axis=1) >= 1e-9
        free[real, 1 + q :] = False
        self.sizeX = s = 0 if self.reduced else X.size
        self.free = np.concatenate([free.ravel(), self.active, np.ones(s, dtype=bool)])
        self.strided = free.size
        a = columns.direction * np.sqrt(w)[:, None]
        told = columns.information(w)
        M = problem.constant + told
        if self.reduced:
            X = self.criterion.direction(M)
        for sign in () if self.reduced else np.unique(signs):
            own = signs == sign
            told_by = float(np.sum(X[:, own] * (M @ X[:, own])))
            if not told_by > 0:
                raise np.linalg.LinAlgError("the information along the certificate is rounding")
            X = np.where(own, X / np.sqrt(told_by), X)
        self.priced = bool((signs > 0).all())
        self.turn = np.eye(0 if self.reduced else X.size) if self.priced else self._units_of(X)
        nu = np.where(self.active, nu, 0.0)
        self.start = Point(
            columns.omega,
            np.concatenate([a.real, a.imag], axis=1),
            nu * (np.sum(X * self._signs_of(X) * (told @ X)) / max(nu.sum(), 1e-300)),
            X,
        )

    def _units_of(self, X: NDArray) -> NDArray[np.float64]:
        """Of modified E: units in which what is known and the loss tell as much of each part of X, for the largest eigenvalue's has a
        curvature that is a condition number larger; X.ravel() is what is returned (n s, n s) times the unknowns."""
        turn = np.zeros(2 * X.shape)
        for k, sign in enumerate(self.signs):
            V = self.criterion.columns
            V = V / np.linalg.norm(V.T @ X[:, self.signs == sign])
            values, vectors = np.linalg.eigh(np.eye(len(V)) + V @ V.T)
            turn[:, k, :, k] = vectors / np.sqrt(values)
        return turn.reshape(X.size, X.size)

    def _signs_of(self, X: NDArray) -> NDArray[np.float64]:
        return np.ones(X.shape[1]) if self.reduced else self.signs

    def symmetries(self, point: Point) -> NDArray[np.float64]:
        """Where power has no price: what changes nothing at the optimum, as rows over the free unknowns: all power against X, the
        columns of X among themselves, and phases. Beside the optimum the conditions shrink along them, and steps would follow that."""
        n, s = point.X.shape
        both = [
            np.multiply.outer(a, b) - np.multiply.outer(b, a)
            for k, a in enumerate(np.eye(s))
            for b in np.eye(s)[:k]
        ]
        turns = [one for one in both if abs(self.signs @ np.abs(one).sum(axis=0)) == 2]
        moves = np.stack([(point.X @ one).ravel() for one in (-np.eye(s), *turns)])
        rows = np.zeros((len(moves) + len(point.omega), len(self.free)))
        rows[: len(moves), -n * s :] = np.linalg.solve(self.turn, moves.T).T
        z = point.z / np.sqrt(point.power)[:, None]
        m, q = len(z), z.shape[1] // 2
        lines = rows[:, : m * (1 + 2 * q)].reshape(len(rows), m, -1)
        lines[0, :, 1:] = z
        lines[len(moves) + np.arange(m), np.arange(m), 1:] = np.concatenate([-z[:, q:], z[:, :q]], axis=1)
        rows = rows[:, self.free]
        size = np.linalg.norm(rows, axis=1, keepdims=True)
        return np.asarray(rows / np.where(size > 0, size, 1.0), dtype=np.float64)

    def moved(self, point: Point, step: NDArray[np.float64]) -> Point:
        """The point after a step in the scaled unknowns, all of them."""
        m, J = len(point.omega), len(point.nu)
        lines, nu, X = np.split(step, [step.size - J - self.sizeX, step.size - self.sizeX])
        lines = lines.reshape(m, -1)
        return Point(
            point.omega + lines[:, 0] * self.unit,
            point.z + lines[:, 1:] * np.sqrt(point.power)[:, None],
            point.nu + nu,
            point.X + (self.turn @ X).reshape(point.X.shape) if self.sizeX else point.X,
        )

    def _expansion(self, omega: NDArray) -> tuple[list[NDArray], list[NDArray]]:
        """D, dD/dw, d2D/dw2 (m, n, r, q) and the same of the forms (m, J, q, q); frequencies in units."""
        of = lambda function: self.expanded(function, omega, self.unit)
        return of(self.problem.scaled_factor), of(self.problem.forms_at)

    def expanded(
        self, function: Callable[[NDArray[np.float64]], NDArray], omega: NDArray, unit: NDArray
    ) -> list[NDArray]:
        """A function of frequency, (K, ..), and its two derivatives at omega (K,), frequencies in units (K,)."""
        # A power of two: the points are then exactly where they are taken to be, however narrow the resonance.
        step = 2.0 ** np.floor(np.log2(self.stride * unit))
        values = function((omega[:, None] + step[:, None] * _STENCIL).ravel())
        rows = values.reshape(len(omega), 5, *values.shape[1:])
        h = (step / unit).reshape(-1, *[1] * (values.ndim - 1))
        first, second = (np.tensordot(rule, rows, (0, 1)) for rule in (_FIRST, _SECOND))
        return [rows[:, 2], first / h, second / h**2]

    def lines_part(
        self,
        point: Point,
        direction: Callable[[NDArray[np.float64]], NDArray[np.float64]],
        derivatives: bool = True,
    ) -> LinesPart:
        """What the lines and the budgets have of the conditions, with X = direction(M) held; derivatives: those too."""
        z, nu, m = point.z, point.nu, len(point.omega)
        root = np.sqrt(point.power)
        (D0, D1, D2), (Q0, Q1, Q2) = self._expansion(point.omega)
        T0, T1, T2 = (_real_factor(part) for part in (D0, D1, D2))  # (m, n, 2 r, 2 q)
        along = [np.einsum("mnrz,mz->mnr", part, z) for part in (T0, T1, T2)]
        G = along[0]
        T = np.concatenate([along[1][:, None], np.moveaxis(T0, 3, 1) * root[:, None, None, None]], axis=1)
        flat = np.moveaxis(G, 1, 0).reshape(G.shape[1], -1)
        M = self.problem.constant + flat @ flat.T
        X = direction(M)
        E, F = (np.moveaxis(np.tensordot(X, part, (0, axis)), 0, axis) for part, axis in ((G, 1), (T, 2)))
        forms = [_real_form(part) for part in (Q0, Q1, Q2)]  # (m, J, 2 q, 2 q)
        steep = np.empty((m, len(nu), T.shape[1]))  # what every unknown changes of every budget
        Qz = [np.einsum("mjyz,mz->mjy", part, z) for part in forms]
        steep[:, :, 0] = np.einsum("mjy,my->mj", Qz[1], z)
        steep[:, :, 1:] = 2 * Qz[0] * root[:, None, None]
        signs = self._signs_of(X)
        JE = E * signs[:, None]
        slope = np.einsum("mjp,j->mp", steep, nu) - 2 * np.einsum("msr,mpsr->mp", JE, F)
        used = np.einsum("mjy,my->j", Qz[0], z)
        size = point.power if self.priced else np.sum(F**2, axis=(1, 2, 3))
        weigh = np.repeat(
            1 / (size if self.priced else np.maximum(size, LEAST * np.sum(T**2, axis=(1, 2, 3)))), T.shape[1]
        )
        if not derivatives:
            return LinesPart(M, X, slope.ravel(), used, weigh)
        from scipy.linalg import block_diag

        # Second derivatives within a line: (m, p, p).
        own = -2 * np.einsum("mpsr,mqsr->mpq", F * signs[:, None], F)
        EX = np.moveaxis(np.tensordot(X, JE, (1, 1)), 0, 1)  # X E, (m, n, 2 r)
        own[:, 0, 0] -= 2 * np.sum(EX * along[2], axis=(1, 2))
        own[:, 0, 0] += np.einsum("mjy,my,j->m", Qz[2], z, nu)
        mixed = 2 * np.einsum("j,mjy->my", nu, Qz[1]) - 2 * np.einsum("mnr,mnry->my", EX, T1)
        own[:, 0, 1:] += mixed * root[:, None]
        own[:, 1:, 0] += mixed * root[:, None]
        own[:, 1:, 1:] += 2 * np.einsum("j,mjyz->myz", nu, forms[0]) * point.power[:, None, None]
        turned = (T @ E.swapaxes(1, 2)[:, None]) + G[:, None] @ F.swapaxes(2, 3)
        return LinesPart(
            M, X, slope.ravel(), used, weigh, block_diag(*own), np.moveaxis(steep, 1, 0).reshape(len(nu), -1),
            turned.reshape(-1, *X.shape),
        )  # fmt: skip

    def conditions(
        self, point: Point, derivatives: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Residual and Jacobian in the scaled unknowns that are free; the rows of a line over its power or, where power has
        no price, over what they could be: of 1e-17 of the power a line may still be worth as much as any."""
        held = self.criterion.direction if self.reduced else lambda M: point.X
        part, nu = self.lines_part(point, held, derivatives), point.nu
        M, X, signs = part.M, part.X, self._signs_of(part.X)
        rise, bend = (None, None) if self.reduced else _rise(self.criterion, X, signs, derivatives)
        parts = [part.slope * part.weigh, (part.used - 1) * nu.sum()]
        if rise is not None:
            parts.append(self.turn.T @ (rise - 2 * M @ X * signs).ravel())
        residual = np.concatenate(parts)[self.free]
        if not derivatives:
            return residual, None
        p, J = len(part.slope), len(nu)
        H = np.zeros((p + J + self.sizeX,) * 2)
        H[:p, :p] = part.own
        H[:p, p : p + J], H[p : p + J, :p] = part.steep.T, part.steep * nu.sum()
        if self.reduced:
            H[:p, :p] += self.criterion.second(M, X, part.turned)
        else:
            cross = -2 * (part.turned * signs).reshape(p, -1) @ self.turn
            H[:p, p + J :], H[p + J :, :p] = cross, cross.T
            H[p + J :, p + J :] = (
                self.turn.T @ (np.asarray(bend) - 2 * np.kron(M, np.diag(signs))) @ self.turn
            )
        H[:p] *= part.weigh[:, None]
        return residual, H[np.ix_(self.free, self.free)]


def _rise(
    criterion: Criterion, X: NDArray, signs: NDArray, second: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Derivatives of log numerator(X); of the difference of two, where the loss is a ratio of two traces."""
    derivatives = criterion.log_derivatives if second else lambda at: criterion.log_numerator(at, False)
    if (signs > 0).all():
        return derivatives(X)
    rise, bend = np.zeros(X.shape), np.zeros(X.shape * 2)
    for sign in np.unique(signs):
        own = np.flatnonzero(signs == sign)
        first, curved = derivatives(X[:, own])
        rise[:, own] = sign * first
        if curved is not None:
            bend[:, own[:, None], :, own] = sign * curved.reshape(len(X), len(own), len(X), -1).transpose(
                1, 3, 0, 2
            )
    return rise, bend.reshape(X.size, X.size) if second else None


def _real_factor(D: NDArray[np.complex128]) -> NDArray[np.float64]:
    """D a as reals, for a as reals: (m, n, 2 r, 2 q)."""
    above, below = np.concatenate([D.real, -D.imag], axis=3), np.concatenate([D.imag, D.real], axis=3)
    return np.concatenate([above, below], axis=2)


def _real_form(Q: NDArray[np.complex128]) -> NDArray[np.float64]:
    """The Hermitian form for a as reals: (m, J, 2 q, 2 q)."""
    above, below = np.concatenate([Q.real, -Q.imag], axis=3), np.concatenate([Q.imag, Q.real], axis=3)
    return np.concatenate([above, below], axis=2)


def polish(
    problem: Problem, columns: Columns, w: NDArray[np.float64], X: NDArray[np.float64], nu: NDArray[np.float64],
    signs: NDArray[np.float64] | None = None,
) -> Polished | None:  # fmt: skip
    """Newton's method from a support that is nearly right: w (m,), signs (s,): modified E, 1 for the columns
    of X that price the least eigenvalue, -1 for the largest's."""
    signs = np.ones(X.shape[1]) if signs is None else signs
    try:
        for _ in range(AT_EDGES):
            columns = snapped(problem, columns)
            system = System(problem, columns, w, X, nu, signs)
            if np.count_nonzero(system.free) > LARGEST:
                return None
            point, residual = newton(system)
            if not (point.power > 0).all() or (point.nu < 0).any():
                return None
            q, w, X, nu = point.z.shape[1] // 2, point.power, point.X, point.nu
            omega = within_bands(problem, point.omega)
            columns = problem.columns(omega, (point.z[:, :q] + 1j * point.z[:, q:]) / np.sqrt(w)[:, None])
            w = w / (columns.q.T @ w).max()
            if np.abs(omega - point.omega).max() < OUTSIDE:
                if system.reduced:
                    X = problem.criterion.direction(problem.constant + columns.information(w))
                return Polished(columns, w, X, nu, residual)
    except np.linalg.LinAlgError:  # the lines that Newton's method led to leave the information singular
        pass
    return None


def newton(system: Any) -> tuple[Any, float]:
    """The point where Newton's method ends, and the norm of the conditions there; of a System, or what answers the same."""
    point = system.start
    residual, J = system.conditions(point)
    before, norm = np.inf, float(np.linalg.norm(residual))
    for _ in range(STEPS):
        if norm < SPENT or not np.isfinite(norm) or (norm < ROUNDING and norm > 0.1 * before):
            break
        found, after = _stepped(system, point, residual, (np.asarray(J), residual), DEPENDENT)
        for way, cond in (
            _other_ways(system, point, residual, J) if after > GAINED * norm and not system.priced else ()
        ):
            other, then = _stepped(system, point, residual, way, cond)
            found, after = (other, then) if then < after else (found, after)
        if not after < norm:
            break
        point, before, norm = found, norm, after
        residual, J = system.conditions(point)
    return point, norm


def _other_ways(
    system: Any, point: Any, residual: NDArray, J: Any
) -> tuple[tuple[tuple[NDArray, NDArray], float], ...]:
    """Other least squares where power has no price, and what counts as dependent in each: rows differ by what their lines tell, by 1e5,
    and what is small beside that may be no dependence, or all of one."""
    still = system.symmetries(point)
    zeros, size = np.zeros(len(still)), 1 / np.maximum(np.linalg.norm(J, axis=1), np.finfo(float).tiny)
    doubted = float(np.linalg.norm(residual) / np.linalg.norm(J, axis=0).max())
    return (
        ((np.vstack([J, still]), np.append(residual, zeros)), DEPENDENT),
        ((np.vstack([J * size[:, None], still]), np.append(size * residual, zeros)), DEPENDENT),
        ((J, residual), max(DEPENDENT, doubted)),
    )


def _stepped(
    system: Any, point: Any, residual: NDArray, way: tuple[NDArray, NDArray], cond: float
) -> tuple[Point, float]:
    """A step that lowers the norm of the conditions, and that norm; the point itself where there is none. It solves for the
    conditions in one way: a matrix and what it leaves."""
    from scipy.linalg import lstsq

    step = np.zeros(len(system.free))
    solved: Any = lstsq(*way, cond=cond, lapack_driver="gelsy", check_finite=False)
    step[system.free] = -solved[0]
    norm = float(np.linalg.norm(residual))
    length = min(1.0, STRIDE / max(float(np.abs(step[: system.strided]).max()), 1e-300))
    for _ in range(HALVINGS):
        trial = system.moved(point, length * step)
        after = float(np.linalg.norm(system.conditions(trial, False)[0]))
        if after < norm * (1 - 0.1 * length):
            return trial, after
        length /= 3
    return point, norm
