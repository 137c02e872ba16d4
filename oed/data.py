"""Measured signals and input spectra: the two kinds of data that everything else takes or gives.

Time is axis 0: a signal is (N, nu) or (N, ny), also for one channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.errors import InputError, check_sampling_time, check_size


def frozen(values: ArrayLike, dtype: type = float) -> NDArray:
    """Copy values into an array that cannot be written to."""
    array = np.array(values, dtype=dtype)
    array.flags.writeable = False
    return array


def entry_name(i: int, j: int, n_outputs: int, n_inputs: int) -> str:
    """Name of the entry of output i and input j (from 0): "12", and from 10 channels on "1_12", which "112" is too."""
    return f"{i + 1}{'_' * (max(n_outputs, n_inputs) > 9)}{j + 1}"


MOST_CHANNELS = 64
"""Channels that one sample alone may have: more in a single row are a signal that lies on its side."""

WRONG = {"c": "complex values", "M": "dates", "m": "durations", "U": "text", "S": "text"}
"""Kinds of arrays that would become numbers, and are none that a signal has."""


def as_frequencies(omega: ArrayLike) -> NDArray:
    """(K,) in double precision; in extended precision where they are given so, and then what follows from them is too."""
    omega = np.atleast_1d(np.asarray(omega))
    return omega if omega.dtype == np.longdouble else omega.astype(float)


def as_signal(values: ArrayLike, name: str, *, missing: bool = False) -> NDArray[np.float64]:
    """Read-only copy of a signal as (N, channels), checked to be finite."""
    try:
        masked = isinstance(values, np.ma.MaskedArray) and values.dtype.kind in "biuf"
        given = (
            values.astype(float).filled(np.nan) if masked else np.asarray(values)
        )  # what is masked is no sample
        if given.dtype.kind in WRONG:
            raise TypeError(WRONG[given.dtype.kind])
        own = given.dtype == float and given.ndim == 2 and given.base is None and not given.flags.writeable
        array = given if own else np.array(given, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is not an array of real numbers ({error}); give numbers only.") from None
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise InputError(
            f"{name} has {array.ndim} axes; a signal is (N,) or (N, channels) with time on axis 0."
        )
    if len(array) == 1 and array.shape[1] > MOST_CHANNELS:
        raise InputError(
            f"{name} is one row of {array.shape[1]} values; time is on axis 0: transpose it, or give (N,) values."
        )
    if array.size == 0:
        raise InputError(f"{name} is empty (shape {array.shape}); give at least one sample and one channel.")
    # A sum of squares is finite only where all samples are; where it overflows, the closer look finds nothing.
    if not isfinite(np.vdot(array, array)) and (bad := _bad(array, missing)).any():
        t, channel = np.argwhere(bad)[0]
        remedy = (
            "replace them by NaN"
            if missing
            else "remove or interpolate them, or say that NaN marks missing samples"
        )
        raise InputError(
            f"{name} has {int(bad.sum())} samples that are not finite, the first {array[t, channel]} "
            f"at sample {t}, channel {channel + 1}; samples must be finite: {remedy}."
        )
    array.flags.writeable = False
    return array


STEADY = 1e-6
"""Spread of numbers, of their size, up to which they are one number: differences of times, which may deviate as much, round by less."""


def the_one(values: NDArray) -> float | None:
    """The number that values (of any shape) are all the time, the shortest of those between them; None where they differ."""
    low, middle, high = float(values.min()), float(np.median(values)), float(values.max())
    if not high - low <= STEADY * abs(high):
        return None
    return next(d for k in range(17) if low <= (d := float(f"{middle:.{k}e}")) <= high)


def as_sampling_time(dt: object) -> float:
    """A sampling time in seconds; an array that holds one number throughout, as MAT files have it, is that number."""
    if isinstance(dt, np.timedelta64):  # NumPy counts it among the integers
        raise InputError(f"the sampling time is {dt}; it must be a positive number of seconds.")
    if isinstance(dt, np.ndarray | list | tuple):
        try:
            values = np.array(dt, dtype=float)
            low, high, dt = values.min(), values.max(), the_one(values)
        except (TypeError, ValueError):
            raise InputError(
                "the sampling time is an array of no numbers; give a number of seconds."
            ) from None
        if dt is None:
            raise InputError(
                f"the sampling time is given as {values.size} values from {low:.9g} to {high:.9g}; it must be one number of "
                "seconds: give times as a column t of a table."
            )
    check_sampling_time(dt)
    return float(dt)  # type: ignore[arg-type]


def _bad(array: NDArray[np.float64], missing: bool) -> NDArray[np.bool_]:
    """Where samples are infinite, or NaN that marks nothing."""
    return np.isinf(array) if missing else ~np.isfinite(array)


@dataclass(frozen=True, eq=False)
class Record:
    """Input and output of one experiment, sampled together at a constant rate.

    Attributes
    ----------
    u : ndarray
        (N, nu) inputs.
    y : ndarray
        (N, ny) outputs.
    dt : float
        Sampling time in seconds (1 where unknown).
    t0 : float
        Time of the first sample in seconds.
    input_names, output_names : tuple of str
        One name per channel; by default u, y, or u1, u2, ..., y1, y2, ...
    input_units, output_units : tuple of str
        One unit per channel; by default empty strings.
    """

    u: NDArray[np.float64]
    y: NDArray[np.float64]
    dt: float = 1.0
    t0: float = 0.0
    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        u = as_signal(self.u, "the input u", missing=True)
        y = as_signal(self.y, "the output y", missing=True)
        if len(u) != len(y):
            raise InputError(
                f"the input has {len(u)} samples and the output {len(y)}; they must be equal: "
                "cut both to the time in which both were recorded."
            )
        object.__setattr__(self, "dt", as_sampling_time(self.dt))
        object.__setattr__(self, "u", u)
        object.__setattr__(self, "y", y)
        if isinstance(self.t0, str) or self.t0 is None or not isfinite(self.t0):
            raise InputError(
                f"the time of the first sample is {self.t0}; it must be a finite number of seconds."
            )
        object.__setattr__(self, "t0", float(self.t0))
        for field, default in (
            ("input_names", _channel_names("u", u.shape[1])),
            ("output_names", _channel_names("y", y.shape[1])),
            ("input_units", ("",) * u.shape[1]),
            ("output_units", ("",) * y.shape[1]),
        ):
            given = getattr(self, field)
            given = (given,) if given and isinstance(given, str) else tuple(given) or default
            if len(given) != len(default):
                side, what = field.split("_")
                raise InputError(
                    f"{len(given)} {side} {what} for {len(default)} {side} channels; give one per channel."
                )
            if not all(isinstance(text, str) for text in given):
                raise InputError(f"{field} is {given}; give text, one for each channel.")
            if field.endswith("names") and len(set(given)) < len(given):
                twice = next(name for name in given if given.count(name) > 1)
                raise InputError(
                    f"two {field.split('_')[0]}s are called {twice!r}; give each channel its own name."
                )
            object.__setattr__(self, field, given)

    def __len__(self) -> int:
        return len(self.u)

    @property
    def n_inputs(self) -> int:
        """Number of inputs nu."""
        return self.u.shape[1]

    @property
    def n_outputs(self) -> int:
        """Number of outputs ny."""
        return self.y.shape[1]

    @property
    def t(self) -> NDArray[np.floating]:
        """Sample times in seconds, (N,)."""
        return self.t0 + self.dt * np.arange(len(self), dtype=float)

    @property
    def complete(self) -> bool:
        """Whether no sample is missing (NaN)."""
        return bool(np.isfinite(self.u).all() and np.isfinite(self.y).all())

    def __getitem__(self, rows: slice) -> Record:
        """Rows a to b-1 as a record of their own: `record[a:b]`."""
        if not isinstance(rows, slice) or rows.step not in (None, 1):
            raise InputError(f"a record takes a slice of consecutive rows, not {rows!r}; write record[a:b].")
        start, stop, _ = rows.indices(len(self))
        if stop <= start:
            raise InputError(
                f"rows {start}:{stop} of a record of {len(self)} samples are empty; ask for at least one."
            )
        return self.replace(u=self.u[start:stop], y=self.y[start:stop], t0=self.t0 + start * self.dt)

    def replace(self, **changes: object) -> Record:
        """The same record with some of its attributes changed.

        Parameters
        ----------
        **changes : object
            Attributes by name.

        Returns
        -------
        Record
            A new record.
        """
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return Record(**(fields | changes))  # type: ignore[arg-type]

    def __repr__(self) -> str:
        return (
            f"Record of {len(self)} samples every {self.dt:g} s: "
            f"{', '.join(self.input_names)} -> {', '.join(self.output_names)}"
        )


def check_sizes(record: Record, which: str, power: int = 1) -> None:
    """Refuse a record whose channels, their ratios or its sampling time have powers whose squares are no doubles."""
    u, y = (np.abs(np.where(np.isfinite(x), x, 0.0)).max(axis=0) for x in (record.u, record.y))
    for sizes, names, side in ((u, record.input_names, "input"), (y, record.output_names, "output")):
        for size, name in zip(sizes, names, strict=True):
            check_size(f"the size of the {side} {name} of {which}", float(size), power)
    u, y = u[u > 0], y[y > 0]
    if len(u) and len(y):
        for ratio in (y.max() / u.min(), y.min() / u.max()):
            check_size(f"the size of the outputs of {which} over that of its inputs", float(ratio), power)
    check_size(f"the sampling time of {which}", record.dt, power)


def _channel_names(letter: str, n: int) -> tuple[str, ...]:
    return (letter,) if n == 1 else tuple(f"{letter}{i + 1}" for i in range(n))


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Input spectrum as lines: frequencies and one-sided powers.

    A line at 0 < omega < pi with power P (nu x nu, Hermitian, positive semidefinite) is a sinusoid whose
    channels have the covariance Re P; lines at 0 and pi are real. The powers sum to the input power:
    E u u' = sum_k Re P_k. A continuous density is a Spectrum whose lines are the nodes of a quadrature.

    Attributes
    ----------
    omega : ndarray
        (K,) angular frequencies in rad/sample, in [0, pi].
    power : ndarray
        (K, nu, nu) one-sided power of each line, in squared input units.
    """

    omega: NDArray[np.float64]
    power: NDArray[Any]

    def __post_init__(self) -> None:
        omega = np.atleast_1d(np.array(self.omega, dtype=float))
        power = np.array(self.power, dtype=complex)
        if power.ndim == 1:
            power = power[:, None, None]
        if omega.ndim != 1 or power.ndim != 3 or power.shape[1] != power.shape[2] or len(omega) != len(power):
            raise InputError(
                f"a spectrum has omega of shape (K,) and power (K,) or (K, nu, nu), not {omega.shape} and {power.shape}."
            )
        if not (np.isfinite(omega).all() and np.isfinite(power).all()):
            raise InputError("a spectrum has frequencies or powers that are not finite; give finite numbers.")
        if len(omega) and (omega.min() < -1e-12 or omega.max() > np.pi + 1e-12):
            raise InputError(
                f"frequencies run from {omega.min():g} to {omega.max():g} rad/sample; "
                "they must lie in [0, pi] (the spectrum is one-sided)."
            )
        scale = np.abs(power).max(initial=0.0)
        if np.abs(power - np.conj(np.swapaxes(power, 1, 2))).max(initial=0.0) > 1e-9 * scale:
            raise InputError("the power of a line must be a Hermitian matrix.")
        power = (power + np.conj(np.swapaxes(power, 1, 2))) / 2
        lowest = float(np.linalg.eigvalsh(power).min(initial=0.0)) if len(power) else 0.0
        if lowest < -1e-9 * scale:
            raise InputError(f"a line has the negative power {lowest:g}; powers are positive semidefinite.")
        omega = np.clip(omega, 0.0, np.pi)
        omega.flags.writeable = power.flags.writeable = False
        object.__setattr__(self, "omega", omega)
        object.__setattr__(self, "power", power)

    @property
    def n_inputs(self) -> int:
        """Number of inputs nu."""
        return self.power.shape[1]

    @property
    def total_power(self) -> float:
        """Input power summed over lines and channels, in squared input units."""
        return float(np.einsum("kii->", self.power).real)

    def __len__(self) -> int:
        return len(self.omega)

    def __mul__(self, factor: float) -> Spectrum:
        return Spectrum(self.omega, self.power * float(factor))

    __rmul__ = __mul__

    def __add__(self, other: Spectrum) -> Spectrum:
        return join([self, other])

    def strongest(self, threshold: float = 1e-6) -> Spectrum:
        """The lines that carry at least a fraction of the power.

        Parameters
        ----------
        threshold : float
            Least share of the total power of a line that is kept.

        Returns
        -------
        Spectrum
            The lines kept, with their powers as they were.
        """
        share = np.einsum("kii->k", self.power).real / max(self.total_power, np.finfo(float).tiny)
        keep = share >= threshold
        return Spectrum(self.omega[keep], self.power[keep])

    def __repr__(self) -> str:
        return f"Spectrum of {len(self)} lines, {self.n_inputs} input(s), power {self.total_power:.6g}"


def join(spectra: Sequence[Spectrum]) -> Spectrum:
    """All lines of several spectra together, sorted by frequency; equal frequencies are added."""
    if len({s.n_inputs for s in spectra}) != 1:
        raise InputError(
            f"spectra of {[s.n_inputs for s in spectra]} inputs cannot be added; the numbers must agree."
        )
    omega = np.concatenate([s.omega for s in spectra])
    power = np.concatenate([s.power for s in spectra])
    lines, where = np.unique(omega, return_inverse=True)
    total = np.zeros((len(lines), *power.shape[1:]), dtype=complex)
    np.add.at(total, where, power)
    return Spectrum(lines, total)
