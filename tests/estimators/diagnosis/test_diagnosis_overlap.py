"""Rows of the training record in the test record are found, and chance is not taken for a copy."""

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.record.overlap import copied_rows
from oed.data import Record


def measured(seed, samples=400, step=0.0, period=0):
    rng = np.random.default_rng(seed)
    u = np.sign(rng.normal(size=period or samples))
    u = np.tile(u, -(-samples // len(u)))[:samples]
    y = lfilter([0.0, 1.0], [1.0, -0.6], u) + 0.01 * rng.normal(size=samples)
    return Record(u, np.round(y / step) * step if step else y)


def longest_stretch(train, test):
    """By brute force, what the search must agree with before it judges."""
    a, b = (np.concatenate((r.u, r.y), axis=1).tolist() for r in (train, test))
    best, ends = 0, {}
    for row in b:
        ends = {i: ends.get(i - 1, 0) + 1 for i, other in enumerate(a) if other == row}
        best = max(best, *ends.values(), 0)
    return best


@pytest.mark.parametrize("first, stop", [(0, 400), (250, 300), (391, 399)])
def test_a_copy_is_found(first, stop):
    train, fresh = measured(1), measured(2)
    piece = train[first:stop]
    test = Record(np.r_[fresh.u[:100], piece.u], np.r_[fresh.y[:100], piece.y])
    assert copied_rows(train, test) == longest_stretch(train, test) == stop - first


@pytest.mark.parametrize("step, period", [(1.0, 0), (0.05, 20)])
def test_coarse_rounding_and_periods_repeat_by_chance(step, period):
    """Two experiments agree over long stretches here, and every record repeats itself as long."""

    def other(seed):
        noise = 0.01 * np.random.default_rng(seed).normal(size=400)
        u = train.u[:, 0] if period else np.sign(np.random.default_rng(seed).normal(size=400))
        return Record(u, step * np.round((lfilter([0.0, 1.0], [1.0, -0.6], u) + noise) / step))

    train = measured(3, step=step, period=period)
    fresh = [other(seed) for seed in range(4, 14)]
    assert max(longest_stretch(train, test) for test in fresh) >= 8
    assert [copied_rows(train, test) for test in fresh] == [0] * len(fresh)
    assert copied_rows(train, train[60:]) == 340


def test_the_whole_record_is_a_copy_whatever_it_repeats():
    train = measured(7, step=0.5, period=20)
    assert copied_rows(train, train[100:300]) == 200


def test_missing_samples_count_as_equal_and_short_records_as_fresh():
    train = measured(8)
    y = train.y.copy()
    y[::3] = np.nan
    train = Record(train.u, y)
    assert copied_rows(train, train[50:90]) == 40
    assert copied_rows(train, train[50:55]) == 0


def test_two_repeats_of_one_sweep_are_no_copy():
    """Whole counts of a quiet sensor coincide row by row where the input is the same; a copied half is longer than that."""
    sweep = np.sin(2e-3 * np.arange(1500) ** 1.5)

    def counts(seed):
        noise = 0.12 * np.random.default_rng(seed).normal(size=1500)
        return Record(sweep, np.round(40 * lfilter([0.0, 0.2], [1.0, -0.8], sweep) + noise))

    train, *repeats = [counts(seed) for seed in range(8)]
    assert max(longest_stretch(train, test) for test in repeats) > 40
    assert [copied_rows(train, test) for test in repeats] == [0] * len(repeats)
    y = repeats[0].y.copy()
    y[700:1400] = train.y[700:1400]
    assert copied_rows(train, Record(sweep, y)) >= 700
