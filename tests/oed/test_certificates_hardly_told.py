"""Designs whose parameters double precision hardly tells apart: what they say is true of their lines, to all digits that are printed."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from oed.criteria import d_criterion
from oed.design import (
    masked_design,
    solve_design,
)
from oed.design.assembling import certified
from oed.design.problem.budgets import power_budgets
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.grid import frequency_grid
from oed.design.problem.information_maps import information_map
from oed.design.problem.lines import Problem
from oed.design.solvers.column_generation import Exchange
from oed.errors import Status
from oed.plants.plant import Plant
from tests.oed.test_certificates_challenged import WITHIN, hard_plants, verdict
from tests.oracles.digits import exact_loss, pole_slope


@pytest.fixture(scope="module")
def hardly_told():
    """Order 15, nearly equal poles: information of a condition of 1e23."""
    return next(islice(hard_plants(24, 48), 47, None))


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_a_loss_keeps_its_digits_where_double_precision_hardly_tells_the_parameters_apart(
    criterion, hardly_told
):
    """It was 1.9e-6 below the truth and OK (D), 3.9e-6 below it (A)."""
    design = solve_design(hardly_told, criterion)
    assert design.status is Status.OK
    assert design.loss == pytest.approx(exact_loss(criterion, hardly_told, design.spectrum), rel=1e-8)


def test_a_loss_of_some_combinations_keeps_its_digits_too():
    """A gain at order 9, all poles within .002 of the circle: 8e-6 below the truth and below its own bound, as it was found
    in the model's own parameters."""
    plant = next(islice(hard_plants(24, 199), 198, None))
    design = solve_design(plant, "gain:0.5")
    assert design.status is Status.OK
    assert design.loss == pytest.approx(
        exact_loss("A", plant, design.spectrum, design.criterion.V), rel=WITHIN
    )


@pytest.mark.parametrize(
    "seed, place, criterion",
    [
        *((24, place, "pole:1") for place in (17, 22, 29, 33, 52)),
        *((24, place, "static-gain") for place in (16, 26)),
        *((77, place, "Ds") for place in (27, 57)),
    ],
)
def test_a_design_for_few_quantities_closes_where_its_information_is_singular(seed, place, criterion):
    """Gaps of 1e-7 to 6e-3, and a loss below the truth by 2e-4 (33) and 2 % (22): lines whose range had a pole to 1e-6 were taken
    to tell all of it, and Newton's steps crept along a curved boundary."""
    plant = next(islice(hard_plants(seed, place + 1), place, None))
    name = f"Ds:{plant.free[0]},{plant.free[-1]}" if criterion == "Ds" else criterion
    design, rng = solve_design(plant, name), np.random.default_rng(0)
    assert 0 <= design.gap < 1e-7
    assert verdict(plant, criterion, rng) in ("closed", "open", "untold")


def of_roots(poles, zeros, gain, delay):
    """A plant of roots of the upper half plane, the others being their conjugates."""
    pair = lambda z: (z, np.conj(z)) if np.imag(z) else (z,)
    whole = lambda roots: np.poly([each for z in roots for each in pair(z)]).real
    return Plant(np.r_[np.zeros(delay), gain * whole(zeros)], whole(poles), noise_covariance=0.01)


@pytest.fixture(scope="module")
def order_19():
    """Information of white noise of a condition of 1e26: its coefficients are told apart in orthonormal coordinates only."""
    poles = (
        .99606, .909018 + .416398j, .355619 + .772113j, -.311174 + .943568j, -.230261 + .869288j, -.812546 + .582665j,
        -.828733 + .540902j, -.846627 + .319597j, .399221 + .131148j, -.316339 + .246575j,
    )  # fmt: skip
    return of_roots(poles, (2.808679 + 0.607739j, 0.856537 + 0.516085j), 6.835, 18)


def test_a_pole_among_many_has_the_loss_of_its_lines(order_19):
    """Loss and bound were 4.5e-5 too large, and OK: what was asked for had the last digits of the coefficients."""
    p = min(
        (p for p in np.roots(order_19.den[0][0]) if p.imag >= 0),
        key=lambda p: -np.log(p).real / abs(np.log(p)),
    )
    design = solve_design(order_19, "pole:1")
    assert design.status is Status.OK
    exact = exact_loss("A", order_19, design.spectrum, pole_slope(order_19, p))
    assert design.loss / exact == pytest.approx(1.0, rel=1e-9)
    assert design.gap < 1e-8


