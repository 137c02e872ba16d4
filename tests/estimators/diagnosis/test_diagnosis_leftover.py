"""What no effect of the catalogue explains, blocked cross-validation, and the force balance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline import blocks_of
from estimators.diagnosis.baseline.linear_model import Prior
from estimators.diagnosis.discovery import BUDGETS
from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.ladder.verdicts import FIRM
from estimators.diagnosis.loop import Setting, diagnose
from estimators.diagnosis.model.fitting import Channel, fit
from estimators.diagnosis.model.forces import effective_samples, force_balance
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.policy import Effort
from estimators.diagnosis.record import leftover
from estimators.diagnosis.record.leftover import leftovers
from estimators.diagnosis.search.blocks import curved, sandwich
from estimators.diagnosis.search.candidates import Menu, augmented
from estimators.diagnosis.search.exchange import exchanged
from estimators.diagnosis.search.free_runs import Start, blocked, start_of
from oed.data import Record
from oed.errors import InputError
from tests.estimators.diagnosis.case_linear import linear_case
from tests.estimators.diagnosis.case_small import looking_for, of_orders

SETTING = Setting(orders=(2,), structure="SISO")
VARYING = (
    "gain_periodic",
    "output_gain_periodic",
    "gain_drift",
    "gain_change",
    "resonance_drift",
    "tones",
    "input_cubic",
)
B, A = [0.0, 0.1, 0.1], [1.0, -1.5, 0.7]


def drawn(rng, n, *, start=0, sway=0.0, wander=0.0, burst=0.0, product=0.0):
    u = np.repeat(rng.uniform(-2, 2, n // 2 + 1), 2)[:n]
    k = np.arange(start, start + n)
    v = u + product * u * np.concatenate(([0.0, 0.0, 0.0], u[:-3]))
    phase = 2 * np.pi * k / 170 + wander * np.sin(2 * np.pi * k / 390)
    y = lfilter(B, A, v) * (1 + sway * np.sin(phase))
    e = 0.05 * rng.standard_normal(n) * (1 + burst * np.sin(2 * np.pi * k / 300))
    return Record(u, y + e, t0=float(start))


def channel_of(record):
    n = len(record)
    return Channel(record.u, record.y[:, 0], Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))


@pytest.mark.parametrize(
    "options, nature, known",
    [
        (
            {"sway": 0.25, "wander": 2.5},
            "time variation",
            looking_for(*VARYING, orders=(2,), structure="SISO"),
        ),
        ({"burst": 1.5}, "noise", replace(SETTING, effort=Effort.QUICK)),
        pytest.param({"sway": 0.25, "wander": 2.5}, "time variation", SETTING, marks=pytest.mark.validate),
    ],
    ids=["gain that sways at no one frequency", "noise that swells", "gain that sways, by the catalogue"],
)
@pytest.mark.slow
def test_a_cause_in_no_catalogue_is_reported_by_its_nature(monkeypatch, options, nature, known):
    monkeypatch.setitem(BUDGETS, "quick", of_orders(2))
    rng = np.random.default_rng(5)
    result = diagnose(drawn(rng, 800, **options), drawn(rng, 400, start=900, **options), known)
    assert result.detected
    assert result.effect == "unknown"
    assert result.nature == nature
    assert result.remaining
    assert "no effect of the catalogue" in result.evidence[0]


def test_leftovers_follow_what_was_planted_and_nothing_else():
    rng = np.random.default_rng(6)
    natures = {}
    for name, options in {"nothing": {}, "sway": {"sway": 0.2}, "product": {"product": 0.3}}.items():
        channel = channel_of(drawn(rng, 700, **options))
        found = leftovers(channel, fit_linear(channel, Structure(2)), alpha=0.001)
        natures[name] = [item.nature for item in found]
    assert natures["nothing"] == []  # negative control
    assert natures["sway"][0] == "time variation"
    assert natures["product"][0] == "dynamic nonlinearity"


@pytest.mark.parametrize("size", [2.0**-163, 2.0**163])
def test_what_is_left_behind_an_oscillator_has_no_unit(size):
    """Products of signals of 1e49 were an explosion beside a plant made of states: nothing was left of a product, and NumPy warned."""
    found = []
    for unit in (1.0, size):
        record = drawn(np.random.default_rng(6), 700, product=0.3)
        channel = channel_of(Record(unit * record.u, unit * record.y))
        s, p = Structure(2, layout="oscillator"), np.array([np.log(0.24), np.log(0.36), 1.0, 0.0])
        found.append(leftovers(channel, fit(channel, s, p, np.ones(4))))
    plain, scaled = found
    assert "products of past inputs and outputs" in plain[0].sentence
    assert [item.sentence for item in scaled] == [item.sentence for item in plain]


def test_blocks_held_out_show_what_overfitting_hides():
    rng = np.random.default_rng(7)
    u = np.repeat(rng.uniform(-1, 1, 60), 4)[:, None]
    y = lfilter([0.0, 0.3], [1.0, -0.7], u[:, 0]) + 0.3 * rng.standard_normal(240)
    channel = channel_of(Record(u, y))
    errors, start = {}, Start(Prior(0.0, np.ones(8), 0.1), rest=True)
    for order in (1, 6):
        f = fit_linear(channel, Structure(order))
        unused = blocked(channel, f, blocks_of([Record(u, y)], 4, 0, 0), 1, start, white=True)[0]
        errors[order] = (np.std(y - unused), np.std(f.residual))
    assert errors[6][1] < errors[1][1]  # more parameters always fit better
    assert errors[6][0] > errors[1][0]  # and here they carry over worse


def test_without_a_test_record_blocks_are_held_out():
    rng = np.random.default_rng(8)
    result = diagnose(drawn(rng, 400), None, looking_for("saturation", orders=(2,), structure="SISO"))
    assert "cross-validation" in result.held_out
    assert len(result.yhat_before) == 400
    assert result.rmse_before.value == pytest.approx(0.05, rel=0.15)  # the noise


def test_blocks_are_held_out_of_a_record_that_is_no_deviation():
    rng = np.random.default_rng(9)
    record = drawn(rng, 400)
    away = record.replace(u=record.u + 3.0, y=record.y + 20.0)  # starts far from rest and has an offset
    result = diagnose(
        away, None, looking_for("offset", "initial", orders=(2,), structure="SISO", deviations=False)
    )
    assert result.rmse_before.value == pytest.approx(0.05, rel=0.2)


def motion(n=6000, dt=2e-3):
    """An axis with Coulomb friction under a position loop, by semi-implicit Euler steps twenty times finer."""
    mass, viscous, coulomb, offset = 2.0, 5.0, 1.5, 0.3
    u, y = np.empty(n), np.empty(n)
    q = v = 0.0
    h = dt / 20
    for k in range(n):
        target = 0.5 * np.sin(2 * np.pi * 0.4 * k * dt) + 0.2 * np.sin(2 * np.pi * 1.1 * k * dt)
        u[k], y[k] = 400 * (target - q) - 20 * v, q
        for _ in range(20):
            push = u[k] - viscous * v - offset
            free = v + h * push / mass
            stop = h * coulomb / mass
            v = np.sign(free) * max(abs(free) - stop, 0.0)
            q += h * v
    return Record(u, y, dt=dt), (mass, viscous, coulomb, offset)


def test_force_balance_weighs_an_axis_in_closed_loop():
    record, truth = motion()
    balance = force_balance(record)
    found = (balance.mass, balance.viscous, balance.coulomb, balance.offset)
    for (value, error), true in zip(found, truth):
        # the held force acts half a sample late, which the balance does not model: 3 % at most here
        assert abs(value - true) < 0.03 * abs(true) + 3 * error
    assert balance.share > 0.99
    doubled = force_balance(record, gain=2.0)
    assert doubled.mass[0] == pytest.approx(2 * balance.mass[0])
    with pytest.raises(InputError, match="at least 400"):
        force_balance(record[:300])


def test_effective_samples_of_an_autoregression():
    # integrated correlation time of AR(1) is (1 + a)/(1 - a): 19 for a = 0.9
    e = np.random.default_rng(9).standard_normal(40000)
    assert effective_samples(e) == pytest.approx(40000, rel=0.1)
    assert effective_samples(lfilter([1.0], [1.0, -0.9], e)) == pytest.approx(40000 / 19, rel=0.25)


@pytest.mark.slow
def test_two_filters_with_a_bend_between_them_are_told_apart():
    rng = np.random.default_rng(10)
    u = lfilter([0.5], [1.0, -0.5], rng.standard_normal(1500))
    x = lfilter([1.0, 0.4], [1.0, -1.2, 0.5], u)
    y = lfilter([0.0, 0.2, 0.1], [1.0, -0.6], np.minimum(x, 0.8)) + 0.002 * rng.standard_normal(1500)
    channel = channel_of(Record(u, y))
    base = fit_linear(channel, Structure(3))
    f = sandwich(channel, base, 3)
    assert np.std(base.residual) > 0.05
    assert np.std(f.residual) < 0.004


def with_parts(channel, base, parts, values):
    """The linear model with effects, fitted from given parameters of theirs."""
    structure = base.structure
    for part in parts:
        structure = structure.adding(part)
    scales = np.concatenate((base.scales, np.abs(values)))
    return fit(channel, structure, np.concatenate((base.p, values)), scales)


@pytest.mark.parametrize("side", ["input", "output"])
def test_a_curve_of_no_simple_form_is_found_beside_a_trend(side):
    """A tanh on one side of zero only: the cubic polynomial is the nearest simple form, and not near enough."""
    rng = np.random.default_rng(12)
    bent = lambda x: np.where(x > 0, np.tanh(1.5 * x) / 1.5, x)
    u = np.repeat(rng.uniform(-2, 2, 401), 2)[:800]
    x = lfilter(B, A, bent(u) if side == "input" else u)
    y = (x if side == "input" else bent(x)) + 0.3 * np.arange(800) / 800 + 0.01 * rng.standard_normal(800)
    channel = channel_of(Record(u, y))
    parts = (Part(named(f"{side}_polynomial")), Part(named("drift")))
    simple = with_parts(channel, fit_linear(channel, Structure(2)), parts, [-0.1, 0.01, 0.01, 0.3])
    f = curved(channel, simple, named(f"{side}_lines"))
    assert np.std(simple.residual) > 0.02
    assert np.std(f.residual) < 0.0105
    assert [part.key for part in f.structure.parts] == ["drift", f"{side}_lines"]
    assert f.p[f.structure.slices()[0]][1] == pytest.approx(0.3, abs=0.01)


def test_one_more_order_is_found_beside_an_effect_at_the_input():
    """A rate limit and the lag of a sensor: with the order of the plant alone the rate comes out wrong."""
    rng = np.random.default_rng(13)
    u = np.repeat(rng.uniform(-2, 2, 81), 10)[:800]
    command, v = 0.0, np.zeros(800)
    for k in range(800):
        v[k] = command = command + np.clip(u[k] - command, -0.3, 0.3)
    y = lfilter([0.3], [1.0, -0.7], lfilter(B, A, v)) + 0.01 * rng.standard_normal(800)
    channel = channel_of(Record(u, y))
    low = with_parts(channel, fit_linear(channel, Structure(2)), [Part(named("rate_limit_sampled"))], [0.4])
    (f,) = augmented(channel, low, Menu((named("order_one"),)))
    assert np.std(low.residual) > 0.02
    assert np.std(f.residual) < 0.0105
    assert f.p[f.structure.slices()[0]][0] == pytest.approx(0.3, rel=0.01)
    kept, *_ = exchanged(channel, f, Menu())  # the order has no parameters of its own, and stays a cause
    assert {part.key for part in kept.structure.effects} == {"rate_limit_sampled", "order_one"}


@pytest.mark.parametrize("seed", [41, 42, 43])
def test_a_poor_linear_model_leaves_nothing_that_looks_bent(seed):
    """Two levels only, taken too late: all powers of the input are the input again; a product of inputs is no such thing."""
    for product in (0.0, 0.4):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.choice([-1.0, 1.4], 450), 2)
        v = u + product * np.abs(lfilter([0.3], [1.0, -0.7], u))
        y = lfilter([0.0, *B], A, v) + 0.02 * rng.standard_normal(900)
        channel = channel_of(Record(u, y))
        found = leftovers(channel, fit_linear(channel, Structure(2, delay=3)))
        assert any(x.nature == "linear dynamics" for x in found)
        assert any("nonlinear" in x.nature for x in found) is (product > 0.0)


def test_samples_lost_at_an_end_of_a_record_are_a_delay():
    """At 6 % of the record nearly all samples are out of step, at 8 % enough are not."""
    y, clock = np.sin(np.arange(400) / 9.0), Clock(np.arange(400.0), 400)
    for time, finite in ((24.0, False), (32.0, True), (368.0, True), (376.0, False)):
        assert np.isfinite(named("lost_samples").apply(y, np.array([2.0, time]), clock)).all() is np.bool_(
            finite
        )


@pytest.mark.parametrize("lags, own, bent", [(20, 5, True), (leftover.LAGS, leftover.OWN, False)])
@pytest.mark.parametrize("seed", [1, 2])
def test_what_rings_longer_than_the_lags_taken_out_does_not_look_bent(monkeypatch, lags, own, bent, seed):
    """Beside two poles a light mode rings that the linear model lacks: with few lags it looks like a curve that is no accident."""
    monkeypatch.setattr(leftover, "LAGS", lags)
    monkeypatch.setattr(leftover, "OWN", own)
    rng, radius = np.random.default_rng(seed), 0.97
    u = np.repeat(rng.choice([-1.0, 1.4], 450), 2)
    ringing = lfilter([0.0, 3.0 * (1.0 - radius)], [1.0, -2.0 * radius * np.cos(0.6), radius**2], u)
    channel = channel_of(Record(u, lfilter([0.0, *B], A, u) + ringing + 0.02 * rng.standard_normal(900)))
    found = leftovers(channel, fit_linear(channel, Structure(2, delay=2)))
    assert any("nonlinear" in x.nature and x.p_value < FIRM for x in found) is bent


@pytest.mark.validate
@pytest.mark.slow
def test_what_one_output_feeds_back_is_no_effect_at_another():
    train, test, _ = linear_case(1320)
    found = diagnose(train, test, Setting(effort=Effort.QUICK, separate=True, deviations=False))
    assert found.nature in ("noise", "none")


def test_a_state_that_only_the_block_left_out_shows_stays_what_the_whole_record_says():
    """From 310 on an input acts in another way, from a state that has died within its block: blocks beside it tell nothing of it, and a
    fit to them had put it thousands off."""
    rng, n = np.random.default_rng(3), 1000
    u = 10.0 + np.repeat(rng.standard_normal(n // 10), 10)
    s = Structure(1).adding(Part(OFFSET)).adding(Part(INITIAL)).adding(Part(named("acts_since"), 0, 1))
    p = np.array([-0.9, 0.2, 1.0, 0.5, 0.03, -0.95, 3.0, 1.0, 10.0, 310.0])
    channel = Channel(u[:, None], np.zeros(n), Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    y = simulate(s, p, channel.u, channel.clock) + 0.05 * rng.standard_normal(n)
    channel = replace(channel, y=y)
    f = fit(channel, s, p, np.array([1.0, 0.2, 1.0, 1.0, 0.2, 1.0, 1.0, 0.0, 1.0, 1.0]))
    start = start_of(f, channel, Prior(0.0, np.ones(9), 0.05**2), False)
    unused, folds = blocked(channel, f, blocks_of([Record(u, y)], 5, 0, 0), 1, start, white=True)
    assert folds[1][6] == f.p[6]
    assert all(fold[6] != f.p[6] for fold in (folds[0], *folds[2:]))
    assert np.std((y - unused)[200:400]) < 1.5 * 0.05
