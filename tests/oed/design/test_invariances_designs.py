"""Designs, fits and residual tests in other units, with other labels, in other parameters."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.pem import identify
from estimators.residual.tests import autocorrelation, cross_correlation
from oed.criteria import a_criterion
from oed.data import Record
from oed.design import solve_design
from oed.information import information_of_records
from oed.plants.named import named_plant
from oed.plants.plant import Plant

UNITS = (1e-6, 1.0, 3.7e5)


def gains(design) -> np.ndarray:
    return np.array([np.trace(P).real for P in design.spectrum.power])


@pytest.mark.parametrize("criterion", ["D", "hinf"])
@pytest.mark.parametrize("unit", [1e-5, 4e4])
def test_design_in_other_units(criterion, unit) -> None:
    """y' = r y: D-optimality does not care, its loss changes by det(d theta / d theta'); the peak gain's variance by r^2.

    u' = s u with the power limit in u' units: the same signal.
    """
    plant = named_plant("reference", 0.5)
    base = solve_design(plant, criterion)
    output = plant.replace(num=[[unit * plant.num[0][0]]], noise_variance=0.5 * unit**2)
    found = solve_design(output, criterion)
    factor = unit**2 if criterion == "hinf" else unit ** (2 * 2 / 4)  # two of the four parameters are gains
    assert found.status.ok
    assert found.loss == pytest.approx(factor * base.loss, rel=1e-8, abs=0)
    assert found.spectrum.omega == pytest.approx(base.spectrum.omega, abs=1e-6)
    inputs = plant.replace(num=[[plant.num[0][0] / unit]])
    found = solve_design(inputs, criterion, input_power=unit**2)
    factor = unit**-2 if criterion == "hinf" else unit ** (-2 * 2 / 4)
    assert found.loss == pytest.approx(factor * base.loss, rel=1e-8, abs=0)
    assert gains(found) == pytest.approx(unit**2 * gains(base), rel=1e-4, abs=0)


@pytest.mark.parametrize("criterion", ["D", "hinf", "static-gain"])
@pytest.mark.parametrize("unit", [2.0**33, 2.0**133, 2.0**-133])
def test_a_prior_in_other_units(criterion, unit) -> None:
    """Outputs in units 1e10 times smaller had a static gain's design 15 % off its bound, at 1e30 none: little in the prior was
    lost beside much. Powers of two, so that not a bit of the data changes."""
    rng = np.random.default_rng(0)
    applied, plant = [rng.standard_normal((200, 1))], named_plant("reference", 0.01)
    designs = []
    for output in (plant, plant.replace(num=[[unit * plant.num[0][0]]], noise_variance=0.01 * unit**2)):
        designs.append(solve_design(output, criterion, prior=information_of_records(output, applied) / 200))
    base, found = designs
    assert found.status.ok
    assert found.spectrum.omega == pytest.approx(base.spectrum.omega, abs=1e-6)
    assert gains(found) == pytest.approx(gains(base), rel=1e-4)


@pytest.mark.parametrize("criterion", ["D", "A", "E", "hinf"])
def test_design_in_other_time_and_frequency(criterion) -> None:
    """A delay changes nothing; G(-z) mirrors the support."""
    plant = named_plant("nonminimum-phase")
    base = solve_design(plant, criterion)
    late = solve_design(plant.replace(num=[[np.r_[0.0, 0.0, plant.num[0][0]]]], free=()), criterion)
    assert late.loss == pytest.approx(base.loss, rel=1e-8)
    assert late.spectrum.omega == pytest.approx(base.spectrum.omega, abs=1e-5)
    flip = lambda m: [[b * (-1.0) ** np.arange(len(b)) for b in row] for row in m]
    other = solve_design(plant.replace(num=flip(plant.num), den=flip(plant.den)), criterion)
    # each of the two is certified to its gap of at most 1e-7
    assert other.loss == pytest.approx(base.loss, rel=2e-7)
    assert np.sort(np.pi - other.spectrum.omega) == pytest.approx(base.spectrum.omega, abs=1e-5)


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_design_with_other_labels(criterion) -> None:
    """Outputs and inputs of a 2 x 2 plant swapped: the same loss (order of parameters is a permutation)."""
    num = [[[0, 0.5], [0, 0.2]], [[0, -0.3], [0, 0.4]]]
    den = [[[1, -1.2, 0.72], [1, -0.5]], [[1, 0.4], [1, 0.2]]]
    covariance = np.array([[1.0, 0.5], [0.5, 2.0]])
    base = solve_design(Plant(num, den, noise_covariance=covariance), criterion)
    swap = lambda m: [row[::-1] for row in m[::-1]]
    other = solve_design(Plant(swap(num), swap(den), noise_covariance=covariance[::-1, ::-1]), criterion)
    assert base.status.ok
    assert other.status.ok
    # each of the two is certified to its gap of at most 1e-7
    assert other.loss == pytest.approx(base.loss, rel=2e-7)
    total = [sum(d.spectrum.power) for d in (base, other)]
    if criterion == "D":
        # strictly concave in I, so I is unique; the spectrum that gives it need not be
        size = np.sqrt(np.outer(np.diag(base.information), np.diag(base.information)))
        rows = Plant(num, den).all_names
        moved = Plant(swap(num), swap(den)).all_names
        turn = {"1": "2", "2": "1"}
        at = [rows.index(name[:-2] + turn[name[-2]] + turn[name[-1]]) for name in moved]
        assert (
            np.abs((other.information - base.information[np.ix_(at, at)]) / size[np.ix_(at, at)]).max() < 1e-4
        )
    assert np.trace(total[0]).real == pytest.approx(1.0, rel=1e-9)
    assert np.trace(total[1]).real == pytest.approx(1.0, rel=1e-9)


def test_weighted_criterion_in_other_parameters() -> None:
    """A(W) is invariant where W goes along: parameters in other units through the plant's units, W' = J^-1 W J^-1."""
    plant = named_plant("reference")
    weight = np.diag([1.0, 2.0, 0.5, 3.0]) + 0.2
    unit = 50.0
    slope = np.array([unit if name.startswith("b") else 1.0 for name in plant.free])  # theta' = slope theta
    other = plant.replace(num=[[unit * plant.num[0][0]]], noise_variance=unit**2)
    base = solve_design(plant, a_criterion(4, weight))
    found = solve_design(other, a_criterion(4, weight / np.outer(slope, slope)))
    assert found.loss == pytest.approx(base.loss, rel=1e-8)
    assert found.spectrum.omega == pytest.approx(base.spectrum.omega, abs=1e-5)


def record(rng, n: int) -> Record:
    u = rng.standard_normal((n, 1))
    return Record(u, named_plant("reference").simulate(u) + 0.2 * rng.standard_normal((n, 1)))


@pytest.mark.parametrize("input_unit", UNITS)
@pytest.mark.parametrize("output_unit", UNITS)
def test_fit_in_other_units(input_unit, output_unit, rng) -> None:
    parts = [record(rng, 300), record(rng, 200)]
    base = identify(parts, "oe", (2, 2), 1, offset=False)
    other = [Record(input_unit * r.u, output_unit * r.y) for r in parts]
    found = identify(other, "oe", (2, 2), 1, offset=False)
    gain = output_unit / input_unit
    slope = np.array([gain, gain, 1.0, 1.0])
    spread = slope * base.standard_errors
    # the optimum is where a further step promises 1e-16 of the loss: 1e-8 of a standard error times sqrt(N)
    assert np.abs((found.theta - slope * base.theta) / spread).max() < 1e-5
    assert found.standard_errors == pytest.approx(spread, rel=1e-6, abs=0)
    assert found.noise_variance == pytest.approx(output_unit**2 * base.noise_variance, rel=1e-9, abs=0)
    assert found.fit_percent == pytest.approx(base.fit_percent, rel=1e-9)
    assert found.hinf_norm[:2] == pytest.approx([gain * x for x in base.hinf_norm[:2]], rel=1e-5, abs=0)


@pytest.mark.parametrize("kind, orders", [("oe", (2, 2)), ("bj", (2, 1, 1, 2)), ("armax", (2, 2, 2))])
def test_fit_with_other_labels_and_signs(kind, orders, rng) -> None:
    """Order of the records, sign of input and output, an offset that is asked for."""
    parts = [record(rng, 250), record(rng, 250)]
    base = identify(parts, kind, orders, 1, offset=False)
    for other in (parts[::-1], [Record(-r.u, -r.y) for r in parts]):
        found = identify(other, kind, orders, 1, offset=False)
        assert np.abs((found.theta - base.theta) / base.standard_errors).max() < 1e-5
        assert found.loss == pytest.approx(base.loss, rel=1e-9)
    level = identify(parts, kind, orders, 1, offset=True, initial="zero")
    moved = [Record(r.u + 40.0, r.y - 7.0) for r in parts]
    found = identify(moved, kind, orders, 1, offset=True, initial="zero")
    assert np.abs((found.theta - level.theta) / level.standard_errors).max() < 1e-5
    assert found.output_level == pytest.approx(level.output_level - 7.0, abs=1e-6)


def test_fit_of_exchanged_outputs(rng) -> None:
    u = rng.standard_normal((300, 1))
    first = named_plant("reference").simulate(u)
    second = named_plant("peak-at-zero").simulate(u)
    y = np.hstack([first, second]) + rng.standard_normal((300, 2)) @ np.array([[0.3, 0.2], [0.0, 0.2]])
    base = identify(Record(u, y), "oe", ([[2], [1]], [[2], [1]]), 1, offset=False)
    found = identify(Record(u, y[:, ::-1]), "oe", ([[1], [2]], [[1], [2]]), 1, offset=False)
    at = [4, 5, 0, 1, 2, 3]
    assert np.abs((found.theta - base.theta[at]) / base.standard_errors[at]).max() < 1e-4
    assert found.loss == pytest.approx(base.loss, rel=1e-9)
    assert found.noise_covariance == pytest.approx(base.noise_covariance[::-1, ::-1], rel=1e-6)


@pytest.mark.parametrize("unit", [1e-8, -3.0, 1e7])
def test_residual_tests_in_other_units(unit, rng) -> None:
    e, u = rng.standard_normal((2, 300))
    e = e + 0.1 * np.r_[0.0, u[:-1]]
    for one, two in (
        (autocorrelation(e), autocorrelation(unit * e)),
        (cross_correlation(e, u), cross_correlation(unit * e, u)),
        (cross_correlation(e, u), cross_correlation(e, unit * u)),
        (cross_correlation(e, u), cross_correlation(e, u + 100.0)),
    ):
        assert two.p_value == pytest.approx(one.p_value, rel=1e-6)
        assert np.abs(two.correlation) == pytest.approx(np.abs(one.correlation), rel=1e-8, abs=1e-9)
    parts = [e[:120], e[120:]], [u[:120], u[120:]]
    assert autocorrelation(parts[0][::-1]).p_value == pytest.approx(
        autocorrelation(parts[0]).p_value, rel=1e-9
    )
    turned = cross_correlation(parts[0][::-1], parts[1][::-1])
    assert turned.p_value == pytest.approx(cross_correlation(*parts).p_value, rel=1e-9)
