"""Effects whose nearest shape still leaves more than the linear model, and those behind a lag that no pole of the linear part is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.loops.limited import _controlled, slowest_rate
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.effects.profiled import profiled_behind
from estimators.diagnosis.effects.sensing.extremes import ANEW, SLIDING
from estimators.diagnosis.model.fitting import Channel, Fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.search.candidates import Menu, augmented
from estimators.diagnosis.search.free_runs import denominator
from estimators.diagnosis.search.starts import behind_a_lag
from tests.estimators.diagnosis.case_parts import lag
from tests.estimators.diagnosis.test_diagnosis_classes import error

N = 900


def recorded(
    u: np.ndarray, y: np.ndarray, order: int, rng: np.random.Generator
) -> tuple[Channel, Fit, float]:
    """A record with noise of a fiftieth, its linear fit without a noise model, and the noise."""
    noise = 0.02 * float(np.std(y))
    y = y + noise * rng.standard_normal(len(u))
    channel = Channel(u[:, None], y, Clock(np.arange(float(len(u))), len(u)), np.ones(len(u), dtype=bool))
    f = fit_linear(channel, replace(Structure(order).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    white = float(np.mean(f.residual**2))
    return channel, replace(f, noise=np.zeros(0), variance=white, deviance=f.n * np.log(white)), noise


def boiling(tau: float, rng: np.random.Generator) -> tuple[Channel, Fit, float]:
    """A vessel that gets no hotter than it boils, behind its heater and before its thermometer."""
    u = np.repeat(rng.uniform(1.0, 5.0, N // 30), 30)
    heat, level = lag(u, np.exp(-1.0 / tau)), 0.0
    out = np.empty(N)
    level = min(u[0], 3.4)
    for k, q in enumerate(heat):
        out[k] = level
        level = min(level + 0.05 * (q - level), 3.4)
    return recorded(np.concatenate((u[1:], u[-1:])), lag(out, 0.5), 3, rng)


@pytest.mark.parametrize("tau", [4.0, 6.0])
def test_a_store_behind_a_lag(tau) -> None:
    """Without its heater's lag it left up to four times the noise, and was passed over for a stop beside a broken line and a delay."""
    channel, base, noise = boiling(tau, np.random.default_rng(2))
    found = list(augmented(channel, base, Menu((named("store_full"),))))
    lagged = [f for f in found if f.structure.parts[-1].first]
    assert min(map(error, found)) < 1.15 * noise
    assert min(map(error, lagged)) == min(map(error, found))
    assert min(error(f) for f in found if f not in lagged) > 1.8 * noise


def test_only_the_best_of_what_acts_on_one_input_are_tried_behind_a_lag() -> None:
    channel, base, _ = boiling(3.0, np.random.default_rng(2))
    found = list(augmented(channel, base, Menu((named("store_full"),))))
    plain = next(f for f in found if not f.structure.parts[-1].first)
    poor = replace(plain, deviance=base.deviance - 1.0)
    white = replace(plain, noise=np.zeros(0))
    assert len(list(behind_a_lag(channel, base, [plain, plain]))) == 1  # once for each effect
    assert not list(behind_a_lag(channel, base, [white]))  # nothing is left that a lag could explain
    assert not list(behind_a_lag(channel, plain, [poor]))  # no second effect
    assert not list(behind_a_lag(channel, base, [f for f in found if f.structure.parts[-1].first]))


