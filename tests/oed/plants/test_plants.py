"""Plants: conventions, conversions, and the words of every error."""

import json

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oed.errors import InputError
from oed.plants.families import FAMILIES, NORM, random_plant
from oed.plants.json import plant_from_json, plant_to_json
from oed.plants.named import NAMES, named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.plants.realisations import state_space

OMEGA = np.linspace(0.01, 3.13, 40)


def test_parameters_are_named_by_letter_power_and_entry():
    plant = Plant([[[0, 1], [0, 0, 0.5, 0, 0.1]], [[1, 0.2], [0]]], [[[1, -0.5], [1, 0.3]], [[1, -0.2], [1]]])
    expected = ["b1_11", "a1_11", "b2_12", "b3_12", "b4_12", "a1_12", "b0_21", "b1_21", "a1_21"]
    assert list(plant.all_names) == expected  # interior zeros are parameters, leading zeros delay
    assert np.array_equal(plant.theta, [1, -0.5, 0.5, 0, 0.1, 0.3, 1, 0.2, -0.2])


def test_free_selects_parameters_in_the_plants_own_order():
    plant = named_plant("reference").replace(free=("a2", "b1"))
    assert plant.free == ("b1", "a2")
    assert plant.response([1.0])[1].shape == (1, 2, 1, 1)
    moved = plant.with_theta([0.3, 0.5])
    assert moved.num[0][0][1] == 0.3
    assert moved.den[0][0][2] == 0.5


@pytest.mark.parametrize("name", NAMES)
def test_gradient_agrees_with_central_differences(name):
    plant = named_plant(name)
    theta, h = plant.theta, 1e-6
    dG = plant.response(OMEGA)[1]
    for i in range(len(theta)):
        step = h * np.eye(len(theta))[i]
        difference = (
            plant.with_theta(theta + step).response(OMEGA)[0]
            - plant.with_theta(theta - step).response(OMEGA)[0]
        ) / (2 * h)
        scale = np.abs(difference).max()
        # error of central differences: h^2 times a third derivative, which sharp resonances make large
        assert np.abs(dG[:, i] - difference).max() <= 1e-4 * scale


@pytest.mark.parametrize("name", NAMES)
def test_round_trips_keep_the_response(name):
    plant = named_plant(name)
    G = plant.response(OMEGA)[0]
    scale = np.abs(G).max()
    for other in (
        Plant.from_control(plant.to_control()),
        plant_from_json(json.loads(json.dumps(plant_to_json(plant)))),
    ):
        assert np.abs(other.response(OMEGA)[0] - G).max() <= 1e-12 * scale
        assert other.all_names == plant.all_names
    A, B, C, D = state_space(plant)
    z = np.exp(1j * OMEGA[7])
    assert np.allclose(C @ np.linalg.solve(z * np.eye(len(A)) - A, B) + D, G[7], atol=1e-9 * scale)


def test_state_space_becomes_minimal_entries():
    plant = named_plant("reference")
    A, B, C, D = state_space(plant)
    padded = np.block([[A, np.zeros((2, 1))], [np.zeros((1, 2)), 0.3 * np.eye(1)]])  # a mode nobody sees
    again = Plant.from_state_space(padded, np.vstack([B, [[0.0]]]), np.hstack([C, [[1.0]]]), D)
    assert again.all_names == plant.all_names
    assert np.allclose(again.theta, plant.theta, atol=1e-9)


