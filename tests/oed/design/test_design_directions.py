"""Scalars of plants with several inputs: all directions of a frequency at once, down to the theorem and the certificate."""

from __future__ import annotations

import numpy as np
import pytest

from oed.criteria import c_criterion
from oed.data import Spectrum
from oed.design import information_map, solve_design
from oed.design.problem.budgets import power_budgets
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.lines import Problem
from oed.design.solvers.elfving_barrier import _Dual, applies, direction_exchange
from oed.errors import SolverFailure, Status
from oed.information import information_of_spectrum
from oed.plants.named import named_plant
from oed.plants.norms import gain_gradient, peak
from oed.plants.plant import Plant


@pytest.fixture(scope="module")
def three():
    return named_plant("three-by-two").replace(noise_variance=1.0)


def test_the_search_finds_the_sinusoid_of_the_theorem(three):
    """Gain scaling (theory.md section 4): the loss of the peak gain is lambda, at the peak in its input direction."""
    # As a Criterion, so that the theorem's own candidate is not offered.
    design = solve_design(three, c_criterion(gain_gradient(three)))
    assert design.status is Status.OK
    assert design.loss == pytest.approx(1.0, rel=1e-7)
    at = peak(three)
    assert design.spectrum.strongest(1e-3).omega == pytest.approx([at.frequency], abs=1e-5)


@pytest.mark.parametrize(
    ("name", "limits"),
    [
        ("gain:0.5", {}),
        pytest.param("hinf", {"channel_power": [0.9, 0.1]}, marks=pytest.mark.slow),
        pytest.param("static-gain", {"output_power": 1.0, "input_power": 1.0}, marks=pytest.mark.slow),
        pytest.param("damping:1", {"band": (0.2, 2.0)}, marks=pytest.mark.slow),
    ],
)
def test_scalars_of_several_inputs_close_their_gap(three, name, limits):
    design = solve_design(three, name, **limits)
    assert design.status is Status.OK
    assert abs(design.gap) < 1e-7
    low, high = limits.get("band", (0.0, np.pi))
    assert design.certificate.check(low, high, points=5001) <= 1 + 1e-7
    own = criterion_of(name, three, design.map).loss(design.information)
    # In double precision the range of a singular information is known to 1e-6 of a length, its loss to the square root.
    assert own == pytest.approx(design.loss, rel=1e-5)
    for budget, limit in design.limits.items():
        assert design.power_used[budget] <= limit * (1 + 1e-9)


def test_who_is_solved_this_way(three):
    problem = lambda plant, name: Problem(
        information_map(plant),
        criterion_of(name, plant, information_map(plant)),
        power_budgets(information_map(plant), 1.0),
        np.linspace(0.1, 3.0, 50),
    )
    assert applies(problem(three, "gain:0.5"))
    assert not applies(problem(three, "D"))
    assert applies(problem(named_plant("reference"), "gain:0.5"))


def test_one_input_is_the_case_of_the_cone_programme():
    """Twin: Elfving's second-order cone programme by Clarabel, on the same grid of one input."""
    from oed.design.solvers.weights_clarabel import elfving

    plant = named_plant("reference")
    information = information_map(plant)
    problem = Problem(
        information,
        criterion_of("damping:1", plant, information),
        power_budgets(information, 1.0),
        np.linspace(0.3, 2.0, 60),
    )
    found = direction_exchange(problem, refine=False, tolerance=1e-8)
    columns = problem.columns(problem.omega, np.ones((60, 1), dtype=complex))
    twin = elfving(columns, problem.criterion, problem.constant)
    assert abs(found.gap) < 1e-8
    assert found.loss == pytest.approx(float(twin.nu.sum()), rel=1e-7)


def test_a_direction_that_no_frequency_tells_anything_of_is_stepped_over():
    """A Newton step with a singular matrix: two static entries beside two with a pole, correlated noise."""
    plant = Plant([[[0, 1], [0, 2]], [[0, 1], [0, 3]]], [[[1, -0.5], [1]], [[1, -0.2], [1, 0.3]]],
                  noise_covariance=[[2.0, 1.0], [1.0, 3.0]])  # fmt: skip
    found = solve_design(plant, "A")
    assert found.gap < 1e-9
    white = np.linalg.inv(
        information_of_spectrum(
            plant, Spectrum(np.pi * (np.arange(4000) + 0.5) / 4000, np.tile(np.eye(2) / 8000, (4000, 1, 1)))
        )
    ).trace()
    assert found.bound <= found.loss < white


@pytest.mark.parametrize("rounds", [0, 1])
def test_a_path_that_rounding_ends_keeps_the_best_design(three, rounds, monkeypatch):
    """A 3 x 3 plant of order 20 had ended in a LinAlgError; it is solved from the rounds before."""
    follow, done = _Dual.follow, []

    def rounded(self, *args):
        done.append(self)
        if len(done) > rounds:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return follow(self, *args)

    monkeypatch.setattr(_Dual, "follow", rounded)
    if rounds:
        design = solve_design(three, "gain:0.5")
        assert design.bound <= design.loss < 1.1 * design.bound
    else:
        with pytest.raises(SolverFailure, match="poles farther from the circle"):
            solve_design(three, "gain:0.5")
