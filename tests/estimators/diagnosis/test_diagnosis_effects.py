"""The NumPy maps and compiled recursions of the catalogue against their CasADi definitions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, ss2tf

from estimators.diagnosis.effects import CATALOGUE, Clock, named
from estimators.diagnosis.effects.kernels import plant_kernels
from estimators.diagnosis.effects.kernels.plant_kernels import Elements, Held, bouc_wen, held_response
from estimators.diagnosis.effects.kernels.recursion_kernels import (
    hinges,
    play,
    rate_limited,
    servo_mean,
)
from estimators.diagnosis.effects.symbols import terms
from estimators.diagnosis.model import fitting, simulation
from estimators.diagnosis.model.derivatives import exact_columns
from estimators.diagnosis.model.fitting import Channel
from estimators.diagnosis.model.intersample import between_samples
from estimators.diagnosis.model.layouts import Inside, layout_matrices, states
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.model.transfer_kernels import rational
from estimators.diagnosis.search.candidates import Menu, augmented
from tests.estimators.diagnosis.case_effects import LINEAR

CURVES = {
    "saturation": lambda x, a, b: min(max(x, -a), a), "saturation_asymmetric": lambda x, a, b: max(min(x, a), b),
    "saturation_upper": lambda x, a, b: min(x, a), "saturation_lower": lambda x, a, b: max(x, a),
    "dead_zone": lambda x, a, b: x - a if x > a else x + a if x < -a else 0.0,
    "dead_zone_asymmetric": lambda x, a, b: x - max(a, b) if x > max(a, b) else x - min(a, b) if x < min(a, b) else 0.0,
    "input_quadratic": lambda x, a, b: x + a * x**2, "input_cubic": lambda x, a, b: x + a * x**3,
    "input_polynomial": lambda x, a, b: x + a * x**2 + b * x**3,
    "output_quadratic": lambda x, a, b: x + a * x**2, "output_cubic": lambda x, a, b: x + a * x**3,
    "output_polynomial": lambda x, a, b: x + a * x**2 + b * x**3,
    "output_arctan": lambda x, a, b: math.atan(a * x) / a, "output_tanh": lambda x, a, b: math.tanh(a * x) / a,
    "output_ratio": lambda x, a, b: x / (1.0 + abs(a * x)), "output_hyperbola": lambda x, a, b: x / max(1.0 - a * x, 0.02),
    "output_clip": lambda x, a, b: min(max(x, -a), a), "output_clip_upper": lambda x, a, b: min(x, a),
    "output_clip_lower": lambda x, a, b: max(x, a), "output_absolute": lambda x, a, b: x + a * abs(x),
    "output_dead_zone": lambda x, a, b: x - max(a, b) if x > max(a, b) else x - min(a, b) if x < min(a, b) else 0.0,
    "offset": lambda x, a, b: x + a, "input_staircase": lambda x, a, b: b + a * round((x - b) / a),
}  # fmt: skip


def _stepped(x, k, p):
    return x + sum(a * min(max(k - t, 0), 1) for a, t in zip(p[::2], p[1::2], strict=True))


TIMED = {
    "gain_change": ([0.3, 70.4], lambda x, k, p: x * (1 + p[0] * min(max(k - p[1], 0), 1))),
    "step_input": ([0.3, 70.4], _stepped), "step_output": ([0.3, 70.4], _stepped),
    "pulse_input": ([0.3, 30.4, 70.4], lambda x, k, p: _stepped(x, k, [p[0], p[1], -p[0], p[2]])),
    "steps_input": ([0.3, 70.4, -0.2, 90.0], _stepped), "steps_output": ([0.3, 70.4, -0.2, 90.0], _stepped),
    "tones": ([0.2, 0.5, -0.4], lambda x, k, p: x + p[1] * math.cos(p[0] * k) + p[2] * math.sin(p[0] * k)),
    "waveform": ([0.2, 0.5, -0.4], lambda x, k, p: x + p[1] * math.cos(p[0] * k) + p[2] * math.sin(p[0] * k)),
    "misread": ([0.7, 0.2, 30.4, 70.4], lambda x, k, p: p[0] * x + p[1] if p[2] < k <= p[3] else x), "misread_since": ([0.7, 0.2, 70.4], lambda x, k, p: p[0] * x + p[1] if p[2] < k else x),
    "drift": ([0.1, 0.7], lambda x, k, p: x + p[0] + p[1] * k / 150),
    "gain_periodic": ([0.2, 0.5, -0.4], lambda x, k, p: x * (1 + p[1] * math.cos(p[0] * k) + p[2] * math.sin(p[0] * k))),
    "gain_drift": ([0.4], lambda x, k, p: x * (1 + p[0] * k / 150)),
    "gain_decay": ([0.4], lambda x, k, p: x * math.exp(-p[0] * k / 150)),
}  # fmt: skip


@pytest.mark.parametrize("key", CURVES)
def test_a_static_map_is_its_formula_in_numbers_and_in_casadi_symbols(key):
    x, e = 2 * np.random.default_rng(1).standard_normal(200), named(key)
    p = np.array([0.4, -0.7] if key == "saturation_asymmetric" else [0.3, 0.2])[: len(e.parameters)]
    expected = [CURVES[key](v, p[0], p[-1]) for v in x]
    clock = Clock(np.arange(200.0), 200)
    np.testing.assert_allclose(e.apply(x, p, clock), expected, rtol=1e-9, atol=1e-12)
    term = terms.map_term(e.apply, p, 200)
    np.testing.assert_allclose(np.array(term(x[None, :], 0)).ravel(), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("key", TIMED)
def test_a_map_that_depends_on_time_is_its_formula(key):
    x, k = np.random.default_rng(2).standard_normal(150), np.arange(150.0)
    p, formula = TIMED[key]
    expected = [formula(a, b, p) for a, b in zip(x, k)]
    np.testing.assert_allclose(
        named(key).apply(x, np.array(p), Clock(k, 150)), expected, rtol=1e-9, atol=1e-12
    )


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
    np.testing.assert_allclose(named("lag").apply(x, np.array([0.83]), clock), lagged, rtol=1e-9, atol=1e-12)
    late = named("delay").apply(x, np.array([2.37]), clock)
    padded = np.concatenate((np.zeros(5), x))
    term = terms.delay_term(4)
    theirs = [float(term(padded[k : k + 6][::-1], 2.37)) for k in range(150)]
    np.testing.assert_allclose(late, theirs, rtol=1e-9, atol=1e-12)
    c = np.array([0.5, 0.3, -0.2, -1.0])
    np.testing.assert_allclose(
        hinges(x, c), np.array(terms.hinges_term(2)(x[None, :], c)).ravel(), atol=1e-12
    )


@pytest.mark.parametrize("lag", [0.0, 0.4, 3.0])
def test_a_limited_servo_agrees_with_casadi_and_with_its_differential_equation(lag):
    u, v, fine = np.repeat(np.random.default_rng(4).standard_normal(20), 3), 0.2, []
    after, mean = terms.servo_step().mapaccum(60)(0.2, u[None, :], 0.31, 0.17, lag)
    ours = servo_mean(u, np.array([0.31]), np.array([0.17]), lag, 0.2)
    np.testing.assert_allclose(ours, np.array(mean).ravel(), atol=1e-12)
    for value in u:  # Euler steps of v' = (u - v)/lag within -0.17 and 0.31
        x, v = v, np.empty(2000)
        for i in range(2000):
            v[i] = x
            x += min(max((value - x) / max(lag, 1e-3), -0.17), 0.31) / 2000
        fine.append(v.mean())
        v = x
    np.testing.assert_allclose(ours, fine, atol=1e-3)
    if lag == 0.0:
        after, _ = terms.servo_step().mapaccum(60)(0.2, u[None, :], 0.31, 0.31, lag)
        np.testing.assert_allclose(rate_limited(u, 0.31, 0.2), np.array(after).ravel(), atol=1e-12)


INSIDE = {
    "linear": [], "springs": [("stiffness", [0.1, 0.3])], "two": [("stiffness_square", [0.05]), ("drag", [0.2])],
    "dry": [("stribeck", [0.3, 0.2, 0.15])], "grip": [("coulomb_grip", [0.4])], "tilted": [("coulomb_asymmetric", [0.3, 0.2]), ("drag", [0.3])],
    "corners": [("stiffness_upper", [0.7, 0.3]), ("stiffness_lower", [0.4, -0.2])], "gap": [("stiffness_gap", [0.7, -0.3])],
    "fifth": [("stiffness_quintic", [0.1, 0.1])], "damping": [("position_damping", [0.5])],
    "hysteresis": [("hysteretic_spring", [0.24, 0.4])], "input": [("bilinear", [0.1]), ("bilinear_driven", [0.2])],
    "stop": [("stiffness_cubic", [0.2]), ("end_stop", [0.7])],
}  # fmt: skip


@pytest.mark.parametrize("parts", INSIDE.values(), ids=INSIDE)
def test_feedback_recursion_agrees_with_casadi(parts):
    rng = np.random.default_rng(5)
    rates, u = np.log([0.09, 0.06]), rng.standard_normal(120)
    effects = [(named(key), np.array(q)) for key, q in parts]
    forces = [(e.force, q) for e, q in effects if e.force is not None]
    elements = {k: v for e, q in effects if e.inside is not None for k, v in e.inside(q).items()}
    ours = states("oscillator", rates, u, Inside(tuple((f, q, None) for f, q in forces), elements))
    A, B, E, position, velocity = layout_matrices("oscillator", rates)
    phi, gamma = held_response(A, np.stack((B, E), axis=1), 0.2)
    held = Held(phi, gamma[:, 0], gamma[:, 1], position, velocity)
    step = terms.feedback_step(2, held, Elements(**elements), forces)
    x, z, theirs = np.zeros(2), 0.0, []
    for value in u:
        theirs.append(x)
        for _ in range(5):
            x, z = step(x, value, z)
            x = np.array(x).ravel()
    np.testing.assert_allclose(ours, np.array(theirs), rtol=1e-9, atol=1e-9)
    if parts:  # the control: it is not what the linear plant does
        assert np.max(np.abs(ours - states("oscillator", rates, u))) > 1e-3


def test_inputs_of_a_plant_add_up_and_a_force_reads_its_own():
    """Without forces the sum of one input each; a product of the state with the second input is that of a plant whose rate follows it."""
    rng = np.random.default_rng(8)
    U, r, b = rng.standard_normal((200, 2)), np.log([0.2, 0.1]), np.array([0.3, -0.1])
    own = states("oscillator", np.concatenate((r, b)), np.stack((0 * U[:, 1], U[:, 1]), axis=1))
    np.testing.assert_allclose(
        states("oscillator", np.concatenate((r, b)), U), states("oscillator", r, U[:, 0]) + own, atol=1e-12
    )
    s = Structure(1, (0, 1), layout="first").adding(Part(named("bilinear"), 1))
    y = simulate(s, np.array([np.log(0.2), 1.0, 0.05, 0.4]), U, Clock(np.arange(200.0), 200))
    x, exact = 0.0, []
    for u, w in U:
        exact.append(x)
        rate = 0.2 * (1.0 - 0.4 * w)
        x = x * np.exp(-rate) + (1 - np.exp(-rate)) * (0.2 * u + 0.05 * w) / rate
    np.testing.assert_allclose(y, exact, atol=5e-4)  # five steps a sample


def test_a_model_bears_as_many_forces_as_the_recursion_takes():
    assert simulation.MOST_FORCES == plant_kernels.MOST_FORCES
    s = Structure(2, layout="oscillator")
    for key in ("stiffness_cubic", "drag", "bilinear"):
        s = s.adding(Part(named(key)))
    y = simulate(s, np.array([-2, -2, 1, 0, 0.1, 0.1, 0.1]), np.ones((9, 1)), Clock(np.arange(9.0), 9))
    assert np.all(np.isinf(y))


def test_a_force_with_a_signal_is_a_plant_whose_rate_follows_it():
    """x' = a (u - x - s x) with s of time alone: exact between samples where s is held."""
    a, u, s = 0.2, np.random.default_rng(3).standard_normal(80), np.linspace(-0.5, 1.5, 80)
    force = lambda p, v, u, q, s, c: c[0] * s * p
    ours = states("first", np.log([a]), u, Inside(((force, np.array([1.0]), s),), steps=40))[:, 0]
    x, exact = 0.0, []
    for value, level in zip(u, s):
        exact.append(x)
        rate = a * (1 + level)
        x = x * np.exp(-rate) + (1 - np.exp(-rate)) * a * value / rate
    np.testing.assert_allclose(ours, exact, atol=2e-4)


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
    np.testing.assert_allclose(rational(u, b, f, 1, np.zeros(0)), expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("key", ["input_lines", "output_lines"])
def test_a_broken_line_agrees_with_casadi_and_keeps_the_origin(key):
    x, p = np.linspace(-2, 2, 41), np.array([0.5, -0.4, -1.2, 0.7])
    line = terms.hinges_term(2)
    ours = named(key).apply(x, p, Clock(np.arange(41.0), 41))
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
        k: np.sqrt(np.mean(next(iter(augmented(channel, base, Menu((named(k),))))).residual ** 2))
        for k in ("backlash_output", "backlash_sampled")
    }
    assert min(errors, key=errors.__getitem__) == key
    assert errors[key] < 1.1 * noise
    assert max(errors.values()) > 2 * noise  # the other of the two does not explain it


