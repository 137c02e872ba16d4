"""oed.information against finite differences: of spectra by sums over lines, of signals by simulating moved plants."""

from __future__ import annotations

import numpy as np
import pytest

from oed.data import Spectrum
from oed.design import information_map
from oed.information import (
    covariance,
    information_of_each,
    information_of_records,
    information_of_signal,
    information_of_spectrum,
)
from oed.models.model import Model, bj
from oed.plants.named import named_plant
from oed.plants.plant import Plant
from tests.oracles import information, lti

# Finite differences, twice extrapolated: 1e-9 of the largest derivative, twice that in a product.
TOLERANCE = 1e-8


def pair(plant):
    return [[list(map(float, b)) for b in row] for row in plant.num], [
        [list(map(float, a)) for a in row] for row in plant.den
    ]


def random_power(rng, lines: int, channels: int) -> np.ndarray:
    root = rng.standard_normal((lines, channels, channels)) + 1j * rng.standard_normal(
        (lines, channels, channels)
    )
    return root @ root.conj().transpose(0, 2, 1)


def close(value, oracle) -> None:
    """Entry by entry, in units of the square roots of the diagonal."""
    scale = np.sqrt(np.outer(np.diag(oracle), np.diag(oracle)))
    assert np.abs((value - oracle) / scale).max() < TOLERANCE


@pytest.mark.parametrize("name", ["reference", "delay", "three-by-two", "avis"])
def test_of_lines(name, rng) -> None:
    plant = named_plant(name)
    p, q = plant.n_outputs, plant.n_inputs
    root = rng.standard_normal((p, p))
    plant = plant.replace(noise_covariance=root @ root.T + np.eye(p))
    omega = np.array([0.2, 0.7, 1.3, 2.9])
    power = random_power(rng, 4, q)
    oracle = information.of_lines(
        information.response_derivative(pair(plant), omega), power, plant.noise_covariance
    )
    close(information_of_spectrum(plant, Spectrum(omega, power)), oracle)


def test_of_lines_in_coloured_noise(rng) -> None:
    plant = named_plant("three-by-two").replace(noise_num=(1.0, 0.4), noise_den=(1.0, -0.8, 0.3))
    omega = np.array([0.2, 0.7, 1.3, 2.9])
    power = random_power(rng, 4, 2)
    h = lti.response(([[[1.0, 0.4]]], [[[1.0, -0.8, 0.3]]]), omega)[:, 0, 0]
    noise = (np.abs(h) ** 2)[:, None, None] * np.eye(3)
    oracle = information.of_lines(information.response_derivative(pair(plant), omega), power, noise)
    close(information_of_spectrum(plant, Spectrum(omega, power)), oracle)


def test_lines_at_zero_and_pi() -> None:
    """A constant of power 1 and an alternating signal of power 2: all of the power at one real response."""
    plant = named_plant("reference", 0.5)
    omega, power = np.array([0.0, np.pi]), np.array([1.0, 2.0])
    g = information.response_derivative(pair(plant), omega)[:, :, 0, 0].real
    oracle = (g * power) @ g.T / 0.5
    value = information_of_spectrum(plant, Spectrum(omega, power))
    assert value == pytest.approx(
        oracle, abs=1e-8 * np.abs(oracle).max()
    )  # rank 2: no scaling by the diagonal


def test_white_noise_spectrum() -> None:
    plant = named_plant("three-by-two", 2.0)
    oracle = information.of_spectrum(
        pair(plant), lambda w: np.tile(np.eye(2) / 2, (len(w), 1, 1)), 2.0 * np.eye(3), lines=128
    )
    omega = (np.arange(64) + 0.5) * np.pi / 64  # the upper half of the same lines, with twice the power each
    close(information_of_spectrum(plant, Spectrum(omega, np.tile(np.eye(2) / 128, (64, 1, 1)))), oracle)


