"""The classes that common rigs show: each is started well enough to be found, and stays away where it is not."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from estimators.diagnosis.baseline.linear_model import Prior
from estimators.diagnosis.effects import CATALOGUE, Clock, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.kernels.recursion_kernels import levelled, relay, size_of_late
from estimators.diagnosis.effects.kernels.spline_kernels import read_between
from estimators.diagnosis.effects.loops import slowest_rate
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.search.candidates import Menu, augmented
from estimators.diagnosis.search.free_runs import Start, free_run, lead_in
from estimators.diagnosis.search.selection import significance
from tests.estimators.diagnosis.case_effects import LINEAR
from tests.estimators.diagnosis.case_hidden import ALL_CLASSES, ALL_LOOKALIKES
from tests.estimators.diagnosis.case_parts import excitation, read

NOISE = 0.01  # of the output's standard deviation
N = 700


@cache
def record(key, strength):
    """Channel, linear fit without a noise model, and the noise's standard deviation."""
    maker, order, signal = ALL_CLASSES[key]
    rng = np.random.default_rng([7, *key.encode()])
    u = excitation(rng, N, **signal)
    y = maker(u, strength)
    noise = NOISE * np.std(y)
    y = y + noise * rng.standard_normal(N)
    U = u.reshape(N, -1)
    channel = Channel(U, y, Clock(np.arange(float(N)), N), np.ones(N, dtype=bool))
    s = replace(Structure(order, tuple(range(U.shape[1]))).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2)
    f = fit_linear(channel, s)
    white = float(np.mean(f.residual**2))
    return channel, replace(f, noise=np.zeros(0), variance=white, deviance=N * np.log(white)), noise


def error(f):
    return float(np.sqrt(np.mean(f.residual**2)))


def fits(key, of, strength=1.0):
    channel, base, noise = record(of, strength)
    return sorted(augmented(channel, base, menu(key)), key=error), base, noise


def menu(key):
    """The effect, and the one that it extends, which the search always has beside it."""
    effect = named(key.split()[0])
    return Menu(tuple(named(k) for k in (effect.extends, effect.key) if k))


@pytest.mark.parametrize("key", ALL_CLASSES)
def test_a_class_is_found_to_the_noise(key):
    found, base, noise = fits(key, key)
    assert error(base) > 2.0 * noise  # the linear model does not do
    assert error(found[0]) < 1.35 * noise


MISLED = ("wrapped", "stiction", "stiction_sliding", "orifices", "output_cutoff", "position_periodic", "refreshed", "reported_on_change", "clock_slips")  # fmt: skip
OTHERS = ALL_CLASSES.keys() - set(MISLED)


@pytest.mark.parametrize(
    "key", [*MISLED, *(pytest.param(key, marks=pytest.mark.slow) for key in sorted(OTHERS))]
)
def test_a_class_is_found_beside_spikes(key):
    """Twelve of 700 samples are six standard deviations off, and do not count: the searches of eight had found nothing, or half of it."""
    channel, base, noise = record(key, 1.0)
    rng = np.random.default_rng([3, *key.encode()])
    at = rng.choice(np.arange(20, N - 20), 12, replace=False)
    y, out = channel.y.copy(), np.isin(np.arange(N), at)
    y[at] += 6.0 * np.std(y) * rng.choice([-1.0, 1.0], len(at))
    spiky = replace(channel, y=y).without(out)
    f = fit_linear(spiky, base.structure)
    white = float(np.sum(f.residual**2)) / f.n
    first = replace(f, noise=np.zeros(0), variance=white, deviance=f.n * np.log(white))
    found = augmented(spiky, first, menu(key))
    assert min(map(error, found)) < 1.5 * noise


def test_an_angle_is_unrolled_where_some_of_its_jumps_were_taken_for_wild_samples():
    """They stand out of a linear model's residual: a position loop had been "a parameter change", 9.7 deg; 2.8 now, of 2.65."""
    channel, base, noise = record("wrapped", 1.0)
    steps = np.abs(np.diff(channel.y, prepend=channel.y[0]))
    some = channel.without(steps >= np.sort(steps)[-7])
    found = list(augmented(some, base, Menu((named("wrapped"),))))
    assert min(map(error, found)) < 1.5 * noise


