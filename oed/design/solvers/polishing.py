"""The last digits: Newton's method on the optimality conditions of the support itself.

Unknowns are the frequencies w_i, the complex amplitudes a_i (power a_i a_i^*) and the multipliers nu; where the
information may be singular (c) or the loss is not smooth (E) also the certificate direction X. With S = D^* X X' D:

    (S(w_i) - Q_nu(w_i)) a_i = 0,   d/dw a_i^* (S - Q_nu) a_i = 0,   active budgets used up,
    c: M X = V;   E, with t = 1 / loss: M X = t V V' X, |V'X|_F = 1.

The system is solved in the least-squares sense (phases are free, X may be), so it converges quadratically.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.design.problem.lines import Columns, Problem

__all__ = ["Polished", "polish"]

_STENCIL = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
_FIRST = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12
_SECOND = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / 12
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class Polished:
    """Support, weights and certificate after Newton's method.

    `columns` one per line and direction; `w` weights within the budgets; `X, nu` certificate; `residual` norm
    of the optimality conditions.
    """

    columns: Columns
    w: NDArray[np.float64]
    X: NDArray[np.float64]
    nu: NDArray[np.float64]
    residual: float


class _Conditions:
    """Residual of the optimality conditions as a function of one real vector."""

    def __init__(self, problem: Problem, columns: Columns, w: NDArray, X: NDArray, nu: NDArray) -> None:
        criterion = problem.criterion
        self.problem, self.shape_X = problem, X.shape
        self.eigen = criterion.kind == "E"
        self.own_X = self.eigen or (criterion.kind == "A" and criterion.columns.shape[1] < criterion.n)
        self.lines, self.channels = columns.direction.shape
        self.unit = problem.length_scale(columns.omega)
        edges = np.array(problem.bands).ravel()
        at_edge = np.abs(columns.omega[:, None] - edges).min(axis=1) < 1e-9
        real = (columns.omega < 1e-12) | (columns.omega > np.pi - 1e-12)
        self.moves = ~at_edge
        self.complex = ~real
        self.active = (nu > 1e-9 * nu.sum()) & (columns.q.T @ w > 1 - 1e-6)
        self.omega0, self.nu0 = columns.omega, np.where(self.active, nu, 0.0)
        a = columns.direction * np.sqrt(w)[:, None]
        parts = [
            columns.omega[self.moves] / self.unit[self.moves],
            a.real.ravel(),
            a.imag[self.complex].ravel(),
            nu[self.active],
        ]
        if self.own_X:
            parts.append(X.ravel())
        if self.eigen:
            parts.append(np.array([nu.sum()]))
        self.start = np.concatenate(parts)
        self.sizes = np.cumsum([p.size for p in parts])[: 5 if self.eigen else 4]

    def unpack(self, x: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray | None]:
        """Frequencies, amplitudes, multipliers and, where it is an unknown of its own, X."""
        omega, real, imag, nu, *rest = np.split(x, self.sizes)
        frequencies, multipliers = self.omega0.copy(), self.nu0.copy()
        frequencies[self.moves] = omega * self.unit[self.moves]
        a = real.reshape(self.lines, self.channels).astype(complex)
        a[self.complex] += 1j * imag.reshape(-1, self.channels)
        multipliers[self.active] = nu
        return frequencies, a, multipliers, rest[0].reshape(self.shape_X) if self.own_X else None

    def expansion(self, omega: NDArray) -> tuple[NDArray, ...]:
        """D, dD/dw, d2D/dw2 (lines, n, r, nu) and the same of the forms, around given frequencies."""
        h = 1e-3 * self.unit
        points = (omega[:, None] + h[:, None] * _STENCIL).ravel()
        D = self.problem.scaled_factor(points)
        Q = self.problem.forms_at(points)
        out = []
        for values in (D, Q):
            rows = values.reshape(len(omega), 5, *values.shape[1:])
            lift = (slice(None),) + (None,) * (values.ndim - 1)
            out += [
                rows[:, 2],
                np.tensordot(_FIRST, rows, (0, 1)) / h[lift],
                np.tensordot(_SECOND, rows, (0, 1)) / (h**2)[lift],
            ]
        return tuple(out)

    def information(self, D: NDArray, a: NDArray) -> NDArray[np.float64]:
        flat = np.moveaxis(np.einsum("knrq,kq->knr", D, a), 1, 0).reshape(D.shape[1], -1)
        return self.problem.constant + flat.real @ flat.real.T + flat.imag @ flat.imag.T

    def _directed(self, D: NDArray, X: NDArray) -> NDArray[np.complex128]:
        """X' D, (lines, s r, nu)."""
        flat = X.T @ D.reshape(*D.shape[:2], -1)
        return flat.reshape(len(D), -1, self.channels)

    def residual(self, x: NDArray, centre: NDArray, taylor: tuple[NDArray, ...]) -> NDArray[np.float64]:
        omega, a, nu, X = self.unpack(x)
        d = omega - centre
        lift = lambda p, ndim: p.reshape(-1, *(1,) * (ndim - 1))
        D0, D1, D2, Q0, Q1, Q2 = taylor
        dD, dQ = lift(d, D0.ndim), lift(d, Q0.ndim)
        D, slope_D = D0 + dD * D1 + dD**2 / 2 * D2, D1 + dD * D2
        Q = np.einsum("j,kjqr->kqr", nu, Q0 + dQ * Q1 + dQ**2 / 2 * Q2)
        slope_Q = np.einsum("j,kjqr->kqr", nu, Q1 + dQ * Q2)
        M = self.information(D, a)
        parts = []
        V = self.problem.criterion.columns
        if X is None:
            X = self.problem.criterion.direction(M)
        elif self.eigen:
            turned = V.T @ X
            parts += [(M @ X - x[-1] * (V @ turned)).ravel(), np.array([np.sum(turned**2) - 1]) * x[-1]]
        else:
            parts.append((M @ X - V).ravel())
        E, slope_E = (self._directed(y, X) for y in (D, slope_D))
        Ea, slope_Ea = (np.einsum("kmq,kq->km", y, a) for y in (E, slope_E))
        priced = np.einsum("kmq,km->kq", E.conj(), Ea) - np.einsum("kqr,kr->kq", Q, a)
        power = np.einsum("kq,kq->k", a.conj(), a).real
        slope = 2 * np.einsum("km,km->k", Ea.conj(), slope_Ea).real
        slope -= np.einsum("kq,kqr,kr->k", a.conj(), slope_Q, a).real
        shares = np.einsum("kq,kjqr,kr->j", a.conj(), Q0 + dQ * Q1 + dQ**2 / 2 * Q2, a).real
        root = np.sqrt(power)[:, None]
        parts += [
            (priced / root).real.ravel(),
            (priced / root).imag[self.complex].ravel(),
            (slope * self.unit / power)[self.moves],
            (shares - 1)[self.active] * nu.sum(),
        ]
        return np.concatenate(parts)


