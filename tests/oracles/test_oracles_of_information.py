"""The oracles of information, of several channels and of random numbers against closed forms and printed values."""

from __future__ import annotations

import numpy as np
import pytest

from tests.oracles import information, limit_spectrum, lti, philox, power


@pytest.mark.parametrize("scaling", ["none", "each", "common"])
def test_mimo_limit(scaling) -> None:  # theory 3: the recursion runs into the printed closed form
    noise = 1.0
    found = power.mimo_limit(lti.TWO_BY_TWO, noise, lines=512, scaling=scaling)
    g = lti.response(lti.TWO_BY_TWO, found["omega"])
    _, s, v = np.linalg.svd(g)
    nu2 = found["gain2_mean"] + 2 * noise
    gathered = {"none": 2.0, "each": nu2, "common": 2 * nu2}[scaling]
    phi = noise * (s**2 + gathered) / (found["mu2"] - s**4)
    assert phi.sum(axis=1).mean() == pytest.approx(1.0, rel=1e-10)
    assert np.mean(np.sum(s**2 * phi, axis=1)) == pytest.approx(found["gain2_mean"], rel=1e-10)
    spectrum = np.einsum("kni,kn,knj->kij", v.conj(), phi, v)
    assert found["spectrum"] == pytest.approx(spectrum, rel=1e-8, abs=1e-10)


def test_mimo_limit_of_one_channel_scaled_is_algorithm_1() -> None:  # theory 3, last lines
    for scaling in ("each", "common"):
        found = power.mimo_limit(lti.REFERENCE, 4.0, lines=1024, scaling=scaling)
        s = limit_spectrum.solve(lti.REFERENCE_NUM[0][0], lti.REFERENCE_DEN[0][0], 4.0)
        gain2 = np.abs(lti.response(lti.REFERENCE, found["omega"])[:, 0, 0]) ** 2
        assert found["spectrum"][:, 0, 0].real == pytest.approx(4.0 / (s.mu2 - gain2), rel=1e-7)
        assert found["gain2_mean"] == pytest.approx(s.beta2_mean, rel=1e-9)
        assert found["mu2"] == pytest.approx(s.mu2**2, rel=1e-9)  # the grid's error, as in the test of H_d
    unscaled = power.mimo_limit(lti.REFERENCE, 4.0, lines=1024)
    assert abs(unscaled["gain2_mean"] / s.beta2_mean - 1.0) > 0.1


def test_mimo_second_moments_tend_to_the_limit() -> None:
    """N mu2 at finite N misses the limit by an edge effect: half as much at twice the length."""
    limit = power.mimo_limit(lti.TWO_BY_TWO, 1.0, lines=1024)["mu2"]
    errors = [
        power.second_moments_procedure_2(lti.TWO_BY_TWO, n, 1.0, 60)[-1] / limit - 1.0 for n in (40, 80, 160)
    ]
    assert abs(errors[2]) < 0.01
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.25)


def test_information_of_a_signal_tends_to_that_of_its_spectrum() -> None:
    """One sinusoid of unit power over many periods, against half the atom at plus and minus its frequency; MIMO, Lambda full."""
    covariance = np.array([[1.0, 0.3], [0.3, 2.0]])
    omega, direction = 2 * np.pi * 9 / 64, np.array([0.6, 0.8j])
    matrices = []
    for samples in (256, 512):
        t = np.arange(samples)
        u = np.sqrt(2.0) * (direction * np.exp(1j * omega * t)[:, None]).real
        matrices.append(information.of_signal(lti.TWO_BY_TWO, u, covariance))
    steady = (matrices[1] - matrices[0]) / 256  # the second stretch alone: the transient of poles .6 is gone
    derivative = information.response_derivative(lti.TWO_BY_TWO, [omega])
    line = information.of_lines(derivative, np.outer(direction, direction.conj())[None], covariance)
    assert steady == pytest.approx(line, rel=1e-8, abs=1e-9)


def test_parametric_error_information() -> None:
    """AR(1): I = 1/(1 - d^2) per sample. MA(1) has the same; ARMA(1,1) adds the cross term 1/(1 + c d), sign minus."""
    one = information.parametric_error_information([1.0], [1.0, -0.7], 1, [("den", 1)], 200)
    assert one[0, 0] == pytest.approx(1 / (1 - 0.49), rel=1e-9)
    two = information.parametric_error_information([1.0, 0.4], [1.0, -0.7], 1, [("num", 1), ("den", 1)], 200)
    expected = [[1 / (1 - 0.16), -1 / (1 + 0.28)], [-1 / (1 + 0.28), 1 / (1 - 0.49)]]
    assert two == pytest.approx(np.array(expected), rel=1e-9)


@pytest.mark.parametrize("counter, key, words", philox.KNOWN_ANSWERS)
def test_philox_known_answers(counter, key, words) -> None:  # Random123, kat_vectors, philox4x32 10 rounds
    assert philox.philox4x32(counter, key) == words
