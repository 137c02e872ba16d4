"""Signals from spectra, and what the realised signal loses.

A spectrum is a set of lines; a signal of N samples is what the plant meets. `realise` keeps the frequencies as
they are, `multisine` moves them to the lines of the discrete Fourier transform and chooses phases for a low crest
factor, `filtered_noise` draws a Gaussian signal, `binary` a signal of two levels. The power of the signal is the
spectrum's exactly, except for `binary`, whose amplitude is its power."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import Spectrum, as_signal
from oed.errors import InputError
from oed.signals.sinusoid_tables import check_realisable, sinusoids


def crest_factor(u: ArrayLike) -> float:
    """Largest absolute value over root mean square, the worst channel's.

    Parameters
    ----------
    u : array_like
        (N, nu) signal.

    Returns
    -------
    float
        1 for a binary signal, sqrt 2 for a sinusoid; NaN for a signal that is zero.
    """
    u = as_signal(u, "the signal")
    rms = np.sqrt(np.mean(u**2, axis=0))
    excited = rms > 0
    return float((np.abs(u).max(axis=0)[excited] / rms[excited]).max()) if excited.any() else float("nan")


def _rescaled(u: NDArray[np.float64], power: float) -> NDArray[np.float64]:
    actual = float(np.sum(u**2)) / len(u)
    if actual <= 0:
        raise InputError("the realised signal is zero: the phases cancel every line; choose other phases.")
    return u * np.sqrt(power / actual)


def realise(
    spectrum: Spectrum, N: int, rng: np.random.Generator | None = None, *, phases: ArrayLike | None = None
) -> NDArray[np.float64]:
    """A sum of sinusoids at the spectrum's own frequencies, with exactly its power.

    u_t = sum_k Re(sqrt 2 a_k exp(j (w_k t + phi_k))) (sqrt 1 at 0 and pi), scaled so that the mean of |u_t|^2
    over the N samples is the spectrum's total power. A line whose power has a rank above 1 is several
    sinusoids 2 pi / N apart, since one sinusoid has rank 1.

    Parameters
    ----------
    spectrum : Spectrum
        The lines.
    N : int
        Number of samples.
    rng : numpy.random.Generator, optional
        Source of random phases.
    phases : array_like, optional
        (m,) phases of the components in rad, instead of random ones; without either, the phases are zero.

    Returns
    -------
    ndarray
        (N, nu).

    Raises
    ------
    InputError
        If the spectrum has no power, or the number of phases is wrong.
    """
    lines = sinusoids(spectrum, N)
    shape = lines.real.shape
    if phases is None:
        phi = rng.uniform(0, 2 * np.pi, shape) if rng is not None else np.zeros(shape)
    else:
        phi = np.asarray(phases, dtype=float)
        if phi.shape != shape:
            raise InputError(
                f"{phi.size} phases were given for {shape[0]} sinusoids; give one for each, or none."
            )
    # A line at 0 or pi has no quadrature: only the sign of its phase is left.
    turn = np.where(lines.real, np.where(np.cos(phi) >= 0, 1.0, -1.0), np.sqrt(2) * np.exp(1j * phi))
    return _rescaled(lines.signal(lines.amplitudes * turn[:, None]), lines.power)


def _binned(spectrum: Spectrum, N: int) -> NDArray[np.complex128]:
    """Power on the lines 2 pi k / N, k = 0 ... N // 2, (bins, nu, nu): every line goes to the nearest."""
    bins = N // 2 + 1
    at = np.clip(np.rint(spectrum.omega * N / (2 * np.pi)).astype(int), 0, bins - 1)
    power = np.zeros((bins, spectrum.n_inputs, spectrum.n_inputs), dtype=complex)
    np.add.at(power, at, spectrum.power)
    return power