@pytest.mark.parametrize("seed", [2, 4, 7])
def test_a_loop_that_winds_up_is_fitted_from_shapes_that_are_worse_than_the_linear_model(seed) -> None:
    """A speed control, its drive limited by its supply: none was fitted."""
    rng = np.random.default_rng(seed)
    u = 100.0 + np.repeat(rng.uniform(-45.0, 45.0, N // 45), 45)
    pace, proportional, integral, most = rng.uniform([0.03, 0.8, 0.05, 140.0], [0.15, 4.0, 0.3, 180.0])
    x = wound = u[0]
    y = np.empty(N)
    for k, wanted in enumerate(u):
        y[k] = x
        for _ in range(20):
            drive = min(max(proportional * (wanted - x) + wound, 0.0), most)
            wound += integral * (wanted - x) / 20.0
            x += pace * (drive - x) / 20.0
    channel, base, noise = recorded(u, y, 2, rng)
    shapes = _controlled(slowest_rate(denominator(base), N), u)
    _, tried = profiled_behind(channel, base, Part(named("wind_up"), 0), shapes)
    assert tried[0][0] > float(np.sum(base.residual**2))
    found = augmented(channel, base, Menu((named("wind_up"),)))
    assert min(map(error, found)) < 1.05 * noise < error(base)


@pytest.mark.parametrize("seed", [47, 50, 52, 58])
def test_a_change_is_put_at_its_instant_once_its_size_is_known(seed) -> None:
    """A thermometer whose pocket loses its oil: fitted from the best of 20 instants, up to three times the noise was left."""
    rng = np.random.default_rng(seed)
    u, at = np.repeat(rng.uniform(20.0, 80.0, N // 25), 25), rng.uniform(0.2, 0.8) * N
    hot, quick = lag(u, np.exp(-1.0 / rng.uniform(6.0, 15.0))), rng.uniform(2.0, 6.0)
    slow, y = quick * rng.uniform(2.5, 6.0), np.empty(N)
    x = hot[0]
    for k, warm in enumerate(hot):
        y[k] = x
        x += (1.0 - np.exp(-1.0 / (slow if k >= at else quick))) * (warm - x)
    channel, _, noise = recorded(u, y, 2, rng)
    base = fit_linear(channel, replace(Structure(2).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    menu = Menu((named("pole_change"), named("timescale_change")))
    found = min(augmented(channel, base, menu), key=lambda f: f.criterion)
    assert error(found) < 1.1 * noise
    assert abs(found.p[found.structure.slices()[-1]][1] - at) < 6.0


@pytest.mark.parametrize(
    ("effect", "seed"), [(SLIDING, 21), (SLIDING, 22), (SLIDING, 26), (ANEW, 3), (ANEW, 7)]
)
def test_a_window_is_found_whatever_poles_the_linear_model_has_for_it(effect, seed) -> None:
    """A peak detector, which no linear model tells from poles: nothing was found."""
    rng = np.random.default_rng(seed)
    u = lag(np.repeat(rng.uniform(20.0, 80.0, N // 30), 30), 0.3)
    x = lag(lag(u, rng.uniform(0.6, 0.95)), rng.uniform(0.3, 0.8))
    window, side, clock = float(rng.integers(3, 26)), rng.choice([1.0, -1.0]), Clock(np.arange(float(N)), N)
    shape = [window, side] if effect is SLIDING else [window, window // 3, side]
    y = effect.apply(np.concatenate((x[:1], x[:-1])), np.array(shape), clock)
    channel, _, noise = recorded(u, y, 2, rng)
    base = fit_linear(channel, replace(Structure(2).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    found = min(augmented(channel, base, Menu((SLIDING, ANEW))), key=error)
    assert error(found) < 1.15 * noise < 0.2 * error(base)
    assert found.structure.parts[-1].effect is effect
    assert list(found.p[found.structure.slices()[-1]]) == shape


def test_a_record_that_moves_alike_both_ways_has_no_window() -> None:
    channel, base, _ = boiling(3.0, np.random.default_rng(2))
    assert not list(augmented(channel, base, Menu((ANEW,))))
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-1.0, 1.0, N // 30), 30)
    channel, base, _ = recorded(u, lag(np.concatenate((u[:1], u[:-1])), 0.8), 1, rng)
    assert not list(augmented(channel, base, Menu((SLIDING, ANEW))))
