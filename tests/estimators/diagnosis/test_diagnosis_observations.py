"""What the samples show by themselves is said beside the system, and changes no conclusion about it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators import diagnose
from estimators.diagnosis.effects import CATALOGUE
from estimators.diagnosis.ladder import verdicts
from estimators.diagnosis.ladder.claims import Claim, Named
from estimators.diagnosis.ladder.steps import Kind
from estimators.diagnosis.ladder.verdicts import Finding, _system
from estimators.diagnosis.model.structure import Part
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.record.admission import told_from_clock
from estimators.diagnosis.record.measurement import LONG_REST, goes_with_clock, observations
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


def test_an_input_that_goes_one_way_is_a_clock():
    stairs, (u, y) = Record(np.repeat(np.arange(10.0), 60), np.zeros(600)), rig()
    ramp = Record(np.arange(600.0) + 20 * u, y)
    assert goes_with_clock([stairs])
    assert goes_with_clock([ramp, stairs])
    assert not goes_with_clock([Record(u, y)])
    assert not goes_with_clock([stairs, Record(u, y)])
    assert "goes with the clock" in observations([stairs])[-1]
    # nothing is lost but what runs by a clock
    gone = {e.key for e in CATALOGUE} - {e.key for e in told_from_clock(CATALOGUE, [stairs])}
    assert {"gain_drift", "integral_curve"} <= gone
    assert not gone & {"saturation", "plays", "output_drift"}
    assert told_from_clock(CATALOGUE, [Record(u, y)]) == tuple(CATALOGUE)


def named(*rivals):
    return Named(None, (Claim(Part(CATALOGUE[0]), None, 0.0, rivals),), (), None)  # type: ignore[arg-type]


def test_an_effect_with_equals_of_many_natures_is_none():
    assert named("parameter_change", "duffing", "hammerstein").anything(CATALOGUE)
    assert not named("input_deadzone", "hammerstein", "output_nonlinearity").anything(CATALOGUE)
    assert not named().anything(CATALOGUE)


@pytest.mark.parametrize("rivals", [(), ("parameter_change", "duffing", "hammerstein")])
def test_where_a_regression_sees_it_such_an_effect_has_no_name_but_a_nature(rivals, monkeypatch):
    """A forest's evaporation: "automatic gain", of which 23 others of seven natures were said to be equals; stomata close, at the input."""
    head = Finding("saturation", "input_saturation", "noise", 0.1, 0.0, "")
    monkeypatch.setattr(verdicts, "_claimed", lambda o, tag: [head])
    monkeypatch.setattr(verdicts, "_supported", lambda o, claimed, policy: claimed)
    monkeypatch.setattr(verdicts, "_nameless", lambda *_: [])
    share = SimpleNamespace(
        explainable=True, nature="static input nonlinearity", natures=[SimpleNamespace(sentence="9 %.")]
    )
    ladder = SimpleNamespace(chosen=SimpleNamespace(chain=[SimpleNamespace(kind=Kind.NAMED)]))
    o: Any = SimpleNamespace(
        inverse=False, bent=True, ladder=ladder, share=share, named=named(*rivals), gainsaid=lambda _: False
    )
    (found,) = _system(o, "", Policy())
    assert (found.cause, found.nature) == (
        ("unknown", "static input nonlinearity") if rivals else ("input_saturation", "noise")
    )
    share.explainable = False
    assert _system(o, "", Policy()) == [head]
