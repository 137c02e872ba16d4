"""oed.theory.mimo and oed.theory.finite against recursions on uniform grids and dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from oed.plants.named import named_plant
from oed.plants.plant import Plant
from oed.theory.finite import finite_moments, finite_norm, singular_values
from oed.theory.mimo import mimo_limit_spectrum, mimo_recursion
from tests.oracles import limit_spectrum, lti, power

NUM = [[[0, 0.5], [0, 0.2, 0.1]], [[0, -0.3], [0, 0.4]], [[0, 0.1], [0.3, 0.1]]]
DEN = [[[1, -0.6], [1, -0.5]], [[1, 0.4], [1, -0.2, 0.5]], [[1, 0.3], [1]]]


def pair(plant):
    return [[list(map(float, b)) for b in row] for row in plant.num], [
        [list(map(float, a)) for a in row] for row in plant.den
    ]


def some(rows: int, columns: int, **noise) -> Plant:
    cut = lambda m: [row[:columns] for row in m[:rows]]
    return Plant(cut(NUM), cut(DEN), **noise)


@pytest.mark.parametrize("scaling", ["none", "each", "common"])
@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 2), (1, 2)])
def test_limit(shape, scaling) -> None:
    """At unit variance these spectra are smooth: 1024 uniform lines integrate them to rounding, and the recursion stops at 1e-13."""
    plant = some(*shape, noise_covariance=1.0)
    oracle = power.mimo_limit(pair(plant), 1.0, lines=1024, scaling=scaling)
    found = mimo_limit_spectrum(plant, scaling=scaling)
    assert found.mu2 == pytest.approx(oracle["mu2"], rel=1e-9)
    assert found.gain2_mean == pytest.approx(oracle["gain2_mean"], rel=1e-9)
    assert found.spectrum.total_power == pytest.approx(1.0, rel=1e-10)
    eigenvalues = np.linalg.eigvalsh(oracle["spectrum"])
    assert found.spectrum_max >= eigenvalues.max() * (1 - 1e-9)
    assert found.spectrum_max == pytest.approx(eigenvalues.max(), rel=1e-3)  # the grid misses the peak itself
    assert found.spectrum_min == pytest.approx(eigenvalues.min(), rel=1e-3)


@pytest.mark.parametrize("scaling", ["none", "each", "common"])
def test_limit_in_coloured_and_unequal_noise(scaling) -> None:
    covariance = np.array([[1.0, 0.4, 0.0], [0.4, 2.0, -0.3], [0.0, -0.3, 0.5]])
    plant = some(3, 2, noise_covariance=covariance, noise_num=(1.0, 0.5), noise_den=(1.0, -0.4))

    def shape(omega):
        return np.abs(lti.response(([[[1.0, 0.5]]], [[[1.0, -0.4]]]), omega)[:, 0, 0]) ** 2

    oracle = power.mimo_limit(pair(plant), covariance, lines=1024, scaling=scaling, shape=shape)
    found = mimo_limit_spectrum(plant, scaling=scaling)
    assert found.mu2 == pytest.approx(oracle["mu2"], rel=1e-9)
    assert found.gain2_mean == pytest.approx(oracle["gain2_mean"], rel=1e-9)


@pytest.mark.parametrize("variance", [1e-3, 0.1, 4.0])
@pytest.mark.parametrize("name", ["reference", "peak-at-zero", "two-peaks"])
def test_one_channel_scaled_is_algorithm_1(name, variance) -> None:
    """theory 3: mu^2 of two steps is (mu^2)^2, so the excess over gamma^4 is delta (2 gamma^2 + delta), in 50 digits."""
    plant = named_plant(name, variance)
    oracle = limit_spectrum.solve(pair(plant)[0][0][0], pair(plant)[1][0][0], variance)
    for scaling in ("each", "common"):
        found = mimo_limit_spectrum(plant, scaling=scaling)
        # gamma^2 - s^2 beside a peak is a fitted series here, not a factored polynomial: 1e-6 of the excess
        assert found.mu2_excess == pytest.approx(
            oracle.delta * (2 * oracle.gamma2 + oracle.delta), rel=1e-6, abs=0
        )
        assert found.gain2_mean == pytest.approx(oracle.beta2_mean, rel=1e-9)


@pytest.mark.parametrize("scaling", ["none", "each", "common"])
def test_recursion(scaling) -> None:
    """The first 12 iterations, against the oracle's loop stopped after as many rounds."""
    plant = some(2, 2, noise_covariance=0.5)
    gain2, mu2 = mimo_recursion(plant, 12, scaling=scaling)
    for rounds in (1, 4, 11):
        oracle = power.mimo_limit(pair(plant), 0.5, lines=1024, scaling=scaling, rounds=rounds)
        assert mu2[rounds - 1] == pytest.approx(oracle["mu2"], rel=1e-10)
        assert gain2[rounds] == pytest.approx(oracle["gain2_mean"], rel=1e-10)


