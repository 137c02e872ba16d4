"""Modified E, fixed-basis and autoregressive spectra: closed forms, brute force, certificates, three powers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from oed.criteria import condition_criterion
from oed.data import Spectrum
from oed.design import (
    autoregressive_design,
    band_basis,
    basis_design,
    information_map,
    solve_design,
)
from oed.design.parametrisations.shaped import step_down, step_up
from oed.errors import InputError, NotIdentifiable
from oed.plants.named import named_plant
from oed.plants.plant import Plant
from oed.signals.synthesis import realise
from tests.oracles.certificates import least_condition

GRID = np.concatenate([[0.01, 0.4, 0.7], np.linspace(0.85, 1.15, 7), [1.4, 2.0, 3.1]])


@pytest.fixture(scope="module")
def plant():
    return named_plant("reference")


def test_condition_number_of_a_fir_model_has_a_closed_form():
    """Unit power at lags 0 and 1: M = P [[1, r], [r, 1]], best at r = 0; with diag(1, 3) known, (3 + P) / (1 + P)."""
    fir = Plant([0, 1.0, 0.5], [1.0])
    assert solve_design(fir, "modified-E").loss == pytest.approx(1.0, abs=1e-7)
    for power in (0.1, 2.0):
        known = solve_design(fir, "modified-E", prior=np.diag([1.0, 3.0]), input_power=power, tolerance=1e-6)
        assert known.loss == pytest.approx((3 + power) / (1 + power), rel=1e-6)
        assert abs(known.gap) < 1e-6
    units = condition_criterion(2, [1.0, 2.0])
    assert solve_design(fir, units).loss == pytest.approx(4.0, rel=1e-6)


def test_no_spectrum_is_better_conditioned(plant, rng):
    design = solve_design(plant, "modified-E")
    assert abs(design.gap) < 1e-7
    assert design.loss == pytest.approx(np.linalg.cond(design.information), rel=1e-12)
    # A vertex of the many optima (Caratheodory): at most n (n + 1) / 2 + 1 lines.
    assert len(design.spectrum) <= 11
    assert design.certificate.check(points=20_001) <= 1 + 1e-7
    information = information_map(plant)
    atoms = np.stack([information.of_spectrum(Spectrum(np.array([w]), [1.0])) for w in GRID])
    condition = lambda x: float(np.linalg.cond(np.einsum("k,kij->ij", np.exp(x - x.max()), atoms)))
    starts = rng.standard_normal((6, len(GRID)))
    best = min(minimize(condition, x, method="Powell", options={"maxiter": 15}).fun for x in starts)
    # A general search over weights stays above the bound and arrives at it.
    assert design.bound * (1 - 1e-9) <= best <= 1.001 * design.bound
    with pytest.raises(InputError, match="input power only"):
        solve_design(plant, "modified-E", output_power=1.0)
    with pytest.raises(NotIdentifiable):
        solve_design(plant, "modified-E", band=(0.5, 0.5))


def test_several_inputs_are_conditioned_too():
    design = solve_design(named_plant("three-by-two"), "modified-E", tolerance=1e-5)
    assert 0 <= design.gap < 1e-5
    assert design.efficiency_white < 0.1
    assert len(design.spectrum) <= 40


@pytest.mark.parametrize("seed", [4, 6, 24])
def test_least_condition_numbers_are_closed_and_no_cone_programme_finds_a_better_one(seed):
    """Easy plants, one channel and two, that were refused or left with gaps to 2e-2 (lines in units of their mean)."""
    rng, channels = np.random.default_rng(seed), 2 - seed // 24
    roots = lambda: (
        np.poly((r := rng.uniform(0.5, 0.95) * np.exp(1j * rng.uniform(0.1, 3)), r.conjugate())).real
    )
    each = [[(np.append(0, rng.normal(size=2)), roots()) for _ in range(channels)] for _ in range(channels)]
    plant = Plant(
        [[b for b, _ in row] for row in each], [[a for _, a in row] for row in each], noise_covariance=1.0
    )
    design = solve_design(plant, "modified-E", tolerance=1e-8)
    assert design.status.ok
    assert len(design.spectrum) <= 2 * design.map.n + 1
    assert np.linalg.cond(design.information) == pytest.approx(design.loss, rel=1e-9)
    least = least_condition(plant, design.spectrum, points=60)
    assert least == pytest.approx(design.bound, rel=1e-5)  # Clarabel's accuracy
    assert design.bound <= least * (1 + 1e-6)


@pytest.mark.parametrize("name", ["D", "E"])
def test_basis_and_autoregressive_spectra_lie_above_the_certified_optimum(plant, name, rng):
    free = solve_design(plant, name)
    coarse = basis_design(plant, name, band_basis(np.linspace(0, np.pi, 9)))
    fine = basis_design(plant, name, band_basis(np.linspace(0, np.pi, 33)))
    ar = [autoregressive_design(plant, name, order=p, radius=0.95) for p in (0, 2, 4)]
    white = free.loss / free.efficiency_white
    assert ar[0].loss == pytest.approx(white, rel=1e-9)
    assert free.bound < ar[2].loss <= ar[1].loss * (1 + 1e-9) < white
    # The coarse bands are sums of the fine ones.
    assert free.bound < fine.loss < coarse.loss < white
    for shaped in (coarse, fine):
        assert abs(shaped.loss / shaped.own_bound - 1) < 1e-7
    for shaped in (coarse, fine, *ar):
        assert shaped.bound == pytest.approx(free.bound, rel=1e-5)
        # Three powers: the optimiser's, the sum of the lines, the variance of the realised signal.
        u = realise(shaped.spectrum, 2000, rng)
        powers = [shaped.power, shaped.spectrum.total_power, float(np.mean(u**2))]
        np.testing.assert_allclose(powers, 1.0, rtol=1e-9)
    assert np.abs(np.roots(ar[2].coefficients)).max() <= 0.95 + 1e-9


def test_the_best_basis_weights_against_a_general_optimiser(plant):
    basis = band_basis(np.linspace(0.6, 1.4, 5))
    found = basis_design(plant, "D", basis)
    information = information_map(plant)
    # Each band on a grid of its own: one over [0, pi] misses its edges, and 1e-3 of the loss with them.
    inside = [a + 0.2 * (np.arange(1000) + 0.5) / 1000 for a in (0.6, 0.8, 1.0, 1.2)]
    parts = np.stack([information.of_spectrum(Spectrum(omega, np.full(1000, 1e-3))) for omega in inside])
    share = lambda x: np.exp(x) / np.exp(x).sum()
    twin = minimize(
        lambda x: -np.linalg.slogdet(np.einsum("k,kij->ij", share(x), parts))[1], np.zeros(4), tol=1e-12
    )
    assert found.loss == pytest.approx(np.exp(twin.fun / 4), rel=1e-6)
    np.testing.assert_allclose(found.coefficients, share(twin.x), atol=2e-3)


def test_two_poles_against_a_fine_grid(plant):
    """Twin: every pair of poles on a grid of moduli and angles."""
    found = autoregressive_design(plant, "A", order=2, radius=0.95)
    information = information_map(plant)
    omega = (np.arange(2048) + 0.5) * np.pi / 2048
    losses = []
    for modulus in np.linspace(0.8, 0.95, 16):
        for angle in np.linspace(0.9, 1.2, 31):
            A = np.abs(np.polyval([1, -2 * modulus * np.cos(angle), modulus**2], np.exp(1j * omega))) ** 2
            spectrum = Spectrum(omega, (1 / A) / np.sum(1 / A))
            losses.append(np.trace(np.linalg.inv(information.of_spectrum(spectrum))))
    assert found.loss <= min(losses) * (1 + 1e-9)
    assert found.loss == pytest.approx(min(losses), rel=2e-3)


def test_reflection_coefficients_and_polynomials_are_one_to_one(rng):
    k = rng.uniform(-0.9, 0.9, 6)
    np.testing.assert_allclose(step_down(step_up(k)), k, atol=1e-12)
    assert np.abs(np.roots(step_up(k))).max() < 1


def test_bad_shapes_are_named(plant):
    with pytest.raises(InputError, match="negative"):
        basis_design(plant, "D", [lambda w: np.cos(w)])
    with pytest.raises(InputError, match="not Hermitian"):
        basis_design(plant, "D", [lambda w: 1j * w])
    with pytest.raises(InputError, match="has the shape"):
        basis_design(named_plant("three-by-two"), "D", [np.ones_like])
    with pytest.raises(InputError, match="empty"):
        basis_design(plant, "D", [])
    with pytest.raises(InputError, match="edges"):
        band_basis([1.0, 0.5])
    with pytest.raises(InputError, match="radius"):
        autoregressive_design(plant, radius=1.0)
    with pytest.raises(InputError, match="order"):
        autoregressive_design(plant, order=-1)
    with pytest.raises(InputError, match="one input"):
        autoregressive_design(named_plant("three-by-two"))
