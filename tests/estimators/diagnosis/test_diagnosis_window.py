"""What the first samples of a record tell of where a linear model starts: its state, and the inputs that came before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline import Options
from estimators.diagnosis.baseline.best import prior_of
from estimators.diagnosis.baseline.choice import run_spread
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from oed.data import Record


def test_what_a_start_leaves_of_a_light_pole_is_not_held_against_its_model() -> None:
    """Fits that differ in how much of it an input excites would differ for as long as it rings; a window of samples tells where it starts."""
    u = np.zeros((400, 1))
    u[0] = 3.0
    gains = (0.1, 0.15, 0.05, 0.12, 0.08, 0.1)
    models = [LinearModel(np.poly([-0.999, 0.5]), np.array([[0.0, g]])) for g in gains]
    prior = Prior(0.0, np.eye(1, 9)[0], 1e-6)
    assert run_spread(models, [u], prior, 20) < 0.02 * run_spread(models, [u], prior, 0)


def test_inputs_before_a_record_leave_the_spread_that_their_changes_say(rng: np.random.Generator) -> None:
    """By drawing them: a first-order input, whose change within k samples has the variance 2 (1 - a^k), before two delays and a zero."""
    a, n, runs = 0.6, 40, 20000
    model = LinearModel(np.poly([-0.95, 0.3]), np.array([[0.0, 0.0, 1.0, 0.9, -0.4]]))
    turned = (1.0 - a ** np.arange(9.0))[None]
    u = lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], rng.standard_normal((runs, 60)), axis=1)[:, 50:]
    driven = [model.driven(np.zeros((n, 1)), x[:-1, None] - x[-1]) for x in u]
    left = lfilter([1.0], model.den, np.array(driven), axis=1)
    assert model._entered(turned, n) == pytest.approx(left.T @ left / runs, rel=0.05, abs=0.02)
    assert not model._entered(np.zeros((1, 9)), n).any()


def test_a_piece_of_a_record_begins_where_its_unseen_inputs_left_it() -> None:
    """A white input and zeros beside a pole that rings: with no room for the inputs before it, the first samples are taken for noise."""
    rng = np.random.default_rng(8)
    model = LinearModel(np.poly([-0.99, 0.5]), np.array([[0.0, 1.0, 2.0, 2.0, 1.0]]))
    squares = []
    for _ in range(20):
        u = rng.standard_normal((1500, 1))
        y = lfilter(model.num[0], model.den, u[:, 0])
        record = Record(u[1000:], y[1000:] + 0.01 * rng.standard_normal(500))
        known = replace(prior_of([record], 0, Options()), noise=1e-4)
        runs = [
            model.free_run(p, record.u, record.y[:, 0], 20)
            for p in (known, replace(known, turned=np.empty((0, 0))))
        ]
        squares.append([np.mean((record.y[:, 0] - run)[20:] ** 2) for run in runs])
    told, untold = np.sqrt(np.mean(squares, axis=0))
    assert told < 0.012 < 2.0 * told < untold
