"""oed.design against slow algorithms: Fedorov's, the multiplicative one, Elfving's theorem as a linear programme."""

from __future__ import annotations

import numpy as np
import pytest

from oed.design import solve_design
from oed.plants.named import named_plant
from oed.plants.norms import gain_gradient, peak
from oed.plants.plant import Plant
from tests.oracles import designs, information

SISO = ("two-peaks", "nonminimum-phase", "peak-at-zero")


def pair(plant):
    return [[list(map(float, b)) for b in row] for row in plant.num], [
        [list(map(float, a)) for a in row] for row in plant.den
    ]


def grid(plant, lines: int, extra=()) -> np.ndarray:
    return np.unique(np.r_[np.linspace(0.0, np.pi, lines), np.asarray(extra, dtype=float)])


@pytest.mark.parametrize("criterion", ["D", "A"])
@pytest.mark.parametrize("name", SISO)
def test_brackets_of_siso_designs(name, criterion) -> None:
    """Whatever the slow algorithm has reached after its rounds, the optimum over the same lines lies between its bound and its loss.

    The suite is given these very lines and no others, so that the bracket holds without a word about grids.
    """
    plant = named_plant(name)
    omega = grid(plant, 240)
    derivative = information.response_derivative(pair(plant), omega)
    oracle = designs.vertex_direction(derivative, criterion, rounds=150)
    found = solve_design(plant, criterion, points=omega, refine=False)
    assert found.loss <= oracle["loss"] * (1 + 1e-7)  # finite differences: 1e-9 times the conditioning
    assert found.loss >= oracle["bound"] * (1 - 1e-7)
    assert oracle["loss"] / oracle["bound"] < 1.2  # a bracket that says something
    free = solve_design(plant, criterion)
    assert free.loss <= found.loss * (1 + 1e-9)
    fine = designs.atoms(pair(plant), grid(plant, 20001, free.spectrum.omega))
    matrix = designs.of_atoms(
        designs.atoms(pair(plant), free.spectrum.omega), free.spectrum.power[:, 0, 0].real
    )
    assert designs.loss(criterion, matrix) == pytest.approx(free.loss, rel=1e-6)
    assert (
        designs.sensitivity(criterion, matrix, fine).max() < 1 + 1e-5
    )  # the oracle's own equivalence theorem


@pytest.mark.parametrize("criterion", ["D"])
def test_support_and_loss_of_another_plant(criterion) -> None:
    plant = named_plant("nonminimum-phase")
    oracle = designs.optimal(criterion, pair(plant), lines=401)
    found = solve_design(plant, criterion)
    assert oracle["gap"] < 1e-5
    # the oracle's search stops within its gap of the optimum
    assert found.loss == pytest.approx(oracle["loss"], rel=1e-6)
    assert found.loss <= oracle["loss"] * (1 + 1e-9)


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_brackets_of_mimo_designs(criterion, rng) -> None:
    plant = named_plant("three-by-two")
    root = rng.standard_normal((3, 3)) * 0.4 + np.eye(3)
    plant = plant.replace(noise_covariance=root @ root.T)
    omega = grid(plant, 60)
    whiten = np.linalg.inv(np.linalg.cholesky(plant.noise_covariance))
    derivative = np.einsum("ab,nkbc->nkac", whiten, information.response_derivative(pair(plant), omega))
    oracle = designs.vertex_direction(derivative, criterion, rounds=150)
    found = solve_design(plant, criterion, points=omega, refine=False)
    assert found.loss <= oracle["loss"] * (1 + 1e-7)
    assert found.loss >= oracle["bound"] * (1 - 1e-7)
    assert oracle["loss"] / oracle["bound"] < 1.5


