"""Sensors that show their signal in some samples only: the linear part is made for these, with the poles that it needs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.kernels.recursion_kernels import play, reported
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.model.fitting import Channel
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.record.measurement import held_in_motion, lost_samples
from estimators.diagnosis.search.candidates import Menu, augmented

N = 1000


def steps(rng, n=N):
    """An operator's steps and ramps about 40, from rest."""
    u, level = np.full(n, 40.0), 40.0
    for at in range(20, n, 60):
        goal, ramp = 40.0 + rng.uniform(-9.0, 9.0), int(rng.integers(1, 30))
        u[at:] = goal
        u[at : at + ramp] = np.linspace(level, goal, ramp + 1)[1:][: n - at]
        level = goal
    return u


def lags(u, *times):
    """What follows an input from rest at its first value."""
    x = u - u[0]
    for time in times:
        pole = np.exp(-1.0 / time)
        x = lfilter([0.0, 1.0 - pole], [1.0, -pole], x)
    return u[0] + x


def channel_of(u, y):
    return Channel(u[:, None], y, Clock(np.arange(float(len(y))), len(y)), np.ones(len(y), dtype=bool))


def linear(channel, order):
    s = replace(Structure(order).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2)
    f = fit_linear(channel, s)
    white = float(np.mean(f.residual**2))
    return replace(f, noise=np.zeros(0), variance=white, deviance=f.n * np.log(white))


def error(f):
    return float(np.sqrt(np.mean(f.residual**2)))


def historian(rng, noise):
    """Readings of a historian that stores a value, and the noise in it, once it is off the last one by more than 1.1."""
    u = steps(rng)
    x = reported(lags(u, 16.0, 5.0), 1.1, u[0] + 0.4, np.zeros(N, dtype=bool))
    moved = np.concatenate(([True], np.diff(x) != 0.0))
    stored = np.cumsum(moved) - 1
    return u, x, x + noise * rng.standard_normal(N)[stored]


def test_readings_between_reports_of_changes_are_not_lost():
    """Half of a historian's readings, noise and all, had been dropouts; losses end in small moves too."""
    rng = np.random.default_rng(35)
    u, _, y = historian(rng, 0.04)
    assert not lost_samples(u[:, None], y).any()
    lost = lags(u, 16.0, 5.0) + 0.04 * rng.standard_normal(N)
    gone = rng.random(N) < 0.5
    gone[0] = False
    lost = lost[np.maximum.accumulate(np.where(gone, 0, np.arange(N)))]
    assert lost_samples(u[:, None], lost).sum() > 0.7 * gone.sum()


@pytest.mark.parametrize("order", [1, 2])
def test_a_historian_is_found_with_the_poles_and_the_start_of_its_signal(order):
    """What stands in steps has poles and a delay of its own to a linear model; what stands at first says nothing of the signal."""
    u, _, y = historian(np.random.default_rng(31), 0.04)
    channel = channel_of(u, y)
    base = linear(channel, order)
    found = min(augmented(channel, base, Menu((named("reported_on_change"),))), key=error)
    assert found.structure.order == 2
    assert error(found) < 0.6 * error(base)  # a report more or less is off by the step until the next
    assert found.p[-2:] == pytest.approx([1.1, 0.4], abs=0.12)


@pytest.mark.parametrize("key", ["backlash_output", "backlash_sampled"])
def test_a_play_is_found_beside_a_linear_model_of_too_few_poles(key):
    """One pole was the best that a linear model had for play behind two lags: from it the fit ended at many times the noise."""
    rng = np.random.default_rng(10)
    u = 40.0 + 22.0 * np.sin(0.00012 * np.arange(N) ** 2)
    x = lags(u, 2.0, 6.0)
    y = 5.0 + play(x, 6.0, x[0] + 1.0) + 0.1 * rng.standard_normal(N)
    channel = channel_of(u, y)
    found = min(augmented(channel, linear(channel, 1), Menu((named(key),)), iterations=25), key=error)
    assert error(found) < 0.2
    assert abs(found.p[-1]) == pytest.approx(6.0, abs=0.2)


@pytest.mark.parametrize("key, p", [("backlash_output", [6.0]), ("backlash_sampled", [6.0]), ("reported_on_change", [6.0, 0.0]),
                                    ("plays_output", [6.0, 0.5, 0.5, 0.5, 0.5, 0.0])])  # fmt: skip
def test_a_sensor_that_remembers_has_no_way_from_zero_behind_it(key, p):
    """Before a record the linear part is led to its first level; a play had been led there from below, and stood half its gap off."""
    s, lead = Structure(1).adding(Part(named(key))), 80
    clock = Clock(np.arange(-lead, 10.0), 100, lead)
    y = simulate(s, np.array([-0.8, 0.2, *p]), np.full((lead + 10, 1), 40.0), clock, rest=True)[lead:]
    gain = 3.0 if key == "plays_output" else 1.0
    np.testing.assert_allclose(y, gain * 40.0, rtol=1e-6)


def gauge(rng, noise, lost):
    """Readings of a level, noise and all, and where it moves fast those of a random share, or all, are `lost` and show the last one."""
    u = steps(rng, 2 * N)
    x = lags(u, 16.0, 5.0)
    y = x + noise * rng.standard_normal(2 * N)
    fast = np.abs(np.gradient(x)) > 0.12
    gone = fast if lost == "in motion" else rng.permutation(fast)
    gone[0] = False
    return u, y[np.maximum.accumulate(np.where(gone, 0, np.arange(2 * N)))], gone


def test_readings_that_are_lost_in_motion_are_told_from_those_lost_at_any_time():
    u, y, gone = gauge(np.random.default_rng(4), 0.04, "in motion")
    assert np.array_equal(held_in_motion(u[:, None], y), gone)
    assert not lost_samples(u[:, None], y).any()
    u, y, gone = gauge(np.random.default_rng(4), 0.04, "at any time")
    assert not held_in_motion(u[:, None], y).any()
    assert lost_samples(u[:, None], y).sum() > 0.7 * gone.sum()


@pytest.mark.parametrize("unit", [1.0, 1e-12, 1e12])
def test_a_gauge_that_loses_fast_motion_is_found_with_its_limit(unit):
    """A level gauge had lost samples at any time, and its model went on through them: .112 m for .0155."""
    u, y, _ = gauge(np.random.default_rng(4), 0.04, "in motion")
    channel = channel_of(u, unit * y)
    base = linear(channel, 2)
    found = min(augmented(channel, base, Menu((named("held_in_motion"),))), key=error)
    assert error(found) < 0.1 * unit < 0.3 * error(base)
    assert found.p[-2] == pytest.approx(0.12 * unit, rel=0.03)