@pytest.mark.parametrize("key", ALL_CLASSES)
def test_a_class_is_not_claimed_on_the_same_rig_without_it(key):
    """One record per class, false-alarm rate 1 % of each: the corrected significance of the best fit."""
    found, base, noise = fits(key, key, 0.0)
    if not key.startswith("integral_curve"):  # an integrator, which the plain fit keeps from the circle
        assert error(base) < 1.35 * noise  # the linear model is right
    for f in found:
        ratio = base.deviance - replace(f, noise=np.zeros(0)).deviance if not len(f.noise) else 0.0
        assert significance(base, f) > 0.01 or ratio < 0.0 or error(f) > 0.98 * error(base)


def test_a_clock_that_is_set_right_every_so_many_samples_has_that_period():
    """The edges of twenty periods told 110.98 of 111 samples: on the next record each came a sample early, .70 mm for .12."""
    rng = np.random.default_rng(5)
    u, k = excitation(rng, N), np.arange(float(N))
    y = read(u, np.maximum(k - 3.0 * (k % 53) / 53, 0.0))
    y = y + NOISE * np.std(y) * rng.standard_normal(N)
    channel = Channel(u[:, None], y, Clock(k, N), np.ones(N, dtype=bool))
    base = fit_linear(channel, replace(Structure(2, (0,)).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    found = min(augmented(channel, base, Menu((named("clock_slips"),))), key=error)
    assert found.p[-3] == 53.0
    assert found.p[-1] == pytest.approx(3.0, abs=0.05)


def test_samples_that_are_lost_several_times_are_counted_each_time():
    """Three jumps, one of them back: all are found, and a fourth is not."""
    rng = np.random.default_rng(3)
    u, k = excitation(rng, N), np.arange(float(N))
    y = read(u, np.maximum(k - 2.4 * (k > 200) + 1.3 * (k > 380) - 2.1 * (k > 520), 0.0))
    y = y + NOISE * np.std(y) * rng.standard_normal(N)
    channel = Channel(u[:, None], y, Clock(k, N), np.ones(N, dtype=bool))
    base = fit_linear(channel, replace(Structure(2, (0,)).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    found = min(augmented(channel, base, Menu((named("lost_samples"),))), key=error)
    jumps = found.p[found.structure.slices()[-1]].reshape(-1, 2)
    by_time = jumps[np.argsort(jumps[:, 1])]
    assert by_time[:, 0] == pytest.approx([-2.4, 1.3, -2.1], abs=0.05)
    assert by_time[:, 1] == pytest.approx([200.0, 380.0, 520.0], abs=1.5)


@pytest.mark.parametrize("key, of", ALL_LOOKALIKES)
def test_a_class_does_not_explain_what_only_looks_like_it(key, of):
    found, _, noise = fits(key, of)
    assert not found or error(found[0]) > 1.5 * noise


def test_a_recycle_is_found_by_its_share_and_delay_and_goes_round_as_its_equation_says():
    """Half of what leaves two vessels comes back after 25 samples, and one by which the sums are late; the run against its sums."""
    f = fits("recycle", "recycle")[0][0]
    assert f.p[f.structure.slices()[-1]][[0, 3]] == pytest.approx([0.5, 26.0], abs=0.1)
    p, x = np.array([0.6, 5.0, 2.0, 7.25]), np.repeat([9.0, 11.0, 6.0], 40)
    (a, b), before = np.exp(-1.0 / p[1:3]), x[0] / (1.0 - p[0])
    one, two, out = before, [before] * 9, []
    for value in x:
        out.append(value + p[0] * (0.75 * two[-7] + 0.25 * two[-8]))
        one = a * one + (1.0 - a) * out[-1]
        two.append(b * two[-1] + (1.0 - b) * one)
    np.testing.assert_allclose(named("recycle").apply(x, p, Clock(np.arange(120.0), 120)), out, rtol=1e-9)


def test_what_repeats_has_the_period_of_its_timer_and_the_harmonics_that_its_edges_ask_for():
    f = fits("waveform", "waveform")[0][0]
    assert 2.0 * np.pi / f.p[f.structure.slices()[-1].start] == pytest.approx(57.3, abs=0.02)
    assert f.structure.parts[-1].size > 9  # a pulse of a fifth lacks the fifth, and has those beyond


def test_an_automatic_gain_follows_the_size_of_late_of_what_is_read():
    x = np.random.default_rng(3).standard_normal(400) * np.repeat([0.2, 3.0, 0.5, 1.0], 100)
    for law in ((2.0, 0.5, 4.0, 60.0), (0.3, 1.0, 20.0, 20.0)):
        shown, of_late = levelled(x, *law), size_of_late(np.abs(x), *law[2:])
        np.testing.assert_allclose(shown, x * (1.0 + law[0] * of_late) ** -law[1], rtol=1e-12)
        size = abs(x[0])
        for k, value in enumerate(x):
            assert shown[k] == pytest.approx(value / (1.0 + law[0] * size) ** law[1], rel=1e-12)
            size += (1.0 - np.exp(-1.0 / law[2 if abs(value) > size else 3])) * (abs(value) - size)


@pytest.mark.parametrize(
    "key, q",
    [("stiction", [1.5, 0.4]), ("stiction_sliding", [1.5, 0.4]), ("backlash_input", [1.2]), ("plays", [1.2, 0.5, 0.2, 0.1, 0.4])],
)  # fmt: skip
def test_where_a_stem_stood_before_a_record_on_a_level_is_fitted(key, q):
    """From the middle of its gap, as from the command itself, the record's first rest would be off by most of the gap."""
    rng, e = np.random.default_rng(5), named(key)
    u = 40.0 + excitation(rng, N) * 2.0
    u[:20] = 40.0
    truth = np.array([*q, -0.6])
    channel = Channel(u[:, None], np.zeros(N), Clock(np.arange(float(N)), N), np.ones(N, dtype=bool))
    s = Structure(1).adding(Part(OFFSET)).adding(Part(INITIAL)).adding(Part(e))
    p = np.array([-0.8, 0.2, 0.0, 8.0, *truth])
    stem = e.apply(u, truth, channel.clock)
    other = e.apply(u, np.array([*q, 0.6]), channel.clock)
    assert stem[0] == pytest.approx(other[0])  # the plant was at rest with it
    assert np.ptp(stem - other) > 0.1 * q[0]
    p[3] = 0.8 * stem[0]
    y = simulate(s, p, channel.u, channel.clock) + NOISE * rng.standard_normal(N)
    start = p.copy()
    start[-1] = 0.0
    f = fit(replace(channel, y=y), s, start, np.array([1.0, 0.2, 1.0, 8.0, *q, 1.0]))
    assert f.p[-1] == pytest.approx(-0.6, abs=0.05)
    assert error(f) < 1.1 * NOISE


def test_a_sensor_that_is_slow_at_low_levels_begins_a_record_at_rest():
    """It had been led there from zero, where it hardly moves: the first samples of a test record were off by a tenth."""
    n, lead, level = 300, 200, 5.7
    s = Structure(1).adding(Part(named("sensor_paced")))
    p, clock = np.array([-0.8, 0.2, 0.17, 0.17, level]), Clock(np.arange(float(n)) - lead, n - lead, lead)
    y = simulate(s, p, np.full((n, 1), level), clock)
    np.testing.assert_allclose(y[lead:], level, atol=1e-6)


def test_relay_is_its_definition():
    x, state, expected = np.cumsum(np.random.default_rng(2).standard_normal(300)), -1.0, []
    for value in x:
        state = 1.0 if value > 0.8 else -1.0 if value < -0.8 else state
        expected.append(state)
    assert len(set(expected)) == 2
    np.testing.assert_array_equal(relay(x, 0.8), expected)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 40])
def test_values_between_samples_are_those_of_scipys_spline(rng, n):
    y, at = rng.standard_normal(n), rng.uniform(-1.0, n + 1.0, 200)
    there = CubicSpline(np.arange(n), y)(np.clip(at, 0.0, n - 1.0))
    assert read_between(y, at) == pytest.approx(there, abs=1e-13)
    assert np.isnan(read_between(y, np.array([np.nan]))).all()


@pytest.mark.parametrize("key, left", [("stiction", 0.0), ("stiction_sliding", 3.0)])
def test_a_stem_in_a_loop_is_found_between_the_widths_of_a_coarse_grid(key, left):
    """A valve that sticks, in a loop: with a width a few hundredths off it jumps at other times ever after."""
    rng, n = np.random.default_rng(2), 1500
    goal = np.repeat(rng.uniform(-8.0, 8.0, n // 50), 50)
    u, y, stem, way = np.zeros(n), np.zeros(n), 0.0, 0.0
    noise, sums, x1, x2 = 0.4 * rng.standard_normal(n), 0.0, 0.0, 0.0
    for k in range(n):
        y[k] = x2 + noise[k]
        sums += 0.06 * (goal[k] - y[k])
        u[k] = 0.5 * (goal[k] - y[k]) + sums
        gap = u[k] - stem
        way = way if key == "stiction_sliding" and k and way * (u[k] - u[k - 1]) > 0.0 else 0.0
        way = way or np.sign(gap) * (abs(gap) > 9.5)
        stem = u[k] - left * way if way * gap > left else stem
        x1, x2 = x1 + 0.45 * (stem - x1), x2 + 0.17 * (0.72 * x1 - x2)
    channel = Channel(u[:, None], y, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    f = fit_linear(channel, Structure(1, delay=8))
    found = list(named(key).search(channel, f, ()))
    assert min(np.sqrt(np.mean(g.residual**2)) for g in found) < 0.6
    assert min(abs(g.p[-3] - 9.5) for g in found) < 0.3


@pytest.mark.parametrize("pole", [0.0, 0.3, 0.63, 0.9])
def test_a_wrapped_angle_passes_the_end_of_its_turn_between_samples(pole):
    """Against steps a four-hundredth of a sample long; a jump put at the next sample would err by half a turn."""
    fine, x = 400, 300.0 * np.sin(np.arange(200) / 9.0)
    angle = np.interp(np.arange(199 * fine + 1) / fine, np.arange(200), x) - 40.0
    turned, a = (angle + 180.0) % 360.0 - 180.0, pole ** (1.0 / fine)
    read = turned[0] + lfilter([1.0 - a], [1.0, -a], turned - turned[0])
    found = named("wrapped").apply(x, np.array([360.0, -40.0, 0.0, pole]), Clock(np.arange(200.0), 200))
    assert np.abs(found - read[::fine]).max() < 0.01 * 360.0


def test_a_wrapped_angle_is_found_under_a_delay_and_an_order_that_were_fitted_to_its_jumps():
    channel, _, noise = record("wrapped", 1.0)
    late = replace(Structure(1, delay=7).adding(Part(OFFSET)), base=1)
    found = named("wrapped").search(channel, fit_linear(channel, late), ())
    assert min(error(f) for f in found) < 1.35 * noise


def conical(seed: int, bent: bool) -> tuple[Channel, Fit]:
    """A vessel that widens, emptied through an orifice, behind a pump that lags; the control empties in proportion."""
    rng, n = np.random.default_rng(seed), 900
    u = np.repeat(rng.uniform(40.0, 66.0, n // 30 + 1), 30)[:n]
    u[:15] = 53.0
    h, q, y = 19.0, 1.88 * u[0], np.empty(n)
    for i, v in enumerate(u):
        y[i] = h
        for _ in range(20):
            q += 0.03 * (1.88 * v - q)
            out = 1.88 * u[0] * (np.sqrt(h / 19.0) if bent else h / 19.0)
            h += 0.15 * (q - out) / (22.0 + ((0.9 * h) ** 2 if bent else 300.0))
    y += 0.04 * rng.standard_normal(n)
    channel = Channel(u[:, None], y, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    s = replace(Structure(2).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2)
    f = fit_linear(channel, s)
    white = float(np.mean(f.residual**2))
    return channel, replace(f, noise=np.zeros(0), variance=white, deviance=n * np.log(white))


@pytest.mark.parametrize("seed", [2, 3])
def test_a_process_takes_the_slow_pole_that_the_linear_model_had(seed):
    """From the linear model's poles the first fit ends at 1.2 and 2.1 times the noise: a zero cancels the slow one there."""
    channel, base = conical(seed, True)
    assert error(next(augmented(channel, base, Menu((named("vessel"),))))) < 1.05 * 0.04
    channel, base = conical(seed, False)
    assert all(error(f) > 0.99 * error(base) for f in augmented(channel, base, Menu((named("vessel"),))))


@pytest.mark.parametrize("k", [2.0, 4.0, 8.53, 16.0])
@pytest.mark.parametrize("widening", [0.0, 0.1, 1.0])
def test_a_vessel_rests_where_its_outflow_is_the_inflow(k, widening):
    """From the level of the inflow itself Newton's steps leave for negative levels where the vessel widens much."""
    for u in (0.5, 50.0, 50.1, 200.0):
        c = np.array([0.6, k, widening])
        assert named("vessel").apply.start(u, c) == pytest.approx((u / k) ** 2, rel=1e-6)
        assert named("loss").apply.start(u, np.array([0.6, 0.0, widening])) <= u


def test_readings_that_age_are_looked_for_only_where_their_age_shows():
    """Twenty linear records, 1e-4 stated for a line in each: none; with refreshes every 3.37 samples the period to 1e-3."""
    for seed in range(20):
        rng = np.random.default_rng([9, seed])
        u = excitation(rng, 500)
        y = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], u) + lfilter(
            [0.05], [1.0, -0.8 * (seed % 2)], rng.standard_normal(500)
        )
        channel = Channel(u[:, None], y, Clock(np.arange(500.0), 500), np.ones(500, dtype=bool))
        assert not list(named("refreshed").search(channel, fit_linear(channel, Structure(2)), ()))
    channel, base, _ = record("refreshed", 1.0)
    kept = replace(channel, keep=np.random.default_rng(1).random(N) > 0.05)  # single samples may be missing
    best = min(named("refreshed").search(kept, base, ()), key=error)
    assert best.p[-2] == pytest.approx(3.37, abs=1e-3)


def test_what_adds_up_begins_with_the_record_and_not_with_the_input_put_before_it():
    """A pump that runs from the first sample on, behind a lag that settles in dozens: its rollers stand where they stood."""
    s = Structure(1).adding(Part(named("gain_of_angle")))
    p, u = np.array([-0.9, 0.1, 0.3, 0.2, 0.4]), np.full((60, 1), 2.0)
    clock = Clock(np.arange(60.0), 60)
    f, start = SimpleNamespace(structure=s, p=p), Start(Prior(0.0, 0.9 ** np.arange(8.0), 0.01), False)
    assert lead_in(f, start) > 40
    run = free_run(f, u, clock, np.full(60, np.nan), 0, start)
    angle = 0.4 * 2.0 * (np.arange(60) + 0.5)
    gain = 1.0 + 0.3 * np.cos(angle) + 0.2 * np.sin(angle)
    level = 2.0 * (1.0 + 0.3)  # before the record at the angle of its start
    expected = level + lfilter([0.0, 0.1], [1.0, -0.9], 2.0 * gain - level)
    assert np.std(expected) > 0.05
    np.testing.assert_allclose(run, expected, atol=1e-3)


def test_a_pole_that_follows_a_drift_is_not_taken_for_a_loops_pace():
    """A loop's own pace by its pair of poles, however light; the drift's alone where there is no other."""
    pair = 0.97 * np.exp(np.array([0.12j, -0.12j]))
    pace = abs(np.log(pair[0]))
    for den, expected in (
        ([*pair, 0.9995], pace),
        (pair, pace),
        ([0.9995], -np.log(0.9995)),
        ([0.5, 0.9], -np.log(0.9)),
    ):
        assert slowest_rate(np.real(np.poly(den)), 1000) == pytest.approx(expected)


def test_a_sweep_of_many_turns_is_found_between_the_rates_of_a_coarse_grid():
    """Of 200 turns, whatever its rate: a hundredth of the largest rate off, the line is no line."""
    rng, k = np.random.default_rng(3), np.arange(2400.0)
    for rate in (1.07e-4, 2.61e-4, 4.93e-4):
        u = excitation(rng, len(k))
        y = lfilter([0.0, 0.3], [1.0, -0.7], u)
        y = y + 0.3 * np.cos(0.05 * k + 0.5 * rate * k**2) + 0.05 * rng.standard_normal(len(k))
        channel = Channel(u.reshape(-1, 1), y, Clock(k, len(k)), np.ones(len(k), dtype=bool))
        base = fit_linear(channel, replace(Structure(1, (0,)).adding(Part(OFFSET)), base=1))
        found = min(augmented(channel, base, Menu((named("sweep"),))), key=error)
        assert error(found) < 0.06
        assert np.isclose(abs(found.p[-3]), rate, rtol=1e-3)


def test_every_effect_that_is_said_to_be_linear_in_the_output_is():
    assert {e.key for e in CATALOGUE if e.linear} == set(LINEAR)
    rng, clock = np.random.default_rng(8), Clock(np.arange(150.0), 150)
    x, z = rng.standard_normal((2, 150))
    for key, q in LINEAR.items():
        of_both, of_x, of_z = (named(key).apply(v, np.array(q), clock) for v in (2.0 * x - 3.0 * z, x, z))
        np.testing.assert_allclose(of_both, 2.0 * of_x - 3.0 * of_z, atol=1e-11)
