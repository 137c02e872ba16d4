"""Sandwich covariance, profile intervals and bands, against Monte Carlo and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.uncertainty import (
    bode_band,
    default_lags,
    long_run,
    pole_covariances,
    profile_interval,
    sandwich,
    step_band,
)
from oed.data import Record
from oed.errors import InputError
from oed.models.polynomials import polynomial
from oed.plants.plant import Plant

B, A = [0.0, 0.2155, 0.2012], [1.0, -0.9854, 0.8187]
THETA = np.array([0.2155, 0.2012, -0.9854, 0.8187])


def record(rng, length=600, colour=()):
    u = lfilter([1.0], [1.0, -0.7], rng.normal(size=length))
    return Record(u, lfilter(B, A, u) + lfilter([0.4], [1.0, *colour], rng.normal(size=length)))


def test_sandwich_in_coloured_noise() -> None:
    """Output error in AR(1) noise: the plain errors are wrong, the sandwich right; 200 runs, spread known to 5 %."""
    rng = np.random.default_rng(1)
    theta, plain, ours = [], [], []
    for _ in range(200):
        data = record(rng, colour=(-0.9,))
        fit = identify(data, start=THETA, offset=False)
        theta.append(fit.theta)
        plain.append(fit.standard_errors)
        ours.append(sandwich(fit, data).standard_errors)
    spread = np.std(theta, axis=0)
    assert np.all(np.abs(np.mean(ours, axis=0) / spread - 1) < 0.25)
    # The negative control: the plain covariance is off by more than that.
    assert np.any(np.abs(np.mean(plain, axis=0) / spread - 1) > 0.4)


def test_sandwich_of_a_right_model_is_the_plain_covariance(rng) -> None:
    data = record(rng, 4000)
    fit = identify(data, offset=False)
    assert np.allclose(sandwich(fit, data, lags=0).standard_errors, fit.standard_errors, rtol=0.15)


def test_profile_interval_of_a_linear_model_is_exact(rng) -> None:
    """fir: N log(1 + d^2 / (S V)) = chi2 has a closed form."""
    data = record(rng, 300)
    fit = identify(data, "fir", 5, offset=True, initial="zero")
    low, high = profile_interval(fit, data, "b2")
    k = fit.names.index("b2")
    v = fit.covariance[k, k] * len(fit.residuals[0]) * fit.loss / fit.noise_variance
    half = np.sqrt(v * (np.exp(3.841458820694124 / 300) - 1))
    assert (low, high) == pytest.approx((fit.theta[k] - half, fit.theta[k] + half), rel=1e-4)


def test_profile_interval_of_output_error(rng) -> None:
    data = record(rng)
    fit = identify(data, offset=False)
    low, high = profile_interval(fit, data, "f2")
    assert low < fit.theta[3] < high
    assert high - low == pytest.approx(2 * 1.96 * fit.standard_errors[3], rel=0.1)
    with pytest.raises(InputError, match="no parameter"):
        profile_interval(fit, data, "f9")


def test_bands_cover_in_monte_carlo() -> None:
    """200 runs: pointwise 95 % bands cover in 88 to 99 % (5 binomial errors of 1.5 %)."""
    rng = np.random.default_rng(2)
    omega = np.array([0.0, 0.5, 1.0, 2.0])
    z = np.exp(-1j * omega)
    true = np.polyval(B[::-1], z) / np.polyval(A[::-1], z)
    step = lfilter(B, A, np.ones(30))
    hits, steps, poles = [], [], []
    for _ in range(200):
        fit = identify(record(rng), start=THETA, offset=False)
        gain, phase = bode_band(fit, omega)
        low, high = gain.interval()
        hits.append((low[:, 0, 0] <= np.abs(true)) & (np.abs(true) <= high[:, 0, 0]))
        low, high = step_band(fit, 30).interval()
        steps.append(((low[:, 0, 0] <= step) & (step <= high[:, 0, 0]))[1:])
        pole, covariance = pole_covariances(fit)[0]
        away = pole - np.roots(A)[np.argmin(np.abs(np.roots(A) - pole))]
        away = np.array([away.real, away.imag])
        poles.append(away @ np.linalg.solve(covariance, away) < 5.991)
        assert phase.standard_error[2, 0, 0] > 0
    for share in (np.mean(hits, axis=0), np.mean(steps, axis=0), np.mean(poles)):
        assert np.all((share > 0.88) & (share <= 0.995))


def test_how_far_a_long_run_covariance_looks() -> None:
    """Newey and West (1994) print 4 (N / 100)^(2/9); a series e(t) + e(t - 3), which an autoregression of order 1 cannot
    whiten, has the long-run variance 4, of which Bartlett's weights at 7 lags keep 2 + 2 (1 - 3/8) = 3.25.
    """
    assert [default_lags(n) for n in (100, 1000, 3200, 100_000, 10_000_000)] == [4, 7, 9, 19, 52]
    rng = np.random.default_rng(8)
    e = rng.normal(size=(200, 1003))
    series = [(row[3:] + row[:-3])[:, None] for row in e]
    mean = lambda lags: np.mean([long_run([x], lags)[0, 0] / 1000 for x in series])
    # 200 runs: the mean is known to 0.02 of itself.
    assert mean(default_lags(1000)) == pytest.approx(3.25, rel=0.06)
    assert mean(default_lags(1000) // 3) < 2.2  # the negative control: a third of it sees no lag 3


def test_parameters_of_more_than_nine_channels_have_names_of_their_own() -> None:
    """Output 1, input 11 and output 11, input 1 were both b1_111."""
    several = polynomial("oe", [1, 1], 1, n_inputs=11, n_outputs=11)
    assert len(set(several.names)) == len(several.names) == 242
    assert {"b1_1_11", "b1_11_1"} <= set(several.names)
    assert polynomial("oe", [1, 1], 1, n_inputs=2, n_outputs=9).names[0] == "b1_11"
    plant = Plant([[[0, 1.0 + i + j] for j in range(11)] for i in range(11)], [[[1.0, -0.5]] * 11] * 11)
    assert len(set(plant.all_names)) == len(plant.all_names) == 242
    assert "b1_11_1" in plant.all_names
