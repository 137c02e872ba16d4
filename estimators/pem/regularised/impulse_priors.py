"""What is expected of an impulse response before any data: it decays and is smooth; and of a slow disturbance.

Kernels are covariances of the taps g_1 ... g_n, of scale 1 (Chen, Ohlsson, Ljung, Automatica 48, 2012, 1525):

    tc   tuned-correlated     a^max(i, j)
    dc   diagonal-correlated  a^((i + j) / 2) rho^|i - j|;  TC is rho = sqrt(a)
    ss   stable spline        a^(i + j + max(i, j)) / 2 - a^(3 max(i, j)) / 6

Each is given by a factor M with K = M M' in closed form, since K itself is singular to working precision.

A disturbance d_t = phi d_(t-1) + w_t under white noise e_t, var w = q var e, has with the difference operator
D v = (v_t - phi v_(t-1)) the tridiagonal covariance q I + D D': its inverse costs O(N)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

KERNELS = ("tc", "dc", "ss")


def kernel_factor(kernel: str, taps: int, decay: float, correlation: float = 0.0) -> NDArray[np.float64]:
    """A factor M of a kernel, K = M M': returns (n, n)."""
    k = np.arange(1, taps + 1)
    if kernel == "tc":  # a^max(i, j) = sum of a^k - a^(k+1) over k >= max(i, j)
        steps = decay**k * np.where(k < taps, 1 - decay, 1.0)
        return np.triu(np.broadcast_to(np.sqrt(steps), (taps, taps)))
    if kernel == "dc":  # a first-order autoregression of unit variance, damped
        chain = np.tril(correlation ** np.abs(np.subtract.outer(k, k)))
        chain[:, 1:] *= np.sqrt(1 - correlation**2)
        return decay ** (k / 2)[:, None] * chain
    # An integrated Wiener process at the times a^n < ... < a: over each interval h two independent increments.
    times = decay**k
    h = times - np.append(times[1:], 0.0)
    after = np.triu(np.subtract.outer(times, times))
    first = np.triu(np.broadcast_to(np.sqrt(h**3 / 3), (taps, taps))) + after * (np.sqrt(3 * h) / 2)
    return np.hstack([first, after * (np.sqrt(h) / 2)])


@dataclass(frozen=True)
class SlowNoise:
    """White noise of variance 1 on top of a first-order disturbance; without one, white noise. `phi` d_t =
    phi d_(t-1) + w_t; 1 is a random walk, which begins at the level; below 1 it is stationary; `q` variance
    of w; 0 leaves the white noise alone."""

    phi: float = 0.0
    q: float = 0.0

    @property
    def innovation(self) -> tuple[float, float]:
        """Variance of the innovations and the Kalman gain, in the long run."""
        b = 1 - self.phi**2 - self.q
        root = np.sqrt(b * b + 4 * self.q)
        variance = 2 * self.q / (b + root) if b > 0 else (root - b) / 2
        return 1 + variance, variance / (1 + variance)

    @property
    def polynomials(self) -> tuple[float, float]:
        """c and d of H = (1 + c z^-1) / (1 + d z^-1)."""
        return -self.phi * (1 - self.innovation[1]), -self.phi

    @property
    def _opening(self) -> float:
        return 1.0 if self.phi >= 1 else np.sqrt(1 - self.phi**2)

    def _differences(self, x: NDArray) -> NDArray[np.float64]:
        out = np.array(x, dtype=float)
        out[1:] -= self.phi * x[:-1]
        out[0] *= self._opening
        return out

    def _factors(self, samples: int) -> tuple[NDArray, NDArray]:
        """Delta and the subdiagonal of the unit bidiagonal L: L Delta L' = q I + D D'."""
        from scipy.linalg.lapack import dpttrf

        diagonal, below = np.full(samples, self.q + 1 + self.phi**2), np.full(samples - 1, -self.phi)
        diagonal[0] = self.q + self._opening**2
        below[:1] *= self._opening
        delta, lower, _ = dpttrf(diagonal, below)
        return delta, lower

    def weighed(self, x: NDArray) -> tuple[NDArray[np.float64], float]:
        """V^-1 x and log det V: x (N, m) -> (N, m)."""
        from scipy.linalg.lapack import dpttrs

        if self.q <= 0 or len(x) < 2:
            level = 1.0 if self.q <= 0 else 1 + self.q / self._opening**2
            return x / level, float(len(x) * np.log(level))
        delta, lower = self._factors(len(x))
        solved = dpttrs(delta, lower, self._differences(x))[0]
        out = np.array(solved)
        out[:-1] -= self.phi * solved[1:]
        out[0] += (self._opening - 1) * solved[0]
        return out, float(np.log(delta).sum()) - 2 * np.log(self._opening)

    def innovations(self, x: NDArray) -> NDArray[np.float64]:
        """What the past does not foretell, by the Kalman filter from the first sample on: x (N, m) -> (N, m)."""
        from scipy.linalg import solve_banded

        if self.q <= 0 or len(x) < 2:
            return np.array(x)
        lower = self._factors(len(x))[1]
        out = np.array(
            solve_banded((1, 0), np.stack([np.ones(len(x)), np.append(lower, 0.0)]), self._differences(x))
        )
        out[0] /= self._opening
        return out

    def foretold(self, x: NDArray, ahead: int) -> NDArray[np.float64]:
        """The disturbance expected after a record of itself and the white noise: x (N,) -> (ahead,)."""
        back = np.arange(len(x) - 1, -1, -1)
        spread = self.q * (len(x) - back) if self.phi >= 1 else self.q * self.phi**back / (1 - self.phi**2)
        last = float(spread @ self.weighed(x[:, None])[0][:, 0]) if self.q > 0 else 0.0
        return last * np.power(self.phi, np.arange(1.0, ahead + 1))
