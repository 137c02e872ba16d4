"""The polynomial family of models: FIR, ARX, OE, ARMAX and BJ are five constructors of one structure.

Every output i is a model of its own, driven by all inputs:

    A_i(q) y_i(t) = sum_j B_ij(q) / F_ij(q) u_j(t) + C_i(q) / D_i(q) e_i(t)

so G_ij = B_ij / (A_i F_ij) and H_i = C_i / (A_i D_i). B_ij = b_nk q^-nk + ... (nb coefficients, the first
at delay nk); A, C, D, F are monic. An entry with nb = 0 is absent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import as_frequencies, entry_name, frozen
from oed.errors import InputError
from oed.models.structures import ORDERS, STRUCTURES

Orders = int | Sequence[int] | Sequence[Sequence[int]] | NDArray


@dataclass(frozen=True, eq=False)
class Polynomial:
    """Orders of a polynomial model; a member of one family whatever its name. `na` (ny,) degrees of A_i; `nb`
    (ny, nu) numbers of numerator coefficients; `nc, nd` (ny,) degrees of C_i and D_i; `nf` (ny, nu) degrees
    of F_ij; `nk` (ny, nu) delays of the first coefficients of B_ij, in samples; `kind` its name among
    `oed.models.structures`; `names` one per parameter, output by output: a, b, c, d, f."""

    na: NDArray[np.int64]
    nb: NDArray[np.int64]
    nc: NDArray[np.int64]
    nd: NDArray[np.int64]
    nf: NDArray[np.int64]
    nk: NDArray[np.int64]
    kind: str = "bj"
    names: tuple[str, ...] = field(default=(), init=False)
    _places: tuple[dict[str, list[slice]], ...] = field(default=(), init=False, repr=False)

    def __post_init__(self) -> None:
        ny, nu = np.atleast_2d(np.array(self.nb)).shape
        for letter in ("na", "nb", "nc", "nd", "nf", "nk"):
            shape = (ny, nu) if letter in ("nb", "nf", "nk") else (ny,)
            given = np.array(getattr(self, letter))
            if given.shape != shape or not np.equal(given, np.round(given)).all() or (given < 0).any():
                raise InputError(
                    f"{letter} is {given.tolist()} for {ny} outputs and {nu} inputs; "
                    f"it must hold whole numbers >= 0 in the shape {shape}."
                )
            object.__setattr__(self, letter, frozen(given, int))
        object.__setattr__(self, "nf", frozen(np.where(self.nb > 0, self.nf, 0), int))
        object.__setattr__(self, "names", tuple(self._names()))
        object.__setattr__(self, "_places", tuple(self._located()))
        if not self.names:
            raise InputError("the model has no parameters; give at least one order above 0.")

    def _names(self) -> list[str]:
        ny, nu = self.nb.shape
        names = []
        for i in range(ny):
            row = "" if ny == 1 else f"_{i + 1}"
            entry = ["" if ny * nu == 1 else f"_{entry_name(i, j, ny, nu)}" for j in range(nu)]
            names += [f"a{k + 1}{row}" for k in range(self.na[i])]
            names += [f"b{self.nk[i, j] + k}{entry[j]}" for j in range(nu) for k in range(self.nb[i, j])]
            names += [f"c{k + 1}{row}" for k in range(self.nc[i])]
            names += [f"d{k + 1}{row}" for k in range(self.nd[i])]
            names += [f"f{k + 1}{entry[j]}" for j in range(nu) for k in range(self.nf[i, j])]
        return names

    @property
    def n(self) -> int:
        """Number of parameters."""
        return len(self.names)

    @property
    def n_outputs(self) -> int:
        """Number of outputs ny."""
        return self.nb.shape[0]

    @property
    def n_inputs(self) -> int:
        """Number of inputs nu."""
        return self.nb.shape[1]

    def row(self, i: int) -> Polynomial:
        """The model of output i alone."""
        rows = slice(i, i + 1)
        return Polynomial(
            self.na[rows], self.nb[rows], self.nc[rows], self.nd[rows], self.nf[rows], self.nk[rows], self.kind,
        )  # fmt: skip

    def places(self) -> tuple[dict[str, list[slice]], ...]:
        """Where each polynomial's coefficients stand in theta."""
        return self._places

    def _located(self) -> list[dict[str, list[slice]]]:
        places, at = [], 0
        for i in range(self.n_outputs):
            row: dict[str, list[slice]] = {}
            for letter in "abcdf":
                sizes = np.atleast_1d(getattr(self, f"n{letter}")[i])
                row[letter] = []
                for size in sizes:
                    row[letter].append(slice(at, at + int(size)))
                    at += int(size)
            places.append(row)
        return places

    def coefficients(self, theta: ArrayLike) -> list[dict[str, list[NDArray[np.float64]]]]:
        """Polynomials in powers of q^-1, with their leading ones and delays: theta (n,)."""
        theta = np.asarray(theta, dtype=float)
        rows = []
        for i, place in enumerate(self.places()):
            row = {x: [np.concatenate([[1.0], theta[s]]) for s in place[x]] for x in "acdf"}
            row["b"] = [np.concatenate([np.zeros(self.nk[i, j]), theta[s]]) for j, s in enumerate(place["b"])]
            rows.append(row)
        return rows

    def response(self, theta: ArrayLike, omega: ArrayLike) -> tuple[NDArray, NDArray]:
        """Frequency response of the input channel and its derivatives: theta (n,), omega (K,) -> (K, ny, nu),
        (K, n, ny, nu)."""
        z = _delays(omega)
        shape = (len(z(0)), self.n_outputs, self.n_inputs)
        g, dg = (np.zeros(size, z(0).dtype) for size in (shape, (shape[0], self.n, *shape[1:])))
        for i, (row, place) in enumerate(zip(self.coefficients(theta), self.places(), strict=True)):
            a = _value(row["a"][0], z)
            for j in range(self.n_inputs):
                f = _value(row["f"][j], z)
                g[:, i, j] = _value(row["b"][j], z) / (a * f)
                for k in range(self.na[i]):
                    dg[:, place["a"][0].start + k, i, j] = -g[:, i, j] * z(k + 1) / a
                for k in range(self.nb[i, j]):
                    dg[:, place["b"][j].start + k, i, j] = z(self.nk[i, j] + k) / (a * f)
                for k in range(self.nf[i, j]):
                    dg[:, place["f"][j].start + k, i, j] = -g[:, i, j] * z(k + 1) / f
        return g, dg

    def noise_response(self, theta: ArrayLike, omega: ArrayLike) -> tuple[NDArray, NDArray]:
        """Frequency response of the noise model and its derivatives: theta (n,), omega (K,) -> (K, ny, ny),
        (K, n, ny, ny)."""
        z = _delays(omega)
        shape = (len(z(0)), self.n_outputs, self.n_outputs)
        h, dh = (np.zeros(size, z(0).dtype) for size in (shape, (shape[0], self.n, *shape[1:])))
        for i, (row, place) in enumerate(zip(self.coefficients(theta), self.places(), strict=True)):
            a, c, d = (_value(row[x][0], z) for x in "acd")
            h[:, i, i] = c / (a * d)
            for letter, value in (("a", -h[:, i, i] / a), ("c", 1 / (a * d)), ("d", -h[:, i, i] / d)):
                for k in range(getattr(self, f"n{letter}")[i]):
                    dh[:, place[letter][0].start + k, i, i] = value * z(k + 1)
        return h, dh

    def simulate(self, theta: ArrayLike, u: NDArray) -> NDArray[np.float64]:
        """Noise-free output from rest: theta (n,), u (N, nu) -> (N, ny)."""
        from scipy.signal import lfilter

        y = np.zeros((len(u), self.n_outputs))
        for i, row in enumerate(self.fractions(theta)):
            for j, (num, den) in enumerate(row):
                if self.nb[i, j]:
                    y[:, i] += lfilter(num, den, u[:, j])
        return y

    def fractions(self, theta: ArrayLike) -> list[list[tuple[NDArray, NDArray]]]:
        """Numerator and denominator in powers of z^-1 of each entry of G, row by row: theta (n,)."""
        return [
            [(row["b"][j] if self.nb[i, j] else np.zeros(1), np.convolve(row["a"][0], row["f"][j])) for j in range(self.n_inputs)]
            for i, row in enumerate(self.coefficients(theta))
        ]  # fmt: skip

    def noise_fractions(self, theta: ArrayLike) -> list[tuple[NDArray, NDArray]]:
        """The same of the noise model, per output."""
        return [(row["c"][0], np.convolve(row["a"][0], row["d"][0])) for row in self.coefficients(theta)]

    def poles(self, theta: ArrayLike) -> list[NDArray[np.complex128]]:
        """Poles of G, entry by entry and row by row: theta (n,)."""
        return [np.roots(den).astype(complex) for row in self.fractions(theta) for _, den in row]

    def to_dict(self) -> dict:
        """The orders as plain lists."""
        return {"kind": self.kind} | {
            x: getattr(self, x).tolist() for x in ("na", "nb", "nc", "nd", "nf", "nk")
        }

    def __repr__(self) -> str:
        used = [*ORDERS[self.kind], "nk"]
        values = [np.unique(getattr(self, x)) for x in used]
        short = [
            str(v[0]) if len(v) == 1 else str(getattr(self, x).tolist())
            for x, v in zip(used, values, strict=True)
        ]
        return f"{self.kind.upper()}({', '.join(f'{x}={v}' for x, v in zip(used, short, strict=True))})"