@pytest.mark.parametrize("samples", [30, 120, 350])
@pytest.mark.parametrize("name", ["reference", "three-by-two", "peak-at-pi", "two-peaks", "bandit-fir"])
def test_finite_norm(name, samples) -> None:
    plant = named_plant(name)
    if name == "three-by-two" and samples == 350:
        samples = 180
    values = np.linalg.svd(lti.toeplitz(pair(plant), samples), compute_uv=False)
    assert finite_norm(plant, samples) == pytest.approx(values[0], rel=1e-10)  # the docstring: about 1e-11
    found = singular_values(plant, samples)
    assert np.sort(found)[::-1][: len(values)] == pytest.approx(values, abs=1e-7)  # roots of squares near 0


@pytest.mark.parametrize("variance", [0.3, 4.0])
def test_edge_effect_is_the_dense_recursion(variance) -> None:
    plant = named_plant("nonminimum-phase", variance)
    oracle = power.second_moments(pair(plant), 80, variance, 40)
    found = finite_moments(plant, 80, 40, effect="edge")
    assert found.mu2 == pytest.approx(oracle["mu2"], rel=1e-11)
    assert found.beta2[1:] == pytest.approx(oracle["beta2_squared"][1:], rel=1e-11)
    # the limit itself, which the recursion nears at the rate of nearly equal singular values: 1 = mean of lambda / (mu^2 - d^2)
    d2 = np.linalg.svd(lti.toeplitz(pair(plant), 80), compute_uv=False) ** 2
    low, high = 1e-12, variance
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.mean(variance / (middle + d2[0] - d2)) > 1 else (low, middle)
    assert found.limit_mu2 == pytest.approx(d2[0] + middle, rel=1e-12)


def test_random_mu_against_runs(rng) -> None:
    """E beta_2^2 with the runs' own mu, 3000 runs at N = 30: the description with both effects is within 4 standard errors plus the
    third-order rest, taken as a tenth of the second effect; the edge effect alone is not (the control).
    """
    variance, samples, n, runs = 4.0, 30, 10, 3000
    plant = named_plant("reference", variance)
    g_h = power.reversal(samples) @ lti.toeplitz(pair(plant), samples)
    u = rng.standard_normal((samples, runs))
    u = u / np.sqrt(np.mean(u**2, axis=0))
    last, factor = u, np.ones(runs)
    for _ in range(n):
        y = g_h @ u + np.sqrt(variance) * rng.standard_normal((samples, runs))
        beta2 = factor * np.mean(last * y, axis=0)
        last, factor = u, np.sqrt(np.mean(y**2, axis=0))
        u = y / factor
    error = beta2.std(ddof=1) / np.sqrt(runs)
    both = finite_moments(plant, samples, n, effect="random-mu").beta2[n - 1]
    edge = finite_moments(plant, samples, n, effect="edge").beta2[n - 1]
    assert abs(beta2.mean() - both) < 4 * error + 0.1 * abs(edge - both)
    assert abs(beta2.mean() - edge) > 4 * error