def test_simulation_agrees_with_python_control():
    plant = named_plant("three-by-two")
    u = np.random.default_rng(3).standard_normal((60, 2))
    response = control.forced_response(control.ss(*state_space(plant), plant.dt), U=u.T)
    assert np.allclose(plant.simulate(u), response.outputs.T, atol=1e-10)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Plant([0, 1], [1, -1.2]), ["pole at z = 1.2", "stable", "stabilise"]),
        (lambda: Plant([1], [0, 1]), ["improper", "z^0"]),
        (lambda: Plant([0, 0], [1]), ["zero", "gain"]),
        (lambda: Plant([1, np.nan], [1]), ["num[0][0]", "finite"]),
        (lambda: Plant([1], [1], noise_covariance=-2), ["noise variance is -2", "at least 0"]),
        (lambda: Plant([1], [1], dt=0), ["sampling time is 0", "positive"]),
        (lambda: Plant([[[1], [1]]], [[[1]]]), ["1 x 2", "1 x 1"]),
        (lambda: named_plant("reference").replace(free=("b7",)), ["b7", "b1, b2, a1, a2"]),
        (lambda: named_plant("referense"), ["referense", "did you mean reference"]),
        (lambda: Plant.from_control(control.tf([1], [1, 1])), ["continuous", "zoh"]),
        (lambda: Plant.from_control(control.tf([1, 0, 0], [1, 0.5], 1)), ["improper", "degree 2"]),
        (lambda: plant_from_json({"num": [1]}), ["needs num and den"]),
        (lambda: plant_from_json({"num": [1], "den": [1], "colour": 1}), ["is unknown", "colour"]),
        (lambda: plant_from_json({"num": [1], "den": [1], "dt": 0}), ["continuous-time", "hold"]),
        (lambda: plant_from_json("nowhere.json"), ["cannot be read", "nowhere.json"]),
    ],
)
def test_bad_plants_are_refused_in_words(make, words):
    with pytest.raises(InputError) as caught:
        make()
    message = str(caught.value)
    for word in words:
        assert word in message


def test_a_continuous_plant_is_sampled_when_asked():
    plant = Plant.from_control(control.tf([1], [1, 1]), dt=0.1, hold="zoh")
    assert plant.dt == 0.1
    assert np.isclose(plant.response([0.0])[0][0, 0, 0].real, 1.0)


@given(st.floats(-0.95, 0.95), st.floats(0.05, 5), st.integers(0, 4))
def test_scaling_numerator_and_denominator_together_changes_nothing(pole, factor, delay):
    num, den = [0.0] * delay + [1.0, 0.4], [1.0, -pole]
    one = Plant(num, den)
    other = Plant([factor * b for b in num], [factor * a for a in den])
    assert np.allclose(one.response(OMEGA)[0], other.response(OMEGA)[0], rtol=1e-12)
    assert one.all_names == other.all_names


def test_arrays_of_a_plant_cannot_be_written():
    plant = named_plant("reference")
    with pytest.raises(ValueError, match="read-only"):
        plant.num[0][0][1] = 9.0


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"num": [0, 1e200]}, "num, divided by the leading coefficient of den, is 1e.200"),
        ({"num": [0, 1e-70]}, "is 1e-70; it must lie between 1e-50 and 1e.50"),
        ({"den": [1e60, 1.0]}, "is 2e-60"),
        ({"noise_covariance": 1e-200}, "the noise's largest standard deviation is 1e-100"),
        ({"noise_num": [1, 1e90]}, "the noise filter's num is 1e.90"),
    ],
)
def test_numbers_whose_squares_are_none_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        Plant(**{"num": [0, 2.0], "den": [1, -0.5]} | changes)
    assert Plant([0, 1e49], [1, -0.5], noise_covariance=0.0).noise_variance == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_random_plants_are_what_their_family_says(family):
    """40 plants by seed: stable (or Plant refuses), the norm as stated, and the feature of the family in each."""
    plants = [random_plant(family, np.random.default_rng([7, k])) for k in range(40)]
    for plant in plants:
        assert np.isclose(peak(plant).value, NORM, rtol=1e-9)
    again = random_plant(family, np.random.default_rng([7, 0]))
    assert np.array_equal(again.theta, plants[0].theta)
    radii = [np.abs(np.roots(plant.den[0][0])).max() for plant in plants]
    delays = [int(np.flatnonzero(plant.num[0][0])[0]) for plant in plants]
    rivals = [sorted(v for _, v in peak(p).local_maxima) for p in plants if p.n_inputs * p.n_outputs == 1]
    channels = {(plant.n_outputs, plant.n_inputs) for plant in plants}
    assert (min(radii) > 0.96) == (family == "light")
    assert (min(delays) >= 3) == (family == "late")
    assert (bool(rivals) and all(len(r) > 1 and r[-2] > 0.8 * NORM for r in rivals)) == (
        family == "competing"
    )
    assert (len(channels) == 9) == (family == "many")
