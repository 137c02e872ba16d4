"""The sinusoids of a spectrum, tabulated once for all signals that have their frequencies."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from oed.data import Spectrum
from oed.errors import InputError


def check_realisable(spectrum: Spectrum, N: int) -> None:
    """Raise where a spectrum has no power, or a signal too few samples."""
    if int(N) != N or N < 2:
        raise InputError(f"the signal has N = {N} samples; ask for a whole number of at least 2.")
    if not (len(spectrum) and spectrum.total_power > 0):
        raise InputError("the spectrum has no power; a signal needs at least one line with positive power.")


def _components(spectrum: Spectrum) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Frequencies and complex amplitudes a, (m,) and (m, nu): P_k = sum of a a^* over the line's components."""
    P = spectrum.power
    values, vectors = (P[:, 0].real, np.ones_like(P)) if P.shape[1] == 1 else np.linalg.eigh(P)
    k, i = np.nonzero(values > 1e-12 * max(values.max(), 1e-300))
    return spectrum.omega[k], vectors[k, :, i] * np.sqrt(values[k, i])[:, None]


@dataclass(frozen=True, eq=False)
class Sinusoids:
    """What all signals of one spectrum and length share: exp(j w t), t = block m + n, is a product of two
    short tables. `real` (m,) whether a sinusoid lies at 0 or pi; `amplitudes` (m, nu) complex, without their
    phases; `fine, coarse` (m, block) and (m, blocks), the two tables; `samples` N; `power` the spectrum's
    total power."""

    real: NDArray[np.bool_]
    amplitudes: NDArray[np.complex128]
    fine: NDArray[np.complex128]
    coarse: NDArray[np.complex128]
    samples: int
    power: float

    def signal(self, amplitudes: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Re sum_k a_k exp(j w_k t)."""
        columns = [((self.coarse * a[:, None]).T @ self.fine).real.ravel() for a in amplitudes.T]
        return np.column_stack([column[: self.samples] for column in columns])


@lru_cache(maxsize=4)
def sinusoids(spectrum: Spectrum, N: int) -> Sinusoids:
    """The sinusoids of a spectrum; those of the last few are kept, since campaigns realise one again and
    again."""
    check_realisable(spectrum, N)
    omega, a = _components(spectrum)
    first = np.concatenate([[True], omega[1:] != omega[:-1]])
    order = np.arange(len(omega)) - np.maximum.accumulate(np.where(first, np.arange(len(omega)), 0))
    aside = np.where(omega + 2 * np.pi * order / N <= np.pi, 1, -1)
    used, block = omega + aside * 2 * np.pi * order / N, int(np.ceil(np.sqrt(N)))
    fine = np.exp(1j * np.outer(used, np.arange(block)))
    coarse = np.exp(1j * np.outer(used, block * np.arange(-(-N // block))))
    real = (omega < 1e-12) | (omega > np.pi - 1e-12)
    return Sinusoids(real, a, fine, coarse, N, spectrum.total_power)
