"""Local rational models by refined instruments, from the lines' second moments over the experiments.

In a band of K DFT lines, at distances x from its centre,

    Y_i = (sum_j B_ij(x) U_j) / A(x) + T_i(x) / A(x) + noise,

one transient T_i of its own in every experiment. With V the powers of x over A and q an orthonormal basis of the
transients, the normal equations need of the channels S = (U, Y, model's output) the sums over the experiments of

    (V_p S_a)* (I - q q*) (V_r S_b) = V_p* diag(conj(S_a) S_b) V_r - (q* V_p S_a)* (q* V_r S_b)

(`estimators.norm.local_kernels`). All of it is linear along K and invariant under a rotation among the experiments, so more
of them than lines times channels are first compressed to that number."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.norm.local_kernels import refine, responses

STEPS = 8
"""Most refinements of the instruments."""
SETTLED = 1e-5
"""Change of the denominator, in a band scaled to [-1, 1], and of the noise, relative, at which they end."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """Discrete Fourier transforms of all records of a trace, over sqrt(N). `U, Y` (N // 2 + 1, M, nu) and (N
    // 2 + 1, M, ny); `samples` N."""

    U: NDArray
    Y: NDArray
    samples: int

    @staticmethod
    def of(trace: Any) -> Spectra:
        """Spectra of records of one length."""
        N = len(trace.records[0])
        sides = ([r.u for r in trace.records], [r.y for r in trace.records])
        U, Y = (np.fft.rfft(np.stack(side), axis=1).transpose(1, 0, 2) / np.sqrt(N) for side in sides)
        return Spectra(U, Y, N)


@dataclass(frozen=True, eq=False)
class Band:
    """DFT lines around a centre. A band that reaches over 0 or pi holds some lines and their conjugates: the
    model then has the symmetry of a real system, and the information counts those lines twice (`repeats`).
    `U, Y` (nu, K, R) and (ny, K, R): the channels' lines in the M experiments, or, where M is larger than R =
    K (nu + ny), in R rotated ones with the same sums of products; `experiments` M; `x` (K,) distances from
    the centre in [-1, 1]; `centre, half` the DFT line in the middle, and how many there are on either side;
    `repeats` how often a line and its conjugate are in the band."""

    U: NDArray
    Y: NDArray
    experiments: int
    x: NDArray
    centre: int
    half: int
    repeats: float

    @staticmethod
    def of(spectra: Spectra, centre: int, half: int) -> Band:
        """The lines centre - half to centre + half, periodic."""
        N = spectra.samples
        k = np.arange(centre - half, centre + half + 1)
        place = np.where(k % N <= N // 2, k % N, N - k % N)
        S = np.concatenate([spectra.U[place], spectra.Y[place]], axis=2)
        S = np.where((k % N > N // 2)[:, None, None], np.conj(S), S)
        K, M, channels = S.shape
        lines = np.ascontiguousarray(S.transpose(2, 0, 1))
        if channels * K < M:
            rotated = np.linalg.qr(np.conj(lines.reshape(-1, M)).T, mode="r")
            lines = np.ascontiguousarray(np.conj(rotated).T).reshape(channels, K, -1)
        across = k[0] < 0 or k[-1] > N // 2
        nu = spectra.U.shape[2]
        return Band(lines[:nu], lines[nu:], M, (k - centre) / half, centre, half, 2.0 if across else 1.0)

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.U)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.Y)


@dataclass(frozen=True, eq=False)
class LocalFit:
    """Coefficients of a local model and what is known of them. `theta` (n,) complex: B of every entry, output
    by output, then A without its leading 1; `information` (n, n) inverse of the covariance of theta; `noise`
    (ny,) variance of the noise; `criterion` akaike's."""

    theta: NDArray
    information: NDArray
    noise: NDArray
    criterion: float


def response(theta: NDArray, x: NDArray, nu: int, ny: int, orders: tuple[int, int, int]) -> NDArray:
    """G = B / A of the coefficients at some distances: x (K,) -> (K, ny, nu)."""
    found = np.empty((len(x), ny, nu), complex)
    responses(theta, x, orders, found)
    return found


@lru_cache(maxsize=32)
def _powers(half: int, most: int) -> NDArray[np.float64]:
    """(most + 1, K) powers of a band's distances x; not to be written to."""
    return np.vander(np.arange(-half, half + 1) / half, most + 1, increasing=True).T.copy()


def fit_band(band: Band, orders: tuple[int, int, int]) -> LocalFit | None:
    """Maximum likelihood of the local model by refined instruments."""
    nb, na, nt = orders
    U, Y = band.U, band.Y
    nu, ny, K, M = band.n_inputs, band.n_outputs, len(band.x), band.experiments
    most = max(nb, na)
    powers = _powers(band.half, max(2 * most, nt + most, 2 * nt))
    n = ny * nu * (nb + 1) + na
    freedom = max(M * (K - nt - 1) - n / ny, 1.0)
    floor = 1e-15 * np.sum(np.abs(Y) ** 2, axis=(1, 2)) / (K * M) + 1e-300
    theta, information, noise = np.empty(n, complex), np.empty((n, n), complex), np.empty(ny)
    if not refine(U, Y, powers, orders, floor, freedom, STEPS, SETTLED, theta, information, noise):
        return None
    size = M * K * ny / band.repeats
    criterion = size * float(np.mean(np.log(noise * freedom / (M * K)))) + 2 * n / band.repeats
    return LocalFit(theta, information / band.repeats, noise, criterion)
