"""The limit spectrum of [S] Algorithm 1, by quadrature with 50-digit decimal numbers.

[S] (9)-(10): Phi = lambda_e / (mu^2 - |G|^2), 1 = (1/2pi) int Phi. The unknown is the excess delta = mu^2 - gamma^2. The
integrand's denominator is delta + f(omega), f = gamma^2 - |G|^2, and f is what double precision loses beside a peak, so f is
evaluated in decimal arithmetic, with sin and cos from their Taylor series. Near a peak of curvature H the integrand is a
Lorentzian of width w = sqrt(2 delta / H): the substitution omega = peak + w sinh(s) makes it smooth in s, however small w.
No spectral factor, no Lyapunov equation, no grid in omega.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, getcontext, localcontext

import numpy as np

DIGITS = 50
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")


def _decimal_cos(x: Decimal) -> Decimal:
    """cos x for 0 <= x <= 4, by its Taylor series after quartering the angle twice."""
    y = x / 16
    term = total = Decimal(1)
    k = 0
    while abs(term) > Decimal(10) ** -(getcontext().prec + 3):
        k += 2
        term = -term * y * y / (k * (k - 1))
        total += term
    for _ in range(4):
        total = 2 * total * total - 1
    return total


def _autocorrelation(coefficients) -> list[Decimal]:
    """r_k of A A* = r_0 + 2 sum r_k cos(k omega); a binary double is an exact decimal."""
    a = [Decimal(float(value)) for value in coefficients]
    return [sum((a[i] * a[i + k] for i in range(len(a) - k)), Decimal(0)) for k in range(len(a))]


def _cosine_series(r: list[Decimal], x: Decimal) -> Decimal:
    """r_0 + 2 sum r_k T_k(x), by the three-term recursion."""
    total, before, now = r[0], Decimal(1), x
    for value in r[1:]:
        total += 2 * value * now
        before, now = now, 2 * x * now - before
    return total


class SquaredGain:
    """|G(e^{j omega})|^2 of a SISO plant in decimal arithmetic."""

    def __init__(self, num, den) -> None:
        with localcontext() as context:
            context.prec = DIGITS
            self.top, self.bottom = _autocorrelation(num), _autocorrelation(den)

    def __call__(self, omega: Decimal) -> Decimal:
        x = _decimal_cos(omega)
        return _cosine_series(self.top, x) / _cosine_series(self.bottom, x)

    def slope(self, omega: Decimal, step: Decimal = Decimal("1e-12")) -> Decimal:
        return (self(abs(omega + step)) - self(abs(omega - step))) / (2 * step)

    def curvature(self, omega: Decimal, step: Decimal = Decimal("1e-12")) -> Decimal:
        """H = -d^2 |G|^2 / d omega^2 by a central difference (error of order step^2, 24 digits left)."""
        return -(self(abs(omega + step)) - 2 * self(omega) + self(abs(omega - step))) / (step * step)


@dataclass(frozen=True)
class LimitSpectrum:
    """What [S] Sec. 3 says of one plant and one noise variance, and the nodes it was integrated on."""

    gamma2: float
    delta: float
    mu2: float
    beta2_mean: float  # by its own integral (13), not as mu^2 - lambda_e
    largest: float
    smallest: float
    peaks: tuple[float, ...]
    curvatures: tuple[float, ...]
    omega: np.ndarray  # nodes in [0, pi]
    weights: np.ndarray  # (1/2pi) int_{-pi}^{pi} g = sum weights g, g even
    spectrum: np.ndarray  # Phi at the nodes


def small_noise_excess(peaks, curvatures, noise_variance: float) -> float:
    """theory.md 1: delta = (lambda_e^2 / 2) (sum over the peaks in (-pi, pi] of H_p^-1/2)^2, the first term."""
    total = 0.0
    for peak, curvature in zip(peaks, curvatures):
        copies = 1 if peak < 1e-9 or peak > np.pi - 1e-9 else 2
        total += copies / np.sqrt(curvature)
    return 0.5 * noise_variance**2 * total**2


def _extrema(gain: SquaredGain, grid: int) -> tuple[list[Decimal], list[Decimal]]:
    """Local maxima and minima in [0, pi]: signs of the slope on a grid, then bisection; the ends always belong to one."""
    with localcontext() as context:
        context.prec = 30
        points = [PI * k / grid for k in range(grid)] + [PI]  # the last one exactly, not a rounded quotient
        values = [gain(point) for point in points]
    maxima, minima = [], []
    for k in range(grid + 1):
        left = values[k - 1] if k > 0 else values[1]
        right = values[k + 1] if k < grid else values[grid - 1]
        if (values[k] >= left and values[k] > right) or (values[k] > left and values[k] >= right):
            maxima.append(_refine(gain, points, k, grid))
        elif (values[k] < left or values[k] < right) and values[k] <= left and values[k] <= right:
            minima.append(_refine(gain, points, k, grid))
    return maxima, minima


def _refine(gain: SquaredGain, points: list[Decimal], k: int, grid: int) -> Decimal:
    low, high = points[max(k - 1, 0)], points[min(k + 1, grid)]
    if k in (
        0,
        grid,
    ):  # |G|^2 is even about 0 and about pi: is the end the extremum, or only a neighbour of it?
        return points[k]
    sign_low = gain.slope(low) if k > 1 else gain.slope(low + (high - low) / 1000)
    for _ in range(120):
        middle = (low + high) / 2
        if (gain.slope(middle) > 0) == (sign_low > 0):
            low = middle
        else:
            high = middle
    return (low + high) / 2


def solve(
    num, den, noise_variance: float, *, grid: int = 400, panels: int = 24, order: int = 12
) -> LimitSpectrum:
    """The limit spectrum for a SISO plant (`num`, `den` plain lists) and a noise variance lambda_e."""
    gain = SquaredGain(num, den)
    with localcontext() as context:
        context.prec = DIGITS
        maxima, minima = _extrema(gain, grid)
        heights = [gain(peak) for peak in maxima]
        gamma2 = max(heights)
        curvature = [float(gain.curvature(peak)) for peak in maxima]
        gaps = [float(gamma2 - height) for height in heights]
        top = [k for k, gap in enumerate(gaps) if gap <= 1e-13 * float(gamma2)]
        peaks = tuple(float(maxima[k]) for k in top)
        curvatures = tuple(curvature[k] for k in top)
        scale = min(small_noise_excess(peaks, curvatures, noise_variance), noise_variance)
        omega, weights, f = [], [], []
        edges = sorted({Decimal(0), PI, *minima})
        for peak, height, gap in zip(maxima, curvature, gaps):
            width = np.sqrt(2.0 * (scale + gap) / height)
            for end in (
                max((e for e in edges if e < peak), default=None),
                min((e for e in edges if e > peak), default=None),
            ):
                if end is None:
                    continue
                length, sign = float(abs(end - peak)), (1 if end > peak else -1)
                s, ds = _gauss(0.0, float(np.arcsinh(length / width)), panels, order)
                offset, jacobian = width * np.sinh(s), width * np.cosh(s) * ds
                for t, weight in zip(offset, jacobian):
                    point = peak + sign * Decimal(float(t))
                    omega.append(float(point))
                    weights.append(weight / np.pi)
                    f.append(float(gamma2 - gain(abs(point))))
    omega, weights, f = np.array(omega), np.array(weights), np.array(f)
    delta = _solve_for_delta(weights, f, noise_variance)
    spectrum = noise_variance / (delta + f)
    g2 = float(gamma2) - f
    ends = [float(gamma2 - gain(e)) for e in (Decimal(0), PI, *minima)]
    return LimitSpectrum(
        gamma2=float(gamma2),
        delta=delta,
        mu2=float(gamma2) + delta,
        beta2_mean=float(weights @ (g2 * spectrum)),
        largest=noise_variance / delta,
        smallest=noise_variance / (delta + max(*ends, f.max())),
        peaks=peaks,
        curvatures=curvatures,
        omega=omega,
        weights=weights,
        spectrum=spectrum,
    )


def _gauss(low: float, high: float, panels: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    x, w = np.polynomial.legendre.leggauss(order)
    edges = np.linspace(low, high, panels + 1)
    half, middle = 0.5 * np.diff(edges), 0.5 * (edges[1:] + edges[:-1])
    return (middle[:, None] + half[:, None] * x).ravel(), (half[:, None] * w).ravel()


def _solve_for_delta(weights, f, noise_variance: float) -> float:
    """Bisection in log delta of sum weights * lambda_e / (delta + f) = 1, which falls as delta grows."""
    low, high = np.log(noise_variance) - 80.0, np.log(noise_variance) + 1.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        if weights @ (noise_variance / (np.exp(middle) + f)) > 1.0:
            low = middle
        else:
            high = middle
    return float(np.exp(0.5 * (low + high)))


def discretised(gain2: np.ndarray, noise_variance: float) -> tuple[float, np.ndarray]:
    """[S] Sec. 5: mu^2 and the spectrum of the dense matrix H_d, gain2 the squared gains on a uniform grid."""
    lines = len(gain2)
    h = np.zeros((lines + 1, lines + 1))
    for k in range(lines):
        h[k, k] = gain2[k]
        h[k, lines] = noise_variance
        h[lines, k] = gain2[k] / lines
    h[lines, lines] = noise_variance
    values, vectors = np.linalg.eig(h)
    best = int(np.argmax(values.real))
    vector = vectors[:, best].real
    return float(values[best].real), vector[:lines] / vector[lines]


def iterated(gain2, weights, noise_variance: float, experiments: int) -> list[np.ndarray]:
    """[S] (8) from a white start: the spectra of experiments 1..n at nodes with (1/2pi) int g = sum weights g."""
    spectra = [np.ones(len(gain2))]
    for _ in range(experiments - 1):
        output = gain2 * spectra[-1] + noise_variance
        spectra.append(output / (weights @ (gain2 * spectra[-1]) + noise_variance))
    return spectra
