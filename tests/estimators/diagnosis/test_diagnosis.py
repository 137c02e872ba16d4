"""Diagnosis: practice cases, detection at its stated rate, errors of the border."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.cases import diagnose_files
from estimators.diagnosis.discovery import Discovery
from estimators.diagnosis.loop import Setting, diagnose
from estimators.diagnosis.model.fitting import ar_model
from estimators.diagnosis.policy import Effort
from estimators.diagnosis.record.measurement import (
    held_samples,
    lost_samples,
    refreshed_every,
    resting_samples,
    rounding_step,
    wild_samples,
)
from estimators.diagnosis.search import discoveries
from estimators.diagnosis.search.feedback import feedback_test
from oed.data import Record
from oed.errors import InputError
from tests.estimators.diagnosis.case_small import looking_for

CASES = os.environ.get("OED_CASES")


def linear_record(rng, n, *, sigma=0.1, start=0, bend=0.0):
    u = np.repeat(rng.uniform(-2, 2, n // 4 + 1), 4)[:n]
    v = u + bend * u**3
    y = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], v)
    return Record(u, y + sigma * rng.standard_normal(n), t0=float(start))


SETTING = Setting(orders=(2,), structure="SISO")


def test_nothing_is_found_in_a_linear_record():
    # negative control: the next test plants a nonlinearity in the same record
    rng = np.random.default_rng(11)
    quick = replace(SETTING, effort=Effort.QUICK)
    result = diagnose(linear_record(rng, 400), linear_record(rng, 300, start=600), quick)
    assert not result.detected
    assert result.ranked == ("none",)
    np.testing.assert_array_equal(result.yhat_before, result.yhat_after)


@pytest.fixture
def asked(monkeypatch) -> list[tuple]:
    """What the search for terms was called with; it finds none."""
    calls = []

    def spy(*arguments):
        calls.append(arguments)
        return Discovery(None)

    monkeypatch.setattr(discoveries, "discover", spy)
    return calls


def test_terms_are_looked_for_only_where_something_is_left(asked):
    rng = np.random.default_rng(11)
    few = looking_for("saturation", "output_cubic", orders=(2,), structure="SISO")
    diagnose(linear_record(rng, 500), None, few)
    assert not asked
    late = linear_record(rng, 500)
    coloured = lfilter([1.0], [1.0, -0.9], 0.1 * rng.standard_normal(500))
    diagnose(late.replace(y=late.y + coloured[:, None]), None, few)
    assert len(asked) == 1  # noise that is not white could be a term


def test_what_stands_out_is_missing_to_what_is_discovered(asked):
    """Spikes in a hundredth of a damper's samples had doubled what its discovered curve left: 5.93 mm, 3.03 now, 2.82 without them."""
    rng = np.random.default_rng(11)
    train = linear_record(rng, 500, bend=-0.08)
    at = np.sort(rng.choice(np.arange(20, 480), 8, replace=False))
    y = train.y.copy()
    y[at] += 6.0 * np.std(y)
    diagnose(train.replace(y=y), None, replace(SETTING, effects=()))
    (records, base, *_), *_ = asked
    assert np.flatnonzero(np.isnan(records[0].y[:, 0])).tolist() == at.tolist()
    assert np.sqrt(np.mean((base.y_model[0] - train.y) ** 2)) < 0.2  # nor had its linear model met them


def test_a_planted_nonlinearity_is_found_and_removed():
    rng = np.random.default_rng(11)
    train = linear_record(rng, 500, bend=-0.08)
    test = linear_record(rng, 400, start=600, bend=-0.08)
    result = diagnose(train, test, SETTING)
    assert result.effect == "hammerstein"
    assert result.rmse_after.value < 1.05 * 0.1
    assert result.rmse_before.value > 1.2 * result.rmse_after.value
    assert result.difference.low > 0
    value, se, _ = result.parameters["input_cubic.c3"]
    assert abs(value + 0.08) < 5 * se
    assert "hammerstein" in str(result)
    json.dumps(result.to_dict())


