"""Designs under masks: loss and bound of densities on the whole band, against programmes on fine cells; limits kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from oed.design import masked_design, solve_design
from oed.design.parametrisations import masked, masked_polishing
from oed.design.parametrisations.densities import changes_of_sign
from oed.errors import InfeasibleDesign, InputError
from oed.plants.named import named_plant
from tests.oed.design.test_design_random import random_plant


def sharp(radius):
    pole = radius * np.exp(0.7j)
    return named_plant("reference").replace(den=[[np.poly([pole, pole.conjugate()]).real]])


def fine_cells(plant, count):
    """Edges of cells, half of them within 20 half widths of the resonance, and their information by 8 midpoints each."""
    pole = np.roots(plant.den[0][0])[0]
    near = abs(np.angle(pole)) + (1 - abs(pole)) * np.linspace(-20, 20, count // 2)
    edges = np.union1d(np.linspace(0, np.pi, count // 2), near[(near > 0) & (near < np.pi)])
    width = np.diff(edges)
    omega = edges[:-1, None] + width[:, None] * (np.arange(8) + 0.5) / 8
    d = plant.response(omega.ravel())[1][:, :, 0, 0].reshape(*omega.shape, -1)
    atoms = np.einsum("kmi,kmj->kij", d, d.conj()).real / 8 / plant.noise_covariance[0, 0]
    return edges, width / np.pi, atoms


def cells_optimum(plant, mask, count=600, rounds=3000):
    """D loss of densities constant in fine cells, by Frank and Wolfe: above the least loss, and close to it."""
    _, share, atoms = fine_cells(plant, count)
    cap = mask * share
    turn = np.linalg.inv(np.linalg.cholesky(np.einsum("kij,k->ij", atoms, share)))
    atoms = turn @ atoms @ turn.T
    w = np.minimum(cap, share)
    for k in range(rounds):
        price = np.einsum("kij,ji->k", atoms, np.linalg.inv(np.einsum("kij,k->ij", atoms, w)))
        order = np.argsort(-price)
        room = np.clip(1 - np.concatenate([[0.0], np.cumsum(cap[order])[:-1]]), 0, cap[order])
        best = np.zeros(len(w))
        best[order] = room
        w = w + 2 / (k + 3) * (best - w)
    M = np.einsum("kij,k->ij", atoms, w)
    return np.exp(-(np.linalg.slogdet(M)[1] - 2 * np.linalg.slogdet(turn)[1]) / 4)


@pytest.mark.parametrize(("radius", "mask"), [(0.9, 3.0), (0.998, 20.0), (0.9995, 100.0)])
def test_sharp_resonances_under_a_mask(radius, mask):
    """Poles .998 exp(+-.7j), mask 20: 300 cells with the information of their centres lost 2.6 times and saw no gap."""
    plant = sharp(radius)
    design = masked_design(plant, "D", input_mask=lambda omega: np.full(omega.shape, mask))
    least = cells_optimum(plant, mask)
    assert design.status.ok
    assert design.bound <= least * (1 + 1e-7)
    assert least * (1 - 2e-3) <= design.loss <= least * (1 + 1e-6)


def test_the_bound_holds_for_densities_that_the_search_never_saw(rng):
    """Random bumps within the mask, on a fine grid of their own; the control: a bound of twice the loss fails."""
    plant = sharp(0.998)
    design = masked_design(plant, "A", input_mask=lambda omega: 5 + 40 * (omega < 0.7))
    edges, share, atoms = fine_cells(plant, 4000)
    middle = (edges[1:] + edges[:-1]) / 2
    best = np.inf
    for _ in range(100):
        bump = np.exp(-(((middle - rng.uniform(0.6, 0.8)) / 10 ** rng.uniform(-3, -1)) ** 2))
        w = (5 + 40 * (middle < 0.7)) * bump * share
        w *= min(1.0, 1 / w.sum())
        best = min(best, np.trace(np.linalg.inv(np.einsum("kij,k->ij", atoms, w))))
    assert design.bound <= best < 2 * design.loss


@pytest.mark.parametrize("name", ["D", "A", "E", "hinf"])
def test_masks_are_kept_and_certified(name):
    plant = named_plant("reference")
    design = masked_design(plant, name, input_mask=lambda omega: np.full(omega.shape, 8.0))
    omega, power = design.spectrum.omega, design.spectrum.power[:, 0, 0].real
    # What lies between two nodes is at most 8 times their distance over pi, and half a node's share at each end.
    for first in range(0, len(omega) - 20, 7):
        inside = slice(first, first + 20)
        reach = omega[min(first + 20, len(omega) - 1)] - omega[max(first - 1, 0)]
        assert power[inside].sum() <= 8.0 * reach / np.pi * (1 + 1e-9)
    assert design.spectrum.total_power <= 1 + 1e-9
    assert 0 <= design.gap < 1e-6
    free = solve_design(plant, name)
    assert design.loss > free.loss
    # A flat mask of density 1 leaves white noise only.
    tight = masked_design(plant, name, input_mask=lambda omega: np.full(omega.shape, 1.0))
    assert tight.efficiency_white == pytest.approx(1.0, rel=1e-7)


def test_output_mask_and_no_mask():
    plant = named_plant("reference")
    limited = masked_design(plant, "D", output_mask=lambda omega: np.full(omega.shape, 4.0))
    omega, power = limited.spectrum.omega, limited.spectrum.power[:, 0, 0].real
    G = np.abs(plant.response(omega)[0][:, 0, 0]) ** 2
    assert (power * G).sum() <= 4.0
    assert limited.gap < 1e-6
    # Twice the mask and twice the power: half the loss.
    doubled = masked_design(plant, "D", output_mask=lambda omega: np.full(omega.shape, 8.0), input_power=2.0)
    assert doubled.loss == pytest.approx(limited.loss / 2, rel=1e-6)
    # Without a mask the density is nearly the lines of the free optimum.
    free = masked_design(plant, "D")
    exact = solve_design(plant, "D").loss
    assert exact * (1 - 1e-9) <= free.loss <= exact * (1 + 1e-5)


def test_bad_masks_are_named():
    plant = named_plant("reference")
    with pytest.raises(InputError, match="real, at least 0"):
        masked_design(plant, input_mask=lambda omega: -np.ones_like(omega))
    with pytest.raises(InputError, match="real, at least 0"):
        masked_design(plant, input_mask=lambda omega: 1j * omega)
    with pytest.raises(InfeasibleDesign, match="0 at every frequency"):
        masked_design(plant, input_mask=np.zeros_like)
    with pytest.raises(InputError, match="has the shape"):
        masked_design(named_plant("three-by-two"), input_mask=np.ones_like)


def test_where_a_density_jumps_is_found_to_the_last_digits():
    """A line, an exponential, a power and what is nearly a step; each of the fourteen cuts before had asked for fifteen points."""
    roots, points = np.array([0.3, 1.2345, 2.9, 0.7]), []

    def function(x, k):
        points.append(len(k))
        y = np.zeros(4)
        y[k] = x
        every = [
            y[0] - roots[0],
            np.expm1(3 * (y[1] - roots[1])),
            roots[2] ** 5 - y[2] ** 5,
            np.tanh(1e8 * (y[3] - roots[3])),
        ]
        return np.array(every)[k]

    low, high = np.array([0, 1, 2, 0.6]), np.array([3, 2, 3.1, 0.8])
    values = [function(end, np.arange(4)) for end in (low, high)]
    found = changes_of_sign(function, (low, high), (values[0], values[1]))
    np.testing.assert_allclose(found, roots, rtol=1e-15)
    assert sum(points) < 0.25 * 4 * 14 * 15


def test_rounding_ends_the_search_for_a_price(monkeypatch):
    """At 32 parameters the conditions stay at 1e-11, and seventeen of twenty-three steps were in vain, half of a minute."""
    asked = []
    monkeypatch.setattr(masked_polishing, "polished_price", lambda *call: asked.append(call) or call[-1])
    masked_design(
        named_plant("reference"), "A", input_mask=lambda omega: np.full(omega.shape, 1.6), tolerance=1e-9
    )
    monkeypatch.undo()
    criterion, respond, one = asked[0]
    noise, counts = np.random.default_rng(0), []

    def rounded(trial, changes=True):
        counts.append(trial)
        found = respond(trial, changes)
        return replace(found, information=found.information * (1 + 1e-11 * noise.normal()))

    found = masked_polishing.polished_price(criterion, rounded, one)
    M = respond(found).information
    np.testing.assert_allclose(2 * M @ found.X, criterion.log_numerator(found.X, False)[0], rtol=0, atol=1e-9)
    assert len(counts) <= 20


def test_few_densities_are_mixed_before_the_price_is_looked_for(monkeypatch):
    """2x2 of order 2: seven rounds to 8e-7, as Newton's method waited for a gap that stalls; of order 4 that was 90 s, 7 now."""
    rounds, before = [], masked.solve_weights
    monkeypatch.setattr(masked, "solve_weights", lambda *call: rounds.append(call) or before(*call))
    plant = random_plant(np.random.default_rng(3), several=True)
    design = masked_design(
        plant, "D", input_mask=lambda omega: 5 * np.multiply.outer(np.ones(len(omega)), np.eye(2))
    )
    assert design.gap < 1e-9
    assert len(rounds) < 5


def test_a_density_that_tells_nothing_of_a_parameter_has_a_price_all_the_same():
    """D_s of one output: the parameters of the others have no curvature, and their unit was a division by 0."""
    design = masked_design(
        named_plant("three-by-two"), "Ds:b1_11,b1_21", tolerance=1e-9,
        input_mask=lambda omega: np.broadcast_to(4 * np.eye(2), (len(omega), 2, 2)),
    )  # fmt: skip
    assert design.status.ok
