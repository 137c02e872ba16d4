"""Power that a filter passes from bounded inputs: certified from above, simulated from below."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from oed.design.parametrisations.bounded_inputs import passed_power
from oed.errors import InputError
from oed.plants.norms import peak
from oed.plants.plant import Plant


def _resonance(radius: float, angle: float, zero: float) -> tuple[np.ndarray, np.ndarray, float]:
    """A filter of unit peak gain, and where the peak lies."""
    num, den = np.array([0.0, 1.0, zero]), np.array([1.0, -2 * radius * np.cos(angle), radius**2])
    at = peak(Plant(num, den))
    return num / at.value, den, at.frequency


@pytest.mark.parametrize(("radius", "angle", "zero"), [(0.9, 1.0, 0.9), (0.7, 2.0, 0.3), (0.98, 0.7, 0.0)])
def test_no_bounded_input_passes_more(radius, angle, zero):
    num, den, frequency = _resonance(radius, angle, zero)
    bounds = [passed_power(num, den, degree=d) for d in (2, 4, 6)]
    # Degree 2 is the norm itself; every degree holds for what the one before it holds.
    assert bounds[0] == pytest.approx(1.0, abs=1e-6)
    assert bounds[0] > bounds[1] > bounds[2] > 8 / np.pi**2 * 0.999
    t = np.arange(20_000)
    # Not only the square wave at the peak: others near it, and the sign of what would raise the output (greedy).
    waves = [np.sign(np.cos(w * t + 0.2)) for w in frequency + np.linspace(-0.05, 0.05, 11)]
    u = waves[5]
    for _ in range(15):
        y = lfilter(num, den, u)
        u = np.where(lfilter(num, den, y[::-1])[::-1] >= 0, 1.0, -1.0)
        waves.append(u)
    power = [float(np.mean(lfilter(num, den, u) ** 2)) for u in waves]
    # The start adds V(s_0) - V(s_N) over N only.
    assert max(power) <= bounds[2] * (1 + 1e-3)
    assert max(power) > 0.78


@pytest.mark.slow
def test_degrees_follow_the_quadratures_of_the_cosine():
    """A sharp resonance: (mean of |cos| by the nodes of Gauss and Radau)^2 / (1/2), exact as the damping vanishes."""
    num, den, _ = _resonance(0.99, 0.987, 0.5)
    radau = 1 / 3 + 2 / 3 * 0.5
    gauss = (np.sqrt((1 + 1 / np.sqrt(2)) / 2) + np.sqrt((1 - 1 / np.sqrt(2)) / 2)) / 2
    five = 0.2 + 0.4 * (np.cos(np.pi / 5) + np.cos(2 * np.pi / 5))
    for degree, mean in ((4, radau), (6, gauss), (8, five)):
        assert passed_power(num, den, degree=degree) == pytest.approx(2 * mean**2, rel=1e-2)


def test_filters_that_do_not_fit_are_named():
    with pytest.raises(InputError, match="without delay"):
        passed_power([1.0, 0.5], [1.0, -0.5])
    with pytest.raises(InputError, match="3 states"):
        passed_power([0, 1.0, 0.0, 0.0], [1.0, -0.5, 0.1, 0.2])
    with pytest.raises(InputError, match="not stable"):
        passed_power([0, 1.0], [1.0, -1.1])
    with pytest.raises(InputError, match="degree"):
        passed_power([0, 1.0], [1.0, -0.5], degree=3)
