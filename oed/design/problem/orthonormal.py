"""Parameters that double precision does not tell apart, told by other coordinates: orthonormal gradients of a rational plant.

The gradients of B/A by all its n coefficients span z^-d P(z)/A(z)^2, P of degree n - 1 in z^-1, d the delay. Arnoldi's recurrence on
a grid gives this space an orthonormal basis that loses no digits, however alike the coefficients' effects are, and that can be
evaluated anywhere; what it is in the coefficients is found in decimal arithmetic of as many digits as it takes."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, localcontext
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import as_frequencies
from oed.errors import InputError
from oed.information import inverse_root
from oed.plants.plant import Plant

DIGITS = (60, 6)
"""Of the decimal arithmetic, and more for each coefficient: elimination loses at most about three for a pair of poles and zeros."""
LARGEST = 100
"""Coefficients of an entry up to which the decimal arithmetic takes a second; FIR models, which have more, have no use for it."""
ENDLESS = 120
"""Coefficients of a rational entry up to which a search in those themselves ends in time: 12 s with 120, 54 s with 140, and no end in nine
minutes with 200."""
NEWTONS = 4
"""Steps by which a pole gets the digits of extended precision from those of its eigenvalue: each doubles them."""


@dataclass(frozen=True, eq=False)
class _Entry:
    """The basis of one entry of the plant. `at` its parameters; `row, column` its place; `first` 1 over the norm of 1/A^2; `steps`
    (n, n) what each multiplication by z^-1 has of the basis so far, `norms` (n,) the length of what is left."""

    plant: Plant
    at: slice
    row: int
    column: int
    first: float
    steps: NDArray[np.float64]
    norms: NDArray[np.float64]

    @property
    def A(self) -> NDArray[np.float64]:
        return self.plant.den[self.row][self.column]

    @property
    def b(self) -> NDArray[np.float64]:
        """B without its delay."""
        B = self.plant.num[self.row][self.column]
        return B[np.flatnonzero(B)[0] :]

    def polynomials(self, z: NDArray) -> NDArray:
        """P_k at values z (K,) of the delay, (K, n)."""
        found = np.full((len(z), len(self.norms)), self.first, dtype=z.dtype)
        for k in range(len(self.norms) - 1):
            found[:, k + 1] = z * found[:, k] - found[:, : k + 1] @ self.steps[: k + 1, k].astype(
                z.real.dtype
            )
            found[:, k + 1] /= self.norms[k]
        return found

    def gradient(self, omega: NDArray) -> NDArray[np.complex128]:
        """The basis without the noise filter, (K, n)."""
        z = np.exp(-1j * omega.astype(np.longdouble))
        return (self.polynomials(z) * _weight(self.plant, self.row, self.column, z)[:, None]).astype(complex)

    def slope_of_pole(self, p: complex) -> NDArray[np.complex128]:
        """What each basis function moves a pole by: A moves by -P/b at it."""
        A, b = (polynomial.astype(np.longdouble) for polynomial in (self.A, self.b))
        at = np.array([p], dtype=np.clongdouble)
        for _ in range(NEWTONS):
            at = at - np.polyval(A, at) / np.polyval(np.polyder(A), at)
        told = self.polynomials(1 / at)[0] / np.polyval(b[::-1], 1 / at)
        return (at ** (len(A) - 1) / np.polyval(np.polyder(A), at) * told).astype(complex)

    @cached_property
    def exact(self) -> tuple[NDArray, NDArray, float]:
        """T and T^-1 of decimals, with dG = T times the basis, and log |det T|."""
        n, nb = len(self.norms), len(self.b)
        with localcontext() as context:
            context.prec = DIGITS[0] + DIGITS[1] * n
            A, b = _decimals(self.A), _decimals(self.b)
            S = np.full((n, n), Decimal(0))
            for k in range(nb):
                S[k, k : k + len(A)] = A
            for k in range(1, len(A)):
                S[nb + k - 1, k : k + nb] = -b
            # z^-j / A^2 is J times the basis: what z^-1 does to the basis is one row of J after the other.
            J, L = (np.full((n, n), Decimal(0)) for _ in "JL")
            J[0, 0], L[0, 0] = 1 / Decimal(self.first), Decimal(self.first)
            steps, norms = _decimals(self.steps), _decimals(self.norms)
            for k in range(n - 1):
                J[k + 1] = J[k] @ steps.T
                J[k + 1, 1:] += J[k, :-1] * norms[:-1]
                L[k + 1, 1:] = L[k, :-1]
                L[k + 1] = (L[k + 1] - steps[: k + 1, k] @ L[: k + 1]) / norms[k]
            inverse, logdet = _inverse(S)
            return S @ J, L @ inverse, float(logdet + sum(x.ln() for x in np.diag(J)))

    def times(self, V: NDArray[np.float64], which: str) -> NDArray[np.float64]:
        """T V, T^-1 V or T'^-1 V ("T", "inverse", "turned"), rounded once."""
        with localcontext() as context:
            context.prec = DIGITS[0] + DIGITS[1] * len(V)
            T, inverse, _ = self.exact
            return ({"T": T, "inverse": inverse, "turned": inverse.T}[which] @ _decimals(V)).astype(float)


