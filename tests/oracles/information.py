"""Fisher information by finite differences and sums: of a spectrum, and of a signal that was applied.

[S] (16)-(19), MIMO: I_ij = (1/2pi) int tr(Phi_v^-1 G'_i Phi_u G'_j*) d omega, per sample, G' = dG/d theta. A plant's parameters are
the coefficients of num beyond the leading zeros, entry by entry (output, then input), then those of den beyond the leading 1.
"""

from __future__ import annotations

import copy

import numpy as np

from tests.oracles import lti


def parameters(plant) -> tuple[list[str], list[tuple[str, int, int, int]]]:
    """Names (b1, a2, b1_21 ...) and places: all numerators of an entry, then its denominators, entry after entry."""
    num, den = plant
    single = len(num) == 1 and len(num[0]) == 1
    names, places = [], []
    for i, row in enumerate(num):
        for j, top in enumerate(row):
            suffix = "" if single else f"_{i + 1}{j + 1}"
            first = next(k for k, value in enumerate(top) if value != 0.0)
            for k in range(first, len(top)):
                names.append(f"b{k}{suffix}")
                places.append(("num", i, j, k))
            for k in range(1, len(den[i][j])):
                names.append(f"a{k}{suffix}")
                places.append(("den", i, j, k))
    return names, places


def moved(plant, place, step: float):
    num, den = copy.deepcopy(plant)
    which, i, j, k = place
    ({"num": num, "den": den}[which])[i][j][k] += step
    return num, den


def _difference(function, plant, place, step: float = 2e-4):
    """d function / d parameter: central differences at three steps, twice extrapolated (error of order step^6)."""
    values = []
    for h in (step, step / 2, step / 4):
        values.append((function(moved(plant, place, h)) - function(moved(plant, place, -h))) / (2 * h))
    once = [(4 * values[1] - values[0]) / 3, (4 * values[2] - values[1]) / 3]
    return (16 * once[1] - once[0]) / 15


def response_derivative(plant, omega) -> np.ndarray:
    """dG/d theta at the frequencies, shape (n, K, p, q)."""
    _, places = parameters(plant)
    return np.array(
        [_difference(lambda moved_: lti.response(moved_, omega), plant, place) for place in places]
    )


def of_lines(derivative, power, noise_spectrum) -> np.ndarray:
    """Information of lines: derivative (n, K, p, q), power (K, q, q) per line, noise_spectrum (p, p) or (K, p, p).

    A line of power P at omega in (0, pi) stands for half of P at omega and half of conj(P) at -omega: the real part.
    """
    n, lines = derivative.shape[:2]
    noise_spectrum = np.broadcast_to(noise_spectrum, (lines, *np.shape(noise_spectrum)[-2:]))
    information = np.zeros((n, n))
    for k in range(lines):
        inverse = np.linalg.inv(noise_spectrum[k])
        for i in range(n):
            for j in range(n):
                term = inverse @ derivative[i, k] @ power[k] @ derivative[j, k].conj().T
                information[i, j] += np.trace(term).real
    return information


def of_lines_siso(derivative, power, noise_variance: float) -> np.ndarray:
    """The same for one input, one output and white noise, without the loop over lines."""
    g = derivative.reshape(len(derivative), -1)
    return (g * np.asarray(power) @ g.conj().T).real / noise_variance


def of_spectrum(plant, spectrum, noise_spectrum, lines: int = 4096) -> np.ndarray:
    """Information per sample of a smooth input spectrum(omega) -> (K, q, q), the mean over a uniform midpoint grid."""
    omega = -np.pi + (np.arange(lines) + 0.5) * 2 * np.pi / lines
    noise = noise_spectrum(omega) if callable(noise_spectrum) else noise_spectrum
    return of_lines(response_derivative(plant, omega), spectrum(omega) / lines, noise)


def of_signal(plant, u, covariance, prefilter=None) -> np.ndarray:
    """Information of a signal of finite length from rest, the sum over its samples, by simulating moved plants.

    prefilter (num, den) is the inverse of a scalar noise filter, run over every output's sensitivity.
    """
    _, places = parameters(plant)
    slopes = np.array([_difference(lambda moved_: lti.simulate(moved_, u), plant, place) for place in places])
    if prefilter is not None:
        slopes = np.array([[lti.difference_equation(*prefilter, y) for y in slope.T] for slope in slopes])
        slopes = slopes.transpose(0, 2, 1)
    return np.einsum("atp,pr,btr->ab", slopes, np.linalg.inv(np.atleast_2d(covariance)), slopes)


def peak_gradient(plant, omega: float | None = None) -> np.ndarray:
    """c = d gamma / d theta by moving the plant and searching for its peak again."""

    def gamma(moved_):
        return np.array(lti.peak_gain(moved_, points=1501)[0])

    _, places = parameters(plant)
    return np.array([_difference(gamma, plant, place, step=4e-4) for place in places], dtype=float)


def parametric_error_information(num, den, samples: int, theta_places, order: int) -> np.ndarray:
    """Information about noise-filter coefficients, E sum (d eps / d eta)(d eps / d eta)' / lambda, by impulse responses.

    H = num/den monic; eps = H^-1 v, d eps / d eta = -H^-1 (dH/d eta) e. With e white the expectation of a product of two
    filtered sequences is the sum of the products of their impulse responses: (1/2pi) int H'_i H'_j* / |H|^2 per sample.
    """
    plant = ([[list(num)]], [[list(den)]])
    inverse = (list(den), list(num))
    pulse = np.zeros((order, 1))
    pulse[0] = 1.0
    slopes = []
    for which, k in theta_places:
        slope = _difference(lambda moved_: lti.simulate(moved_, pulse)[:, 0], plant, (which, 0, 0, k))
        slopes.append(lti.difference_equation(*inverse, slope))
    return samples * np.array(slopes) @ np.array(slopes).T