@pytest.mark.parametrize(
    "structure, p",
    [
        (Structure(2, (0, 1), delay=1), [-1.2, 0.5, 0.3, 0.1, -0.2, 0.4]),
        (Structure(2).adding(Part(named("saturation"))).adding(Part(named("output_cubic"))).adding(Part(named("output_quadratic"))),
         [-1.2, 0.5, 0.3, 0.1, 0.8, 0.01, 0.02]),
        (Structure(2).adding(Part(named("offset"))).adding(Part(named("initial"))), [-1.2, 0.5, 0.3, 0.1, 0.8, 1.0, 0.5]),
        (Structure(2).adding(Part(named("mode"), 0, 2)), [-1.2, 0.5, 0.3, 0.1, 0.1, 0.1, -1.3, 0.6]),
        (Structure(2).adding(Part(named("sandwich"), first=1, free=True)), [-1.2, 0.5, 0.3, 0.1, -0.5, 0.2, 0.3, 0.4]),
        (Structure(2, layout="oscillator", delay=1).adding(Part(named("stiffness_cubic"))).adding(Part(named("output_arctan"))),
         [-2.0, -1.0, 1.0, 0.3, 0.1, 0.3]),
        (Structure(2).adding(Part(named("offset"))).adding(Part(named("initial"))).adding(Part(named("output_cubic"))),
         [-1.2, 0.5, 0.3, 0.2, 0.4, 0.7, -0.3, 0.05]),
        (Structure(2).adding(Part(named("tones"), size=2)), [-1.2, 0.5, 0.3, 0.1, 0.2, 0.3, -0.1, 1.1, 0.2, 0.4]),
        (Structure(2).adding(Part(named("waveform"), size=2)), [-1.2, 0.5, 0.3, 0.1, 0.2, 0.3, -0.1, 0.2, 0.4]),
        *((Structure(2).adding(Part(named("output_cubic"))).adding(Part(named(key))), [-1.2, 0.5, 0.3, 0.1, 0.05, *q])
          for key, q in LINEAR.items()),
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


def test_coarse_differences_end_at_the_minimum_of_the_fine_ones(monkeypatch):
    rng, clock = np.random.default_rng(6), Clock(np.arange(400.0), 400)
    s = Structure(2, layout="oscillator").adding(Part(named("stiffness_cubic")))
    p, u = np.array([-1.5, -1.5, 1.0, 0.0, 0.4]), 2.0 * rng.standard_normal((400, 1))
    y = simulate(s, p, u, clock)
    channel = Channel(u, y + 0.05 * np.std(y) * rng.standard_normal(400), clock, np.ones(400, dtype=bool))
    fits = []
    for steps in (fitting.COARSE, s.steps):
        monkeypatch.setattr(fitting, "COARSE", steps)
        fits.append(
            fitting.fit(channel, s, p * np.array([1.1, 1.1, 0.8, 1.0, 0.5]), np.ones(5), iterations=40)
        )
    coarse, fine = fits
    assert abs(coarse.deviance - fine.deviance) < 0.05
    np.testing.assert_allclose(coarse.p, fine.p, atol=2e-3)
    assert (
        fine.deviance
        < fitting.fit(channel, s, p * np.array([1.1, 1.1, 0.8, 1.0, 0.5]), np.ones(5), iterations=1).deviance
    )


def test_an_effect_with_a_memory_that_is_not_linear_has_no_exact_derivatives():
    s, u = Structure(1).adding(Part(named("backlash_output"))), np.ones((30, 1))
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
    rates, dry = np.log([0.16]), Inside(elements={"coulomb": level, "tilt": tilt})
    errors = [np.abs(states("first", rates, u, replace(dry, steps=n))[:, 0] - exact).max() for n in (5, 20)]
    assert errors[0] < 2e-3 * np.std(exact)
    assert errors[1] < errors[0] / 10


def test_every_parameter_has_a_name_and_a_unit():
    names = lambda part, order=2: [name for name, _ in part.parameters(order)]
    assert names(Part(named("output_lines"), 0, 2)) == ["slope1", "corner1", "slope2", "corner2"]
    assert [unit for _, unit in Part(named("output_lines"), 0, 1).parameters(2)] == ["1", "y"]
    assert names(Part(named("sandwich"), first=1, free=True)) == ["f1", "b1", "slope1", "corner1"]
    assert names(Part(named("cross"), 1, 1)) == ["b1", "f1"]
    assert names(Part(named("initial")), 3) == ["x1", "x2", "x3"]
    assert names(Part(named("tones"), 0, 2))[3:] == ["frequency2", "cosine2", "sine2"]
    for e in CATALOGUE:
        part = Part(e)
        assert len(part.parameters(2)) == part.count(2) == Structure(2).adding(part).size - 4
