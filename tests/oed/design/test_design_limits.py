"""Limits on rates, Hermitian masks, quantiles over plants, designs in a loop, and three powers on every parametrisation."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from oed.criteria import a_criterion
from oed.data import Spectrum
from oed.design import (
    amplitude_design,
    autocorrelation_design,
    masked_design,
    moment_design,
    quantile_design,
    robust_design,
    solve_design,
)
from oed.design.parametrisations.amplitude import slew_limited
from oed.design.problem.masks import _newton_step
from oed.errors import InfeasibleDesign, InputError, Status
from oed.plants.named import named_plant
from oed.plants.plant import Plant
from oed.signals.synthesis import realise


@pytest.fixture(scope="module")
def plant():
    return named_plant("reference")


def _plants(plant, count: int) -> list:
    rng = np.random.default_rng(1)
    pole = lambda: rng.uniform(0.7, 0.95) * np.exp(1j * rng.uniform(0.7, 1.3))
    return [plant.replace(den=np.poly([p, p.conjugate()]).real) for p in (pole() for _ in range(count))]


@pytest.mark.parametrize("name", ["moments", "autocorrelation", "masked", "multisine", "output-limited"])
def test_three_powers_on_every_parametrisation(plant, name, rng):
    """The optimiser's own variables, the sum of the lines, the variance of the realised signal."""
    power = 2.5
    if name == "moments":
        found = moment_design(plant, "D", input_power=power)
        own = found.power
    elif name == "autocorrelation":
        found = autocorrelation_design(plant, "D", lags=12, input_power=power)
        own = found.power
    elif name == "masked":
        found = masked_design(plant, "D", input_mask=lambda w: np.full(w.shape, 20.0), input_power=power)
        own = found.power_used["input power"]
    elif name == "multisine":
        lines = 2 * np.pi * np.arange(501) / 1000
        found = solve_design(plant, "D", input_power=power, points=lines, refine=False)
        own = found.power_used["input power"]
    else:
        found = solve_design(plant, "D", input_power=power, output_power=1.0)
        own, power = found.power_used["input power"], found.spectrum.total_power
    u = realise(found.spectrum, 1000, rng)
    # Clarabel keeps equalities to about 1e-9.
    np.testing.assert_allclose([own, found.spectrum.total_power, np.mean(u**2)], power, rtol=1e-7)


def test_a_rate_limit_is_a_power_of_the_differences(plant, rng):
    wide, _ = amplitude_design(plant, "D", 1.0, 400, rng, tries=1)
    design, made = amplitude_design(plant, "D", 1.0, 400, rng, rate=0.3, tries=1)
    assert np.abs(made.u).max() <= 1 + 1e-12
    assert np.abs(np.diff(made.u, axis=0, prepend=0.0)).max() <= 0.3 * (1 + 1e-12)
    change = np.sum(
        design.spectrum.power[:, 0, 0].real * np.abs(1 - np.exp(-1j * design.spectrum.omega)) ** 2
    )
    assert change == pytest.approx(0.09, rel=1e-6)
    assert design.power_used["rate of input 1"] == pytest.approx(0.09, rel=1e-6)
    assert abs(design.gap) < 1e-7
    assert design.loss > wide.loss
    assert made.loss > design.bound
    # A rate that the amplitude allows anyway changes nothing.
    free, _ = amplitude_design(plant, "D", 1.0, 400, rng, rate=2.5, tries=1)
    assert free.loss == wide.loss
    steps = slew_limited(np.array([[1.0], [1.0], [-1.0]]), 0.4)
    np.testing.assert_allclose(steps[:, 0], [0.4, 0.8, 0.4])
    with pytest.raises(InputError, match="limit a power too"):
        solve_design(plant, "D", rate_power=[1.0])
    with pytest.raises(InputError, match="the rate is"):
        amplitude_design(plant, "D", 1.0, 100, rng, rate=0.0)


def test_a_hermitian_mask_on_one_input_is_the_scalar_mask(plant):
    scalar = masked_design(plant, "D", input_mask=lambda w: 8.0 + 0 * w)
    matrix = masked_design(plant, "D", input_mask=lambda w: (8.0 + 0 * w)[:, None, None])
    assert matrix.loss == pytest.approx(scalar.loss, rel=1e-9)
    assert 0 <= matrix.gap < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("criterion", ["D", "A", "E"])