@pytest.mark.parametrize("name", ["delay", "nonminimum-phase", "peak-at-pi"])
def test_peak_gain_by_elfving(name) -> None:
    plant = named_plant(name, 0.7)
    at = peak(plant).frequency
    omega = grid(plant, 401, np.clip(at + np.linspace(-5e-3, 5e-3, 201), 0, np.pi))
    c = gain_gradient(plant)
    oracle = designs.elfving(designs.atoms(pair(plant), omega), c)
    found = solve_design(plant, "hinf")
    # theory 4: a free numerator, so lambda_e / power; the grid's optimum is at least as large and no more than 1e-4 above
    assert found.loss == pytest.approx(0.7, rel=1e-8)
    assert found.loss <= 0.7 * oracle["upper"] * (1 + 1e-7)
    assert found.loss >= 0.7 * oracle["lower"] * (1 - 1e-4)


def test_peak_gain_with_known_numerator() -> None:
    """theory 4: with b1, b2 known the optimum is .99487 of lambda_e: below what the theorem gives for all parameters."""
    plant = named_plant("reference").replace(free=("a1", "a2"))
    omega = grid(plant, 801, 0.9940627 + np.linspace(-5e-3, 5e-3, 201))
    g = designs.atoms(pair(plant), omega)[:, 2:]
    oracle = designs.elfving(g, gain_gradient(plant))
    found = solve_design(plant, "hinf")
    assert found.loss == pytest.approx(oracle["upper"], rel=1e-6)
    assert found.loss == pytest.approx(0.99487, abs=5e-6)


@pytest.mark.parametrize("free", ["all", "denominators"])
def test_peak_gain_of_mimo_by_elfving(free) -> None:
    """The linear programme's cuts bracket the optimum over its lines to 1e-2; what the spacing of the lines may cost is 1e-3."""
    num = [[[0, 0.5], [0, 0.2]], [[0, -0.3], [0, 0.4]]]
    den = [[[1, -1.2, 0.72], [1, -0.5]], [[1, 0.4], [1, 0.2]]]
    covariance = [[1.0, 0.5], [0.5, 2.0]] if free == "denominators" else 0.5
    plant = Plant(num, den, noise_covariance=covariance)
    if free == "denominators":
        plant = plant.replace(free=tuple(name for name in plant.all_names if name.startswith("a")))
    at = peak(plant).frequency
    omega = grid(plant, 61, at + np.linspace(-0.05, 0.05, 41))
    names, _ = information.parameters(pair(plant))
    keep = [names.index(name) for name in plant.free]
    whiten = np.linalg.inv(np.linalg.cholesky(plant.noise_covariance))
    derivative = np.einsum("ab,nkbc->nkac", whiten, information.response_derivative(pair(plant), omega)[keep])
    lower, upper = designs.elfving_matrices(derivative, gain_gradient(plant), tolerance=1e-2)
    found = solve_design(plant, "hinf")
    if free == "all":
        assert found.loss == pytest.approx(0.5, rel=1e-7)  # theory 4, MIMO: lambda_e
    assert upper <= lower * (1 + 1e-2)
    assert found.loss <= upper * (1 + 1e-6)
    assert found.loss >= lower * (1 - 1e-3)


@pytest.mark.parametrize("name, boxes", [("reference", [(0.7, 1.0), (1.0, 1.3), (0.2, 0.8)])])
def test_smallest_eigenvalue(name, boxes) -> None:
    plant = named_plant(name)
    oracle = designs.smallest_eigenvalue_two_lines(pair(plant), boxes)
    found = solve_design(plant, "E")
    assert found.loss <= oracle["loss"] * (1 + 1e-9)
    assert found.loss == pytest.approx(oracle["loss"], rel=1e-6)  # the search stops above a kink
    matrix = designs.of_atoms(
        designs.atoms(pair(plant), found.spectrum.omega), found.spectrum.power[:, 0, 0].real
    )
    bound = designs.smallest_eigenvalue_bound(matrix, designs.atoms(pair(plant), np.linspace(0, np.pi, 8001)))
    assert 1.0 / bound <= found.loss * (
        1 + 1e-5
    )  # of the 8001 lines, of which none is exactly a support point
    assert 1.0 / bound >= found.loss * (1 - 1e-4)
