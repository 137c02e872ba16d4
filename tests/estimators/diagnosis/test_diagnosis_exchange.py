"""The backward step of the selection, whole delays, changes of gain, and wild samples where a play turns."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.kernels.recursion_kernels import play
from estimators.diagnosis.model.fitting import Channel, fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.record.measurement import at_extremes, at_reversals, held_samples
from estimators.diagnosis.search.candidates import Menu, augmented
from estimators.diagnosis.search.exchange import (
    akin,
    drifting,
    exchanged,
    trending,
    whole_delay,
    without,
    without_idle,
)

B, A = [0.0, 0.1, 0.08], [1.0, -1.5, 0.7]


def channel_of(u, y):
    n = len(y)
    return Channel(u[:, None], np.asarray(y), Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))


def added(channel, base, key):
    return min(augmented(channel, base, Menu((named(key),))), key=lambda f: f.criterion)


def test_a_step_at_the_wrong_place_is_exchanged_and_an_idle_effect_taken_out():
    rng = np.random.default_rng(31)
    u = rng.standard_normal(500)
    y = lfilter(B, A, u)
    y = play(np.ascontiguousarray(y), 0.15 * y.std()) + 0.5 * (np.arange(500) >= 290)
    noise = 0.01 * rng.standard_normal(500)
    channel = channel_of(u, y + noise)
    model = added(channel, fit_linear(channel, Structure(2)), "backlash_sampled")
    model = added(channel, model, "step_input")
    s = model.structure.adding(Part(named("output_cubic")))
    idle = fit(channel, s, np.append(model.p, 1e-4), np.append(model.scales, 0.01))
    best, came, rests = exchanged(channel, idle, Menu())
    assert {part.key for part in best.structure.parts} == {"backlash_sampled", "step_output"}
    assert "step_output" in came
    assert set(rests) == {"backlash_sampled", "step_output"}
    assert all(np.std(rest.residual) > 1.2 * np.std(best.residual) for rest in rests.values())
    assert best.p[best.structure.slices()[-1]] == pytest.approx([0.5, 289.5], abs=1.5)
    assert np.std(best.residual) < 1.02 * np.std(noise)
    again, _, _ = exchanged(channel, best, Menu())  # nothing is left to mend
    assert {part.key for part in again.structure.parts} == {part.key for part in best.structure.parts}
    assert again.criterion > best.criterion - 12


def test_a_curve_that_lacks_a_term_gives_way_before_a_third_effect_comes():
    """A quadratic that stands for a quadratic with a cubic, beside a limited input."""
    rng = np.random.default_rng(36)
    u = lfilter([0.5], [1.0, -0.7], rng.standard_normal(600))
    x = lfilter(B, A, np.clip(u, -1.0, 1.0))
    channel = channel_of(u, x + 0.3 * x**2 + 0.2 * x**3 + 0.01 * rng.standard_normal(600))
    model = added(channel, fit_linear(channel, Structure(2)), "saturation")
    poor = added(channel, model, "output_quadratic")
    best, came, _ = exchanged(channel, poor, Menu())
    assert [part.key for part in best.structure.parts] == ["saturation", "output_polynomial"]
    assert "output_polynomial" in came
    assert np.std(best.residual) < 1.1 * 0.01 < np.std(poor.residual)


def test_static_curves_of_one_cause_and_effects_of_one_family_are_akin():
    assert akin(named("output_quadratic"), named("output_polynomial"))
    assert akin(named("rate_limit"), named("rate_limit_servo"))
    assert not akin(named("output_quadratic"), named("input_quadratic"))
    assert not akin(named("backlash_input"), named("saturation"))


def test_an_effect_that_changes_nothing_of_the_run_is_taken_out():
    rng = np.random.default_rng(33)
    u = rng.standard_normal(300)
    channel = channel_of(u, lfilter(B, A, np.clip(u, -1, 1)) + 0.01 * rng.standard_normal(300))
    model = added(channel, fit_linear(channel, Structure(2)), "saturation")
    assert without_idle(channel, model) is None
    p, scales = np.append(model.p, 0.0), np.append(model.scales, 0.1)
    wide = model.structure.adding(Part(named("backlash_sampled")))
    position, rest = without_idle(channel, replace(model, structure=wide, p=p, scales=scales))
    assert (position, [part.key for part in rest.structure.parts]) == (1, ["saturation"])
    assert np.std(rest.residual) < 1.02 * np.std(model.residual)


def test_a_part_left_out_leaves_the_others():
    rng = np.random.default_rng(32)
    u = rng.standard_normal(300)
    channel = channel_of(u, lfilter(B, A, np.clip(u, -1, 1)) + 0.3 + 0.01 * rng.standard_normal(300))
    model = added(channel, added(channel, fit_linear(channel, Structure(2)), "saturation"), "offset")
    (rest,) = without(channel, model, 0)
    assert [part.key for part in rest.structure.parts] == ["offset"]
    assert np.std(rest.residual) > 3 * np.std(model.residual)


def test_a_whole_delay_is_preferred_where_it_fits_as_well():
    rng = np.random.default_rng(33)
    u = rng.standard_normal(500)
    for true, whole in ((2.0, True), (1.5, False)):
        low, part = int(true), true % 1
        late = [np.concatenate((np.zeros(d), u[: 500 - d])) for d in (low, low + 1)]
        y = lfilter(B, A, (1 - part) * late[0] + part * late[1])
        channel = channel_of(u, y + 0.02 * rng.standard_normal(500))
        base = fit_linear(channel, Structure(2))
        s = base.structure.adding(Part(named("delay")))
        p = np.concatenate((fit_linear(channel, Structure(2, delay=low)).p, [true - 0.4]))
        free = fit(channel, s, p, np.append(base.scales, 1.0))
        found = whole_delay(channel, free)
        assert (found.p[-1] == true) == whole
        assert found.deviance < free.deviance + np.log(500)
        assert np.all(np.linalg.norm(found.jacobian, axis=0) > 0)


def test_a_large_change_of_gain_is_found_from_poor_poles():
    rng = np.random.default_rng(34)
    u = np.asarray(lfilter([0.2], [1.0, -0.8], rng.standard_normal(600))) + 0.5
    y = lfilter(B, A, u * np.where(np.arange(600) >= 170, 1.8, 1.0))
    channel = channel_of(u, y + 0.01 * rng.standard_normal(600))
    base = fit_linear(channel, Structure(2))
    found = added(channel, base, "gain_change")
    assert found.p[-2] == pytest.approx(0.8, abs=0.05)
    assert found.p[-1] == pytest.approx(169.5, abs=3.0)
    assert np.std(found.residual) < 1.1 * 0.01


def test_wild_samples_where_a_signal_turns_are_told_from_faults():
    rng = np.random.default_rng(35)
    signal = np.round(np.sin(np.arange(800) / 15.0), 2)  # it rests at its extremes, as behind a play
    turns = np.flatnonzero((signal >= 0.999) & (np.roll(signal, 1) < 0.999))
    at_turns, anywhere = np.zeros(800, dtype=bool), np.zeros(800, dtype=bool)
    at_turns[turns[:6]] = True
    anywhere[rng.choice(800, 6, replace=False)] = True
    assert at_reversals(at_turns, signal)
    assert not at_reversals(anywhere, signal)


def test_wild_samples_where_the_signals_are_large_or_quick_are_told_from_faults(rng):
    u = np.cumsum(rng.standard_normal(1000))
    x = lfilter([0.2], [1.0, -0.8], u)
    for at in (np.argsort(-x)[:5], np.argsort(x)[:5], np.argsort(-np.abs(np.diff(u, prepend=u[0])))[:5]):
        assert at_extremes(np.isin(np.arange(1000), at), u[:, None], x)
    drawn = [np.isin(np.arange(1000), rng.choice(1000, 5, replace=False)) for _ in range(200)]
    assert sum(at_extremes(wild, u[:, None], x) for wild in drawn) <= 2  # six signals at 1e-4 each


def test_repeated_samples_of_a_coarse_scale_or_of_what_creeps_are_no_losses(rng):
    y = lfilter([0.1], [1.0, -1.6, 0.7], rng.standard_normal(800))
    lost = y.copy()
    lost[100:700:50] = lost[99:699:50]
    assert held_samples(lost).sum() == 12
    few = y.copy()  # interpolated or edited here and there: nothing hangs on them
    few[100:700:150] = few[99:699:150]
    assert held_samples(few).sum() == 0
    rest = (
        np.exp(-np.abs(np.arange(800) - 400) / 40.0) * y
    )  # it creeps far from its middle, to fewer and fewer digits
    slow = np.argsort(np.abs(np.diff(rest)))[:6]
    rest[slow + 1] = rest[slow]
    assert held_samples(rest).sum() == 0
    table = np.where(
        y > 0, np.round(y, 2), np.round(y, 3)
    )  # steps that grow with the level: many values recur
    assert held_samples(table).sum() == 0


def test_the_lag_before_a_curve_stays_when_the_curve_is_taken_out():
    rng = np.random.default_rng(33)
    u = np.repeat(rng.standard_normal(60), 10)
    y = lfilter([0.2], [1.0, -0.8], lfilter([0.1], [1.0, -0.9], u)) + 0.01 * rng.standard_normal(600)
    channel = channel_of(u, y)
    base = fit_linear(channel, Structure(1))
    s = base.structure.adding(Part(named("input_cubic"), first=1))
    model = fit(channel, s, np.append(base.p, [-0.7, 0.0]), np.append(base.scales, [1.0, 1.0]))
    (rest,) = without(channel, model, 0)
    assert np.std(base.residual) > 2 * np.std(model.residual)
    assert np.std(rest.residual) < 1.02 * np.std(model.residual)
    assert [part.key for part in rest.structure.parts] == ["lag_before"]
    assert len(rest.p) == len(model.p) - 1


def test_the_curve_of_a_sensor_starts_within_what_the_sensor_reads_whatever_the_level_of_the_record():
    from estimators.diagnosis.search.starts import sizes_of

    rng = np.random.default_rng(34)
    u = rng.standard_normal(300)
    x = lfilter(B, A, u)
    sizes = []
    for level in (0.0, 50.0):
        channel = channel_of(u, level + x)
        s = Structure(2).adding(Part(named("offset")))
        base = fit(channel, s, np.array([-1.5, 0.7, 0.1, 0.08, level]), np.ones(5))
        sizes.append(sizes_of(channel, base, Part(named("output_sigmoid"))))
    assert sizes[0].centres(sizes[0].y) == pytest.approx(sizes[1].centres(sizes[1].y), abs=1e-3)


def test_what_changes_at_the_very_end_of_a_record_is_no_model_of_a_later_one():
    channel = channel_of(np.ones(200), np.zeros(200))
    s = Structure(1).adding(Part(named("gain_change")))
    for time, admitted in ((188.0, True), (193.0, False), (7.0, False)):
        p = np.array([-0.5, 1.0, -1.1, time])
        assert bool(np.all(np.isfinite(simulate(s, p, channel.u, channel.clock)))) is admitted


def test_a_pole_that_forgets_nothing_gives_way_to_a_trend():
    """A limited input before a lag, and a scale that creeps: a pole at .9998 had run down from an initial state of its own."""
    rng, n = np.random.default_rng(35), 900
    u = np.repeat(rng.uniform(10.0, 90.0, n // 15), 15)
    y = 6.0 + lfilter([0.0, 0.01], [1.0, -0.9], np.minimum(u, 55.0)) - 0.4 * np.arange(n) / n
    channel = channel_of(u, y + 0.01 * rng.standard_normal(n))
    s = Structure(
        2, parts=(Part(named("offset")), Part(named("initial")), Part(named("saturation_upper"))), base=2
    )
    linear = [-1.8998, 0.89982, 0.01, -0.01]
    slow = fit(
        channel, s, np.array([*linear, 6.0, 0.0, 0.0, 56.0]), np.array([1.0] * 7 + [50.0]), iterations=40
    )
    straight = trending(channel, slow)
    assert straight is not None
    assert [part.key for part in straight.structure.effects] == ["saturation_upper", "drift"]
    assert straight.structure.order == 1
    assert straight.criterion < slow.criterion
    assert straight.p[straight.structure.slices()[2]] == pytest.approx([55.0], abs=0.2)
    assert straight.p[straight.structure.slices()[3]][1] == pytest.approx(-0.4, abs=0.02)
    assert trending(channel, straight) is None  # one trend is enough
    assert drifting(channel, straight) is None
    bare, at = straight.structure.keeping([part.key != "drift" for part in straight.structure.parts])
    again = drifting(channel, fit(channel, bare, straight.p[at], straight.scales[at], iterations=40))
    assert again is not None
    assert again.p[again.structure.slices()[3]][1] == pytest.approx(-0.4, abs=0.02)