def test_autocorrelations_of_several_inputs(criterion):
    """MOOSE2's parametrisation: between white noise and the certified optimum, better with every lag."""
    three = named_plant("three-by-two")
    free = solve_design(three, criterion, tolerance=1e-5)
    found = [autocorrelation_design(three, criterion, lags=L, input_power=2.0) for L in (0, 2, 5)]
    losses = [2 * one.loss for one in found]
    assert free.bound < losses[2] < losses[1] < losses[0] <= free.loss / free.efficiency_white * (1 + 1e-6)
    for one in found:
        R = one.coefficients
        # Three powers: the optimiser's, the lines', and the trace of the autocorrelation at lag 0.
        np.testing.assert_allclose([one.power, one.spectrum.total_power, np.trace(R[0])], 2.0, rtol=1e-6)
        # Phi = sum_l R_l e^-jlw is what the lines say, and positive semidefinite between them too.
        turns = np.exp(-1j * np.outer(np.linspace(0, np.pi, 2001), np.arange(len(R))))
        half = np.einsum("kl,lpq->kpq", turns, R) - R[0] / 2
        assert np.linalg.eigvalsh(half + half.conj().swapaxes(1, 2)).min() > -1e-6


def test_the_correlation_of_two_inputs_has_a_closed_form():
    """y_t = b1 u1_(t-1) + b2 u2_(t-2): M = [[1/2, r], [r, 1/2]] with r = E u1_(t+1) u2_t, best at 2 r = 1/2 for W = 0.8."""
    delays = Plant([[[0, 1.0], [0, 0, 1.0]]], [[[1.0], [1.0]]])
    criterion = a_criterion(2, np.array([[1.0, 0.8], [0.8, 1.0]]))
    found = autocorrelation_design(delays, criterion, lags=1)
    assert found.loss == pytest.approx(4 * (1 - 0.8 * 0.5) / (1 - 0.5**2), rel=1e-7)
    # Not its transpose: the other way round the plant does not see it.
    assert found.coefficients[1][0, 1] == pytest.approx(0.25, abs=1e-4)
    spectrum = found.spectrum
    for lag in range(2):
        own = np.einsum("kpq,k->pq", spectrum.power, np.exp(1j * lag * spectrum.omega)).real
        np.testing.assert_allclose(own, found.coefficients[lag], atol=1e-6)
    white = autocorrelation_design(delays, criterion, lags=0)
    assert white.loss == pytest.approx(4.0, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("criterion", "both", "gap"),
    [
        ("D", False, 1e-6),
        ("A", False, 1e-3),
        pytest.param("A", False, 1e-6, marks=pytest.mark.validate),
        ("E", False, 1e-6),
        ("D", True, 1e-3),
        pytest.param("D", True, 1e-4, marks=pytest.mark.validate),
    ],
)
def test_hermitian_masks_are_kept_and_certified(criterion, both, gap):
    """Twin: on 24 cells with the masks at their centres, CVXPY's optimum is no better than the bound allows."""
    three = named_plant("three-by-two")
    skew = np.array([[2.0, 0.5 + 0.5j], [0.5 - 0.5j, 3.0]])
    masks = {"input_mask": lambda w: np.broadcast_to(skew, (len(w), 2, 2))}
    if both:
        masks["output_mask"] = lambda w: np.broadcast_to(2 * np.eye(3), (len(w), 3, 3))
    design = masked_design(three, criterion, **masks, tolerance=gap)
    assert design.status is Status.OK
    assert design.spectrum.total_power <= 1 + 1e-9
    # A sum of lines over any part of the band is at most the mask over it, and the lines next to a node are its own.
    omega, power = design.spectrum.omega, design.spectrum.power
    edges = np.linspace(0, np.pi, 41)
    for low, high in pairwise(edges):
        own = power[(omega >= low) & (omega < high)].sum(axis=0)
        assert np.linalg.eigvalsh(skew * (high - low) / np.pi * 1.3 - own).min() > -1e-9
    free = solve_design(three, criterion, tolerance=1e-5)
    assert design.loss > free.loss
    rng = np.random.default_rng(5)
    centres = (np.arange(400) + 0.5) * np.pi / 400
    G = three.response(centres)[0]
    root = np.linalg.cholesky(skew)
    for _ in range(20):
        v = rng.standard_normal((400, 2)) + 1j * rng.standard_normal((400, 2))
        v /= np.linalg.norm(v, axis=1)[:, None]
        peak = rng.uniform(0, np.pi)
        height = np.exp(-(((centres - peak) / 0.3) ** 2))[:, None, None]
        P = height * np.einsum("qr,kr,ks,ts->kqt", root, v, v.conj(), root.conj()) / 400
        if both:
            most = np.linalg.eigvalsh(G @ P @ G.conj().swapaxes(1, 2))[:, -1] * 400 / 2
            P /= np.maximum(most, 1)[:, None, None]
        P *= min(1.0, 1 / np.einsum("kii->", P).real)
        assert design.efficiency(Spectrum(centres, P)) <= 1 + 1e-9