@pytest.mark.slow
def test_wild_samples_of_a_long_record_are_left_out_of_the_answer():
    """Of more samples than are examined at once: the model after is the one without the wild samples."""
    rng = np.random.default_rng(14)
    train, test = linear_record(rng, 6000), linear_record(rng, 1000, start=7000)
    clean = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], test.u[:, 0])
    y = train.y.copy()
    y[rng.choice(6000, 200, replace=False), 0] += 3.0
    few = looking_for("outliers", "saturation", "output_cubic", orders=(2,), structure="SISO")
    result = diagnose(train.replace(y=y), test, few)
    assert result.effect == "outliers"
    before, after = (np.std(yhat[:, 0] - clean) for yhat in (result.yhat_before, result.yhat_after))
    assert after < 0.5 * before


@pytest.mark.slow
def test_a_planted_hysteresis_is_found_with_its_parameters():
    # the element by Euler steps of its differential equation, 200 per sample
    rng = np.random.default_rng(4)

    def record(n, start):
        u = 2 * lfilter([0.3], [1.0, -0.7], rng.standard_normal(n))
        z, before, bent = 0.0, 0.0, np.empty(n)
        for k, now in enumerate(u):
            d = (now - before) / 200
            before = now
            for _ in range(200):
                z += d - abs(d) * (z + np.sign(d) * abs(z))  # width 0.5
            bent[k] = z
        y = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], 0.4 * u + 0.6 * bent)
        return Record(u, y + 0.02 * rng.standard_normal(n), t0=float(start))

    result = diagnose(record(600, 0), record(400, 700), SETTING)
    assert result.effect == "hysteresis"
    assert result.variant == "hysteresis"
    for name, true in (("share", 0.6), ("width", 0.5)):
        value, se, _ = result.parameters[f"hysteresis.{name}"]
        assert abs(value - true) < 4 * se, name
    assert result.rmse_after.value < 1.1 * 0.02


@pytest.mark.skipif(CASES is None, reason="OED_CASES does not name the folder of the practice cases")
@pytest.mark.parametrize(
    "case, effect", [("case_011", "none"), ("case_013", "output_nonlinearity"), ("case_048", "output_offset")]
)
def test_practice_cases(case, effect):
    folder = Path(CASES) / "undeclared" / "practice" / "public" / "P" / case
    result, _ = diagnose_files(folder / "train.csv", folder / "test.csv", meta=folder / "meta.json")
    assert result.effect == effect


@pytest.mark.validate
def test_false_alarms_stay_within_the_stated_rate():
    # 500 linear records with white noise: at 1 % the count is below 13 with probability 0.995
    alarms = 0
    for seed in range(500):
        rng = np.random.default_rng([77, seed])
        alarms += diagnose(linear_record(rng, 300), linear_record(rng, 100, start=400), SETTING).detected
    assert alarms <= 12


def test_rounded_and_held_samples_are_recognised():
    rng = np.random.default_rng(3)
    y = np.cumsum(rng.standard_normal(400))
    assert rounding_step(np.round(y / 0.5) * 0.5) == pytest.approx(0.5)
    assert rounding_step(y) == 0.0
    held = y.copy()
    held[100:104] = held[99]
    assert held_samples(held).sum() == 4
    single = y.copy()
    single[[50, 150, 300]] = single[[49, 149, 299]]
    assert held_samples(single).sum() == 0  # by interpolation, say
    top = int(np.argmax(held))
    held[top + 1 : top + 3] = held[top]
    assert held_samples(held).sum() == 6  # lost at the largest value
    held[top + 10] = held[top]
    assert held_samples(held).sum() == 4  # a limit that is reached again
    assert held_samples(y).sum() == 0
    assert held_samples(np.round(y)).sum() == 0  # values recur: coarse, not lost
    coarse = np.round(lfilter([1.0], [1.0, -0.9], rng.standard_normal(900)) / 0.5) * 0.5
    lost, resting, first = coarse.copy(), coarse.copy(), np.arange(20, 880, 30)
    for at in first:
        lost[at : at + 8] = lost[at - 1]  # too long a row for this scale, and the next sample is far
        resting[at + 8 :] += resting[at - 1] - resting[at + 8]
        resting[at : at + 8] = resting[
            at - 1
        ]  # as long a row, after which the signal goes on from where it was
    assert held_samples(coarse).sum() == held_samples(resting).sum() == 0
    flags = held_samples(lost)
    assert np.mean([flags[at : at + 8].all() for at in first]) > 0.9
    assert flags.sum() < 8.5 * len(first)
    nights = np.where(np.arange(400) % 100 < 40, -0.3, y)
    nights[150:153] = nights[149]
    assert set(np.flatnonzero(held_samples(nights))) == {
        150,
        151,
        152,
    }  # neither its largest value nor its least


