"""Sandwich covariance, profile intervals and bands, against Monte Carlo and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.uncertainty import bode_band, pole_covariances, profile_interval, sandwich, step_band
from oed.data import Record
from oed.errors import InputError

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
