"""oed.plants.norms against the oracles: search on a grid, 50-digit curvatures, derivatives by moving the plant."""

from __future__ import annotations

import numpy as np
import pytest

from oed.plants.named import NAMES, named_plant
from oed.plants.norms import gain_gradient, peak, response_derivatives
from tests.oracles import information, limit_spectrum, lti

SISO = [name for name in NAMES if named_plant(name).n_inputs * named_plant(name).n_outputs == 1]


def pair(plant):
    return [[list(map(float, b)) for b in row] for row in plant.num], [
        [list(map(float, a)) for a in row] for row in plant.den
    ]


@pytest.mark.parametrize("name", NAMES)
def test_peak(name) -> None:
    plant = named_plant(name)
    gamma, frequency = lti.peak_gain(pair(plant))
    found = peak(plant)
    assert found.value == pytest.approx(gamma, rel=1e-12)  # both are values at a flat maximum, to rounding
    assert found.frequency == pytest.approx(
        frequency, abs=1e-6
    )  # ternary search fixes the place to root eps only
    assert found.value <= found.upper_bound <= found.value * (1 + 1e-8)
    u, v = found.output_direction, found.input_direction
    g = lti.response(pair(plant), found.frequency)[0]
    assert (u.conj() @ g @ v).real == pytest.approx(gamma, rel=1e-11)


@pytest.mark.parametrize("name", SISO)
def test_curvature(name) -> None:
    plant = named_plant(name)
    num, den = (x[0][0] for x in pair(plant))
    found = peak(plant)
    if len(den) == 1 and len(num) < 2:
        pytest.skip("a constant has no peak")
    oracle = limit_spectrum.solve(num, den, 0.1, panels=4)
    assert found.frequencies == pytest.approx(oracle.peaks, abs=1e-8)
    # H of the order-20 plant is a cancelling sum of second derivatives: relative rounding times |G''| / H
    assert found.curvatures == pytest.approx(oracle.curvatures, rel=1e-8)


@pytest.mark.parametrize("name", ["reference", "three-by-two", "avis", "nonminimum-phase"])
def test_response_and_parameter_derivatives(name) -> None:
    plant = named_plant(name)
    omega = np.array([0.0, 0.3, 1.1, 2.5, np.pi])
    names, _ = information.parameters(pair(plant))
    assert plant.free == tuple(names)
    response, derivative = plant.response(omega)
    assert response == pytest.approx(lti.response(pair(plant), omega), rel=1e-12, abs=1e-13)
    moved = information.response_derivative(pair(plant), omega).transpose(1, 0, 2, 3)
    # differences: rounding eps |G| / step (2e-4 / 4), and the step^6 that extrapolation leaves at poles near the circle
    assert derivative == pytest.approx(moved, rel=1e-8, abs=1e-8 * np.abs(moved).max())


def test_frequency_derivatives() -> None:
    plant = named_plant("three-by-two")
    omega, h = np.array([0.4, 1.7]), 1e-4
    g = [lti.response(pair(plant), omega + k * h) for k in (-1, 0, 1)]
    value, first, second = response_derivatives(plant, omega)
    assert value == pytest.approx(g[1], rel=1e-13)
    assert first == pytest.approx((g[2] - g[0]) / (2 * h), abs=1e-6)  # h^2 G''' / 6 with |G'''| about 1e2
    assert second == pytest.approx((g[2] - 2 * g[1] + g[0]) / h**2, abs=1e-5)


@pytest.mark.parametrize("name", ["reference", "nonminimum-phase", "three-by-two", "peak-at-zero"])
def test_gain_gradient(name) -> None:
    plant = named_plant(name)
    moved = information.peak_gradient(pair(plant))
    assert gain_gradient(plant) == pytest.approx(moved, rel=1e-7, abs=1e-8 * np.abs(moved).max())
