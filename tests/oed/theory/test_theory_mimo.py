"""The limit of Procedure 2: against Algorithm 1's, against an iterated grid, against simulation."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.montecarlo.engine import monte_carlo
from oed.errors import InputError
from oed.plants.named import named_plant
from oed.theory.limit import limit_spectrum
from oed.theory.mimo import mimo_limit_spectrum, mimo_recursion


def iterated_on_a_grid(plant, scaling, iterations=250, points=1500):
    """Twin: the recursion on a uniform grid, written channel by channel from the experiments' description."""
    omega = (np.arange(points) + 0.5) * np.pi / points
    G = plant.response(omega)[0]
    adjoint = np.conj(np.swapaxes(G, 1, 2))
    h2 = np.abs(plant.noise_response(omega)) ** 2
    L, p, q = plant.noise_covariance, plant.n_outputs, plant.n_inputs
    Phi = np.broadcast_to(np.eye(q) / q, (points, q, q)).astype(complex)
    for _ in range(iterations):
        gain2 = np.mean(np.trace(G @ Phi @ adjoint, axis1=1, axis2=2)).real
        y = G @ Phi @ adjoint + h2[:, None, None] * L
        power = np.mean(np.diagonal(y, axis1=1, axis2=2), axis=0).real
        added = np.zeros((points, q, q), complex)
        for i in range(q):
            for j in range(p):
                amplified = {"none": 1.0, "each": 1 / power[j], "common": 1 / power.sum()}[scaling]
                added[:, i, i] += h2 * L[j, j] / amplified
        new = adjoint @ y @ G + added
        mu2 = np.mean(np.trace(new, axis1=1, axis2=2)).real
        Phi = new / mu2
    return gain2, mu2


@pytest.mark.parametrize("variance", [1e-8, 0.01, 1.0, 9.0])
@pytest.mark.parametrize("scaling", ["each", "common"])
def test_one_channel_scaled_is_algorithm_1(variance, scaling):
    """Two steps of Algorithm 1: mu^2 of the pair is mu^4, so the excess is 2 gamma^2 delta + delta^2."""
    plant = named_plant("reference", variance)
    one, pair = limit_spectrum(plant), mimo_limit_spectrum(plant, scaling=scaling)
    delta = one.mu2_excess
    assert pair.mu2_excess == pytest.approx(2 * one.peak.value**2 * delta + delta**2, rel=1e-8)
    assert pair.gain2_mean == pytest.approx(one.beta2_mean, rel=1e-11)
    assert pair.spectrum_max == pytest.approx(one.spectrum_max, rel=1e-8)
    assert pair.spectrum_min == pytest.approx(one.spectrum_min, rel=1e-8)


def test_one_channel_unscaled_is_not():
    plant = named_plant("reference", 1.0)
    off = mimo_limit_spectrum(plant).gain2_mean - limit_spectrum(plant).beta2_mean
    assert off > 0.1  # the second stage's input has the power of the output, so its noise matters less


@pytest.mark.parametrize("scaling", ["none", "each", "common"])
@pytest.mark.parametrize("kind", ["avis", "three-by-two", "two-by-three", "coloured"])
def test_limit_is_that_of_the_iterated_grid(kind, scaling):
    """Much noise: smooth spectra, where a coarse grid is exact, and quick convergence."""
    plant = named_plant("three-by-two" if kind != "avis" else kind, 20.0)
    if kind == "two-by-three":
        num, den = ([[side[i][j] for i in range(3)] for j in range(2)] for side in (plant.num, plant.den))
        plant = plant.replace(num=num, den=den, noise_covariance=20.0, free=())
    if kind == "coloured":
        covariance = [[20.0, 5.0, 0], [5.0, 10.0, 0], [0, 0, 30.0]]
        plant = plant.replace(noise_covariance=covariance, noise_num=[1, 0.4], noise_den=[1, -0.6])
    limit = mimo_limit_spectrum(plant, scaling=scaling)
    gain2, mu2 = iterated_on_a_grid(plant, scaling)
    tolerance = 1e-5 if kind == "avis" else 1e-7
    assert limit.gain2_mean == pytest.approx(gain2, rel=tolerance)
    assert limit.mu2 == pytest.approx(mu2, rel=tolerance)
    assert limit.spectrum.total_power == pytest.approx(1, rel=1e-12)
    recursion = mimo_recursion(plant, 250, scaling=scaling)
    assert recursion[0][-1] == pytest.approx(gain2, rel=tolerance)


def test_formula_of_white_equal_noise():
    """phi_i = lambda_e (s_i^2 + p) / (mu^2 - s_i^4), theory.md section 3; null directions lambda_e p / mu^2."""
    plant = named_plant("three-by-two", 0.7)
    limit = mimo_limit_spectrum(plant)
    omega = limit.spectrum.omega[::97]
    s2 = np.linalg.svd(plant.response(omega)[0])[1] ** 2
    phi = 0.7 * (s2 + 3) / (limit.mu2 - s2**2)
    assert phi.max() <= limit.spectrum_max * (1 + 1e-9)
    assert phi.min() >= limit.spectrum_min * (1 - 1e-9)
    G = plant.response(limit.spectrum.omega)[0]
    power = np.einsum("kia,kab,kib->", G, limit.spectrum.power, np.conj(G)).real
    assert power == pytest.approx(limit.gain2_mean, rel=1e-10)


def test_small_noise_keeps_its_digits():
    """mu^2 - gamma^4 grows as the square of the noise (one peak inside): slope 2, down to 1e-7 of gamma^4."""
    plant = named_plant("three-by-two")
    variances = np.array([1e-4, 1e-5, 1e-6])
    excess = [mimo_limit_spectrum(plant.replace(noise_variance=v)).mu2_excess for v in variances]
    slopes = np.diff(np.log(excess)) / np.diff(np.log(variances))
    np.testing.assert_allclose(slopes, 2, atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, scaling", [("reference", "none"), ("avis", "each"), ("three-by-two", "common")]
)
def test_recursion_agrees_with_simulation(name, scaling):
    """Iteration 12 from a white start, N = 2000 and 4000 extrapolated to N -> infinity: within 4.5 standard errors.

    False alarm 1e-5. Negative control: the same campaign is far from the recursion without the second stage's
    noise of the other outputs (variance a tenth).
    """
    plant, algorithm, m = named_plant(name, 0.5), "mimo", 12
    runs = [monte_carlo(plant, N, m, 384, seed=5, algorithm=algorithm, scaling=scaling) for N in (2000, 4000)]
    short, long = (run.mean["gain_square"][-1] for run in runs)
    error = np.hypot(runs[0].error("gain_square")[-1], 2 * runs[1].error("gain_square")[-1])
    predicted = mimo_recursion(plant, m, scaling=scaling)[0][-1]
    assert abs(2 * long - short - predicted) < 4.5 * error
    wrong = mimo_recursion(plant.replace(noise_variance=0.05), m, scaling=scaling)[0][-1]
    assert abs(2 * long - short - wrong) > 4.5 * error


def test_no_noise_is_refused():
    with pytest.raises(InputError, match="needs a positive one"):
        mimo_limit_spectrum(named_plant("avis", 0.0))
    with pytest.raises(InputError, match="no scaling named"):
        mimo_limit_spectrum(named_plant("avis"), scaling="some")
