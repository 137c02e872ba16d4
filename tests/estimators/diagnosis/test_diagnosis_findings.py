"""Findings about the data: each fault is found with its samples, and clean records have none."""

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline import Baseline, best_linear
from estimators.diagnosis.record.findings import Fault, cleaned, data_findings
from oed.data import Record

N = 800


def rig(seed, noise=0.05):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal(N // 4), 4)
    y = lfilter([0.0, 0.5], [1.0, -0.8], u)
    return rng, u, y + noise * rng.standard_normal(N)


def found(u, y, fault=None) -> list:
    record = Record(u, y)
    base: Baseline = best_linear([record])
    return [f for f in data_findings([record], base) if fault is None or f.fault is fault]


@pytest.mark.parametrize("seed", range(6))
def test_a_clean_record_has_no_findings(seed):
    """Negative control, linear and bent, levels and coloured noise: no false finding in six records."""
    rng, u, y = rig(seed)
    y = np.tanh(y) if seed % 2 else y + 5.0 + lfilter([0.1], [1.0, -0.9], rng.standard_normal(N))
    assert found(u, y) == []


def test_outliers_are_found_and_cleaning_leaves_none():
    rng, u, y = rig(1)
    where = np.sort(rng.choice(np.arange(60, N), 12, replace=False))
    y[where] += 3.0 * rng.choice([-1.0, 1.0], 12)
    record = Record(u, y)
    (f,) = data_findings([record], best_linear([record]))
    assert f.fault is Fault.OUTLIERS
    assert np.isin(where, np.flatnonzero(f.rows)).mean() > 0.8
    assert f.rows.sum() <= 14
    assert f.size == pytest.approx(3.0, rel=0.2)
    (clean,) = cleaned([record], [f])
    assert np.array_equal(np.isnan(clean.y[:, 0]), f.rows)
    assert data_findings([clean], best_linear([clean]))[0].fault is Fault.GAPS


def test_repeats_are_lost_samples_but_rest_is_not():
    _, u, y = rig(2)
    held = y.copy()
    for k in range(100, 700, 30):
        held[k : k + 3] = held[k - 1]
    (f,) = found(u, held, Fault.REPEATS)
    assert f.rows.sum() == 60
    assert f.harmful
    u, y = (np.concatenate((np.full(100, x), z)) for x, z in ((0.0, u), (1.25, y + 1.25)))
    (rest,) = found(u, y)
    assert rest.fault is Fault.REST
    assert rest.size == 100
    assert not rest.harmful


def test_rounding_and_gaps_are_said():
    _, u, y = rig(3, noise=0.01)
    y = 0.1 * np.round(y / 0.1)
    y[200:207] = np.nan
    gaps, rounding = found(u, y)
    assert (gaps.fault, rounding.fault) == (Fault.GAPS, Fault.ROUNDING)
    assert "7 in a row" in gaps.sentence
    assert rounding.size == pytest.approx(0.1)


def test_feedback_is_seen_in_what_is_new_in_the_input():
    rng, r, _ = rig(4)
    u, y, e = np.zeros(N), np.zeros(N), 0.3 * rng.standard_normal(N)
    state = 0.0
    for k in range(N):
        y[k] = state + e[k]
        u[k] = r[k] - 0.8 * y[k - 1] + 0.3 * rng.standard_normal()
        state = 0.8 * state + 0.5 * u[k]
    (f,) = found(u, y)
    assert f.fault is Fault.FEEDBACK
    assert "closed loop" in f.sentence
    u = r + 0.3 * rng.standard_normal(N)
    assert found(u, lfilter([0.0, 0.5], [1.0, -0.8], u) + e) == []
