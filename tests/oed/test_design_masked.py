"""Designs under masks: the certificate against a linear programme, limits kept, limit cases that must collapse."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from oed.design import solve_design
from oed.design.parametrisations.masked import knapsack, masked_design
from oed.errors import InfeasibleDesign, InputError
from oed.plants.named import named_plant


def test_the_knapsack_is_the_linear_programme(rng):
    for _ in range(20):
        S, cap = rng.exponential(size=30), rng.uniform(0, 0.2, 30)
        value, nu = knapsack(S, cap)
        lp = linprog(-S, A_ub=np.ones((1, 30)), b_ub=[1.0], bounds=list(zip(np.zeros(30), cap, strict=True)))
        assert value == pytest.approx(-lp.fun, rel=1e-9)
        assert value == pytest.approx(nu + cap @ np.maximum(S - nu, 0), rel=1e-9)


@pytest.mark.parametrize("name", ["D", "A", "E", "hinf"])
def test_masks_are_kept_and_certified(name):
    plant = named_plant("reference")
    mask = lambda omega: np.full(omega.shape, 8.0)
    design = masked_design(plant, name, input_mask=mask)
    density = design.spectrum.power[:, 0, 0].real * 300
    assert density.max() <= 8.0 * (1 + 1e-12)
    assert design.spectrum.total_power <= 1 + 1e-12
    assert abs(design.gap) < 1e-6
    free = solve_design(plant, name)
    assert design.loss > free.loss
    # A flat mask of density 1 leaves white noise only.
    tight = masked_design(plant, name, input_mask=lambda omega: np.full(omega.shape, 1.0))
    assert tight.efficiency_white == pytest.approx(1.0, rel=1e-4)


def test_output_mask_and_no_mask():
    plant = named_plant("reference")
    limited = masked_design(plant, "D", output_mask=lambda omega: np.full(omega.shape, 4.0))
    G = np.abs(plant.response(limited.spectrum.omega)[0][:, 0, 0]) ** 2
    assert (limited.spectrum.power[:, 0, 0].real * 300 * G).max() <= 4.0 * (1 + 1e-12)
    free = masked_design(plant, "D", cells=400)
    grid = solve_design(plant, "D", points=free.spectrum.omega, refine=False)
    assert free.loss == pytest.approx(grid.loss, rel=1e-6)


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
