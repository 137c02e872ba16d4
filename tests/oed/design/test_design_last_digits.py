"""Newton's method on the support: exact derivatives, certificates to 1e-9 for several inputs, one line per peak."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from oed.criteria import a_criterion, c_criterion, d_criterion, e_criterion, g_criterion, worst_d_criterion
from oed.design import solve_design
from oed.errors import Status
from tests.oed.design.test_design_random import random_plant

RNG = np.random.default_rng(0)
CRITERIA = [
    d_criterion(4),
    d_criterion(4, [0, 2]),
    a_criterion(4),
    c_criterion(RNG.standard_normal(4)),
    e_criterion(4),
    g_criterion(RNG.standard_normal((3, 4, 2))),
    worst_d_criterion(RNG.standard_normal((3, 4, 2))),
]


@pytest.mark.parametrize("criterion", CRITERIA, ids=lambda c: c.name)
def test_derivatives_of_the_numerator(criterion):
    rng = np.random.default_rng(1)
    X = rng.standard_normal((4, 2 if criterion.kind == "E" else criterion.columns.shape[1]))
    rise, bend = criterion.log_numerator(X)
    step = 1e-5 * rng.standard_normal(X.shape)
    ahead, behind = (np.log(criterion.numerator(X + side * step)) for side in (1, -1))
    assert np.sum(rise * step) == pytest.approx((ahead - behind) / 2, rel=1e-6)
    ahead, behind = (criterion.log_numerator(X + side * step, False)[0] for side in (1, -1))
    assert bend @ step.ravel() == pytest.approx((ahead - behind).ravel() / 2, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("criterion", [c for c in CRITERIA if c.smooth], ids=lambda c: c.name)
def test_second_derivatives_of_the_loss(criterion):
    rng = np.random.default_rng(2)
    A, B = rng.standard_normal((2, 4, 4))
    M, change = A @ A.T + np.eye(4), B + B.T
    value = lambda M: 4 * np.log(criterion.loss(M)) if criterion.kind == "D" else criterion.loss(M)
    X, h = criterion.direction(M), 1e-3
    second = criterion.second(M, X, (change @ X)[None])[0, 0]
    assert second == pytest.approx(
        (value(M + h * change) - 2 * value(M) + value(M - h * change)) / h**2, rel=1e-3
    )


@pytest.mark.parametrize("criterion", ["D", "A", "E"])
def test_several_inputs_to_nine_digits_by_a_line_per_peak(criterion):
    """Found so, not by hundreds of columns: the support has fewer lines than there are parameters."""
    design = solve_design(random_plant(np.random.default_rng(3), several=True), criterion, tolerance=1e-9)
    assert design.gap <= 1e-9
    assert len(design.spectrum) <= design.map.n
    assert design.certificate.check(points=20_001) <= 1 + 1e-8


def test_a_design_that_is_not_closed_says_so_first():
    design = solve_design(random_plant(np.random.default_rng(3)), "D")
    assert "not closed" not in str(design)
    open_one = replace(design, status=Status.INACCURATE)
    assert "not closed" in str(open_one).splitlines()[0]
