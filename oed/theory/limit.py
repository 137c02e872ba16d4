"""The limit spectrum of the SISO power iterations, [S] Theorem 7, without loss of digits at little noise.

    Phi(w) = lambda_e |H|^2 / (mu^2 - |G|^2),   (1/2pi) int Phi dw = 1.

As the noise vanishes mu tends to gamma and the spectrum's poles close in on the unit circle, so that grids
fail and mu^2 - |G|^2 cancels. Two measures keep every digit: the unknown is the excess
delta = mu^2 - gamma^2, and gamma^2 |A|^2 - |B|^2, a polynomial in x = cos w with a double root at every peak, is
divided by these roots before it is evaluated, on panels that shrink towards every peak. The second way to the
same number is `limit_spectrum_on_grid`: the eigenproblem of the matrix H_d of [S] Sec. 5."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from oed.data import Spectrum
from oed.errors import InputError, SolverFailure
from oed.plants.norms import Peak, peak
from oed.plants.plant import Plant
from oed.plants.systems import as_plant
from oed.theory.quadrature import SMALLEST, graded_nodes

RESOLVED = 1e-4
"""Of the width of the limit spectrum's peak: where the panels stop shrinking; what is nearer holds that share of the power."""
NARROWEST = 1e-140
"""Rad/sample: the squares of smaller distances are not representable."""
LITTLE = 1e-300
"""An excess below this is none that a double could hold beside the gains."""

SMALL = 1e-6
"""Of gamma^2: a smaller difference gamma^2 - |G|^2 is evaluated by its factors."""


@dataclass(frozen=True, eq=False)
class LimitSpectrum:
    """Limit of the input spectrum under Algorithm 1, and what follows from it.

    Attributes
    ----------
    plant : Plant
        The plant, with its noise.
    peak : Peak
        Its H-infinity norm.
    mu2_excess : float
        delta = mu^2 - gamma^2, solved for directly.
    spectrum : Spectrum
        Phi as the nodes of a quadrature: its powers sum to 1.
    """

    plant: Plant
    peak: Peak
    mu2_excess: float
    spectrum: Spectrum = field(repr=False)

    @property
    def mu2(self) -> float:
        """mu^2, the limit of the squared output power; [S] (10)."""
        return self.peak.value**2 + self.mu2_excess

    @property
    def beta2_mean(self) -> float:
        """Limit of E beta_2^2 = mu^2 - lambda_e (1/2pi) int |H|^2 dw; [S] Lemma 11."""
        return float(self.mu2 - self._noise)

    @property
    def beta2_bias(self) -> float:
        """Root of that limit minus the norm, from their small difference: the two agree in all digits at little noise."""
        root = np.sqrt(self.beta2_mean) if self.beta2_mean > 0 else np.nan
        return float((self.mu2_excess - self._noise) / (root + self.peak.value))

    @property
    def _noise(self) -> float:
        return float(self.plant.noise_covariance[0, 0] * noise_power(self.plant))

    @property
    def spectrum_max(self) -> float:
        """max Phi = lambda_e |H(w^)|^2 / delta (at white noise; [S] Theorem 8, 2)."""
        return float(self.density(np.array(self.peak.frequencies)).max())

    @property
    def spectrum_min(self) -> float:
        """min Phi over a fine grid, refined at the minima of |G| ([S] Theorem 8, 3)."""
        return _minimum(self)

    def density(self, omega: NDArray[np.float64]) -> NDArray[np.float64]:
        """Phi at given frequencies.

        Parameters
        ----------
        omega : ndarray
            (K,) rad/sample.

        Returns
        -------
        ndarray
            (K,) spectral density, normalised to (1/2pi) int Phi dw = 1.
        """
        omega = np.atleast_1d(np.asarray(omega, dtype=float))
        gap = _Gap(self.plant, self.peak)
        tops = np.array(self.peak.frequencies)
        nearest = tops[np.argmin(np.abs(omega[:, None] - tops), axis=1)]
        distance = gap(nearest, omega - nearest)
        return (
            self.plant.noise_covariance[0, 0] * noise_shape(self.plant, omega) / (self.mu2_excess + distance)
        )

    def __repr__(self) -> str:
        return (
            f"LimitSpectrum of {self.plant.name} at noise variance {self.plant.noise_variance:g}: "
            f"mu^2 = {self.mu2:.12g} (gamma^2 + {self.mu2_excess:.6g}), E beta_2^2 = {self.beta2_mean:.9g}, "
            f"density from {self.spectrum_min:.6g} to {self.spectrum_max:.6g}"
        )


