"""Poles in hertz, damping and time constants, against the continuous system that was sampled."""

from __future__ import annotations

import numpy as np
import pytest

from oed.models.poles import poles_in_hz


def test_a_sampled_system_has_its_frequency_damping_and_time_constant():
    dt, natural, zeta, tau = 0.01, 2 * np.pi * 3.0, 0.2, 0.5
    pair = natural * (-zeta + 1j * np.sqrt(1 - zeta**2))
    slow, rings = poles_in_hz([*np.exp(dt * np.array([pair, pair.conjugate(), -1 / tau])), 0.0], dt)
    assert (slow.frequency_hz, slow.time_constant) == (0.0, pytest.approx(tau))
    assert str(slow) == "0.5 s"
    assert rings.frequency_hz == pytest.approx(3.0 * np.sqrt(1 - zeta**2))
    assert rings.damping == pytest.approx(zeta)
    assert str(rings) == "2.939 Hz (damping 0.2)"
