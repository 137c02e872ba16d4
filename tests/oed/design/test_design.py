"""Optimal designs against theory.md section 4, and what every certificate must satisfy."""

from __future__ import annotations

import numpy as np
import pytest

from oed.data import Spectrum
from oed.design import information_map, solve_design
from oed.design.problem.white import white_information
from oed.errors import InputError, NotIdentifiable, Status
from oed.plants.named import named_plant
from oed.plants.plant import Plant

# theory.md section 4, computed there by two independent programs; 12 printed digits.
OPTIMA = {
    "D": (0.033674015758, [(0.93726655, 0.5), (1.05275551, 0.5)], 0.220591954),
    "A": (0.339118600620, [(0.91084793, 0.46295031), (1.08986566, 0.53704969)], 1.741356784),
    "E": (0.230078614237, [(0.90738544, 0.46398609), (1.10443530, 0.53601391)], 1.169828904),
    "hinf": (1.0, [(0.98899412, 1.0)], 20.226776126),
}


@pytest.fixture(scope="module")
def designs():
    plant = named_plant("reference")
    return {name: solve_design(plant, name) for name in OPTIMA}


@pytest.mark.parametrize("name", OPTIMA)
def test_the_optima_of_the_reference_plant(designs, name):
    loss, support, white = OPTIMA[name]
    design = designs[name]
    assert design.status is Status.OK
    assert design.loss == pytest.approx(loss, rel=1e-9)
    assert abs(design.gap) < 1e-9
    assert design.efficiency_white == pytest.approx(loss / white, rel=1e-8)
    # Loss is flat at the optimum: a gap of 1e-10 leaves 1e-6 in the frequencies of E, which is not polished.
    tolerance = 1e-6 if name == "E" else 1e-8
    np.testing.assert_allclose(design.spectrum.omega, [w for w, _ in support], atol=tolerance)
    np.testing.assert_allclose(design.spectrum.power[:, 0, 0].real, [p for _, p in support], atol=tolerance)


@pytest.mark.parametrize("name", OPTIMA)
def test_the_certificate_holds_on_a_grid_the_solver_never_saw(designs, name):
    certificate = designs[name].certificate
    assert certificate.check(points=40_001) <= 1 + 1e-12
    np.testing.assert_allclose(certificate.sensitivity(designs[name].spectrum.omega), 1, atol=1e-7)
    assert certificate.bound == pytest.approx(certificate.numerator / certificate.value, rel=1e-12)


@pytest.mark.parametrize("name", OPTIMA)
def test_no_other_spectrum_beats_the_bound(designs, name, rng):
    design = designs[name]
    for _ in range(50):
        lines = rng.integers(1, 6)
        power = rng.dirichlet(np.ones(lines))
        other = Spectrum(rng.uniform(0.8, 1.2, lines), power)
        assert design.efficiency(other) <= 1 + 1e-9


def test_a_wrong_optimum_is_seen_by_the_certificate(designs):
    """Negative control: the prices of a direction that belongs to white noise exceed 1 by far."""
    design = designs["D"]
    white = white_information(design.map, design.limits, design.spectrum.total_power)
    X = design.criterion.direction(white)
    price = np.einsum("knrq,ns->ksrq", design.map.factor(np.linspace(0.5, 1.5, 500)), X)
    assert (np.abs(price) ** 2).sum(axis=(1, 2, 3)).max() > 2 * len(X)


def test_scaling_of_power_and_noise(designs):
    plant = named_plant("reference").replace(noise_variance=4.0)
    for name in ("D", "A", "E", "hinf"):
        design = solve_design(plant, name, input_power=2.0)
        assert design.loss == pytest.approx(2 * designs[name].loss, rel=1e-9)
        assert design.spectrum.total_power == pytest.approx(2.0, rel=1e-12)


@pytest.mark.parametrize("name", OPTIMA)
def test_three_powers_agree(designs, name, rng):
    """Optimiser, sum of lines, and variance of the realised signal."""
    from oed.signals.synthesis import multisine, realise

    design = designs[name]
    assert design.power_used["input power"] == pytest.approx(1.0, rel=1e-12)
    assert design.spectrum.total_power == pytest.approx(1.0, rel=1e-12)
    for u in (realise(design.spectrum, 1000, rng), multisine(design.spectrum, 1000, rng)):
        assert np.mean(np.sum(u**2, axis=1)) == pytest.approx(1.0, rel=1e-12)