def test_rest_is_no_loss_and_a_loss_is_no_rest():
    """Thirty samples before the input moves, and ten in the middle, repeat; three lost ones under a moving input do too."""
    rng = np.random.default_rng(8)
    u = np.concatenate((np.zeros(30), rng.standard_normal(370)))
    y = np.concatenate((np.full(30, 0.7), np.cumsum(rng.standard_normal(370))))
    u[200:210], y[200:210] = u[200], y[200]
    y[300:303] = y[299]
    rest = resting_samples(u[:, None], y)
    assert rest[1:30].all()
    assert rest[201:210].all()
    assert rest.sum() == 38
    assert set(np.flatnonzero(held_samples(y) & ~rest)) == {300, 301, 302}


def test_an_output_that_is_read_anew_now_and_then_is_held_between(rng):
    """Whole tenths, every eleventh sample, under an input of its own times; but not a quick plant behind an input of that lattice."""
    k = np.arange(1500)
    u = np.repeat(rng.standard_normal(1500 // 7 + 1), 7)[:1500, None]
    y = np.round(np.asarray(lfilter([0.0, 1.0], [1.0, -0.95], u[:, 0])) + 0.2 * rng.standard_normal(1500), 1)
    late = y[k // 11 * 11]
    assert refreshed_every(u, y) == 1
    assert refreshed_every(u, late) == 11
    changed = np.append(False, late[1:] != late[:-1])
    assert np.mean(lost_samples(u, late)[k % 11 != 0]) > 0.95  # a few refreshes bring the same tenth
    assert not lost_samples(u, late)[changed].any()
    quick = np.round(0.3 * np.repeat(rng.standard_normal(1500 // 11 + 1), 11)[:1500], 1)
    assert refreshed_every(quick[:, None], np.append(0.0, quick[:-1])) == 1


def test_wild_samples_are_recognised_and_gaussian_ones_are_not():
    rng = np.random.default_rng(4)
    r = rng.standard_normal(2000)
    keep = np.ones(2000, dtype=bool)
    assert wild_samples(r, keep).sum() == 0
    r[[50, 700, 1500]] += 12
    assert set(np.flatnonzero(wild_samples(r, keep))) == {50, 700, 1500}


def test_the_noise_model_finds_its_order():
    rng = np.random.default_rng(5)
    e = rng.standard_normal(3000)
    assert len(ar_model(e)[0]) == 0
    r = np.zeros(3000)
    for k in range(2, 3000):
        r[k] = 1.2 * r[k - 1] - 0.6 * r[k - 2] + e[k]
    a, _ = ar_model(r)
    np.testing.assert_allclose(a[:2], [-1.2, 0.6], atol=0.06)


def test_feedback_shows_in_the_input_and_open_loop_does_not():
    rng = np.random.default_rng(6)
    e, r = 0.1 * rng.standard_normal(1500), np.repeat(rng.choice([-1.0, 1.0], 150), 10)
    assert feedback_test(r - 0.5 * np.concatenate(([0.0], e[:-1])), e) < 1e-10
    assert feedback_test(r, e) > 1e-3
    # beside the constant, an input in small units was no column at all, and in large ones the constant none
    usual = feedback_test(r + 0.5 * np.roll(r, 1), e)
    for unit in (2.0**-130, 2.0**130):
        assert np.isclose(feedback_test(unit * (r + 0.5 * np.roll(r, 1)), unit * e), usual, rtol=1e-6)


def test_bad_input_is_refused_with_its_remedy():
    rng = np.random.default_rng(7)
    record = linear_record(rng, 300)
    with pytest.raises(InputError, match="give data that were not used"):
        diagnose(record, record[100:], SETTING)
    with pytest.raises(InputError, match="no excitation"):
        diagnose(record.replace(u=np.ones((300, 1))), None, SETTING)
    with pytest.raises(InputError, match="sampling times"):
        diagnose(record, linear_record(rng, 200, start=500).replace(dt=2.0), SETTING)
    with pytest.raises(InputError, match="at least 50"):
        diagnose(record[:40], None, SETTING)
