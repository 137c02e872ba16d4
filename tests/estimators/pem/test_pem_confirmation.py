"""When one search is enough: the optimum is confirmed only where no rival can be, and then it is the global one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.speed.pem import _case
from estimators.pem import identify
from estimators.pem.search import global_search
from estimators.pem.search.confirmation import Standing, confirmed, first_start, standing
from estimators.pem.search.problem import prepare
from oed.data import Record
from oed.errors import Status
from oed.models.model import bj, oe
from tests.estimators.pem.test_pem_global import random_case

B, F = [0.0, 0.5, 0.3], [1.0, -1.2, 0.6]


def record(seed: int, size: int = 1000, noise: float = 0.3, b=B, f=F, e=(1.0,)) -> Record:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=size)
    return Record(u, lfilter(b, f, u) + lfilter(e, [1.0], noise * rng.normal(size=size)))


def ended(structure, data):
    problem = prepare(structure, [data])
    z = first_start(problem)
    assert z is not None
    return problem, problem.descend(
        problem.evaluate(problem.projected(z)), max_iterations=100, tolerance=1e-16
    )


def test_confirmed_is_what_a_thorough_search_finds() -> None:
    data = record(1)
    problem, optimum = ended(oe(2, 2), data)
    assert confirmed(problem, optimum)
    quick, thorough = (
        identify(data, "oe", (2, 2), offset=False),
        identify(data, "oe", (2, 2), search="thorough", offset=False),
    )
    assert quick.loss == pytest.approx(thorough.loss, rel=1e-12)
    assert quick.theta == pytest.approx(thorough.theta, abs=1e-7)


@pytest.mark.parametrize(
    "structure, data",
    [
        (oe(1, 1), record(2)),  # a mode is missing
        (oe(3, 3), record(3)),  # one too many: a root in common
        (oe(2, 2), record(4, e=(1.0, 0.9))),  # the noise is coloured
        (oe(2, 2), record(5, noise=20.0)),  # hardly any signal
    ],
    ids=["missing mode", "common root", "coloured noise", "poor signal"],
)
def test_not_confirmed(structure, data) -> None:
    assert not confirmed(*ended(structure, data))


def test_a_search_at_its_limit_of_steps_does_not_hide_orders_that_are_too_high() -> None:
    """Modes that cancel make a valley without an end; an optimum that was not reached is never confirmed."""
    for order, expected in ((4, Standing.OVER_ORDERED), (2, Standing.OPEN)):
        problem, optimum = ended(oe(order, order), record(3))
        assert standing(problem, replace(optimum, status=Status.MAX_ITERATIONS)) is expected


@pytest.mark.parametrize("order, told", [(2, False), (4, True)])
def test_a_search_without_an_end_says_that_the_orders_are_too_high(order, told) -> None:
    """Not where it was only stopped early: a second order is the plant's own."""
    fit = identify(record(3), "oe", (order, order), offset=False, search="quick", max_iterations=2)
    assert fit.status is Status.MAX_ITERATIONS
    assert any("orders are too high" in note for note in fit.notes) is told


def test_no_modes_are_drawn_where_nothing_is_left_and_none_moved(monkeypatch) -> None:
    """Order 8: two roots of B and F are 12 standard errors apart, the residual is white. Forty-eight random starts took
    three quarters of the search and found nothing."""
    data, _, _ = _case(8, 2000)
    assert standing(*ended(oe(8, 8), data)) is Standing.UNTOLD
    monkeypatch.setattr(global_search, "drawn", lambda *_: pytest.fail("modes are drawn"))
    found = identify(data, "oe", (8, 8), offset=False)
    monkeypatch.undo()
    assert found.loss == pytest.approx(
        identify(data, "oe", (8, 8), offset=False, search="thorough").loss, rel=1e-9
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_orders_that_are_far_too_high_leave_a_model(seed) -> None:
    """Modes that are not there were put at 1, where they are a level and an initial state too: NotIdentifiable."""
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=(2, 2000))
    y = lfilter([0, 0.2155, 0.2012], [1, -0.9854, 0.8187], u) + 0.3 * e
    fit = identify(Record(u, y), "oe", (30, 30))
    assert fit.loss < 0.09
    assert np.isfinite(fit.covariance).all()


def test_local_optima_are_not_confirmed() -> None:
    """A plant of order 5 with several optima, of which some are 2 % above the lowest: none is confirmed."""
    data, _, orders, _, starts = random_case(31, 16)
    problem, ends = prepare(oe(*orders), [data]), []
    for start in starts:
        point = problem.evaluate(problem.projected(start / problem.scale))
        if point is not None:
            ends.append(problem.descend(point, max_iterations=200, tolerance=1e-16))
    losses = [end.point.loss for end in ends]
    assert max(losses) > 1.01 * min(losses)
    assert not any(confirmed(problem, end) for end in ends)


def test_no_first_start_where_it_does_not_apply() -> None:
    data = record(7)
    assert first_start(prepare(bj(2, 1, 1, 2), [data])) is None
    assert first_start(prepare(oe(2, 2), [data[:100]])) is None
