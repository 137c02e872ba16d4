"""Local rational models by refined instruments, from the lines' second moments over the experiments.

In a band of K DFT lines, at distances x from its centre,

    Y_i = (sum_j B_ij(x) U_j) / A(x) + T_i(x) / A(x) + noise,

one transient T_i of its own in every experiment. All that the normal equations need of the experiments is
C_ab = sum_m conj(S_a) S_b', (K, K), of the channels S = (U, Y): with P the projection that takes the transients out
and V the powers of x over A, the sum over m of the products of V_p S_a and V_r S_b without transients is
V_p* (P o C_ab) V_r. The cost of a step does not depend on the number of experiments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Band", "LocalFit", "Spectra", "fit_band", "response"]

STEPS = 8
"""Most refinements of the instruments."""
SETTLED = 1e-5
"""Change of the denominator, in a band scaled to [-1, 1], and of the noise, relative, at which they end."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """Discrete Fourier transforms of all records of a trace, over sqrt(N).

    Attributes
    ----------
    U, Y : ndarray
        (N // 2 + 1, M, nu) and (N // 2 + 1, M, ny).
    samples : int
        N.
    """

    U: NDArray
    Y: NDArray
    samples: int

    @staticmethod
    def of(trace: Any) -> Spectra:
        """Spectra of records of one length.

        Parameters
        ----------
        trace : Trace
            Its M records.

        Returns
        -------
        Spectra
            Of all of them.
        """
        N = len(trace.records[0])
        sides = ([r.u for r in trace.records], [r.y for r in trace.records])
        U, Y = (np.fft.rfft(np.stack(side), axis=1).transpose(1, 0, 2) / np.sqrt(N) for side in sides)
        return Spectra(U, Y, N)


@dataclass(frozen=True, eq=False)
class Band:
    """DFT lines around a centre, and the moments of the channels there.

    A band that reaches over 0 or pi holds some lines and their conjugates: the model then has the symmetry of a
    real system, and the information counts those lines twice (`repeats`).

    Attributes
    ----------
    moments : ndarray
        (nu + ny, nu + ny, K, K) sums over the experiments of conj(S_a) S_b', inputs first.
    n_inputs, experiments : int
        nu and M.
    x : ndarray
        (K,) distances from the centre in [-1, 1].
    centre, half : int
        The DFT line in the middle, and how many there are on either side.
    repeats : float
        How often a line and its conjugate are in the band.
    """

    moments: NDArray
    n_inputs: int
    experiments: int
    x: NDArray
    centre: int
    half: int
    repeats: float

    @staticmethod
    def of(spectra: Spectra, centre: int, half: int) -> Band:
        """The lines centre - half to centre + half, periodic.

        Parameters
        ----------
        spectra : Spectra
            Of all records.
        centre, half : int
            As in the attributes.

        Returns
        -------
        Band
            With its moments.
        """
        N = spectra.samples
        k = np.arange(centre - half, centre + half + 1)
        place = np.where(k % N <= N // 2, k % N, N - k % N)
        S = np.concatenate([spectra.U[place], spectra.Y[place]], axis=2)
        S = np.where((k % N > N // 2)[:, None, None], np.conj(S), S)
        K, M, channels = S.shape
        flat = S.transpose(2, 0, 1).reshape(channels * K, M)
        moments = (np.conj(flat) @ flat.T).reshape(channels, K, channels, K).transpose(0, 2, 1, 3)
        across = k[0] < 0 or k[-1] > N // 2
        nu = spectra.U.shape[2]
        return Band(moments.copy(), nu, M, (k - centre) / half, centre, half, 2.0 if across else 1.0)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.moments) - self.n_inputs


@dataclass(frozen=True, eq=False)
class LocalFit:
    """Coefficients of a local model and what is known of them.

    Attributes
    ----------
    theta : ndarray
        (n,) complex: B of every entry, output by output, then A without its leading 1.
    information : ndarray
        (n, n) inverse of the covariance of theta.
    noise : ndarray
        (ny,) variance of the noise.
    criterion : float
        Akaike's.
    """

    theta: NDArray
    information: NDArray
    noise: NDArray
    criterion: float


def response(theta: NDArray, X: NDArray, nu: int, ny: int, orders: tuple[int, int, int]) -> NDArray:
    """G = B / A of the coefficients at the powers X of x.

    Parameters
    ----------
    theta : ndarray
        Coefficients as in `LocalFit`.
    X : ndarray
        (K, L) powers of x from 0 on.
    nu, ny : int
        Channels.
    orders : tuple of int
        Orders of the numerators, the denominator and the transients.

    Returns
    -------
    ndarray
        (K, ny, nu).
    """
    nb, na, _ = orders
    B = theta[: nu * ny * (nb + 1)].reshape(ny, nu, nb + 1)
    A = 1 + X[:, 1 : na + 1] @ theta[len(theta) - na :]
    return np.tensordot(X[:, : nb + 1], B, (1, 2)) / A[:, None, None]


def fit_band(band: Band, orders: tuple[int, int, int]) -> LocalFit | None:
    """Maximum likelihood of the local model by refined instruments.

    Parameters
    ----------
    band : Band
        The lines.
    orders : tuple of int
        Orders in x of the numerators, of the common denominator and of the transients' numerators.

    Returns
    -------
    LocalFit or None
        None where the equations are singular.
    """
    nb, na, nt = orders
    nu, ny, K, M = band.n_inputs, band.n_outputs, len(band.x), band.experiments
    X = np.vander(band.x, max(orders) + 1, increasing=True).astype(complex)
    C, inner = band.moments, nu * (nb + 1)
    nparameters = ny * inner + na
    shared = slice(nparameters - na, nparameters)
    a, model = np.zeros(na, complex), [(C[nu + i], C[nu + i, nu + i]) for i in range(ny)]
    weights, noise, freedom = np.ones(ny), np.ones(ny), 1.0
    theta, information = np.zeros(0, complex), np.eye(1)
    q, P = _projection(X, a, nt)
    floor = 1e-15 * np.array([np.trace(C[nu + i, nu + i]).real for i in range(ny)]) / (K * M) + 1e-300
    for _ in range(STEPS):
        V = X / (1 + X[:, 1 : na + 1] @ a)[:, None]
        product = lambda moments, V=V, P=P: np.conj(V.T) @ ((P * moments) @ V)
        T = product(C[:nu])  # (nu, nu + ny, L, L): inputs against all channels
        own = T[:, :nu, : nb + 1, : nb + 1].transpose(0, 2, 1, 3).reshape(inner, inner)
        normal = np.zeros((nparameters, nparameters), complex)
        information = np.zeros_like(normal)
        right = np.zeros(nparameters, complex)
        for i in range(ny):
            here = slice(i * inner, (i + 1) * inner)
            against = T[:, nu + i, : nb + 1].reshape(inner, -1)
            instruments = product(model[i][0])  # (nu + ny, L, L): the model's output against all channels
            back = instruments[:nu, 1 : na + 1, : nb + 1].transpose(1, 0, 2).reshape(na, inner)
            normal[here, here] = information[here, here] = weights[i] * own
            normal[here, shared] = -weights[i] * against[:, 1 : na + 1]
            normal[shared, here] = information[shared, here] = -weights[i] * back
            information[here, shared] = -weights[i] * np.conj(back.T)
            normal[shared, shared] += weights[i] * instruments[nu + i, 1 : na + 1, 1 : na + 1]
            information[shared, shared] += weights[i] * product(model[i][1])[1 : na + 1, 1 : na + 1]
            right[here] = weights[i] * against[:, 0]
            right[shared] -= weights[i] * instruments[nu + i, 1 : na + 1, 0]
        try:
            theta = np.linalg.solve(normal, right)
        except np.linalg.LinAlgError:
            return None
        change = np.max(np.abs(theta[shared] - a), initial=0.0)
        a = theta[shared]
        q, P = _projection(X, a, nt)
        G = response(theta, X, nu, ny, orders)
        freedom = max(M * (K - nt - 1) - nparameters / ny, 1.0)
        for i in range(ny):
            model[i], power = _model_moments(C, G[:, i], nu, nu + i, q, P)
            noise[i] = power / freedom
        noise = np.maximum(noise, floor)
        change = max(
            change, np.max(np.abs(noise * weights - 1))
        )  # the information has the weights of the step before
        weights = 1 / noise
        if change < SETTLED:
            break
    size = M * K * ny / band.repeats
    criterion = size * float(np.mean(np.log(noise * freedom / (M * K)))) + 2 * nparameters / band.repeats
    return LocalFit(theta, information / band.repeats, noise, criterion)


def _projection(X: NDArray, a: NDArray, nt: int) -> tuple[NDArray, NDArray]:
    """An orthonormal basis of the transients and the projection onto what is orthogonal to them."""
    A = 1 + X[:, 1 : len(a) + 1] @ a
    q = np.linalg.qr(X[:, : nt + 1] / A[:, None])[0]
    return q, np.eye(len(X)) - q @ np.conj(q.T)


def _model_moments(
    C: NDArray, G: NDArray, nu: int, output: int, q: NDArray, P: NDArray
) -> tuple[tuple[NDArray, NDArray], float]:
    """Moments of the model's output, transients included, with all channels and with itself; the residual power.

    The model's output is Q Y + (I - Q) G U, with Q = q q*.
    """
    direct = np.einsum("kj,jbkl->bkl", np.conj(G), C[:nu])  # G U against all channels
    both = np.einsum("jkl,lj->kl", direct[:nu], G)
    left = direct[output]
    rest = C[output, output] - left - np.conj(left.T) + both
    power = float(np.sum(P * rest).real)
    away = np.conj(q) @ (q.T @ (direct - C[output]))
    against = direct - away
    right = np.einsum("jkl,lj->kl", against[:nu], G)
    itself = right - ((right - against[output]) @ np.conj(q)) @ q.T
    return (against, itself), power