def _delays(omega: ArrayLike):
    omega = as_frequencies(omega)
    return cache(lambda k: np.exp(-1j * k * omega))


def _value(coefficients: NDArray, z) -> NDArray:
    return np.asarray(sum((c * z(k) for k, c in enumerate(coefficients)), 0 * z(0)))


def polynomial(
    kind: str, orders: int | Sequence[Orders], delay: Orders = 1, *, n_outputs: int = 1, n_inputs: int = 1,
    diagonal: bool = False,
) -> Polynomial:  # fmt: skip
    """A polynomial structure by its name and orders."""
    if kind not in STRUCTURES:
        raise InputError(f"the structure {kind!r} is unknown; choose one of {', '.join(ORDERS)}.")
    letters = STRUCTURES[kind].letters
    if orders is None or isinstance(orders, str):
        raise InputError(
            f"the orders are {orders!r}; {kind} takes {' '.join(ORDERS[kind])}, whole numbers in that order."
        )
    given: list = [orders] if isinstance(orders, int) else list(orders)
    if len(given) != len(letters):
        raise InputError(f"{len(given)} orders were given; {kind} takes {' '.join(ORDERS[kind])}.")
    if diagonal and n_outputs != n_inputs:
        raise InputError(f"a diagonal model needs as many inputs as outputs, not {n_inputs} and {n_outputs}.")
    sizes = dict(zip(letters, given, strict=True)) | {"k": delay}
    full = {}
    for letter in "abcdfk":
        value = np.asarray(sizes.get(letter, 0))
        try:
            if letter in "bfk":
                if value.ndim == 1 and n_outputs == n_inputs > 1 and diagonal:
                    value = np.diag(value)
                value = np.broadcast_to(value, (n_outputs, n_inputs)).copy()
            else:
                value = np.broadcast_to(value, (n_outputs,)).copy()
        except ValueError:
            raise InputError(
                f"n{letter} has the shape {value.shape}; for {n_outputs} outputs and {n_inputs} inputs give one "
                "number, or one per output or entry."
            ) from None
        full[f"n{letter}"] = value
    if diagonal:
        for letter in "bf":
            full[f"n{letter}"] = full[f"n{letter}"] * np.eye(n_outputs, dtype=int)
    if (full["nk"] < 0).any():
        raise InputError(f"the delay is {np.min(full['nk'])} samples; a causal model delays by 0 or more.")
    return Polynomial(**full, kind=kind)
