"""Linear systems the slow way: responses by Horner, impulse responses by the recursion, gains by search.

A plant is a pair `(num, den)` of nested lists, `num[i][j]` and `den[i][j]` the coefficients of output i and input j in
powers of z^-1 (the format of the command line's plant files). Nothing here is shared with the suite.
"""

from __future__ import annotations

import numpy as np

# Reference plant of [S] Sec. 5.
REFERENCE_NUM = [[[0.0, 0.2155, 0.2012]]]
REFERENCE_DEN = [[[1.0, -0.9854, 0.8187]]]
REFERENCE = (REFERENCE_NUM, REFERENCE_DEN)
TWO_BY_TWO = (
    [[[0, 0.5], [0, 0.2, 0.1]], [[0, -0.3], [0, 0.4]]],
    [[[1, -0.6], [1, -0.5]], [[1, 0.4], [1, -0.2, 0.5]]],
)


def response(plant, omega) -> np.ndarray:
    """G(e^{j omega}), shape (K, p, q)."""
    num, den = plant
    z_inverse = np.exp(-1j * np.atleast_1d(np.asarray(omega, dtype=float)))
    result = np.zeros((z_inverse.size, len(num), len(num[0])), dtype=complex)
    for i, row in enumerate(num):
        for j, top in enumerate(row):
            result[:, i, j] = _horner(top, z_inverse) / _horner(den[i][j], z_inverse)
    return result


def _horner(coefficients, z_inverse):
    total = np.zeros_like(z_inverse)
    for coefficient in reversed(list(coefficients)):
        total = total * z_inverse + coefficient
    return total


def impulse_response(num, den, samples: int) -> np.ndarray:
    """The first `samples` Markov parameters of one entry, by the difference equation on a unit pulse."""
    pulse = np.zeros(samples)
    pulse[0] = 1.0
    return difference_equation(num, den, pulse)


def difference_equation(num, den, u) -> np.ndarray:
    """den(q) y = num(q) u from rest, one sample at a time."""
    num, den = np.asarray(num, dtype=float) / den[0], np.asarray(den, dtype=float) / den[0]
    y = np.zeros(len(u))
    for t in range(len(u)):
        total = 0.0
        for k in range(min(len(num), t + 1)):
            total += num[k] * u[t - k]
        for k in range(1, min(len(den), t + 1)):
            total -= den[k] * y[t - k]
        y[t] = total
    return y


def simulate(plant, u) -> np.ndarray:
    """Noise-free response from rest to u of shape (N, q), shape (N, p)."""
    num, den = plant
    y = np.zeros((len(u), len(num)))
    for i, row in enumerate(num):
        for j, top in enumerate(row):
            y[:, i] += difference_equation(top, den[i][j], u[:, j])
    return y


def toeplitz(plant, samples: int) -> np.ndarray:
    """The finite-time matrix of [M] (7): blocks of N x N, channels stacked one after the other."""
    num, den = plant
    p, q = len(num), len(num[0])
    matrix = np.zeros((p * samples, q * samples))
    for i in range(p):
        for j in range(q):
            g = impulse_response(num[i][j], den[i][j], samples)
            for t in range(samples):
                matrix[i * samples + t :: 1, j * samples + t][: samples - t] = g[: samples - t]
    return matrix


def peak_gain(plant, points: int = 4001) -> tuple[float, float]:
    """(gamma, frequency in [0, pi]) by the largest singular value on a grid, then ternary search around each maximum."""
    omega = np.linspace(0.0, np.pi, points)
    gain = np.linalg.norm(response(plant, omega), ord=2, axis=(1, 2))
    best = (float(gain[0]), 0.0)
    for k in range(points):
        low, high = omega[max(k - 1, 0)], omega[min(k + 1, points - 1)]
        neighbours = gain[max(k - 1, 0) : k + 2]
        if gain[k] < neighbours.max() or gain[k] < 0.9 * gain.max():
            continue
        while high - low > 1e-10:
            a, b = low + (high - low) / 3, high - (high - low) / 3
            ga, gb = np.linalg.norm(response(plant, [a, b]), ord=2, axis=(1, 2))
            low, high = (a, high) if ga < gb else (low, b)
        for w in (0.5 * (low + high), float(omega[k])):
            value = float(np.linalg.norm(response(plant, w)[0], ord=2))
            if value > best[0]:
                best = (value, w)
    return best
