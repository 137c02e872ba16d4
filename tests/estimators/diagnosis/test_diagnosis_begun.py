"""What records do not say: changes before a first move, dynamics where a store was full, signs without meaning, loops of two sensors."""

import warnings
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline import Options, best_linear
from estimators.diagnosis.effects import Nature, named
from estimators.diagnosis.effects.disturbances.added import begun_beside, run_up
from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.effects.process import at_once
from estimators.diagnosis.ladder.claims import Claim
from estimators.diagnosis.loop import diagnose
from estimators.diagnosis.model.errors import parameters_of
from estimators.diagnosis.model.fitting import Channel, fit
from estimators.diagnosis.model.linear import fit_linear, plant_scales
from estimators.diagnosis.model.simulation import ENDS, simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.search.named import linear_step
from estimators.diagnosis.search.naming import MUST, as_shown, bending
from oed.data import Record
from tests.estimators.diagnosis.case_small import looking_for

N = 800
CLOCK = Clock(np.arange(float(N)), N)


def _channel(u: np.ndarray, y: np.ndarray) -> Channel:
    return Channel(u[:, None], y, CLOCK, np.ones(N, dtype=bool))


@pytest.mark.parametrize("key, moves", [("gain_change", True), ("pole_change", True), ("step_output", False)])
def test_no_change_of_the_system_is_dated_before_its_input_has_moved(key, moves, rng) -> None:
    """A heated plate that cooled until its lamp was switched on had "one time constant changes abruptly" as its cause."""
    u = np.where(np.arange(N) < N // 4, 0.0, rng.standard_normal(N))
    effect = named(key)
    s = Structure(2, layout=next(iter(effect.change or ("tf",)))).adding(Part(effect))
    for at, bears in ((0.2, not moves), (0.25 + 0.9 * ENDS, not moves), (0.25 + 1.1 * ENDS, True)):
        p = np.concatenate((np.full(s.plant_size, -0.3), [0.2, at * N]))
        assert np.all(np.isfinite(simulate(s, p, u[:, None], CLOCK))) == bears


def _tired(rng, deviates: float, use: float) -> tuple[Channel, Any]:
    """A record from a full store, and the fit of the effect that made it."""
    u = np.where(np.arange(N) < 10, 0.0, 10.0 + deviates * np.repeat(rng.uniform(-1, 1, N // 20), 20))
    s = Structure(1).adding(Part(named("gain_fatigue")))
    p = np.array([-0.8, 0.2, use, 0.01])
    y = simulate(s, p, u[:, None], CLOCK) + 0.01 * rng.standard_normal(N)
    channel = _channel(u, y)
    scales = np.concatenate((plant_scales(Structure(1), p[:2]), [use, 0.01]))
    return channel, fit(channel, s, p * [1.0, 1.0, -1.0, -1.0], scales)


def _renamed(channel: Channel, f: Any, gained: float, alternatives: list[Any]) -> list[str]:
    part = f.structure.parts[-1]
    gain: Any = SimpleNamespace(value=gained)
    claim: Any = Claim(part, gain, 0.0)
    bench: Any = SimpleNamespace(
        channel=channel, output=0, over=lambda *_: SimpleNamespace(value=gained),
        linear=np.zeros(N),
    )  # fmt: skip
    return [c.part.key for c in bending(bench, f, [claim], np.zeros(N), alternatives)]


def test_a_store_that_was_full_is_no_missing_mode_where_more_dynamics_leave_what_it_explains(rng) -> None:
    """Of a motor that warms up, most of the gain over a linear model is of its slow pole; what bends beside it is the answer."""
    channel, f = _tired(rng, 3.0, 0.002)
    linear = fit_linear(channel, Structure(2, parts=(Part(named("order")),)))
    squares = lambda g: float(np.mean(g.residual**2))
    more = squares(linear) - squares(f)
    assert linear.structure.effects[0].effect.nature is Nature.LINEAR
    assert more > squares(f)
    gained = 1e6 * more
    assert _renamed(channel, f, gained, []) == ["order"]
    assert _renamed(channel, f, gained, [linear]) == ["gain_fatigue"]
    as_good = replace(linear, residual=1.3 * f.residual)
    assert _renamed(channel, f, gained, [as_good]) == ["order"]
    worse_than_the_bend = replace(linear, residual=linear.residual + 1e3 / MUST)
    assert _renamed(channel, f, gained, [worse_than_the_bend]) == ["order"]


def test_friction_that_grows_with_the_deflection_is_no_missing_mode_though_it_is_in_proportion(rng) -> None:
    """A ring spring's run is as large as its input, with either sign: what two parts of an input do together shows it."""
    s, u = Structure(2, layout="oscillator").adding(Part(named("coulomb_grip"))), rng.standard_normal((N, 1))
    p = np.concatenate((np.log([0.09, 0.06]), [1.0, 0.0, 0.4]))
    channel = _channel(u[:, 0], simulate(s, p, u, CLOCK) + 0.01 * rng.standard_normal(N))
    f = fit(channel, s, p, np.ones(5))
    assert f.p[-1] == pytest.approx(0.4, rel=0.05)
    gained = 0.5 * float(np.var(channel.y))
    assert _renamed(channel, f, gained, []) == ["coulomb_grip"]
    f = replace(f, p=np.concatenate((f.p[:-1], [0.01])))
    assert _renamed(channel, f, gained, []) == ["order"]


@pytest.mark.parametrize(("more", "key"), [(0.0, "order"), (60.0, "capacity_bump")])
def test_a_bump_far_from_all_levels_is_no_lag_though_its_size_is_told_from_nothing(more, key, rng) -> None:
    """An accumulator's gas spring, softer the fuller it is, was a bump of 2193 +- 50340 at -9 +- 41 L/min and became "more dynamics"."""
    u = np.repeat(rng.uniform(-1.0, 1.0, N // 8), 8)
    s = Structure(1).adding(Part(named("capacity_bump")))
    p = np.array([-0.3, 0.7, 0.5, more, -4.0, 2.0])
    channel = _channel(u, simulate(s, p, u[:, None], CLOCK) + 0.02 * rng.standard_normal(N))
    f = fit(channel, s, p + [0.0, 0.0, 0.0, 0.1, 0.0, 0.0], np.ones(6))
    value, error, _ = parameters_of(f, channel)["capacity_bump.more"]
    assert abs(value) < 1.96 * error
    assert as_shown(f.structure.parts[-1], f, channel).effect.key == key


@pytest.mark.parametrize(
    ("key", "q", "shown"),
    [("check_valve", [0.3, 0.2, -0.5, 2.5], "check_valve"), ("check_valve", [0.2, 1.4, -9.0, 2.5], "order"),
     ("pull_out", [0.3, 0.5, 0.1, 0.0, 2.5], "pull_out"), ("pull_out", [0.3, 40.0, 0.1, 0.0, 2.5], "order")],
)  # fmt: skip
def test_a_valve_that_never_closes_and_a_slip_far_from_that_of_most_torque_are_more_dynamics(
    key, q, shown, rng
) -> None:
    """Of three lags, a linear model of order two left what either took up whole."""
    u = np.repeat(rng.uniform(-1.0, 1.0, N // 8), 8)
    s = Structure(1).adding(Part(named(key)))
    p = np.array([-0.3, 0.7, *q])
    channel = _channel(u, simulate(s, p, u[:, None], CLOCK) + 0.02 * rng.standard_normal(N))
    f = fit(channel, s, p * 1.02, np.ones(len(p)))
    assert as_shown(f.structure.parts[-1], f, channel).effect.key == shown


def test_a_lag_before_a_process_moves_on_within_each_sample() -> None:
    """Against steps of a two-hundredth of a sample: held over each sample at its end or its mean, the lag would put it off by .13 and .024, not .0035."""
    fine, u = 200, np.repeat([3.0, 5.0, 2.0, 4.0, 1.0], 12)
    rate, loss, level, lag = 0.3, 0.1, 0.5, 1.5
    s, x, out = u[0], (u[0] + loss * level) / (1.0 + loss), []
    for value in u:
        for _ in range(fine):
            x += rate * (max(s - x, 0.0) - loss * (x - level)) / fine
            s += (value - s) / lag / fine
        out.append(x)
    found = named("check_valve").apply(u, np.array([rate, loss, level, lag]), Clock(np.arange(60.0), 60))  # pyright: ignore[reportOptionalCall]
    np.testing.assert_allclose(found, out, atol=5e-3)


def test_a_parameter_whose_sign_means_nothing_is_said_by_its_size(rng) -> None:
    channel, f = _tired(rng, 3.0, 0.002)
    assert max(f.p[2:]) < 0.0
    said = parameters_of(f, channel)
    assert said["gain_fatigue.use"][0] == pytest.approx(0.002, rel=0.1)
    assert said["gain_fatigue.recovery"][0] == pytest.approx(0.01, rel=0.2)
    bent = fit(channel, Structure(1).adding(Part(named("input_quadratic"))),
               np.array([-0.8, 0.2, -0.01]), np.array([1.0, 1.0, 0.1]))  # fmt: skip
    assert parameters_of(bent, channel)["input_quadratic.c2"][0] == bent.p[2] < 0.0


@pytest.mark.slow
def test_two_measurements_of_one_thing_are_no_closed_loop(rng) -> None:
    """Each has noise of its own, so that the past of one helps to predict the other: "the input answers the noise" was said of two
    seismometers side by side, and of the temperatures on the two sides of a wall."""

    def record(n: int) -> Record:
        shaken = lfilter([0.28], [1.0, -1.6, 0.8], rng.standard_normal(n + 200))[200:]
        return Record(
            shaken + 0.15 * rng.standard_normal(n),
            lfilter([1.0, -0.3], [1.0, -0.5], shaken) + 0.15 * rng.standard_normal(n),
        )

    d = diagnose(record(600), record(400), looking_for("feedback", "input_quadratic", "saturation"))
    assert d.effect in ("none", "coloured_noise")
    assert "closed_loop" not in d.ranked
    assert "in two measurements of one thing" in str(d).splitlines()[0]


def test_what_several_inputs_feed_is_simulated_with_a_signal_set_beside_them(rng) -> None:
    """The search for a second stage set one beside three inputs that a process had mixed: a record of soil moisture ended in an error."""
    u = rng.uniform(1.0, 3.0, (N, 3))
    s = Structure(1, inputs=(0, 1, 2)).adding(Part(named("outflow_root_fed"), 0, 2))
    p = np.concatenate(([-0.5, 0.3, 0.2, 0.1], [0.2, 1.0, 0.6, 0.3]))
    y = simulate(s, p, u, CLOCK)
    channel = Channel(u, y + 0.01 * rng.standard_normal(N), CLOCK, np.ones(N, dtype=bool))
    beside = begun_beside(channel, fit(channel, s, p, np.abs(p)), np.sin(0.1 * CLOCK.k))[1]
    assert np.array_equal(simulate(s, p, np.column_stack((u, y)), CLOCK), y)
    assert np.all(np.isfinite(list(beside.values())))


def test_a_sweep_from_standstill_divides_by_no_frequency() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.all(np.isfinite(run_up(np.zeros(N), np.array([0.0, 1e-4, 1.0, 0.5, 2.0]), CLOCK)))


def test_a_linear_model_that_cancels_gains_of_a_million_is_not_the_best() -> None:
    """A gauge with play under slow sinusoids: ten coefficients cancel at their frequencies, and a test record that begins with another
    value had an error of 4644 "before", of a signal of 1.07."""
    rng, k = np.random.default_rng([4, 1, 7]), np.arange(1600)
    lines = np.arange(1, 16) * 0.12 / 15
    u = np.sqrt(2 / 15) * np.cos(np.pi * k[:, None] * lines + rng.uniform(0, 2 * np.pi, 15)).sum(axis=1)
    x, seen, y = lfilter([0.0, 0.05, 0.045], [1.0, -1.74, 0.78], u), 0.0, np.empty(1600)
    for i, value in enumerate(x):
        y[i] = seen = min(max(seen, value - 0.3), value + 0.3)
    record = Record(u, y + 0.02 * rng.standard_normal(1600))
    train, test = record[:1200], record[1200:]
    base = best_linear([train], Options(asked=(test.u,)))
    step = linear_step(base, 0, False)
    for of in (train, test):
        assert np.sqrt(np.mean((step.simulate(of, 0) - of.y[:, 0]) ** 2)) < 0.6 * np.std(y)
    assert base.rmse_unused[0] < 0.3 * np.std(y)


@pytest.mark.parametrize(("more", "instant"), [(0.0, True), (200.0, False)])
def test_a_process_has_no_memory_where_its_capacity_lets_it_have_none(more, instant, rng) -> None:
    """A vessel that widens was a curve of its input: beside a bump of two hundred its rate is none of the record's."""
    u = 3.0 + rng.standard_normal(N)
    assert at_once(named("capacity_bump"), np.array([4.5, more, 3.0, 3.0]), _channel(u, u), 0) is instant
