"""Light modes: of several inputs, their delays and where a record of them starts; of two, one that changes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim, lfilter

from estimators.diagnosis.baseline import Options, best_linear, blocks_of
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.baseline.regression import Arx
from estimators.diagnosis.baseline.search import Search
from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.model.layouts import NOTHING, changed_states, states
from oed.data import Record


def rms(e):
    return float(np.sqrt(np.mean(e**2)))


def test_light_modes_of_two_inputs_that_arx_does_not_see_have_their_own_delay():
    """In noise of 5 % the delays of ARX, which explains nothing, are those of noise: order 8 stood for 4, and more error with it."""
    rng, n, phase = np.random.default_rng(1), 1200, 2 * np.pi * np.arange(1200) / 1200
    lines = [rng.permutation(np.arange(3, n // 4))[: n // 12] for _ in range(2)]
    u = np.stack(
        [np.cos(np.outer(phase, q) + rng.uniform(0, 2 * np.pi, len(q))).sum(axis=1) for q in lines], axis=1
    )
    u[:15], y = 0.0, np.zeros(n)
    for w, radius in ((0.2616, 0.9972), (0.3408, 0.9963)):
        gains = rng.uniform(0.5, 1.0, 2) * rng.choice([-1.0, 1.0], 2)
        y += lfilter([0.0, 1.0], [1.0, -2.0 * radius * np.cos(w), radius**2], u @ gains)
    noise = 0.05 * float(np.std(y))
    base = best_linear([Record(u, y + noise * rng.standard_normal(n))])
    assert base.outputs[0].delays == (1, 1)
    assert base.rmse_unused[0] < 1.2 * noise


def test_a_dead_time_before_light_modes_is_found_though_they_ring_on():
    """ARX sees so little of them that its delay is one of noise, after the onset of the answer: twice the error of the noise."""
    rng, n, dead = np.random.default_rng(4), 1500, 11
    u, y = rng.standard_normal(n), np.zeros(n)
    for w, radius, gain in ((0.262, 0.9945, 1.0), (0.557, 0.9911, -0.6), (0.905, 0.9875, 0.43)):
        num, den = np.zeros(dead + 1), [1.0, -2.0 * radius * np.cos(w), radius**2]
        num[dead] = gain * w
        y += lfilter(num, den, u)
    noise = 0.05 * float(np.std(y))
    base = best_linear([Record(u[:, None], y + noise * rng.standard_normal(n))])
    assert abs(base.outputs[0].delays[0] - dead) <= 2
    assert base.rmse_unused[0] < 1.1 * noise


@pytest.mark.parametrize("window", [0, 15])
def test_light_poles_of_each_input_are_not_set_ringing_by_the_noise_of_a_rest(window):
    """Near-double poles make a growing swing of any error of the level, or of samples that only noise moves."""
    rng, pair = np.random.default_rng(3), 0.997 * np.exp(0.26j * np.array([1.0, -1.0]))
    den = np.real(np.poly([*pair, *(1.0005 * pair), *pair]))
    model = LinearModel(den, np.array([[0.0, 0.05], [0.0, 0.02]]), 0.0, np.ones(2))
    u = np.concatenate((np.zeros((15, 2)), rng.standard_normal((400, 2))))
    truth = model.run(model.driven(u), np.zeros(6))
    size = float(np.std(truth))
    y = truth + 0.05 * size * rng.standard_normal(len(u))
    known = Prior(
        0.0, size**2 * 0.9 ** np.arange(8.0), (0.05 * size) ** 2, level=0.02 * size, held=np.zeros(2)
    )
    assert rms(model.free_run(known, u, y, window) - truth) < 1e-6 * size


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_slow_and_quick_modes_in_coloured_noise_are_found_from_a_long_arx(seed):
    """A quarter car on a shaker, modes of 1.2 and 10 Hz: descents from short ARX end in other minima, 10 to 13 % above the noise."""
    k, c, kt, lag, ratio, dt, n = 65.5, 4.75, 4070.0, 0.013, 6.64, 0.005, 2400
    A = np.zeros((5, 5))
    A[0, 1] = A[2, 3] = 1.0
    A[1, :4] = -k, -c, k, c
    A[3] = ratio * k, ratio * c, -ratio * k - kt, -ratio * c, kt
    A[4, 4] = -1.0 / lag
    plant = cont2discrete((A, np.eye(5)[:, 4:] / lag, A[1:2], np.zeros((1, 1))), dt)[:4]
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal(n // 20), 20)
    y = dlsim((*plant, dt), u)[1][:, 0]
    noise = lfilter([1.0], [1.0, -0.9], rng.standard_normal(n))
    noise *= 0.05 * rms(y) / rms(noise)
    base = best_linear([Record(u, y + noise, dt)], Options(deviations=True))
    assert base.rmse_unused[0] < 1.05 * rms(noise)


def test_a_long_arx_is_of_the_records_that_are_searched():
    rng = np.random.default_rng(2)
    first, other = ([Record(u, np.cumsum(u))] for u in rng.standard_normal((2, 300)))
    search = Search(first, 0, blocks_of(first, 5, 20, 20), Prior(0.0, 0.9 ** np.arange(40.0), 0.01), False)
    form = Arx(1, 1, (1,), False)
    assert search._long(form) is search._long(form)
    assert replace(search, records=other)._long(form) is not search._long(form)


def test_of_two_modes_side_by_side_only_the_one_that_changes_is_driven_as_by_its_new_stiffness():
    """A joint that comes loose: against both modes alone, each with its own held input and what it was when that came."""
    rng, at, size = np.random.default_rng(4), 60, np.log(0.7)
    rates, u = np.log([0.09, 0.03, 0.4, 0.05]), rng.standard_normal(150)
    change = named("loss_change").change["modes"]
    both = changed_states(
        "modes",
        rates,
        u,
        NOTHING,
        change,
        np.array([size, float(at)]),
        Clock(np.arange(150.0), 150),
        np.zeros(4),
    )
    first = states("oscillator", rates[:2], u[: at + 1])
    later = states("oscillator", rates[:2] + [size, 0.0], np.exp(-size) * u[at:], x0=first[at])
    assert np.allclose(both[:, :2], np.concatenate((first[:at], later)))
    assert np.allclose(both[:, 2:], states("oscillator", rates[2:], u))
