"""The design problem as columns: one line of unit power at one frequency in one direction is one column.

Its information is F F' with F (n, m) real, and it uses the share q_j of budget j, so that a spectrum is a
vector of weights w >= 0 with Q w <= 1 and M(w) = M_0 + sum_k w_k F_k F_k'. A direction X of the certificate
prices every frequency: S(w) = sum over D(w)^* X X' D(w), (nu, nu), against the budgets' Q_nu(w) = sum_j nu_j Q_j(w).
Parameters are scaled so that white noise carries the unit information matrix; what is computed in these
coordinates keeps its accuracy at dampings of 1e-3 and time constants over six decades."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.covariances import root_in_own_units, solved_below
from oed.criteria import Criterion
from oed.design.problem.families import local_maxima, maxima_between
from oed.design.problem.information_maps import InformationMap
from oed.design.problem.white import white_root

ROUNDED = 1e5
"""Condition of the coordinates above which double precision loses what the tightest tolerance, 1e-9, asks for."""

LAST_DIGITS = (1, -1, 2, -2)
"""Units in the last place by which frequencies are moved to see what rounding does."""
DRAWS = 4
"""Units in the last place, to either side, at which the prices are seen."""
LOST = 0.01
"""Rounding of the coordinates over its worst case, condition times precision: .013 was seen where it is largest."""
BESIDE = 1e-5
"""Distance from an end of a band, in units of the distance over which the plant changes, at which a line is put there: what it is worth is off by the square."""
REGULAR = 1e-4
"""Least singular value of the information's factor over the largest from which on the coordinates tell the loss of some combinations:
with 4e-4 to 12 digits, and singular designs have 0."""


@dataclass(frozen=True, eq=False)
class Budget:
    """A limit on a power that is linear in the spectrum: sum_k tr(form(w_k) P_k) <= limit. `name` what is
    limited, as in messages; `form` omega (K,) -> (K, nu, nu) Hermitian, positive semidefinite; `limit`
    positive."""

    name: str
    form: Callable[[NDArray[np.float64]], NDArray[np.complex128]]
    limit: float


@dataclass(frozen=True, eq=False)
class Columns:
    """Lines of unit power: frequencies, directions, information factors and what they use of the budgets.
    `omega` (m,) rad/sample; `direction` (m, nu) complex, unit length; `F` (m, n, 2 r) real; `q` (m, J) share
    of each budget per unit of power."""

    omega: NDArray[np.float64]
    direction: NDArray[np.complex128]
    F: NDArray[np.float64]
    q: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.omega)

    def __add__(self, other: Columns) -> Columns:
        pair = lambda name: np.concatenate([getattr(self, name), getattr(other, name)])
        return Columns(pair("omega"), pair("direction"), pair("F"), pair("q"))

    def take(self, keep: NDArray) -> Columns:
        """Some of the columns."""
        return Columns(self.omega[keep], self.direction[keep], self.F[keep], self.q[keep])

    def information(self, w: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of the columns' information: w (m,) -> (n, n)."""
        flat = factor_of(self.F, w)
        return flat @ flat.T

    def prices(self, X: NDArray[np.float64], nu: NDArray[np.float64]) -> NDArray[np.float64]:
        """Price of every column against its cost: X (n, s), nu (J,) -> (m,)."""
        worth = np.sum(np.einsum("mnr,ns->mrs", self.F, X) ** 2, axis=(1, 2))
        return worth / np.maximum(self.q @ nu, 1e-300)


@dataclass(frozen=True, eq=False)
class Prices:
    """What each grid line is worth to a certificate direction, relative to its cost. `ratio` (K,) largest
    eigenvalue of S against Q_nu: at most 1 at the optimum; `direction` (K, nu) input direction in which it is
    attained, unit length."""

    ratio: NDArray[np.float64]
    direction: NDArray[np.complex128]


