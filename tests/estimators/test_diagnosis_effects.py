"""The NumPy maps and compiled recursions of the catalogue against their CasADi definitions."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, ss2tf

from estimators.diagnosis.effects import terms
from estimators.diagnosis.effects.catalogue import CATALOGUE, Clock
from estimators.diagnosis.effects.plant_kernels import bouc_wen, held_response, simulate_feedback
from estimators.diagnosis.effects.recursion_kernels import (
    hinges,
    play,
    rate_limited,
    rate_limited_mean,
    rational,
)
from estimators.diagnosis.model.derivatives import exact_columns
from estimators.diagnosis.model.fitting import Channel
from estimators.diagnosis.model.intersample import between_samples
from estimators.diagnosis.model.layouts import states
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.search.candidates import augmented

STATIC = [
    k
    for k, e in CATALOGUE.items()
    if e.apply is not None and e.slot in ("input", "output", "added")
    and k not in ("rate_limit", "rate_limit_sampled", "backlash_input", "backlash_output", "backlash_sampled", "hysteresis", "delay", "lag", "gain_drift", "gain_change",
                  "step_input", "step_output", "drift", "tones", "input_lines", "output_lines")
]  # fmt: skip
TIMED = ["gain_drift", "gain_change", "step_input", "step_output", "drift", "tones"]


@pytest.mark.parametrize("key", STATIC)
def test_static_maps_agree_with_casadi(key):
    rng = np.random.default_rng(1)
    x = 2 * rng.standard_normal(200)
    p = (
        np.array([-0.7, 0.4])
        if key == "saturation_asymmetric"
        else np.array([0.3, 0.2])[: len(CATALOGUE[key].parameters)]
    )
    ours = CATALOGUE[key].apply(x, p, Clock(np.arange(200.0), 200))
    theirs = np.array(terms.static_term(key)(x[None, :], p)).ravel()
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("key", TIMED)
def test_timed_maps_agree_with_casadi(key):
    x, k = np.random.default_rng(2).standard_normal(150), np.arange(150.0)
    p = {"gain_change": [0.3, 70.4], "step_input": [0.3, 70.4], "step_output": [0.3, 70.4], "tones": [0.2, 0.5, -0.4],
         "drift": [0.1, 0.7], "gain_drift": [0.4]}[key]  # fmt: skip
    ours = CATALOGUE[key].apply(x, np.array(p), Clock(k, 150))
    theirs = np.array(terms.timed_term(key)(x[None, :], k[None, :], 150.0, p)).ravel()
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)


def test_play_agrees_with_casadi():
    v = np.cumsum(np.random.default_rng(3).standard_normal(300))
    theirs = np.array(terms.play_step().mapaccum(300)(0.0, v[None, :], 0.8)).ravel()
    np.testing.assert_allclose(play(v, 0.8), theirs, atol=1e-12)


def test_bouc_wen_agrees_with_casadi_and_with_its_differential_equation():
    x = np.cumsum(np.random.default_rng(8).standard_normal(200))
    step, z, theirs = terms.bouc_wen_step(), 0.0, []
    for before, now in zip(np.concatenate(([0.0], x[:-1])), x):
        z = float(step(z, before, now, 0.7))
        theirs.append(z)
    ours = bouc_wen(x, 0.7)
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
    z, fine = 0.0, []  # Euler steps of z' = x' - |x'| (z + sign(x') |z|)/(2 width), 4000 per sample
    for before, now in zip(np.concatenate(([0.0], x[:-1])), x):
        d = (now - before) / 4000
        for _ in range(4000):
            z += d - abs(d) * (z + np.sign(d) * abs(z)) / 1.4
        fine.append(z)
    np.testing.assert_allclose(ours, fine, atol=2e-3)  # Euler's own error, first order in the step
    assert np.max(np.abs(ours)) <= 0.7


def test_lag_delay_and_hinges_agree_with_casadi():
    x, clock = np.random.default_rng(9).standard_normal(150), Clock(np.arange(150.0), 150)
    lagged = np.array(terms.lag_step().mapaccum(150)(0.0, x[None, :], 0.83)).ravel()
    np.testing.assert_allclose(
        CATALOGUE["lag"].apply(x, np.array([0.83]), clock), lagged, rtol=1e-9, atol=1e-12
    )
    late = CATALOGUE["delay"].apply(x, np.array([2.37]), clock)
    padded = np.concatenate((np.zeros(5), x))
    term = terms.delay_term(4)
    theirs = [float(term(padded[k : k + 6][::-1], 2.37)) for k in range(150)]
    np.testing.assert_allclose(late, theirs, rtol=1e-9, atol=1e-12)
    c = np.array([0.5, 0.3, -0.2, -1.0])
    np.testing.assert_allclose(
        hinges(x, c), np.array(terms.hinges_term(2)(x[None, :], c)).ravel(), atol=1e-12
    )


def test_rate_limit_agrees_with_casadi():
    u = np.repeat(np.random.default_rng(4).standard_normal(60), 5)
    after, mean = terms.rate_step().mapaccum(300)(0.0, u[None, :], 0.31)
    np.testing.assert_allclose(rate_limited_mean(u, 0.31), np.array(mean).ravel(), atol=1e-12)
    np.testing.assert_allclose(rate_limited(u, 0.31), np.array(after).ravel(), atol=1e-12)


@pytest.mark.parametrize(
    "c",
    [
        {0: 0.1, 1: 0.3, 2: 0.05, 3: 0.2, 4: 0.1, 7: 1.0},
        {5: 0.3, 6: 0.2, 7: 0.15, 8: 0.2},
        {1: 0.2, 3: 0.3, 5: 0.2, 7: 1.0},
        {9: 0.1, 10: 0.7, 11: 0.3, 12: 0.4, 13: -0.2, 14: 0.5},
        {15: 0.6, 16: 0.4},
        {4: 0.1, 17: 0.2},
        {1: 0.2, 18: 0.7},
    ],
)
def test_feedback_recursion_agrees_with_casadi(c):
    rng = np.random.default_rng(5)
    A = np.array([[0.0, 1.0], [-0.09, -0.06]])
    columns = np.array([[0.0, 0.0], [0.09, 0.09]])
    phi, gamma = held_response(A, columns, 0.2)
    position, velocity, u = np.array([1.0, 0.0]), np.array([0.0, 1.0]), rng.standard_normal(120)
    gu, gw, values = gamma[:, 0].copy(), gamma[:, 1].copy(), np.zeros(19)
    values[[7, 16]] = 1.0  # divisors: a speed and a width
    values[list(c)] = list(c.values())
    c, z = values, 0.0
    ours = simulate_feedback(u, phi, gu, gw, position, velocity, c, np.zeros(2), 5)
    step, x, theirs = terms.feedback_step(2), np.zeros(2), []
    for value in u:
        theirs.append(x)
        for _ in range(5):
            x, z = step(x, value, phi, gu, gw, position, velocity, c, z)
            x = np.array(x).ravel()
    np.testing.assert_allclose(ours, np.array(theirs), rtol=1e-9, atol=1e-9)


def test_held_response_is_the_matrix_exponential():
    from scipy.linalg import expm

    rng = np.random.default_rng(6)
    A, B = rng.standard_normal((4, 4)), rng.standard_normal((4, 2))
    phi, gamma = held_response(A, B, 0.7)
    np.testing.assert_allclose(phi, expm(0.7 * A), rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(A @ gamma, (expm(0.7 * A) - np.eye(4)) @ B, rtol=1e-9, atol=1e-10)


def test_rational_agrees_with_lfilter():
    from scipy.signal import lfilter

    rng = np.random.default_rng(7)
    u, b, f = rng.standard_normal((200, 2)), np.array([[0.5, 0.2], [0.1, -0.3]]), np.array([-1.5, 0.7])
    expected = sum(lfilter([0.0, 0.0, *b[j]], [1.0, *f], u[:, j]) for j in range(2))
    np.testing.assert_allclose(rational(u, b, f, 1), expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("key", ["input_lines", "output_lines"])
def test_a_broken_line_agrees_with_casadi_and_keeps_the_origin(key):
    x, p = np.linspace(-2, 2, 41), np.array([0.5, -0.4, -1.2, 0.7])
    line = terms.hinges_term(2)
    ours = CATALOGUE[key].apply(x, p, Clock(np.arange(41.0), 41))
    theirs = np.array(line(x[None, :], p)).ravel() - float(line(0.0, p))
    np.testing.assert_allclose(ours, theirs, atol=1e-12)
    assert abs(ours[20]) < 1e-12  # a deviation of zero stays zero


def test_hinges_bend_at_their_corners():
    x = np.linspace(-2, 2, 41)
    expected = x + 0.5 * np.maximum(x - 0.3, 0) - 0.2 * np.maximum(x + 1, 0)
    np.testing.assert_allclose(hinges(x, np.array([0.5, 0.3, -0.2, -1.0])), expected, atol=1e-12)


def _held_oscillator(u, by):
    """Output of an oscillator at 0.7 rad per sample behind a held input, `by` values per sample."""
    A = np.array([[0.0, 1.0], [-0.49, -0.14]])
    Ad, Bd, *_ = cont2discrete((A, np.array([[0.0], [0.49]]), np.eye(2), np.zeros((2, 1))), 1.0 / by)
    x, fine = np.zeros(2), []
    for v in np.repeat(u, by):
        fine.append(x[0])
        x = Ad @ x + Bd[:, 0] * v
    return np.array(fine)


def test_output_between_samples_is_that_of_the_continuous_system():
    u = np.random.default_rng(11).standard_normal(300)
    fine = _held_oscillator(u, 8)
    sampled = cont2discrete((np.array([[0.0, 1.0], [-0.49, -0.14]]), np.array([[0.0], [0.49]]),
                             np.array([[1.0, 0.0]]), np.zeros((1, 1))), 1.0)  # fmt: skip
    num, den = ss2tf(*sampled[:4])
    ours = between_samples(u[:, None], num[:, 1:], np.asarray(den)[1:], 0, 8)
    assert ours is not None
    np.testing.assert_allclose(ours.ravel(), fine, atol=1e-10)
    assert between_samples(u[:, None], np.ones((1, 1)), np.array([0.5]), 0, 8) is None  # pole at -0.5


@pytest.mark.parametrize("key, by", [("backlash_output", 64), ("backlash_sampled", 1)])
def test_play_at_the_output_is_fitted_to_the_noise_between_and_on_the_samples(key, by):
    rng = np.random.default_rng(21)
    u = rng.standard_normal(500)
    fine = _held_oscillator(u, by)
    y = play(fine, 0.2 * fine.std())[::by]
    noise = 0.003 * y.std()
    y = y + noise * rng.standard_normal(len(y))
    channel = Channel(u[:, None], y, Clock(np.arange(500.0), 500), np.ones(500, dtype=bool))
    base = fit_linear(channel, Structure(2))
    errors = {
        k: np.sqrt(np.mean(next(iter(augmented(channel, base, only={k}))).residual ** 2))
        for k in ("backlash_output", "backlash_sampled")
    }
    assert min(errors, key=errors.__getitem__) == key
    assert errors[key] < 1.1 * noise
    assert max(errors.values()) > 2 * noise  # the other of the two does not explain it


@pytest.mark.parametrize(
    "structure, p",
    [
        (Structure(2, (0, 1), delay=1), [-1.2, 0.5, 0.3, 0.1, -0.2, 0.4]),
        (Structure(2).adding(Part("saturation")).adding(Part("output_cubic")).adding(Part("output_quadratic")),
         [-1.2, 0.5, 0.3, 0.1, 0.8, 0.01, 0.02]),
        (Structure(2).adding(Part("offset")).adding(Part("initial")), [-1.2, 0.5, 0.3, 0.1, 0.8, 1.0, 0.5]),
        (Structure(2).adding(Part("mode", 0, 2)), [-1.2, 0.5, 0.3, 0.1, 0.1, 0.1, -1.3, 0.6]),
        (Structure(2).adding(Part("sandwich", 0, 101)), [-1.2, 0.5, 0.3, 0.1, -0.5, 0.2, 0.3, 0.4]),
        (Structure(2, layout="oscillator", delay=1).adding(Part("stiffness_cubic")).adding(Part("output_arctan")),
         [-2.0, -1.0, 1.0, 0.3, 0.1, 0.3]),
    ],
)  # fmt: skip
def test_exact_derivatives_agree_with_differences(structure, p):
    rng, p = np.random.default_rng(5), np.array(p)
    u, clock = rng.standard_normal((200, 2)), Clock(np.arange(200.0), 200)
    columns = dict(exact_columns(structure, p, u, clock))
    assert set(columns) >= set(range(structure.plant_size - structure.taps, structure.plant_size))
    for i, column in columns.items():
        ahead, behind = p.copy(), p.copy()
        ahead[i] += 1e-6
        behind[i] -= 1e-6
        twin = (simulate(structure, ahead, u, clock) - simulate(structure, behind, u, clock)) / 2e-6
        np.testing.assert_allclose(column, twin, atol=1e-5 * np.abs(twin).max())


def test_an_effect_with_memory_at_the_output_has_no_exact_derivatives():
    s, u = Structure(1).adding(Part("lag")), np.ones((30, 1))
    assert not dict(exact_columns(s, np.array([-0.5, 0.3, 0.4]), u, Clock(np.arange(30.0), 30)))


def stick_slip(u, rate, level, tilt):
    """v' = rate (u - v - friction) sampled, event by event: between events v is an exponential."""
    v, out = 0.0, []
    for held in u:
        out.append(v)
        left = 1.0
        while left > 0:
            up, down = level * (1 + tilt), level * (1 - tilt)
            if v == 0 and -down <= held <= up:
                break
            side = np.sign(v) if v != 0 else np.sign(held)
            target = held - (up if side > 0 else -down)
            stop = np.log((v - target) / -target) / rate if v * target < 0 else np.inf
            if stop >= left:
                v, left = target + (v - target) * np.exp(-rate * left), 0.0
            else:
                v, left = 0.0, left - stop
    return np.array(out)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_dry_friction_is_exact_to_second_order(tilt):
    """A motor that stops and reverses within samples, against its exact solution; four times the steps, 16 times less error."""
    rng = np.random.default_rng(8)
    u, level = np.repeat(rng.uniform(-1.0, 1.0, 100), 7), 0.35
    exact = stick_slip(u, 0.16, level, tilt)
    assert np.sum(exact == 0.0) > 50  # it sticks
    assert np.sum(exact[1:] * exact[:-1] < 0) > 5  # and reverses
    rates, c = np.log([0.16]), np.zeros(19)
    c[[5, 7, 8, 16]] = level, 1.0, tilt, 1.0
    errors = [np.abs(states("first", rates, u, c, steps=n)[:, 0] - exact).max() for n in (5, 20)]
    assert errors[0] < 2e-3 * np.std(exact)
    assert errors[1] < errors[0] / 10


def test_every_parameter_has_a_name_and_a_unit():
    names = lambda part, order=2: [name for name, _ in part.parameters(order)]
    assert names(Part("output_lines", 0, 2)) == ["slope1", "corner1", "slope2", "corner2"]
    assert [unit for _, unit in Part("output_lines", 0, 1).parameters(2)] == ["1", "y"]
    assert names(Part("sandwich", 0, 101)) == ["f1", "b1", "slope1", "corner1"]
    assert names(Part("cross", 1, 1)) == ["b1", "f1"]
    assert names(Part("initial"), 3) == ["x1", "x2", "x3"]
    assert names(Part("tones", 0, 2))[3:] == ["frequency2", "cosine2", "sine2"]
    for key in CATALOGUE:
        part = Part(key)
        assert len(part.parameters(2)) == part.count(2) == Structure(2).adding(part).size - 4
