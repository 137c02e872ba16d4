"""A linear model of one output, y = (B u + c) / A, and its free run from a state that a window of samples sets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz
from scipy.signal import lfilter

__all__ = ["LinearModel", "Prior"]

Array = NDArray[np.float64]

REST = 1e-6
"""Variance of a state about rest, of that of the signal: rest is not exact, and a singular prior is no prior."""
FAR = 0.999
"""Radius from which on a pole forgets too slowly (over 1000 samples) for a steady state to say where a record starts."""


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the output before a record begins, and how far its samples are off the simulation.

    Attributes
    ----------
    mean : float
        Of the output.
    covariance : ndarray
        (m,) autocovariance of the output at lags 0 to m - 1, m above the order of every model.
    noise : float
        Variance of measured minus simulated output, sample by sample.
    drive : float
        Variance of a disturbance that enters with the input (before 1/A): the more, the more the last samples count.
    rest : bool
        Whether signals are deviations from a rest in which every record starts.
    """

    mean: float
    covariance: Array
    noise: float
    drive: float = 0.0
    rest: bool = False


@dataclass(frozen=True, eq=False)
class LinearModel:
    """y(k) + a1 y(k-1) + ... = sum_j b_j0 u_j(k) + b_j1 u_j(k-1) + ... + c.

    Attributes
    ----------
    den : ndarray
        (n + 1,) denominator, its first coefficient 1.
    num : ndarray
        (nu, m) numerators by lag from 0; delays are leading zeros.
    constant : float
        c, the drive of a constant level.
    """

    den: Array
    num: Array
    constant: float = 0.0

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.den) - 1

    @cached_property
    def poles(self) -> NDArray[np.complex128]:
        """(n,) poles in the z plane."""
        return np.roots(self.den).astype(complex)

    @cached_property
    def radius(self) -> float:
        """Largest magnitude of a pole."""
        return float(np.abs(self.poles).max(initial=0.0))

    def driven(self, u: Array) -> Array:
        """(N,) what enters 1/A; before the record the inputs are those of its first sample."""
        out = np.full(len(u), self.constant)
        for b, x in zip(self.num, u.T, strict=True):
            if (used := np.flatnonzero(b)).size:
                first, last = used[0], used[-1]
                padded = np.concatenate((np.full(last, x[0]), x[: len(x) - first]))
                out += np.convolve(padded, b[first : last + 1])[last - first : last - first + len(x)]
        return out

    def level(self, u: Array) -> float:
        """Output at rest under constant inputs (nu,); not finite without a rest."""
        gain = float(self.den.sum())
        return float(self.num.sum(axis=1) @ u + self.constant) / gain if gain else np.inf

    @cached_property
    def _memory(self) -> Array:
        """(n, n): past outputs y(-1), ..., y(-n) to the state of the filter 1/A."""
        n, a = self.order, self.den[1:]
        return -np.array([np.concatenate((a[m:], np.zeros(m))) for m in range(n)]).reshape(n, n)

    def run(self, driven: Array, past: Array) -> Array:
        """(N,) free run after the outputs `past` = y(-1), ..., y(-n)."""
        if not self.order:
            return driven
        return np.asarray(lfilter([1.0], self.den, driven, zi=self._memory @ past)[0])

    def _before(self, prior: Prior, u: Array, y: Array) -> tuple[float, Array]:
        """Mean and covariance (n, n) of the outputs before the record."""
        n = self.order
        size = prior.covariance[0]
        still = toeplitz(REST * prior.covariance[:n]) if n else np.empty((0, 0))
        if prior.rest:
            return 0.0, still
        seen = y[np.isfinite(y)]
        level = self.level(u[0]) if self.radius < FAR else np.nan
        if len(seen) < 2:  # nothing is measured: at rest under the first input, or anywhere
            return (level, still) if np.isfinite(level) else (prior.mean, still)
        if np.ptp(u[: len(y)], axis=0).max() == 0.0 and np.ptp(seen) < 6.0 * np.sqrt(prior.noise):
            return float(np.mean(seen)), size * np.ones((n, n)) + still
        return prior.mean, toeplitz(prior.covariance[:n]) if n else still

    def opening(self, prior: Prior, u: Array, y: Array) -> Array:
        """(n + w,) simulated output from n samples before the record to the end of a window of w samples y.

        It is the conditional mean of a Gaussian: outputs before the record with the prior's covariance, a disturbance of
        variance `drive` that enters with the input, noise of variance `noise` on the samples; NaN where none is measured.
        """
        n, w = self.order, len(y)
        mean, cov = self._before(prior, u, y)
        past = np.full(n, mean)
        ahead = np.concatenate((past, self.run(self.driven(u[:w]), past)))
        if not n or not w:
            return ahead
        free = lfilter([1.0], self.den, np.zeros((n, w)), zi=self._memory.T)[0].T  # (w, n)
        lead = np.concatenate((np.eye(n)[::-1], free))
        spread = lead @ cov @ lead.T
        if prior.drive:
            T = toeplitz(lfilter([1.0], self.den, np.eye(1, w)[0]), np.zeros(w))
            spread[n:, n:] += prior.drive * T @ T.T
        seen = np.flatnonzero(np.isfinite(y)) + n
        inner = spread[np.ix_(seen, seen)] + prior.noise * np.eye(len(seen))
        return ahead + spread[:, seen] @ np.linalg.lstsq(inner, y[seen - n] - ahead[seen], rcond=1e-13)[0]

    def free_run(self, prior: Prior, u: Array, y: Array, window: int) -> Array:
        """(N,) simulated output; the first `window` samples of y (N,) set the state, and are smoothed by it."""
        n, w = self.order, min(window, len(y))
        opening = self.opening(prior, u, y[:w])
        later = self.run(self.driven(u)[w:], opening[w:][::-1])
        return np.concatenate((opening[n:], later))