def _line_weight(N: int) -> NDArray[np.float64]:
    """|U_k|^2 / N^2 of a line of unit power under `irfft`: 1/2 for a sinusoid, 1 at 0 and at pi."""
    weight = np.full(N // 2 + 1, 0.5)
    weight[0] = 1.0
    if N % 2 == 0:
        weight[-1] = 1.0
    return weight


def _principal(power: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """One amplitude per bin; what a power of higher rank has left goes to the neighbouring bins in turn."""
    bins, nu = power.shape[:2]
    values, vectors = np.linalg.eigh(power)
    amplitude = vectors[:, :, -1] * np.sqrt(np.clip(values[:, -1], 0, None))[:, None]
    if nu == 1:
        return amplitude
    largest = max(values.max(), 1e-300)
    dense = np.count_nonzero(values[:, -1] > 1e-12 * largest) > bins // 2
    for i in range(nu - 1):
        for k in np.flatnonzero(values[:, i] > 1e-10 * largest):
            extra = vectors[k, :, i] * np.sqrt(values[k, i])
            free = k if dense else _nearest_free(np.abs(amplitude).sum(axis=1), int(k))
            amplitude[free] = amplitude[free] + extra if not dense else amplitude[free]
    return amplitude


def _nearest_free(used: NDArray[np.float64], k: int) -> int:
    empty = np.flatnonzero(used <= 1e-12 * used.max())
    empty = empty[(empty > 0) & (empty < len(used) - 1)]
    return int(empty[np.argmin(np.abs(empty - k))]) if len(empty) else k


def multisine(
    spectrum: Spectrum, N: int, rng: np.random.Generator, *, crest: bool = True, iterations: int = 200
) -> NDArray[np.float64]:
    """A periodic sum of sinusoids on the lines 2 pi k / N, with phases chosen for a low crest factor.

    Parameters
    ----------
    spectrum : Spectrum
        The lines; each is moved to the nearest 2 pi k / N.
    N : int
        Number of samples, one period.
    rng : numpy.random.Generator
        Source of the first phases.
    crest : bool
        Whether the phases are improved; otherwise they stay random.
    iterations : int
        Rounds of clipping and restoring the amplitudes.

    Returns
    -------
    ndarray
        (N, nu), of exactly the spectrum's power.

    Notes
    -----
    Source: E. Van der Ouderaa, J. Schoukens, J. Renneboog, "Peak factor minimization using a time-frequency
    domain swapping algorithm", IEEE Transactions on Instrumentation and Measurement 37 (1988) 145-147.
    """
    check_realisable(spectrum, N)
    power = _binned(spectrum, N)
    nu = spectrum.n_inputs
    amplitude = _random_rank(power, rng) if _full_rank(power) else _principal(power)
    scale = np.sqrt(_line_weight(N))[:, None] * N
    real = np.zeros(N // 2 + 1, dtype=bool)
    real[0] = True
    real[-1] = N % 2 == 0
    phase = np.exp(1j * rng.uniform(0, 2 * np.pi, N // 2 + 1))
    to_signal = lambda phase: np.fft.irfft(
        np.where(real[:, None], amplitude.real, amplitude * phase[:, None]) * scale, N, axis=0
    )
    best, best_crest = _rescaled(to_signal(phase), spectrum.total_power), np.inf
    if crest:
        best_crest = crest_factor(best)
        for i in range(iterations):
            u = to_signal(phase)
            level = np.abs(u).max(axis=0) * (0.75 + 0.23 * i / iterations)
            clipped = np.fft.rfft(np.clip(u, -level, level), axis=0)
            phase = np.exp(1j * np.angle(np.sum(amplitude.conj() * clipped, axis=1)))
            trial = _rescaled(to_signal(phase), spectrum.total_power)
            if (value := crest_factor(trial)) < best_crest:
                best, best_crest = trial, value
    return best.reshape(N, nu)


def _full_rank(power: NDArray[np.complex128]) -> bool:
    values = np.linalg.eigvalsh(power)
    used = values[:, -1] > 1e-12 * values.max()
    return power.shape[1] > 1 and used.mean() > 0.5


def _random_rank(power: NDArray[np.complex128], rng: np.random.Generator) -> NDArray[np.complex128]:
    """Amplitudes of a dense spectrum of full rank: a random unit-modulus mixture of its principal parts."""
    values, vectors = np.linalg.eigh(power)
    mix = np.exp(1j * rng.uniform(0, 2 * np.pi, values.shape))
    return np.einsum("kqi,ki->kq", vectors, np.sqrt(np.clip(values, 0, None)) * mix)


def filtered_noise(spectrum: Spectrum, N: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """A Gaussian signal with the spectrum's density, of exactly its power over the N samples.

    Parameters
    ----------
    spectrum : Spectrum
        Lines of a density, or true lines, which become narrow bands of the width 2 pi / N.
    N : int
        Number of samples.
    rng : numpy.random.Generator
        Source of the noise.

    Returns
    -------
    ndarray
        (N, nu).
    """
    check_realisable(spectrum, N)
    power = _binned(spectrum, 2 * N)
    values, vectors = np.linalg.eigh(power)
    shape = values.shape
    e = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
    e[0], e[-1] = e[0].real * np.sqrt(2), e[-1].real * np.sqrt(2)
    U = np.einsum("kqi,ki->kq", vectors, np.sqrt(np.clip(values, 0, None)) * e)
    u = np.fft.irfft(U * np.sqrt(_line_weight(2 * N))[:, None] * 2 * N, 2 * N, axis=0)[:N]
    return _rescaled(u, spectrum.total_power)


def binary(
    spectrum: Spectrum,
    N: int,
    rng: np.random.Generator,
    *,
    amplitude: float | ArrayLike | None = None,
    iterations: int = 300,
) -> NDArray[np.float64]:
    """A two-level signal whose spectrum resembles the wanted one.

    Parameters
    ----------
    spectrum : Spectrum
        The wanted lines; their relative powers count.
    N : int
        Number of samples.
    rng : numpy.random.Generator
        Source of the first phases.
    amplitude : float or array_like, optional
        Level per channel; by default the root of the channel's power.
    iterations : int
        Rounds of restoring amplitudes and taking signs.

    Returns
    -------
    ndarray
        (N, nu), every sample + or - the amplitude.
    """
    check_realisable(spectrum, N)
    channel = np.einsum("kii->i", spectrum.power).real
    level = np.broadcast_to(
        np.sqrt(channel) if amplitude is None else np.asarray(amplitude, float), channel.shape
    )
    if not (np.isfinite(level).all() and (level >= 0).all() and level.max() > 0):
        raise InputError(f"the amplitude is {amplitude}; it must be positive.")
    target = np.sqrt(np.einsum("kii->ki", _binned(spectrum, N)).real * _line_weight(N)[:, None]) * N
    x = multisine(spectrum, N, rng, crest=False)
    best, best_misfit = np.sign(x), np.inf
    for _ in range(iterations):
        signs = np.where(x >= 0, 1.0, -1.0)
        S = np.fft.rfft(signs * np.sqrt(channel), axis=0)
        inside = float(np.sum(np.minimum(np.abs(S), target) * target))
        if -inside < best_misfit:
            best, best_misfit = signs, -inside
        modulus = np.abs(S)
        x = np.fft.irfft(
            np.where(modulus > 0, target * S / np.where(modulus > 0, modulus, 1), target), N, axis=0
        )
    return np.where(best >= 0, 1.0, -1.0) * level


@dataclass(frozen=True, eq=False)
class Realised:
    """A signal made from a design, and what it lost. `u` (N, nu); `loss` loss per sample of the finite
    experiment from rest, edge effects included; `design_loss, bound` of the design; `power` mean square
    summed over channels; `crest_factor` of the worst channel."""

    u: NDArray[np.float64]
    loss: float
    design_loss: float
    bound: float
    power: float
    crest_factor: float

    @property
    def efficiency(self) -> float:
        """Certified bound over the realised loss."""
        return self.bound / self.loss

    def __repr__(self) -> str:
        return (
            f"Realised: {len(self.u)} samples, loss {self.loss:.6g} against {self.design_loss:.6g} of the spectrum "
            f"({100 * self.efficiency:.4g} % of the bound), crest factor {self.crest_factor:.3g}"
            + (
                ".\nWARNING: so few samples do not tell all parameters apart: ask for more"
                if np.isinf(self.loss)
                else ""
            )
        )


def realisation(
    plant: Any, design: Any, N: int, rng: np.random.Generator, *, how: Callable[..., NDArray] = multisine
) -> Realised:
    """Make a signal of a design and say what the realisation lost."""
    from oed.information import information_of_signal

    u = how(design.spectrum, N, rng)
    information = information_of_signal(plant, u) / N + design.map.constant
    return Realised(
        u=u, loss=design.criterion.loss(information), design_loss=design.loss, bound=design.bound,
        power=float(np.sum(u**2)) / N, crest_factor=crest_factor(u),
    )  # fmt: skip
