"""Sensors that fold what they measure: what is behind them is found though a linear model shows nothing of it."""

import numpy as np
import pytest
from scipy.linalg import expm

from estimators import diagnose
from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.loops.ageing import leaky
from oed.data import Record
from tests.estimators.diagnosis.case_small import looking_for


def drives(seed: int, n: int = 700) -> Record:
    """Two motors with one belt over a sprung pulley, whose speed is counted without its sign."""
    rng = np.random.default_rng(seed)
    w, z, tau, dt = 10.8, 0.21, 0.4, 0.02
    A = np.array([[0.0, 1.0, 0.0], [-w * w, -2 * z * w, w * w], [0.0, 0.0, -1 / tau]])
    M = expm(np.block([[A, np.array([[0.0], [0.0], [1.3 / tau]])], [np.zeros((1, 4))]]) * dt)
    u = np.repeat(rng.uniform(-1.5, 1.5, n // 25), 25)
    x, y = np.zeros(3), np.zeros(n)
    for k in range(n):
        y[k] = abs(x[0])
        x = M[:3, :3] @ x + M[:3, 3] * u[k]
    return Record(u, y + 0.003 * rng.standard_normal(n), dt)


@pytest.mark.slow
def test_the_order_behind_a_fold_is_not_that_of_a_model_that_sees_nothing_of_it() -> None:
    """The linear model had one pole: behind the magnitude two were looked for, and .134 of .33 was left where .003 is noise."""
    folds = "magnitude", "squared", "rectified", "output_absolute", "output_quadratic"
    found = diagnose(drives(1), drives(2), looking_for(*folds, skip=20))
    assert found.effect == "magnitude_sensor"
    assert found.rmse_after.value < 0.05 * found.rmse_before.value


def test_a_parabola_far_from_its_fold_is_a_line_and_no_square() -> None:
    """A ship's turning rate was read through the square of a level five times as far: it took the place of the model's own gain, and
    the cause with it."""
    x = np.linspace(-1.0, 1.0, 50)
    assert np.all(np.isfinite(named("squared").apply(x, np.array([5.0]), None)))
    assert not np.any(np.isfinite(named("squared").apply(x, np.array([7.5]), None)))


def test_what_follows_within_a_sample_is_no_slow_state() -> None:
    """An electrostatic spring was named a slow state with a time constant of -2e-5 s."""
    assert np.all(np.isfinite(leaky(np.ones(9), 1.5)))
    assert not np.any(np.isfinite(leaky(np.ones(9), -0.3)))
