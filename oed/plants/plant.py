"""Plants: a stable rational transfer matrix with its noise, and which of its parameters are unknown.

    y_t = G(q) u_t + H(q) e_t,   E e e' = Lambda,   G_ij(q) = B_ij(q^-1) / A_ij(q^-1)

G has ny outputs and nu inputs ([M]: p and q). The parameters of entry ij are the coefficients of B_ij
from its first nonzero one on (what comes before is delay, not a parameter) and those of A_ij after the
leading 1. Their names are letter and power, with the entry where there is more than one: b1, a2, b1_21."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import as_frequencies, entry_name, frozen
from oed.errors import InputError, check_sampling_time
from oed.plants.checking import (
    check_covariance,
    check_sizes,
    check_stable,
    matrix_of_polynomials,
    polynomial,
    scaled,
)


@dataclass(frozen=True, eq=False)
class Plant:
    """A stable discrete-time plant with measurement noise.

    Attributes
    ----------
    num, den : nested sequences
        `num[i][j]`, `den[i][j]`: coefficients of z^0, z^-1, ... of entry (output i, input j); a flat
        list is a plant with one input and one output. `den` is scaled to begin with 1.
    dt : float
        Sampling time in seconds.
    noise_covariance : ndarray
        (ny, ny) covariance Lambda of the white noise e; a number is that variance on every output.
    noise_num, noise_den : ndarray
        The noise filter H = noise_num / noise_den, common to all outputs, scaled to begin with 1.
    free : tuple of str
        Names of the unknown parameters (default: all).
    name : str
        What the plant is called in tables; also part of the seed of its noise.
    """

    num: Any
    den: Any
    dt: float = 1.0
    noise_covariance: Any = 1.0
    noise_num: Any = (1.0,)
    noise_den: Any = (1.0,)
    free: tuple[str, ...] = ()
    name: str = "plant"

    def __post_init__(self) -> None:
        num, den = matrix_of_polynomials(self.num, "num"), matrix_of_polynomials(self.den, "den")
        ny, nu = len(num), len(num[0])
        if (len(den), len(den[0])) != (ny, nu):
            raise InputError(
                f"num has {ny} x {nu} entries and den {len(den)} x {len(den[0])}; they must agree."
            )
        check_sampling_time(self.dt)
        for i in range(ny):
            for j in range(nu):
                lead = den[i][j][0]
                if lead == 0:
                    raise InputError(
                        f"den[{i}][{j}] begins with 0, which makes the plant improper (it would know the future); "
                        "the coefficient of z^0 must not be zero: multiply num and den by a power of z."
                    )
                num[i][j], den[i][j] = (scaled(side[i][j], lead, f"den[{i}][{j}]") for side in (num, den))
                check_stable(den[i][j], f"den[{i}][{j}]")
        try:
            covariance = np.array(self.noise_covariance, dtype=float)
        except (TypeError, ValueError):
            raise InputError(
                f"the noise covariance is {self.noise_covariance!r}; give a number, or a row per output."
            ) from None
        covariance = covariance * np.eye(ny) if covariance.ndim == 0 else covariance
        check_covariance(covariance, ny)
        shape = []
        for side in ("noise_num", "noise_den"):
            p = polynomial(getattr(self, side), side)
            if p[0] == 0:
                raise InputError(
                    f"{side} begins with 0; the noise filter must be monic up to scale (H = 1 + ...)."
                )
            shape.append(scaled(p, p[0], side))
        check_stable(shape[1], "the noise filter's den")
        check_sizes(num, covariance, shape[0])
        checked = {"num": tuple(map(tuple, num)), "den": tuple(map(tuple, den)), "dt": float(self.dt)}
        checked |= {"noise_covariance": frozen(covariance), "noise_num": shape[0], "noise_den": shape[1]}
        for field, value in checked.items():
            object.__setattr__(self, field, value)
        names = self.all_names
        free = tuple(self.free) or names
        unknown = [p for p in free if p not in names]
        if unknown or len(set(free)) != len(free):
            raise InputError(f"free names {unknown or free}; choose each once from {', '.join(names)}.")
        object.__setattr__(self, "free", tuple(p for p in names if p in free))

    @property
    def n_inputs(self) -> int:
        """Number of inputs nu ([M]: q)."""
        return len(self.num[0])

    @property
    def n_outputs(self) -> int:
        """Number of outputs ny ([M]: p)."""
        return len(self.num)

    @property
    def noise_variance(self) -> float:
        """Mean noise variance per output, tr(Lambda) / ny (lambda_e where there is one output)."""
        return float(np.trace(self.noise_covariance)) / self.n_outputs

    @property
    def white_noise(self) -> bool:
        """Whether the noise filter H is 1."""
        return len(np.trim_zeros(self.noise_num, "b")) == 1 and len(np.trim_zeros(self.noise_den, "b")) == 1

    def _parameters(self) -> list[tuple[str, str, int, int, int, float]]:
        """(name, letter, power, output, input, value) of every parameter, entry by entry, B before A."""
        several = self.n_outputs * self.n_inputs > 1
        rows = []
        for i in range(self.n_outputs):
            for j in range(self.n_inputs):
                tail = f"_{entry_name(i, j, self.n_outputs, self.n_inputs)}" if several else ""
                B, A = self.num[i][j], self.den[i][j]
                first = np.flatnonzero(B)
                if not first.size:
                    continue  # a structural zero has no parameters
                rows += [(f"b{k}{tail}", "b", k, i, j, B[k]) for k in range(first[0], len(B))]
                rows += [(f"a{k}{tail}", "a", k, i, j, A[k]) for k in range(1, len(A))]
        return rows

    @property
    def all_names(self) -> tuple[str, ...]:
        """Names of all parameters, known and unknown."""
        return tuple(row[0] for row in self._parameters())

    @property
    def theta(self) -> NDArray[np.float64]:
        """Values of the unknown parameters, in the order of `free`."""
        return np.array([row[5] for row in self._parameters() if row[0] in self.free])

    def with_theta(self, theta: ArrayLike) -> Plant:
        """The plant with other values of its unknown parameters.

        Parameters
        ----------
        theta : array_like
            (n,) values in the order of `free`.

        Returns
        -------
        Plant
            A new plant; InputError if it is unstable.
        """
        values = dict(zip(self.free, np.asarray(theta, dtype=float), strict=True))
        num = [[np.array(entry) for entry in row] for row in self.num]
        den = [[np.array(entry) for entry in row] for row in self.den]
        for name, letter, power, i, j, _ in self._parameters():
            if name in values:
                (num if letter == "b" else den)[i][j][power] = values[name]
        return self.replace(num=num, den=den)

    def replace(self, **changes: Any) -> Plant:
        """The same plant with some of its attributes changed.

        Parameters
        ----------
        **changes : object
            Attributes by name; `noise_variance` is short for a `noise_covariance` that is this variance
            times the identity.

        Returns
        -------
        Plant
            A new plant.
        """
        if "noise_variance" in changes:
            changes["noise_covariance"] = float(changes.pop("noise_variance"))
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return Plant(**(fields | changes))

    def _rational(self, z: NDArray[np.complex128]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """G and 1/A (K, ny, nu) at the values z of the delay."""
        G = np.zeros((len(z), self.n_outputs, self.n_inputs), dtype=z.dtype)
        inverse_A = np.zeros_like(G)
        for i, row in enumerate(self.num):
            for j, B in enumerate(row):
                inverse_A[:, i, j] = 1 / np.polyval(self.den[i][j][::-1], z)
                G[:, i, j] = np.polyval(B[::-1], z) * inverse_A[:, i, j]
        return G, inverse_A

    def transfer(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """Frequency response without its derivatives, which of many parameters at many frequencies fill the memory.

        Parameters
        ----------
        omega : array_like
            (K,) angular frequencies in rad/sample.

        Returns
        -------
        ndarray
            (K, ny, nu), complex.

        Examples
        --------
        >>> float(abs(Plant([0.0, 0.2], [1.0, -0.8]).transfer([0.0])[0, 0, 0]).round(9))
        1.0
        """
        return self._rational(np.exp(-1j * as_frequencies(omega)))[0]

    def response(self, omega: ArrayLike) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Frequency response and its derivative with respect to the unknown parameters.

        Parameters
        ----------
        omega : array_like
            (K,) angular frequencies in rad/sample.

        Returns
        -------
        G : ndarray
            (K, ny, nu).
        dG : ndarray
            (K, n, ny, nu), dG[:, i] = dG/dtheta_i.
        """
        z = np.exp(-1j * as_frequencies(omega))
        G, inverse_A = self._rational(z)
        unknown = [row for row in self._parameters() if row[0] in self.free]
        dG = np.zeros((len(z), len(unknown), self.n_outputs, self.n_inputs), dtype=z.dtype)
        for n, (_, letter, power, i, j, _) in enumerate(unknown):
            dG[:, n, i, j] = z**power * inverse_A[:, i, j] * (1 if letter == "b" else -G[:, i, j])
        return G, dG

    def noise_response(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """Frequency response of the noise filter, H(e^jw).

        Parameters
        ----------
        omega : array_like
            (K,) angular frequencies in rad/sample.

        Returns
        -------
        ndarray
            (K,), complex.
        """
        z = np.exp(-1j * as_frequencies(omega))
        return np.polyval(self.noise_num[::-1], z) / np.polyval(self.noise_den[::-1], z)

    def simulate(self, u: ArrayLike) -> NDArray[np.float64]:
        """Noise-free output from a zero initial state.

        Parameters
        ----------
        u : array_like
            (N, nu) input.

        Returns
        -------
        ndarray
            (N, ny) output.
        """
        from scipy.signal import lfilter

        u = np.asarray(u, dtype=float)
        y = np.zeros((len(u), self.n_outputs))
        for i, row in enumerate(self.num):
            for j, B in enumerate(row):
                A = self.den[i][j]
                # SciPy's detour for FIR filters costs more than the filter.
                short = len(A) == 1 and A[0] == 1.0
                y[:, i] += np.convolve(B, u[:, j])[: len(u)] if short else lfilter(B, A, u[:, j])
        return y

    def impulse_response(self, length: int) -> NDArray[np.float64]:
        """Markov parameters g_0 ... g_(length-1).

        Parameters
        ----------
        length : int
            How many.

        Returns
        -------
        ndarray
            (length, ny, nu).
        """
        pulse = np.zeros((length, self.n_inputs))
        g = np.zeros((length, self.n_outputs, self.n_inputs))
        for j in range(self.n_inputs):
            pulse[0] = np.eye(self.n_inputs)[j]
            g[:, :, j] = self.simulate(pulse)
        return g

    @staticmethod
    def from_control(system: Any, *, dt: float | None = None, hold: str | None = None, **noise: Any) -> Plant:
        """Plant of a python-control StateSpace or TransferFunction.

        Parameters
        ----------
        system : control.StateSpace or control.TransferFunction
            Discrete time; continuous time needs `dt` and `hold`.
        dt : float, optional
            Sampling time in seconds at which a continuous-time system is sampled.
        hold : {"zoh", "foh", "bilinear", ...}, optional
            Hold by which it is sampled, as in `control.sample_system`.
        **noise : object
            Other attributes of the plant (`noise_covariance`, `name`, ...).

        Returns
        -------
        Plant
            The plant; InputError if it is continuous without `dt` and `hold`, improper or unstable.
        """
        from oed.plants.realisations import entries_of_control

        return Plant(**entries_of_control(system, dt, hold), **noise)

    @staticmethod
    def from_state_space(
        A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike | None = None, **attributes: Any
    ) -> Plant:
        """Plant in transfer-function form of a discrete-time state-space system, entry by entry, minimal.

        Parameters
        ----------
        A, B, C, D : array_like
            (n, n), (n, nu), (ny, n), (ny, nu); D is zero by default.
        **attributes : object
            Other attributes of the plant (`dt`, `noise_covariance`, `name`, ...).

        Returns
        -------
        Plant
            Each entry with its own minimal numerator and denominator.
        """
        from oed.plants.realisations import entries_of_state_space

        return Plant(**entries_of_state_space(A, B, C, D), **attributes)

    def to_control(self) -> Any:
        """The plant's G as a python-control TransferFunction.

        Returns
        -------
        control.TransferFunction
            With the same sampling time.
        """
        import control

        pad = lambda p, n: np.pad(p, (0, n - len(p)))
        num, den = [], []
        for Bs, As in zip(self.num, self.den, strict=True):
            sizes = [max(len(B), len(A)) for B, A in zip(Bs, As, strict=True)]
            num.append([pad(B, n) for B, n in zip(Bs, sizes, strict=True)])
            den.append([pad(A, n) for A, n in zip(As, sizes, strict=True)])
        return control.TransferFunction(num, den, self.dt)

    def __repr__(self) -> str:
        several = self.n_outputs * self.n_inputs > 1
        shape = f", {self.n_outputs} outputs x {self.n_inputs} inputs" if several else ""
        colour = "white" if self.white_noise else "coloured"
        return (
            f"Plant {self.name}{shape}, {len(self.free)} unknown parameters, dt = {self.dt:g} s, "
            f"{colour} noise of variance {self.noise_variance:g}"
        )