@pytest.mark.parametrize("name", ["reference", "delay", "three-by-two"])
@pytest.mark.parametrize("coloured", [False, True])
def test_of_signal(name, coloured, rng) -> None:
    plant = named_plant(name)
    p, q = plant.n_outputs, plant.n_inputs
    root = rng.standard_normal((p, p))
    plant = plant.replace(noise_covariance=root @ root.T + np.eye(p))
    prefilter = None
    if coloured:
        plant = plant.replace(noise_num=(1.0, 0.4), noise_den=(1.0, -0.8, 0.3))
        prefilter = ([1.0, -0.8, 0.3], [1.0, 0.4])
    u = rng.standard_normal((40, q))
    oracle = information.of_signal(pair(plant), u, plant.noise_covariance, prefilter)
    close(information_of_signal(plant, u), oracle)
    v = rng.standard_normal((25, q))
    each = information_of_each(plant, [u, v, 2 * u])
    for found, expected in zip(each, (u, v, 2 * u), strict=True):
        close(found, information.of_signal(pair(plant), expected, plant.noise_covariance, prefilter))
    close(
        information_of_records(plant, [u, v]),
        oracle + information.of_signal(pair(plant), v, plant.noise_covariance, prefilter),
    )
    assert covariance(information_of_signal(plant, u)) == pytest.approx(
        np.linalg.inv(oracle), rel=1e-4
    )  # conditioning: up to 1e4 here


def test_known_parameters_are_left_out(rng) -> None:
    plant = named_plant("reference").replace(free=("a2", "b1"))
    u = rng.standard_normal((30, 1))
    oracle = information.of_signal(pair(plant), u, np.eye(1))
    names, _ = information.parameters(pair(plant))
    keep = [names.index(name) for name in plant.free]
    assert plant.free == ("b1", "a2")
    close(information_of_signal(plant, u), oracle[np.ix_(keep, keep)])


def test_of_a_model() -> None:
    """A Model's noise filter is a matrix with its derivatives, a Plant's a number: both by the same sum over lines."""
    structure = bj(2, 1, 1, 2)
    theta = {"b1": 0.2155, "b2": 0.2012, "f1": -0.9854, "f2": 0.8187, "c1": 0.4, "d1": -0.7}
    model = Model(structure, [theta[name] for name in structure.names], np.array([[0.5]]))
    omega, power = np.array([0.5, 1.2]), np.array([1.0, 0.4])
    h = lti.response(([[[1.0, 0.4]]], [[[1.0, -0.7]]]), omega)[:, 0, 0]
    g = information.response_derivative(lti.REFERENCE, omega)[:, :, 0, 0]
    at = [structure.names.index(name) for name in ("b1", "b2", "f1", "f2")]
    found = information_of_spectrum(model, Spectrum(omega, power))
    close(found[np.ix_(at, at)], ((g * power / np.abs(h) ** 2) @ g.conj().T).real / 0.5)
    others = [structure.names.index(name) for name in ("c1", "d1")]
    assert not found[others].any()  # the input brings nothing to the noise filter


def test_of_a_noise_filter() -> None:
    """What the noise tells of its own filter: impulse responses against the suite's integral over frequency."""
    structure = bj(2, 1, 1, 2)
    theta = {"b1": 0.2155, "b2": 0.2012, "f1": -0.9854, "f2": 0.8187, "c1": 0.4, "d1": -0.7}
    model = Model(structure, [theta[name] for name in structure.names], np.array([[0.5]]))
    places = [("num", 1), ("den", 1)]
    oracle = information.parametric_error_information([1.0, 0.4], [1.0, -0.7], 1, places, 200)
    at = [structure.names.index(name) for name in ("c1", "d1")]
    constant = information_map(model).constant
    close(constant[np.ix_(at, at)], oracle)
    assert np.count_nonzero(np.abs(constant) > 1e-12) == 4


def test_steady_state_of_a_sinusoid() -> None:
    """The information of N samples of a sinusoid, less that of the first half, is its line's: edge effects are in the first."""
    plant = Plant([[[0, 0.5], [0, 0.2, 0.1]]], [[[1, -0.6], [1, -0.5]]], noise_covariance=0.7)
    omega, direction = 2 * np.pi * 5 / 64, np.array([0.8, 0.6j])
    t = np.arange(512)
    u = np.sqrt(2.0) * (direction * np.exp(1j * omega * t)[:, None]).real
    steady = (information_of_signal(plant, u) - information_of_signal(plant, u[:256])) / 256
    line = information_of_spectrum(
        plant, Spectrum(np.array([omega]), np.outer(direction, direction.conj())[None])
    )
    assert steady == pytest.approx(line, rel=1e-9, abs=1e-9 * np.abs(line).max())
