"""What the samples show by themselves is said beside the system, and changes no conclusion about it."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from estimators import diagnose
from estimators.diagnosis.record.measurement import LONG_REST, observations
from oed import Record


def rig(n: int = 600):
    rng = np.random.default_rng(5)
    u = rng.standard_normal(n)
    return u, lfilter([0.0, 0.5], [1.0, -0.6], u) + 0.05 * rng.standard_normal(n)


def test_gaps_and_rest_are_counted():
    u, y = rig()
    y[50:53] = y[200] = np.nan
    assert observations([Record(u, y)]) == ("y: 4 of 600 samples are missing, 3 in a row at most",)
    u, y = (np.concatenate((np.zeros(LONG_REST), x)) for x in rig())
    assert observations([Record(u, y)]) == (f"the input rests for the first {LONG_REST} of {len(u)} samples",)
    two = observations([Record(*rig()), Record(u, y)])
    assert two == (f"the input rests for the first {LONG_REST} of {len(u)} samples in record 2",)


def test_a_plain_record_and_a_repeated_first_sample_are_no_news():
    u, y = rig()
    assert observations([Record(u, y)]) == ()
    u[: LONG_REST - 1] = u[0]
    assert observations([Record(u, y)]) == ()


def test_a_diagnosis_says_them_and_finds_nothing_missing():
    u, y = rig()
    y[100:104] = np.nan
    u, y = np.concatenate((np.zeros(40), u)), np.concatenate((np.full(40, 0.0), y))
    found = diagnose(Record(u, y))
    assert "the input rests for the first 40 of 640 samples" in found.data
    assert "y: 4 of 640 samples are missing, 4 in a row at most" in found.data
    assert not found.detected