def polish(
    problem: Problem,
    columns: Columns,
    w: NDArray[np.float64],
    X: NDArray[np.float64],
    nu: NDArray[np.float64],
) -> Polished | None:
    """Newton's method from a support that is nearly right.

    Shapes: w (m,).
    """
    if problem.criterion.kind not in ("D", "A", "E") or not len(columns):
        return None
    if problem.criterion.kind == "E":
        # Z has the rank of the multiplicity of the eigenvalue; what is below that is the solver's rounding.
        U, values, _ = np.linalg.svd(X, full_matrices=False)
        rank = int(np.count_nonzero(values > 1e-2 * values[0]))
        X = U[:, :rank] * values[:rank]
    conditions = _Conditions(problem, columns, w, X, nu)
    if len(conditions.start) > 400:
        return None
    x, best, residual = conditions.start, None, np.inf
    try:
        for _ in range(12):
            centre = conditions.unpack(x)[0]
            taylor = conditions.expansion(centre)
            now = conditions.residual(x, centre, taylor)
            norm = float(np.linalg.norm(now)) / float(nu.sum())
            if not norm < 0.9 * residual:
                break
            best, residual = x, norm
            if norm < 1e-15:
                break
            steps = _STEP * np.maximum(np.abs(x), 1e-2 * np.abs(x).max())
            ahead = [conditions.residual(x + dx, centre, taylor) for dx in np.diag(steps)]
            behind = [conditions.residual(x - dx, centre, taylor) for dx in np.diag(steps)]
            J = (np.array(ahead) - np.array(behind)).T / 2
            x = x - steps * np.linalg.lstsq(J, now, rcond=1e-9)[0]
    except np.linalg.LinAlgError:
        pass
    if best is None:
        return None
    try:
        return _outcome(problem, conditions, best, X, residual)
    except np.linalg.LinAlgError:  # the lines that Newton's method ended with leave the information singular
        return None


def _outcome(
    problem: Problem, conditions: _Conditions, x: NDArray, X: NDArray, residual: float
) -> Polished | None:
    omega, a, nu, own_X = conditions.unpack(x)
    inside = np.zeros(len(omega), dtype=bool)
    for low, high in problem.bands:
        inside |= (omega >= low - 1e-12) & (omega <= high + 1e-12)
    w = np.einsum("kq,kq->k", a.conj(), a).real
    if not inside.all() or not (w > 0).all() or (nu < 0).any():
        return None
    columns = problem.columns(np.clip(omega, 0, np.pi), a / np.sqrt(w)[:, None])
    w = w / (columns.q.T @ w).max()
    if own_X is None:
        own_X = problem.criterion.direction(problem.constant + columns.information(w))
    return Polished(columns, w, own_X, nu, residual)
