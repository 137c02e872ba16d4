"""The H-infinity norm: published digits, other people's code, equal peaks, and the certificate."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oed.design import solve_design
from oed.errors import InputError, SolverFailure
from oed.plants import level_sets
from oed.plants.named import NAMES, named_plant
from oed.plants.norms import gain_gradient, peak, refined_maximum, response_derivatives
from oed.plants.plant import Plant
from oed.plants.realisations import state_space
from oed.theory import limit_spectrum


def test_reference_plant_to_the_printed_digits():
    """theory.md, head: all digits printed there."""
    top = peak(named_plant("reference"))
    assert abs(top.value - 2.411554068769) < 1e-12
    assert abs(top.frequency - 0.9889941220) < 1e-10
    assert abs(top.curvature - 1148.953609) < 1e-6
    assert top.unique


@pytest.mark.parametrize("name", NAMES)
def test_agrees_with_python_control_and_with_a_dense_grid(name):
    plant = named_plant(name)
    top = peak(plant)
    # python-control bisects to its tolerance of 1e-10 relative; the grid can only fall short
    assert np.isclose(
        top.value,
        control.system_norm(control.ss(*state_space(plant), plant.dt), "inf", tol=1e-10),
        rtol=1e-8,
    )
    omega = np.linspace(0, np.pi, 20001)
    grid = np.linalg.svd(plant.response(omega)[0], compute_uv=False)[:, 0].max()
    assert grid <= top.value * (1 + 1e-12)
    assert top.value <= top.upper_bound <= top.value * (1 + 2e-9)


@pytest.mark.parametrize("name, where", [("peak-at-zero", 0.0), ("peak-at-pi", np.pi)])
def test_peaks_at_the_ends_are_exactly_there(name, where):
    assert peak(named_plant(name)).frequency == where


def test_equal_peaks_are_all_reported():
    top = peak(Plant([0, 1], [1, 0, 0.5]))  # poles at +-0.707j: one peak, at pi/2, by symmetry
    assert top.unique
    comb = peak(Plant([1, 0, 0, 0, 1], [1]))  # 1 + z^-4: gain 2 at 0, pi/2 and pi
    assert np.allclose(comb.frequencies, [0, np.pi / 2, np.pi], atol=1e-9)


@pytest.mark.parametrize("name", ["reference", "three-by-two", "avis", "order-20"])
def test_curvature_and_gradient_against_differences(name):
    plant = named_plant(name)
    top = peak(plant)
    gain = lambda p, w: np.linalg.svd(p.response([w])[0][0], compute_uv=False)[0]
    # Richardson of two central differences: error of order h^4 of a resonance whose width is about 1/sqrt(H)
    h = 0.02 * top.value / np.sqrt(top.curvature)
    second = lambda h: (
        -(gain(plant, top.frequency + h) ** 2 - 2 * top.value**2 + gain(plant, top.frequency - h) ** 2) / h**2
    )
    assert np.isclose((4 * second(h / 2) - second(h)) / 3, top.curvature, rtol=1e-3)
    c, theta = gain_gradient(plant, top), plant.theta
    for i in range(0, len(theta), max(len(theta) // 6, 1)):
        step = 1e-6 * np.eye(len(theta))[i]
        difference = (
            gain(plant.with_theta(theta + step), top.frequency)
            - gain(plant.with_theta(theta - step), top.frequency)
        ) / 2e-6
        assert np.isclose(c[i], difference, rtol=1e-4, atol=1e-6 * np.abs(c).max())


@given(st.floats(0.2, 5.0), st.integers(0, 5))
def test_gain_scales_and_delay_does_nothing(factor, delay):
    plain = peak(named_plant("reference"))
    other = peak(Plant([0.0] * (1 + delay) + [factor * 0.2155, factor * 0.2012], [1, -0.9854, 0.8187]))
    assert np.isclose(other.value, factor * plain.value, rtol=1e-12)
    assert np.isclose(other.frequency, plain.frequency, atol=1e-9)


def test_very_light_damping_is_found_between_grid_points():
    r = 1 - 1e-6
    plant = Plant([0, 1e-6], [1, -2 * r * np.cos(1.2345), r * r])
    omega = np.linspace(1.2345 - 1e-5, 1.2345 + 1e-5, 200001)
    assert np.isclose(peak(plant).value, np.abs(plant.response(omega)[0]).max(), rtol=1e-8)


def test_frequency_derivatives_of_the_response():
    plant = named_plant("three-by-two")
    w, h = np.array([0.4, 1.7]), 1e-4
    G, G1, G2 = response_derivatives(plant, w)
    up, down = plant.response(w + h)[0], plant.response(w - h)[0]
    assert np.allclose(G1, (up - down) / (2 * h), atol=1e-5 * np.abs(G1).max())
    assert np.allclose(G2, (up - 2 * G + down) / h**2, atol=1e-4 * np.abs(G2).max())


def test_a_stalled_eigenvalue_iteration_is_started_again(monkeypatch):
    """Seen on one processor and not on another: QZ stalls on entries near the underflow threshold."""
    import scipy.linalg

    plant = named_plant("three-by-two")
    expected = peak(plant)
    solve, calls = scipy.linalg.eig, []

    def stalls(*arguments, **options):
        calls.append(1)
        if len(calls) == 1:
            raise scipy.linalg.LinAlgError("did not converge")
        return solve(*arguments, **options)

    monkeypatch.setattr(scipy.linalg, "eig", stalls)
    assert peak(plant.replace()).upper_bound == expected.upper_bound
    assert len(calls) > 1

    def never(*arguments, **options):
        raise scipy.linalg.LinAlgError("did not converge")

    monkeypatch.setattr(scipy.linalg, "eig", never)
    with pytest.raises(SolverFailure, match="no certificate: rescale"):
        peak(plant.replace())


def test_a_coefficient_near_underflow_changes_nothing():
    plant = Plant(num=[[[0, 0.5]]], den=[[[1.0, 2.2e-305]]])
    assert peak(plant).value == pytest.approx(0.5, rel=1e-14)


@pytest.mark.parametrize("num", [[0.5], [0.0, 0.5]])
@pytest.mark.parametrize("relative", [0.0, 1e-15, 1e-16])
def test_rounding_at_a_flat_top_makes_no_second_peak(num, relative):
    """A double pole: crossings of the level set a hundred-millionth from the peak at 0."""
    plant = Plant(num=[[num]], den=[[[1.0, -0.1875, 0.0087890625 * (1 + relative)]]])
    assert peak(plant).frequencies == (0.0,)
    assert limit_spectrum(plant).mu2_excess == pytest.approx(0.893142882687, rel=1e-11)


def test_double_poles_peak_exactly_at_the_ends(rng):
    for _ in range(100):
        r = rng.uniform(0.01, 0.9) * rng.choice([-1, 1])
        den = np.convolve([1, -r], [1, -r]) * [1, 1, 1 + rng.choice([0, 1e-16, 1e-15, -1e-15])]
        plant = Plant(num=[[np.r_[np.zeros(rng.integers(3)), 0.562]]], den=[[den]])
        assert peak(plant).frequencies == ((0.0,) if r > 0 else (np.pi,))


def test_refined_maximum_is_good_to_the_square_of_the_distance():
    height = lambda x: np.cos(x - 0.3) + 0.2 * (x - 0.3) ** 3
    for wide in (0.1, 0.01):
        assert abs(refined_maximum(height, 0.3 - 0.7 * wide, 0.3 + 0.3 * wide) - 0.3) < 1e-4 * wide**2
    assert refined_maximum(lambda x: x, 0.0, 1.0) == pytest.approx(1.0)


def test_delays_of_rows_and_columns_cost_no_states():
    plain = Plant([[[1.0, 0.5], [0.0]], [[0, 0.3], [0.2, 0, 1]]], [[[1, -0.5], [1]], [[1, 0.4], [1]]])
    late = plain.replace(
        num=[
            [np.r_[np.zeros(700), 1.0, 0.5], [0.0]],
            [np.r_[np.zeros(720), 0.3], np.r_[np.zeros(1019), 0.2, 0, 1]],
        ],
        free=(),
    )
    assert len(state_space(late, delays=False)[0]) < 10
    assert np.isclose(peak(late).upper_bound, _brute(late), rtol=1e-6)
    assert peak(late) is peak(late), "asked again, it is not computed again"


def test_too_many_states_are_refused_at_once():
    with pytest.raises(InputError, match="the plant has 1999 states"):
        peak(Plant(0.99 ** np.arange(2000), [1.0]))


def _brute(plant):
    omega = np.linspace(0, np.pi, 100_001)
    return np.linalg.norm(plant.response(omega)[0], 2, axis=(1, 2)).max()


def test_a_plant_of_too_many_coefficients_is_refused_before_its_matrices_are_made(rng, monkeypatch):
    """With 20000, a state matrix of 3.2 GB was made and then refused; a design ran for hours in as much."""
    plant = Plant(num=rng.standard_normal(1500), den=[1.0])
    monkeypatch.setattr(level_sets, "state_space", None)
    with pytest.raises(InputError, match="at most 400"):
        peak(plant)
    with pytest.raises(InputError, match="1500 unknown parameters.* at most 1000; .* `free`"):
        solve_design(plant, "D")