def test_a_static_gain_costs_the_noise(order_19):
    """A plant whose gain's slope is a combination that the other parameters do not need has its own sinusoid as optimum: the
    loss is the noise's variance. At order 17 the bound was 1.4e-4 above it."""
    poles = (
        -.967149 + .249428j, -.857191 + .465137j, -.847359 + .530796j, -.7134 + .571256j, -.019977 + .853949j,
        .87018 + .492026j, .998891, .992239, .82488, .776905 + .070751j,
    )  # fmt: skip
    zeros = (
        -.910329 + 2.137909j, 1.517075, -.998476 + .055181j, -.871509 + .49038j, -.392017 + .919958j,
        .512954 + .841171j, .598475 + .801141j, .796203 + .196659j, .080571 + .12803j,
    )  # fmt: skip
    design = solve_design(of_roots(poles, zeros, 5.896, 9), "static-gain")
    assert design.status is Status.OK
    assert (design.bound, design.loss) == pytest.approx((0.01, 0.01), rel=1e-8)


@pytest.mark.parametrize(
    "criterion", ["D", "A", "E", "I", "G", "hinf", "gain:0.5", "damping:1", "Ds:b18,a2", "mask D"]
)
def test_designs_of_parameters_that_are_not_told_apart_close(order_19, criterion):
    """I, G and the scalars had been open at gaps of 1e-8 to 1e-6, as rounding hid what they ask for; in the model's own parameters
    the design's numbers belong together."""
    if criterion == "mask D":
        design = masked_design(order_19, "D", input_mask=lambda w: np.full(len(w), 20.0))
    else:
        design = solve_design(order_19, criterion)
    told = design.certificate
    assert design.status is Status.OK
    assert told.rounding < 1e-9
    assert told.X.shape[0] == design.criterion.n == len(order_19.free)
    assert design.map.factor(np.array([0.3])).shape == (1, 24, 1, 1)
    assert told.numerator == pytest.approx(design.criterion.numerator(told.X), rel=1e-2)
    assert told.bound == pytest.approx(told.numerator / told.value)


def rounded(map_, digits, order):
    """The same problem rounded anew: every frequency is moved by units in the last place, the parameters are in another order."""
    moved = lambda told: told and (lambda omega: told(omega * (1 + digits * np.finfo(float).eps))[:, order])
    names = tuple(np.array(map_.names)[order])
    return replace(map_, names=names, factor=moved(map_.factor), finer=moved(map_.finer), coordinates=None)


@pytest.mark.parametrize(
    "place, criterion",
    [(47, "D"), (47, "A"), (127, "modified-E"), (137, "modified-E"), (198, "gain:0.5")],
)
def test_no_last_digit_decides_whether_a_design_closes(place, criterion):
    """Of 137 and 198 it did: gaps of 4.4e-7 and 6.3e-7 with another BLAS, where this one had closed them by luck."""
    plant = next(islice(hard_plants(24, place + 1), place, None))
    map_ = information_map(plant)
    wanted = criterion_of(criterion, plant, map_, over_a_band=True)
    order = np.arange(map_.n)
    designs = [
        solve_design(rounded(map_, digits, order), replace(wanted, V=wanted.V[order]))
        for digits, order in ((-1, order), (1, order[::-1]), (2, np.roll(order, len(order) // 2)))
    ]
    assert [design.status for design in designs] == [Status.OK] * 3, [design.gap for design in designs]
    assert [design.loss for design in designs] == pytest.approx([designs[0].loss] * 3, rel=5e-8)


def test_a_singular_design_is_exact_in_the_models_own_parameters():
    """One line for the peak gain of order 14: the coordinates do not tell the range of its information."""
    plant = next(islice(hard_plants(24, 114), 113, None))
    design = solve_design(plant, "hinf")
    assert design.status is Status.OK
    assert len(design.spectrum) < len(plant.free) / 2


def test_a_loss_without_the_digits_is_not_ok(hardly_told):
    """The same plant by its response in double precision: what rounding does to the loss is told, whatever the gap."""
    map_ = replace(information_map(hardly_told), finer=None)
    grid = frequency_grid(map_, ((0.0, np.pi),), 400)
    problem = Problem(map_, d_criterion(map_.n), power_budgets(map_, 1.0), grid)
    spectrum = solve_design(hardly_told, "D").spectrum
    columns, w = (
        problem.columns(spectrum.omega, np.ones((len(spectrum), 1), complex)),
        spectrum.power[:, 0, 0].real,
    )
    X, loss = np.eye(map_.n), problem.loss(columns, w)
    found = Exchange(columns, w, loss, X, np.ones(1), loss, 1.0, 1.0, 1, Status.CONVERGED, problem)
    design = certified(found, tolerance=1e-8, solver="newton")
    again = [
        problem.loss(problem.columns(columns.omega * (1 + k * 2e-16), columns.direction), w) for k in range(9)
    ]
    off = np.abs(np.array(again) * problem.scale / exact_loss("D", hardly_told, spectrum) - 1).max()
    assert off > 1e-8, "the control: here the digits are not there"
    assert 0.1 * off < design.certificate.rounding < 100 * off
    assert design.gap < 1e-8
    assert not design.status.ok
    assert "rounding alone" in str(design)
