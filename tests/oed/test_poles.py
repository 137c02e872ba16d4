"""Poles in hertz, damping and time constants, against the continuous system that was sampled."""

from __future__ import annotations

import numpy as np
import pytest

from oed.models.model import Model, armax, oe
from oed.models.poles import poles_in_hz
from oed.models.polynomials import polynomial
from oed.models.statespaces import state_space


def test_a_sampled_system_has_its_frequency_damping_and_time_constant():
    dt, natural, zeta, tau = 0.01, 2 * np.pi * 3.0, 0.2, 0.5
    pair = natural * (-zeta + 1j * np.sqrt(1 - zeta**2))
    slow, rings = poles_in_hz([*np.exp(dt * np.array([pair, pair.conjugate(), -1 / tau])), 0.0], dt)
    assert (slow.frequency_hz, slow.time_constant) == (0.0, pytest.approx(tau))
    assert str(slow) == "time constant 0.5 s"
    assert rings.frequency_hz == pytest.approx(3.0 * np.sqrt(1 - zeta**2))
    assert rings.damping == pytest.approx(zeta)
    assert str(rings) == "2.939 Hz (damping 0.2, time constant 0.2653 s)"


def test_a_model_is_written_as_in_a_book():
    model = Model(armax(1, 2, 1, delay=3), np.array([-0.9, 0.25, -2.0, 0.3]))
    assert model.written() == [
        "G(z) = (0.25 z^-3 - 2 z^-4) / (1 - 0.9 z^-1)",
        "H(z) = (1 + 0.3 z^-1) / (1 - 0.9 z^-1)",
    ]
    form = polynomial("oe", ([[1, 1]], [[1, 0]]), n_inputs=2, delay=[[1, 0]])
    two = Model(form, np.array([2.0, 3.0, 0.5]))
    assert two.written(["valve", "heater"], ["T"]) == [
        "G from valve to T(z) = 2 z^-1 / (1 + 0.5 z^-1)",
        "G from heater to T(z) = 3",
    ]
    assert Model(oe(9, 1), np.ones(10)).written() == []


@pytest.mark.parametrize("delay", [0, 1])
def test_fractions_of_a_state_space_model_are_its_response(rng, delay):
    structure = state_space(4, n_outputs=2, n_inputs=2, delay=delay)
    theta = 0.3 * rng.standard_normal(structure.n)
    omega = np.linspace(0.1, 3, 7)
    g = structure.response(theta, omega)[0]
    at = lambda p: np.polynomial.polynomial.polyval(np.exp(-1j * omega), p)
    for i, row in enumerate(structure.fractions(theta)):
        for j, (num, den) in enumerate(row):
            np.testing.assert_allclose(at(num) / at(den), g[:, i, j], rtol=1e-8, atol=1e-10)