def test_bad_matrix_masks_are_named():
    three = named_plant("three-by-two")
    constant = lambda values: lambda w: np.broadcast_to(np.array(values), (len(w), 2, 2))
    with pytest.raises(InputError, match="not Hermitian at"):
        masked_design(three, "D", input_mask=constant([[1.0, 0.5], [0.0, 1.0]]))
    with pytest.raises(InputError, match="negative eigenvalue"):
        masked_design(three, "D", input_mask=constant([[1.0, 2.0], [2.0, 1.0]]))
    with pytest.raises(InfeasibleDesign, match="0 at every frequency"):
        masked_design(three, "D", input_mask=constant(np.zeros((2, 2))))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "height"),
    [("hinf", 2.0), pytest.param("static-gain", 3.0, marks=pytest.mark.validate), ("Ds:b1_11,b1_21", 4.0)],
)
def test_scalars_under_hermitian_masks(name, height):
    three = named_plant("three-by-two")
    mask = lambda w: np.broadcast_to(height * np.eye(2), (len(w), 2, 2))
    design = masked_design(three, name, input_mask=mask, tolerance=1e-5)
    assert design.status is Status.OK
    assert 0 <= design.gap < 1e-5
    assert design.spectrum.total_power <= 1 + 1e-9
    free = solve_design(three, name, tolerance=1e-6)
    assert design.loss >= free.bound * (1 - 1e-9)


@pytest.mark.slow
def test_quantile_designs_against_every_subset(plant):
    plants = _plants(plant, 5)
    found = quantile_design(plants, "E", quantile=0.6)
    assert found.status is Status.OK
    # Twin: the minimax design of every subset of three.
    every = min(
        robust_design([plants[j] for j in chosen], "E", how="minimax", tolerance=1e-6).loss
        for chosen in combinations(range(5), 3)
    )
    assert found.value == pytest.approx(every, rel=1e-5)
    assert np.sort(found.losses)[2] == pytest.approx(found.value, rel=1e-12)
    assert found.bound <= found.value
    whole = quantile_design(plants[:3], "E", quantile=1.0)
    assert whole.value == pytest.approx(
        robust_design(plants[:3], "E", how="minimax", tolerance=1e-6).loss, rel=1e-5
    )
    # D: two of three against every pair.
    pairs = min(
        robust_design([plants[j] for j in chosen], "D", how="minimax", tolerance=1e-6).loss
        for chosen in combinations(range(3), 2)
    )
    assert quantile_design(plants[:3], "D", quantile=0.6).value == pytest.approx(pairs, rel=1e-5)
    # Cut short, it still bounds and says that it is not done.
    short = quantile_design(plants, "A", quantile=0.6, max_designs=5)
    assert short.status is Status.INACCURATE
    assert short.bound <= quantile_design(plants, "A", quantile=0.6).value * (1 + 1e-5)
    with pytest.raises(InputError, match="quantile"):
        quantile_design(plants, quantile=0.0)
    with pytest.raises(InputError, match="at least one plant"):
        quantile_design([])


def test_a_curvature_that_rounding_left_singular_still_gives_a_step():
    H = np.stack([np.diag([4.0, 1.0]), np.array([[1.0, 1.0], [1.0, 1.0]])])
    g = np.array([[4.0, 1.0], [1.0, 1.0]])
    steps = _newton_step(H, g)
    np.testing.assert_allclose(steps[0], [1.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(steps[1], [0.5, 0.5], rtol=1e-9)
    np.testing.assert_allclose(_newton_step(H[:1], g[:1]), steps[:1], rtol=1e-12)