@dataclass(frozen=True, eq=False)
class Orthonormal:
    """A plant in these coordinates: it responds as a model does, its parameters being those of the basis."""

    plant: Plant
    entries: tuple[_Entry, ...]

    def response(self, omega: ArrayLike) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """G (K, ny, nu) and dG by the coordinates (K, n, ny, nu)."""
        wide = as_frequencies(omega).astype(np.longdouble)
        G = self.plant._rational(np.exp(-1j * wide))[0].astype(complex)
        dG = np.zeros((len(G), len(self.plant.free), *G.shape[1:]), dtype=complex)
        for entry in self.entries:
            dG[:, entry.at, entry.row, entry.column] = entry.gradient(wide)
        return G, dG

    def factor(self, omega: NDArray[np.float64]) -> NDArray[np.complex128]:
        """The gradient with the noise whitened, (K, n, r, nu)."""
        H = self.plant.noise_response(omega)
        dG = self.response(omega)[1] / H[:, None, None, None]
        return np.einsum("pr,knrq->knpq", inverse_root(self.plant.noise_covariance), dG)

    def times(self, V: NDArray[np.float64], which: str) -> NDArray[np.float64]:
        """With V (n, s), or (K, n, s): combinations of the coordinates as such of the model's own parameters ("T"), the other
        way ("inverse"), and a certificate's direction in the model's parameters ("turned")."""
        flat = V if V.ndim == 2 else np.concatenate(list(V), axis=1)
        flat = np.concatenate([entry.times(flat[entry.at], which) for entry in self.entries])
        return flat if V.ndim == 2 else np.stack(np.split(flat, len(V), axis=1))

    def slope_of_pole(self, row: int, column: int, p: complex) -> NDArray[np.complex128]:
        """Derivative of a pole of an entry by the coordinates, (n,)."""
        slope = np.zeros(len(self.plant.free), dtype=complex)
        for entry in self.entries:
            if (entry.row, entry.column) == (row, column):
                slope[entry.at] = entry.slope_of_pole(p)
        return slope

    @property
    def logdet(self) -> float:
        """log |det T|."""
        return float(sum(entry.exact[2] for entry in self.entries))


def orthonormal_coordinates(plant: Plant, omega: NDArray[np.float64]) -> Orthonormal | None:
    """The coordinates on a grid (K,); None where some parameters are known, or there are too many.

    Raises
    ------
    InputError
        If a rational entry has more than `ENDLESS` coefficients.
    """
    if plant.free != plant.all_names:
        return None
    z, entries, start = np.exp(-1j * omega.astype(np.longdouble)), [], 0
    H = plant.noise_response(omega)
    for i, row in enumerate(plant.num):
        for j, B in enumerate(row):
            if not np.any(B):
                continue
            n = len(B) - int(np.flatnonzero(B)[0]) + len(plant.den[i][j]) - 1
            if n > ENDLESS and len(plant.den[i][j]) > 1:
                raise InputError(
                    f"the plant has {n} coefficients from one input to one output, which double precision does not tell apart: a search "
                    f"among more than {ENDLESS} takes minutes to hours; lower the order, name the parameters that matter in `free`, or "
                    "take an FIR model."
                )
            if n > LARGEST:
                return None
            entries.append(
                _Entry(plant, slice(start, start + n), i, j, *_recurrence(z, _weight(plant, i, j, z) / H, n))
            )
            start += n
    return Orthonormal(plant, tuple(entries))


def _weight(plant: Plant, row: int, column: int, z: NDArray) -> NDArray:
    """z^d / A^2."""
    B = plant.num[row][column]
    return z ** int(np.flatnonzero(B)[0]) / np.polyval(plant.den[row][column][::-1], z) ** 2


def _recurrence(z: NDArray, weight: NDArray, n: int) -> tuple[float, NDArray, NDArray]:
    """Arnoldi's: first, steps (n, n) and norms (n,), rounded as they are found, so that what they define is a basis to the last
    digit and orthonormal nearly."""
    size = lambda v: float(np.sqrt(np.mean(np.abs(v) ** 2)))
    first, steps, norms = 1 / size(weight), np.zeros((n, n)), np.ones(n)
    Q = np.empty((n, len(z)), dtype=z.dtype)
    Q[0] = weight * first
    for k in range(n - 1):
        v = z * Q[k]
        for _ in range(2):  # once leaves what rounding left
            own = (np.mean(Q[: k + 1].conj() * v, axis=1)).real.astype(float)
            steps[: k + 1, k] += own
            v = z * Q[k] - steps[: k + 1, k] @ Q[: k + 1]
        norms[k] = size(v)
        Q[k + 1] = v / norms[k]
    return first, steps, norms


def _decimals(values: NDArray[np.float64]) -> NDArray:
    """The same numbers as decimals, exactly."""
    return np.array([Decimal(float(x)) for x in values.ravel()], dtype=object).reshape(values.shape)


def _inverse(S: NDArray) -> tuple[NDArray, Decimal]:
    """The inverse of a matrix of decimals by elimination with pivots, and log |det S|."""
    n, logdet = len(S), Decimal(0)
    M = np.concatenate([S, _decimals(np.eye(n))], axis=1)
    for k in range(n):
        top = k + int(np.argmax(np.abs(M[k:, k])))
        M[[k, top]] = M[[top, k]]
        logdet += abs(M[k, k]).ln()
        M[k] = M[k] / M[k, k]
        for i in range(n):
            if i != k and M[i, k]:
                M[i] = M[i] - M[i, k] * M[k]
    return M[:, n:], logdet