def test_output_power_limit():
    """theory.md section 4: with the output's power limited, the peak-gain bound is lambda gamma^2 / P_y."""
    plant = named_plant("reference")
    design = solve_design(plant, "hinf", output_power=2.0)
    assert design.loss == pytest.approx(2.411554068769**2 / 2.0, rel=1e-9)
    assert design.power_used["output power"] == pytest.approx(2.0, rel=1e-9)
    both = solve_design(plant, "D", output_power=2.0, input_power=0.5)
    assert both.status is Status.OK
    assert both.power_used["input power"] <= 0.5 * (1 + 1e-9)
    assert both.power_used["output power"] <= 2.0 * (1 + 1e-9)


def test_known_gain_breaks_the_claim():
    """theory.md section 4: with b1, b2 known the optimum is 0.99487 at 0.9940627, under output power 0.98984."""
    plant = named_plant("reference").replace(free=("a1", "a2"))
    design = solve_design(plant, "hinf")
    assert design.loss == pytest.approx(0.99487, abs=5e-6)
    assert design.spectrum.omega == pytest.approx([0.9940627], abs=1e-7)
    gamma = 2.411554068769
    assert solve_design(plant, "hinf", output_power=gamma**2).loss == pytest.approx(0.98984, abs=5e-6)


def test_prior_information_is_counted():
    plant = named_plant("reference")
    first = solve_design(plant, "D")
    second = solve_design(plant, "D", prior=first.information)
    # As much again of the same is optimal for D: the information doubles.
    assert second.loss == pytest.approx(first.loss / 2, rel=1e-8)


def test_the_two_solvers_agree():
    plant = named_plant("reference")
    for name in ("D", "A", "E", "hinf"):
        # What Clarabel reaches through CVXPY: the semidefinite programme of E stops earlier than the others.
        tolerance = 2e-7 if name == "E" else 1e-8
        slow = solve_design(plant, name, solver="clarabel", tolerance=tolerance)
        assert slow.loss == pytest.approx(OPTIMA[name][0], rel=1e-8)
        assert slow.gap < tolerance


def test_bad_input_is_named():
    plant = named_plant("reference")
    with pytest.raises(InputError, match="must be positive and finite"):
        solve_design(plant, input_power=0.0)
    with pytest.raises(InputError, match="did you mean hinf"):
        solve_design(plant, "hinff")
    with pytest.raises(InputError, match="leave|must have"):
        solve_design(plant, band=(0.5, 4.0))
    with pytest.raises(InputError, match="does not|a system is given as float"):
        information_map(3.0)
    with pytest.raises(NotIdentifiable, match="b1"):
        solve_design(Plant([0, 1.0, 0.5], [1, 0.5]), band=(0.0, 0.0))


def test_a_grid_that_misses_the_resonance_is_seen():
    plant = named_plant("reference")
    far = np.linspace(1.5, 3.0, 20)
    # With refinement the given points are a start only: the certificate covers the band.
    assert solve_design(plant, "D", points=far).loss == pytest.approx(OPTIMA["D"][0], rel=1e-8)
    fixed = solve_design(plant, "D", points=far, refine=False)
    assert fixed.certificate.elsewhere > 10
    assert 0.8 < fixed.certificate.elsewhere_frequency < 1.2
    assert "the grid misses something" in str(fixed)
    fine = solve_design(plant, "D", points=np.linspace(0, np.pi, 20_001), refine=False)
    assert fine.certificate.elsewhere < 1 + 1e-4


def test_a_demand_that_the_power_cannot_meet_is_named():
    from oed.design import least_power_design, masked_design
    from oed.errors import InfeasibleDesign

    plant = named_plant("reference")
    with pytest.raises(InfeasibleDesign, match="demand clashes with the input power"):
        least_power_design(plant, "A", 0.1, max_power=1.0)
    assert least_power_design(plant, "A", 0.5, max_power=1.0).spectrum.total_power < 1
    with pytest.raises(InfeasibleDesign, match="clashes with the output mask"):
        masked_design(
            plant,
            input_mask=lambda w: (w < 1) * 1.0,
            output_mask=lambda w: (w > 1) * 1.0,
        )
