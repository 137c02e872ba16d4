"""What is evidence for an effect: starts off rest, gains stretch by stretch, smooth errors, loops, the balance of forces."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline import best_linear
from estimators.diagnosis.baseline.linear_model import Prior
from estimators.diagnosis.discovery import BUDGETS, Curve, FoundTerm, discover
from estimators.diagnosis.discovery.found import leading_nature, strongest_first
from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.ladder import Gain, Kind, paired_gain
from estimators.diagnosis.ladder.claims import Claim
from estimators.diagnosis.ladder.held_out import APART, _undecided
from estimators.diagnosis.loop import Setting, diagnose
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.search.examination import Known, as_motion
from estimators.diagnosis.search.free_runs import free_run, start_of
from estimators.diagnosis.search.named import _gains, _holds, _surest
from estimators.diagnosis.search.ratios import part_significance
from oed.data import Record
from tests.estimators.diagnosis.case_small import looking_for, of_orders

N = 600
INPUT = np.arange(N)[:, None] > 0  # that moves at once


def channel_of(u: np.ndarray, y: np.ndarray) -> Channel:
    """Samples that all count."""
    return Channel(u[:, None], y, Clock(np.arange(len(u), dtype=float), len(u)), np.ones(len(u), dtype=bool))


def slow(rng: np.random.Generator, start: float) -> Channel:
    """A lag of 100 samples that begins where no constant input has brought it."""
    u = np.repeat(rng.choice([4.0, 8.0, 9.0], N // 60), 60)
    y = lfilter([0.0, 0.2], [1.0, -0.99], u, zi=[0.99 * start])[0]
    return channel_of(u, y + 0.05 * rng.standard_normal(N))


def test_a_free_run_of_a_record_that_begins_off_rest_takes_its_state_from_the_window(rng) -> None:
    s = replace(Structure(1, (0,)).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2)
    prior = Prior(0.0, np.zeros(64), 100.0)
    for start, factor in ((20.0, 0.02), (None, 1.0)):
        level = 20.0 * 4.0 if start is None else start
        train = slow(rng, level)
        train.u[:60], train.y[:] = (4.0, train.y) if start is None else (train.u[:60], train.y)
        found = start_of(fit_linear(train, s), train, prior, False)
        assert found.prior.noise < 0.01  # the fit's own error, not the linear model's
        other = slow(rng, 20.0)
        run = free_run(fit_linear(train, s), other.u, other.clock, other.y, 20, found)
        off = np.sqrt(np.mean((other.y - run)[20:] ** 2))
        if start is None:
            assert np.sqrt(found.prior.covariance[0]) < 5.0  # what began settled is expected to do so again
        else:
            assert off < factor * np.sqrt(np.mean((other.y - other.y.mean()) ** 2))


def test_a_gain_of_every_stretch_counts_where_one_of_them_has_nearly_all_squares(rng) -> None:
    policy, counted = Policy(), [np.ones(N, dtype=bool)]
    size = np.where(np.arange(N) < N // 20, 30.0, 1.0)
    e = size * rng.standard_normal(N)
    gain = paired_gain([e], [np.zeros(N)], [0.4 * e], counted, policy)
    assert not gain.value > policy.searched[0] * gain.error  # the first stretch alone says all of it
    assert gain.beyond(2.0 * policy.searched[0])
    passed = 0
    for _ in range(
        200
    ):  # negative control: another model of the same error, at the one-sided rate of two errors, 2.3 %
        a, b = (size * rng.standard_normal(N) for _ in range(2))
        passed += paired_gain([0.0 * e], [a], [b], counted, policy).beyond(2.0)
    assert passed < 16


def bent(rng: np.random.Generator, curve: float, pole: float) -> tuple[Fit, Fit, Part]:
    """A lag with and without a square at its input, fitted to a record with it, and noise of a pole."""
    u = np.repeat(rng.standard_normal(N // 10), 10)
    e = lfilter([1.0], [1.0, -pole], rng.standard_normal(N))
    y = lfilter([0.0, 0.03], [1.0, -0.9], lfilter([0.1], [1.0, -0.9], u + curve * u**2)) + 0.02 * e / e.std()
    part, channel = Part(named("input_quadratic")), channel_of(u, y)
    f = fit_linear(channel, Structure(2, (0,)))
    return f, fit(channel, f.structure.adding(part), np.append(f.p, 0.01), np.append(f.scales, 1.0)), part


def test_an_effect_is_significant_though_a_noise_model_predicts_the_error_without_it(rng) -> None:
    f, g, part = bent(rng, 0.0, 0.95)
    smooth = lfilter([0.3], [1.0, -0.97], rng.standard_normal(N))
    for share, told in ((0.2, True), (0.9, False)):  # noise models predict both errors as well as one another
        rest, whole = (
            replace(f, residual=smooth, deviance=0.0),
            replace(g, residual=share * smooth, deviance=0.0),
        )
        rest, whole = (replace(h, noise=np.array([-0.97])) for h in (rest, whole))
        assert (part_significance(rest, whole, part, 90, INPUT) < 1e-3) is told
    off = replace(f, deviance=np.inf, residual=np.full(N, np.inf))
    assert part_significance(off, g, part, 90, INPUT) == 0.0
    # negative control: 60 linear plants in slow noise at 1 %, before the correction for the family
    alarms = sum(part_significance(*bent(rng, 0.0, 0.95), 1, INPUT) < 0.01 for _ in range(60))
    assert alarms <= 3


def test_a_constant_no_larger_than_the_error_of_the_resting_values_is_no_effect(rng) -> None:
    """Deviations from the mean of 12 samples in noise of memory 10: 20 records, each with that constant and no other."""
    u = np.concatenate((np.zeros(12), np.repeat(rng.standard_normal(N // 10), 10)))[:N]
    plain = Structure(1, (0,))
    told = {0.0: 0, 3.0: 0}
    for constant in told:
        for _ in range(20):
            e = np.asarray(lfilter([1.0], [1.0, -0.9], rng.standard_normal(N + 100)))[100:]
            y = lfilter([0.0, 0.5], [1.0, -0.9], u) + 0.2 * e
            channel = channel_of(u, y - y[:12].mean() + constant)
            rest, f = (fit_linear(channel, s) for s in (plain, plain.adding(Part(OFFSET))))
            told[constant] += part_significance(rest, f, f.structure.parts[0], 1, channel.u) < 0.01
    assert told[0.0] <= 1
    assert told[3.0] == 20


def test_what_the_record_does_not_ask_for_is_not_named_beside_what_it_asks_for() -> None:
    """A lamp: a play of -1 +- 28 units bent to its saturation, which halved the error of unused blocks with it and p = 1."""
    bench, gain = SimpleNamespace(alpha=0.01), Gain(8.0, 1.0, 0.7)
    play, curve = (
        Claim(Part(named("clearance_sprung")), gain, 1.0),
        Claim(Part(named("input_tanh")), gain, 1e-9),
    )
    assert _surest([play, curve], bench) == [curve]  # pyright: ignore[reportArgumentType]
    assert _surest([play], bench) == [play]  # pyright: ignore[reportArgumentType]


def looped(rng: np.random.Generator, n: int) -> Record:
    """A linear plant whose input answers the output's noise in the sample in which it is measured."""
    r = np.repeat(rng.standard_normal(n // 15 + 1), 15)[:n]
    u, y, x = np.zeros(n), np.zeros(n), 0.0
    for k in range(n):
        y[k] = x + 0.1 * rng.standard_normal()
        u[k] = 2.0 * (r[k] - y[k])
        x = 0.8 * x + 0.15 * u[k]
    return Record(u, y)


@pytest.mark.slow
@pytest.mark.parametrize(
    "known",
    [
        # deaf to the loop, it was play behind a lag
        looking_for("clearance_driven", "rate_limit", "backlash_input", "saturation", "input_quadratic", "delay"),
        pytest.param(Setting(), marks=pytest.mark.validate),
    ],
    ids=["few effects", "the catalogue"],
)  # fmt: skip
def test_nothing_is_claimed_of_a_linear_plant_in_a_loop_without_delay(known: Setting) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        result = diagnose(looped(rng, 800), looped(rng, 500), replace(known, deviations=False, skip=20))
        assert result.effect in ("none", "closed_loop", "coloured_noise")


def sliding(rng: np.random.Generator, n: int, dry: float, start: float) -> Record:
    """A mass on a slide under a force, from any position; the slide's friction is viscous, and dry where it is asked."""
    force = np.repeat(rng.choice([-2.0, -1.2, 1.2, 2.0], n // 40 + 1), 40)[:n]
    q, v, fine, y = start, 0.0, 20, np.empty(n)
    for k in range(n):
        y[k] = q
        for _ in range(fine):
            push = force[k] - 0.5 * v
            a = 0.0 if v == 0.0 and abs(push) < dry else push - dry * np.sign(v or push)
            w = v + a * 0.01 / fine / 0.3
            v = 0.0 if v * w < 0.0 else w
            q += v * 0.01 / fine
    return Record(force, y + 1e-4 * rng.standard_normal(n), 0.01)


@pytest.mark.slow
def test_a_motion_with_dry_friction_is_found_from_its_force_balance_wherever_it_begins(
    rng, monkeypatch
) -> None:
    monkeypatch.setitem(BUDGETS, "quick", replace(of_orders(2), terms=1))
    # the balance needs no search for friction
    rivals = "drag", "dead_zone", "stiffness_cubic", "saturation", "input_cubic"
    train, setting = sliding(rng, 1500, 0.5, 0.7), looking_for(*rivals, deviations=False, skip=20)
    result = diagnose(train, sliding(rng, 600, 0.5, -0.2), setting)
    assert result.effect == "coulomb_friction"
    assert result.rmse_after.value < 0.1 * result.rmse_before.value
    motion = as_motion(train, 0, setting, Known(2))
    assert motion is not None
    assert motion.attribution.chosen == ["coulomb_asymmetric"]
    assert as_motion(sliding(rng, 1500, 0.0, 0.7), 0, setting, Known(2)) is None  # negative control
    assert as_motion(train[:300], 0, setting, Known(2)) is None


def test_a_standard_error_knows_that_slow_errors_last_for_several_pieces(rng) -> None:
    policy, counted, y = Policy(), [np.ones(4 * N, dtype=bool)], [np.zeros(4 * N)]
    passed = {0.0: 0, 0.998: 0}
    for pole in passed:
        for _ in range(150):
            a, b = (
                np.asarray(lfilter([1.0], [1.0, -pole], rng.standard_normal(5 * N)))[N:] for _ in range(2)
            )
            passed[pole] += paired_gain(y, [a], [b], counted, policy).beyond(2.0)
    assert passed[0.0] < 12  # 2.3 % on one side
    assert passed[0.998] < 30  # memory of four pieces: a third of them with pieces taken for independent


def test_what_was_searched_on_the_same_blocks_must_gain_more_there() -> None:
    bench = SimpleNamespace(policy=Policy(), alpha=0.01)
    gain = Gain(1.5, 1.0, 0.2)
    for key, kept, claimed in (
        ("input_cubic", True, True),
        ("order", True, False),
        ("gain_change", False, True),
    ):
        claim = Claim(Part(named(key)), gain, 0.001)
        assert _gains(claim, bench) is kept  # pyright: ignore[reportArgumentType]
        assert _holds(claim, bench) is claimed  # pyright: ignore[reportArgumentType]
    for share, held in ((0.6, True), (0.4, False)):
        claim = Claim(Part(named("input_cubic")), Gain(3.0, 1.0, share), 0.5)
        assert _holds(claim, bench) is held  # pyright: ignore[reportArgumentType]


def test_rivals_that_disagree_leave_a_run_undecided(rng) -> None:
    linear, (cause, form) = rng.standard_normal(N), (APART[Kind.NAMED], APART[Kind.DISCOVERED])
    run = linear + 0.5
    assert _undecided(run, linear, [linear - 0.5, linear + 1.4], cause)
    assert not _undecided(run, linear, [linear + 0.4, linear + 0.6, np.full(N, np.nan)], cause)
    # models of one search share what they get wrong: less tells them apart
    assert _undecided(run, linear, [linear + 0.1, linear + 0.9], form)
    assert not _undecided(run, linear, [linear + 0.1, linear + 0.9], cause)
    assert not _undecided(run, linear, [linear + 0.4, linear + 0.6], form)
    assert not _undecided(run, linear, [], form)


def test_terms_that_nearly_cancel_are_as_strong_as_they_are_together() -> None:
    def term(text: str, signal: str, nature: str) -> FoundTerm:
        curve = Curve(signal, "", np.arange(3.0), np.zeros(3), np.zeros(3), "")
        return FoundTerm(text, "force", 0, nature, signal, "", {}, curve)

    slope = np.array([0.0, 5.0, 10.0])
    terms = [term("a", "rate(y)", "dynamic"), term("b", "rate(y)", "dynamic"), term("c", "u", "static")]
    found = strongest_first(terms, np.stack([slope, -0.95 * slope, 0.2 * slope], axis=1))
    assert [t.text for t in found] == ["c", "a", "b"]
    assert leading_nature(found) == "static"
    found = strongest_first(terms, np.stack([slope, 0.1 * slope, slope], axis=1))
    assert leading_nature(found) == "dynamic nonlinearity"  # neither has most of it
    # each may be unsure only because the other is the same curve
    unsure = [replace(t, sure=False) for t in terms]
    found = strongest_first(unsure, np.stack([slope, 0.1 * slope, slope], axis=1))
    assert {t.text: t.sure for t in found} == {"a": True, "b": True, "c": False}


@pytest.mark.slow
def test_a_curve_that_is_nearly_straight_moves_little_beyond_a_linear_model(rng) -> None:
    """A logarithm far from its zero is a gain: by the range of its curve it is the strongest term, by what it bends the weakest."""
    u = np.repeat(rng.uniform(90.0, 110.0, N // 20), 20)
    y = np.zeros(N)
    for k in range(N - 1):
        y[k + 1] = y[k] + 0.2 * (u[k] - 100.0 - y[k] - 0.02 * y[k] ** 3)
    record = Record(u[:, None], (y + 0.02 * rng.standard_normal(N))[:, None], 1.0)
    found = discover([record], best_linear([record]), "quick")
    assert found.nature == "dynamic nonlinearity"
    assert all(a.weight >= b.weight > 0.0 for a, b in pairwise(found.terms))


def test_a_linear_fit_of_a_record_that_begins_in_a_transient_finds_its_order(rng) -> None:
    u = np.repeat(rng.choice([0.0, 1.0], N // 60), 60)
    y = lfilter([0.0, 0.004], [1.0, -1.93, 0.931], u, zi=[0.97 * 12.0, -0.931 * 12.0])[
        0
    ] + 0.01 * rng.standard_normal(N)
    s = replace(Structure(2, (0,)).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2)
    f = fit_linear(channel_of(u, y), s, rough=True)
    assert np.sqrt(np.mean(f.residual**2)) < 0.015
