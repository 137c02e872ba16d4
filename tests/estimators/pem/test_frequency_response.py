"""Models of measured frequency responses: the truth is met within the stated errors, and lies are told apart."""

from __future__ import annotations

import control
import numpy as np
import pytest
from scipy.stats import chi2, kstest

from estimators.pem import identify_response
from oed import InputError, solve_design
from oed.models.model import polynomial

TRUE = np.array([0.5, 0.2, -1.2, 0.6])
DT = 0.01


def measured(rng, deviation=0.02, lines=120):
    """(omega in rad/s, response, variances): lines of unequal accuracy, circular errors."""
    w = np.linspace(0.05, 3.0, lines)
    G = polynomial("oe", (2, 2), 3).response(TRUE, w)[0][:, 0, 0]
    sigma = deviation * np.where(w > 1.5, 10.0, 1.0)
    noise = (rng.standard_normal(lines) + 1j * rng.standard_normal(lines)) / np.sqrt(2)
    return w / DT, G + sigma * noise, sigma**2


def test_errors_are_those_stated(rng):
    """The standardised errors of 60 responses have the covariance that is claimed: chi2 with 4 x 60 degrees of freedom,
    two-sided at 1e-3."""
    total, p = 0.0, []
    for _ in range(60):
        w, G, v = measured(rng)
        fit = identify_response(G, (2, 2), 3, omega=w, variance=v, dt=DT)
        e = fit.model.theta - TRUE
        total += float(e @ np.linalg.solve(fit.covariance, e))
        p.append(fit.p_value)
    assert chi2.ppf(5e-4, 240) < total < chi2.ppf(1 - 5e-4, 240)
    assert kstest(p, "uniform").pvalue > 1e-3


def test_weights_matter(rng):
    """Without the variances the accurate lines are not trusted: the errors grow, as theory says they must."""
    weighted, plain = [], []
    for _ in range(15):
        w, G, v = measured(rng)
        weighted.append(identify_response(G, (2, 2), 3, omega=w, variance=v, dt=DT).model.theta - TRUE)
        plain.append(identify_response(G, (2, 2), 3, omega=w, dt=DT).model.theta - TRUE)
    assert np.sum(np.square(plain)) > 3 * np.sum(np.square(weighted))


def test_a_model_that_lacks_something_is_told(rng):
    """Negative control of the p-value: order 1 for a plant of order 2."""
    w, G, v = measured(rng)
    assert identify_response(G, (1, 1), 3, omega=w, variance=v, dt=DT).p_value < 1e-6


def test_python_control_in_and_a_design_out(rng):
    w, G, v = measured(rng)
    fit = identify_response(control.frd(G, w, dt=DT), (2, 2), 3, variance=v)
    assert fit.model.dt == DT
    assert np.all(np.abs(fit.model.theta - TRUE) < 5 * fit.standard_errors)
    assert solve_design(fit, "D").gap < 1e-6
    assert "b3" in repr(fit)
    assert fit.to_dict()["parameters"]["b3"][0] == fit.model.theta[0]


@pytest.mark.parametrize(
    "words, change",
    [
        ("dt in seconds", {"dt": None}),
        ("one value for each", {"omega": [1.0]}),
        ("in Hz, or is dt", {"dt": 1.0}),
        ("not positive", {"variance": 0.0}),
        ("omega in rad/s", {"omega": None}),
        ("cannot determine", {"orders": (200, 200)}),
    ],
)
def test_mistakes_are_told(rng, words, change):
    w, G, v = measured(rng)
    how = {"orders": (2, 2), "delay": 3, "omega": w, "variance": v, "dt": DT} | change
    with pytest.raises(InputError, match=words):
        identify_response(G, **how)
    with pytest.raises(InputError, match="one entry at a time"):
        identify_response(control.frd(np.ones((2, 1, 3)), [1, 2, 3], dt=DT), (1, 1))