class Problem:
    """A design problem in scaled coordinates, with its grid."""

    def __init__(
        self, information: InformationMap, criterion: Criterion, budgets: tuple[Budget, ...],
        omega: NDArray[np.float64], bands: tuple[tuple[float, float], ...] = ((0.0, np.pi),),
        amplitude: NDArray[np.complex128] | None = None,
    ) -> None:  # fmt: skip
        """The unit of information is that of white noise, or of the lines omega with the amplitudes (K, nu)."""
        self.map, self.budgets, self.omega, self.bands = information, budgets, omega, bands
        self.band = np.searchsorted([low for low, _ in bands], omega, side="right")
        self.original = criterion
        D = information.factor(omega)
        told = D if amplitude is None else D @ (amplitude * np.sqrt(len(omega)))[:, None, :, None]
        self.R = white_root(information, told)
        self.condition = float(np.linalg.cond(self.R / np.linalg.norm(self.R, axis=0)))
        self.finely = self.condition > ROUNDED
        # What is asked of all parameters, where it is rounded itself, has double precision however fine the coordinates are.
        exact = not criterion.whole or not np.any(criterion.V % 1)
        digits = np.finfo(np.longdouble if self.finely and exact else float)
        self.lost = LOST * self.condition * float(digits.eps)
        self.criterion, self.scale = criterion.transformed(self.R, self.finely)
        half = solved_below(self.R, information.constant, self.finely)
        self.constant = solved_below(self.R, half.T, self.finely)
        self.grid = self._scaled(self._factor(omega) if self.finely else D)
        self.forms = self.forms_at(omega)

    def for_criterion(self, criterion: Criterion) -> Problem:
        """The same problem on the same grid with another criterion."""
        other = copy(self)
        other.original = criterion
        other.criterion, other.scale = criterion.transformed(self.R, self.finely)
        return other

    def _factor(self, omega: NDArray[np.float64]) -> NDArray:
        """D (K, n, r, nu), in extended precision where the coordinates ask for it and the map has it."""
        return (self.map.finer if self.finely and self.map.finer else self.map.factor)(omega)

    def _scaled(self, D: NDArray[np.complex128]) -> NDArray[np.float64]:
        """D (K, n, r, nu) in scaled coordinates, real and imaginary parts apart: (n, 2, K, r, nu)."""
        flat = np.moveaxis(D, 1, 0)
        both = np.stack([flat.real, flat.imag], axis=1)
        return solved_below(self.R, both.reshape(len(both), -1), self.finely).reshape(both.shape)

    def forms_at(self, omega: NDArray[np.float64]) -> NDArray[np.complex128]:
        """The budgets' forms over their limits: omega (K,) -> (K, J, nu, nu)."""
        return np.stack([b.form(omega) / b.limit for b in self.budgets], axis=1)

    def extended(self, omega: NDArray[np.float64]) -> Problem:
        """The same problem on a grid with more frequencies."""
        new = np.setdiff1d(omega, self.omega)
        both = np.concatenate([self.omega, new])
        order = np.argsort(both)
        other = copy(self)
        other.omega = both[order]
        other.band = np.searchsorted([low for low, _ in self.bands], other.omega, side="right")
        other.grid = np.concatenate([self.grid, self._scaled(self._factor(new))], axis=2)[:, :, order]
        other.forms = np.concatenate([self.forms, self.forms_at(new)])[order]
        return other

    def loss(self, columns: Columns, w: NDArray[np.float64]) -> float:
        """Scaled loss of the weights of some columns: w (m,)."""
        flat = factor_of(columns.F, w, self.constant)
        if self.criterion.whole or (self.finely and _regular(flat)):
            return self.criterion.loss_of_factor(flat)
        # Of some combinations the optimum may be singular: what lies in its range is told exactly in the model's own parameters.
        D = np.einsum("knrq,kq->nkr", self.map.factor(columns.omega), columns.direction * np.sqrt(w)[:, None])
        flat = np.concatenate([D.real, D.imag], axis=2).reshape(self.map.n, -1)
        return self.original.loss_of_factor(_beside(flat, self.map.constant), self.map.alike) / self.scale

    def rounding(self, columns: Columns, w: NDArray[np.float64]) -> float:
        """How far rounding alone moves the loss, relative: seen at the last digits, and what the coordinates may have lost."""
        again = lambda omega: self.loss(self.columns(omega, columns.direction), w)
        return max(self.lost, moved_by_rounding(self.loss(columns, w), again, columns.omega))

    def uncertain_prices(
        self, columns: Columns, X: NDArray[np.float64], nu: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Price of every column and what rounding does to it: mean and standard deviation over the last digits of its frequency."""
        digits = np.arange(-DRAWS, DRAWS + 1) * np.finfo(float).eps
        draws = [self.columns(columns.omega * (1 + k), columns.direction).prices(X, nu) for k in digits]
        return np.mean(draws, axis=0), np.std(draws, axis=0)

    def scaled_factor(self, omega: NDArray[np.float64]) -> NDArray[np.complex128]:
        """D in scaled coordinates: omega (K,) -> (K, n, r, nu)."""
        flat = self._scaled(self._factor(omega))
        return np.moveaxis(flat[:, 0] + 1j * flat[:, 1], 0, 1)

    def length_scale(self, omega: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance in frequency over which the plant changes: to the nearest resonance, at most 0.3; omega
        (K,) -> (K,)."""
        centres, widths = self.map.resonances[:, 0], self.map.resonances[:, 1]
        distance = np.hypot(omega[:, None] - centres, widths)
        return np.minimum(distance.min(axis=1, initial=np.inf), 3.0 / (self.map.n + 10))

    def columns(self, omega: NDArray[np.float64], direction: NDArray[np.complex128]) -> Columns:
        """Columns at given frequencies and directions: omega (m,), direction (m, nu)."""
        D = self._factor(omega)
        G = np.moveaxis(np.einsum("knrq,kq->knr", D, direction), 1, 0)
        both = np.stack([G.real, G.imag], axis=-1)
        F = solved_below(self.R, both.reshape(len(both), -1), self.finely).reshape(both.shape)
        F = np.moveaxis(F, 0, 1).reshape(len(omega), len(both), 2 * D.shape[2])
        q = np.einsum("kq,kjqr,kr->kj", direction.conj(), self.forms_at(omega), direction).real
        return Columns(omega, direction, F, q)

    def prices(self, X: NDArray[np.float64], nu: NDArray[np.float64]) -> Prices:
        """Prices on the grid: X (n, s), nu (J,)."""
        return _price(self.grid, self.forms, X, nu)

    def prices_at(
        self, omega: NDArray[np.float64], X: NDArray[np.float64], nu: NDArray[np.float64]
    ) -> Prices:
        """Prices at any frequencies: omega (K,), X (n, s), nu (J,)."""
        return _price(self._scaled(self._factor(omega)), self.forms_at(omega), X, nu)

    def refined_maxima(
        self, prices: Prices, X: NDArray[np.float64], nu: NDArray[np.float64], above: float, divisions: int = 13,
    ) -> tuple[NDArray[np.float64], Prices]:  # fmt: skip
        """The local maxima of the price between grid lines, where the grid's own reach a level."""
        at = local_maxima(prices.ratio)
        at = at[prices.ratio[at] >= above]
        left, right = np.maximum(at - 1, 0), np.minimum(at + 1, len(self.omega) - 1)
        # A neighbour in another band is no bracket: lines are allowed in the bands only.
        low = self.omega[np.where(self.band[left] == self.band[at], left, at)]
        high = self.omega[np.where(self.band[right] == self.band[at], right, at)]
        omega = maxima_between(lambda w: self.prices_at(w, X, nu).ratio, low, high, divisions)
        return omega, self.prices_at(omega, X, nu)


def factor_of(
    F: NDArray[np.float64], w: NDArray[np.float64], constant: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Factor (n, k) of the information of weights w (m,) of factors F (m, n, r), and of a constant part (n, n)."""
    flat = np.moveaxis(F * np.sqrt(w)[:, None, None], 0, 1).reshape(F.shape[1], -1)
    return flat if constant is None else _beside(flat, constant)


def _beside(factor: NDArray[np.float64], constant: NDArray[np.float64]) -> NDArray[np.float64]:
    """A factor (n, k), and that of a constant part (n, n) where there is one."""
    return np.concatenate([factor, root_in_own_units(constant)[0]], axis=1) if np.any(constant) else factor


def moved_by_rounding(
    kept: float, loss: Callable[[NDArray[np.float64]], float], omega: NDArray[np.float64]
) -> float:
    """How far a loss moves from what was kept, relative, where the frequencies (m,) move by their last digits, which rounds every
    response anew and changes nothing else; infinite where there is no loss."""
    again = [loss(omega * (1 + k * np.finfo(float).eps)) for k in LAST_DIGITS]
    return float(np.max(np.abs(np.array(again) / kept - 1))) if np.isfinite(kept) else np.inf


def _regular(factor: NDArray[np.float64]) -> bool:
    """Whether a factor in scaled coordinates has full rank, far from rounding: factor (n, k)."""
    values = np.linalg.svd(factor, compute_uv=False)
    return bool(len(values) == len(factor) and values[-1] > REGULAR * values[0])


def _price(
    flat: NDArray[np.float64], forms: NDArray[np.complex128], X: NDArray[np.float64], nu: NDArray[np.float64]
) -> Prices:
    n, _, K, r, q = flat.shape
    E = X.T @ flat.reshape(n, -1)
    if q == 1:
        E *= E
        worth = E.reshape(len(E) * flat.shape[1], K, r).sum(axis=0).sum(axis=1)
        cost = (forms[:, :, 0, 0].real * nu).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(worth > 0, worth / cost, 0.0)
        return Prices(ratio, np.ones((K, 1), dtype=complex))
    E = E.reshape(X.shape[1], *flat.shape[1:])
    cost = np.einsum("j,kjqr->kqr", nu, forms)
    C = np.moveaxis(E[:, 0] + 1j * E[:, 1], 1, 0).reshape(K, X.shape[1] * r, q)
    S = C.conj().swapaxes(1, 2) @ C
    values, vectors = np.linalg.eigh(cost)
    floor = 1e-14 * np.maximum(values[:, -1:], 1e-300)
    inverse_root = vectors / np.sqrt(np.maximum(values, floor))[:, None, :]
    worth, turned = np.linalg.eigh(inverse_root.conj().swapaxes(1, 2) @ S @ inverse_root)
    direction = np.einsum("kqr,kr->kq", inverse_root, turned[:, :, -1])
    return Prices(worth[:, -1], direction / np.linalg.norm(direction, axis=1, keepdims=True))


def within_bands(problem: Problem, omega: NDArray[np.float64]) -> NDArray[np.float64]:
    """Frequencies moved to the nearest in the bands."""
    edges = np.array(problem.bands)
    near = np.clip(omega[:, None], edges[:, 0], edges[:, 1])
    return near[np.arange(len(omega)), np.argmin(np.abs(near - omega[:, None]), axis=1)]


def snapped(problem: Problem, columns: Columns) -> Columns:
    """Lines beside an end of a band moved to it; at 0 and pi an amplitude is real."""
    edges = np.unique(np.array(problem.bands).ravel())
    nearest = edges[np.argmin(np.abs(columns.omega[:, None] - edges), axis=1)]
    at = np.abs(nearest - columns.omega) < BESIDE * problem.length_scale(columns.omega)
    if not at.any():
        return columns
    omega, direction = np.where(at, nearest, columns.omega), columns.direction.copy()
    for k in np.flatnonzero((omega == 0) | (omega == np.pi)):
        turned = direction[k] * np.exp(-0.5j * np.angle(np.sum(direction[k] ** 2)))
        direction[k] = turned.real / np.linalg.norm(turned.real)
    return problem.columns(omega, direction)