def check_limit(plant: Plant) -> None:
    """Refuse a plant of several channels or without noise: Algorithm 1 has no limit spectrum there."""
    if plant.n_inputs * plant.n_outputs != 1:
        raise InputError(
            f"the plant has {plant.n_outputs} outputs and {plant.n_inputs} inputs; this limit spectrum is that of "
            "Algorithm 1 for one input and one output: use oed.theory.mimo for Procedure 2."
        )
    if not plant.noise_covariance[0, 0] > 0:
        raise InputError(
            f"the noise variance is {plant.noise_covariance[0, 0]:g}; the limit spectrum needs a positive one "
            "(without noise the iterations end in sinusoids at the peaks, which have no density)."
        )


def _autocorrelation(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """|p(e^jw)|^2 as a Chebyshev series in x = cos w."""
    r = np.correlate(p, p, "full")[len(p) - 1 :]
    return np.concatenate([r[:1], 2 * r[1:]])


class _Gap:
    """gamma^2 - |G|^2 near a peak, evaluated without cancellation."""

    def __init__(self, plant: Plant, top: Peak) -> None:
        B, A = plant.num[0][0], plant.den[0][0]
        self.A, self.B, self.level = A, B, top.value**2
        self.q = chebyshev.chebsub(self.level * _autocorrelation(A), _autocorrelation(B))
        self.centres = top.frequencies
        # divided by (x - x^)^2 inside, by (x - x^) at 0 and pi, where x moves as w^2
        for w in top.frequencies:
            for _ in range(1 if w in (0.0, np.pi) else 2):
                self.q = chebyshev.chebdiv(self.q, [-np.cos(w), 1.0])[0]

    def _factor(self, centre: NDArray, offset: NDArray) -> NDArray:
        """The product of what was divided out; cos w - cos c = -2 sin((w + c)/2) sin((w - c)/2)."""
        product = np.ones_like(offset)
        for c in self.centres:
            distance = np.where(centre == c, offset, centre + offset - c)
            factor = -2 * np.sin((centre + offset + c) / 2) * np.sin(distance / 2)
            if c in (0.0, np.pi):
                # sin((w + c)/2) = +-sin(distance/2) there: the factor is -2 sin^2 at 0 and +2 sin^2 at pi
                factor = (-2 if c == 0 else 2) * np.sin(distance / 2) ** 2
                product = product * factor
            else:
                product = product * factor**2
        return product

    def __call__(self, centre: NDArray, offset: NDArray) -> NDArray:
        """gamma^2 - |G|^2 at centre + offset."""
        x, z = np.cos(centre + offset), np.exp(-1j * (centre + offset))
        bottom = np.abs(np.polyval(self.A[::-1], z)) ** 2
        direct = self.level - np.abs(np.polyval(self.B[::-1], z)) ** 2 / bottom
        near = self._factor(centre, offset) * chebyshev.chebval(x, self.q) / bottom
        # The difference keeps its digits where it is not small; the series of sharp poles loses them there.
        return np.maximum(np.where(direct > SMALL * self.level, direct, near), 0.0)


def noise_shape(plant: Plant, omega: NDArray) -> NDArray:
    """|H|^2."""
    return np.ones(len(omega)) if plant.white_noise else np.abs(plant.noise_response(omega)) ** 2


def noise_power(plant: Plant) -> float:
    """(1/2pi) int |H|^2 dw."""
    if plant.white_noise:
        return 1.0
    nodes = graded_nodes(_pole_angles(plant.noise_den))
    return float(nodes.weight @ noise_shape(plant, nodes.omega))


def _pole_angles(den: NDArray) -> list[float]:
    roots = np.roots(den)
    return [float(abs(np.angle(root))) for root in roots if root.imag >= 0]


def centres(plant: Plant, top: Peak) -> list[float]:
    """Where the integrands have features: peaks (exact), local maxima, poles of G and of H."""
    others = [w for w, _ in top.local_maxima] + _pole_angles(plant.den[0][0]) + _pole_angles(plant.noise_den)
    exact = list(top.frequencies)
    return exact + [w for w in others if min(abs(w - e) for e in exact) > 1e-9]


def resolution(plant: Plant, top: Peak) -> float:
    """Where panels may stop: near a peak Phi is lambda |H|^2 / (delta + H_mu w^2 / 2), about lambda |H|^2 / H_mu wide."""
    noise = np.diag(plant.noise_covariance).min() * np.abs(plant.noise_response(top.frequencies)).min() ** 2
    width = float(noise / max(*top.curvatures, top.value**2))
    return max(min(SMALLEST, RESOLVED * width), NARROWEST)


def limit_spectrum(plant: Any) -> LimitSpectrum:
    """Limit of the input spectrum under Algorithm 1 with noise, [S] Theorem 7.

    Solves (1/2pi) int lambda_e |H|^2 / (delta + gamma^2 - |G|^2) dw = 1 for the excess delta = mu^2 - gamma^2.

    Parameters
    ----------
    plant : Plant or what `oed.plants.systems.as_plant` takes
        One input, one output, positive noise variance; H may be any rational filter.

    Returns
    -------
    LimitSpectrum
        mu^2, its excess, the spectrum and the mean of beta_2^2.

    Raises
    ------
    InputError
        If the plant is MIMO or without noise.
    SolverFailure
        If the noise is too little beside the gains for the limit to be told from sinusoids.

    Notes
    -----
    Source: [S] (9)-(10), solved as docs/theory/iterations.md advises. The quadrature keeps 10 digits however
    little the noise, since its panels shrink with the peak. Twins: `limit_spectrum_on_grid`, and adaptive quadrature in tests/oracles.
    """
    plant = as_plant(plant)
    check_limit(plant)
    top = peak(plant)
    variance = float(plant.noise_covariance[0, 0])
    nodes = graded_nodes(centres(plant, top), resolution(plant, top))
    gap = _Gap(plant, top)(nodes.centre, nodes.offset)
    shape = variance * noise_shape(plant, nodes.omega)
    power = lambda delta: float(nodes.weight @ (shape / (delta + gap)))
    delta = solve_excess(power, variance * float(nodes.weight @ (shape / variance)))
    return LimitSpectrum(plant, top, delta, Spectrum(nodes.omega, nodes.weight * shape / (delta + gap)))


def solve_excess(power: Callable[[float], float], upper: float) -> float:
    """The delta in (0, upper] with power(delta) = 1; power falls, and power(upper) <= 1."""
    from scipy.optimize import brentq

    lower = upper
    while power(lower) < 1:
        lower *= 1e-2
        if lower < LITTLE:
            raise SolverFailure(
                "the noise is too little beside the gains for the limit spectrum to be told from sinusoids at the peaks; "
                "give a larger noise variance, or scale the plant."
            )
    f = lambda log_delta: power(float(np.exp(log_delta))) - 1
    if lower == upper or f(np.log(upper)) >= 0:  # to rounding: the gap is nothing beside the noise
        return float(upper)
    return float(np.exp(np.asarray(brentq(f, np.log(lower), np.log(upper), xtol=1e-15))))


def _minimum(limit: LimitSpectrum) -> float:
    from scipy.optimize import minimize_scalar

    omega = np.unique(np.concatenate([np.linspace(0, np.pi, 4001), limit.spectrum.omega[::16]]))
    values = limit.density(omega)
    k = int(np.argmin(values))
    low, high = omega[max(k - 1, 0)], omega[min(k + 1, len(omega) - 1)]
    height = lambda w: float(limit.density(np.array([w]))[0])
    best = minimize_scalar(height, bounds=(low, high), method="bounded", options={"xatol": 1e-12})
    return float(min(values[k], best.fun))
