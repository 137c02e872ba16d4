"""Coverage of the 95 % intervals in Monte Carlo, structure by structure; long, so `make validate` runs it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.uncertainty import sandwich
from oed.data import Record
from oed.models import state_space

REPLICATES, SAMPLES = 2000, 1000
B, F = [0.0, 0.5, 0.3], [1.0, -1.2, 0.6]
C, D = [1.0, 0.4], [1.0, -0.7]
CASES = {
    "fir": (([0, 0.5, 0.3, -0.2, 0.1], [1.0], [1.0], [1.0]), (4,), [0.5, 0.3, -0.2, 0.1]),
    "arx": ((B, F, [1.0], F), (2, 2), [-1.2, 0.6, 0.5, 0.3]),
    "armax": ((B, F, C, F), (2, 2, 1), [-1.2, 0.6, 0.5, 0.3, 0.4]),
    "oe": ((B, F, [1.0], [1.0]), (2, 2), [0.5, 0.3, -1.2, 0.6]),
    "bj": ((B, F, C, D), (2, 1, 1, 2), [0.5, 0.3, 0.4, -0.7, -1.2, 0.6]),
}


def simulated(rng, filters):
    b, f, c, d = filters
    u = rng.normal(size=SAMPLES)
    return Record(u, lfilter(b, f, u) + lfilter(c, d, 0.7 * rng.normal(size=SAMPLES)))


def shares(filters, kind, orders, theta, seed=0):
    rng, hits = np.random.default_rng(seed), []
    for _ in range(REPLICATES):
        data = simulated(rng, filters)
        fit = identify(data, kind, orders, search="quick")
        hits.append(np.abs(fit.theta - theta) < 1.959964 * fit.standard_errors)
    return np.mean(hits, axis=0)


@pytest.mark.validate
@pytest.mark.parametrize("kind", CASES)
def test_coverage(kind, record_figure) -> None:
    """Between 93 and 97 %, parameter by parameter; 2000 replicates know 95 % to 0.5 %."""
    filters, orders, theta = CASES[kind]
    share = shares(filters, kind, orders, np.array(theta))
    record_figure(f"coverage {kind}", share, seed=0, replicates=REPLICATES)
    assert np.all((share > 0.93) & (share < 0.97)), share


@pytest.mark.validate
def test_coverage_of_state_space(record_figure) -> None:
    """The parameters of the observable form of the ARMAX case."""
    filters, _, theta = CASES["armax"]
    structure = state_space(2)
    a, b, c = np.array(theta[:2]), np.array(theta[2:4]), np.array([theta[4], 0.0])
    A = np.array([[-a[0], 1.0], [-a[1], 0.0]])
    true = structure.theta_of(A, b[:, None], np.array([[1.0, 0.0]]), np.zeros((1, 1)), (c - a)[:, None])
    assert np.all(np.linalg.eigvals(solve_discrete_lyapunov(A, np.eye(2))) > 0)
    share = shares(filters, "ss", [2], true)
    record_figure("coverage ss", share, seed=0, replicates=REPLICATES)
    assert np.all((share > 0.93) & (share < 0.97)), share


@pytest.mark.validate
def test_sandwich_covers_where_the_plain_covariance_does_not(record_figure) -> None:
    """Output error in strongly coloured noise: the model of the noise is wrong, that of the plant is right. The same
    2000 fits for both."""
    filters, theta = (B, F, [1.0], [1.0, -0.95]), np.array(CASES["oe"][2])
    rng, plain, ours = np.random.default_rng(0), [], []
    for _ in range(REPLICATES):
        data = simulated(rng, filters)
        fit = identify(data, "oe", (2, 2), search="quick")
        plain.append(np.abs(fit.theta - theta) < 1.959964 * fit.standard_errors)
        ours.append(np.abs(fit.theta - theta) < 1.959964 * sandwich(fit, data).standard_errors)
    found = {"plain": np.mean(plain, axis=0), "sandwich": np.mean(ours, axis=0)}
    record_figure("coverage in coloured noise", found, seed=0, replicates=REPLICATES)
    assert np.all((found["sandwich"] > 0.92) & (found["sandwich"] < 0.97)), found
    assert np.any((found["plain"] < 0.9) | (found["plain"] > 0.98)), found


@pytest.mark.validate
def test_coverage_of_the_peak_gain(record_figure) -> None:
    rng, hits = np.random.default_rng(1), []
    filters, orders, _ = CASES["oe"]
    z = np.exp(-1j * np.linspace(0, np.pi, 200_001))
    gamma = np.abs(np.polyval(B[::-1], z) / np.polyval(F[::-1], z)).max()
    for _ in range(REPLICATES):
        value, error, _ = identify(simulated(rng, filters), "oe", orders, search="quick").hinf_norm
        hits.append(abs(value - gamma) < 1.959964 * error)
    record_figure("coverage of the peak gain", float(np.mean(hits)), seed=1, replicates=REPLICATES)
    assert 0.93 < np.mean(hits) < 0.97
