"""Objects that are not what is asked for: one line that says what was given, what is wanted and what to do."""

from __future__ import annotations

from datetime import datetime

import numpy as np
import pytest

import oed
from estimators import identify
from oed.errors import InputError

U = np.sign(np.sin(np.arange(60)))
RECORD = oed.Record(U, np.roll(U, 1))
REFERENCE = oed.named_plant("reference")
MISTAKES = {
    "dates for a signal": (lambda: oed.Record(np.array([datetime(2026, 1, 1)] * 9, dtype="M8[s]"), U[:9]), "dates.; give numbers"),
    "text for a signal": (lambda: oed.Record(np.array(["1"] * 9), U[:9]), "text.; give numbers"),
    "no orders": (lambda: identify(RECORD, "oe", None), "the orders are None; oe takes nb nf"),
    "no plant": (lambda: oed.Plant(None, None), "num is None; give a list of coefficients"),
    "an empty plant": (lambda: oed.Plant([], []), "num is ..; give a list of coefficients"),
    "a number for a list": (lambda: oed.Plant(1, 1), "num is 1; give a list"),
    "text for a list": (lambda: oed.Plant("1", "2"), "num is '1'; give a list"),
    "text for a sampling time": (lambda: oed.Plant([0, 1], [1, -0.5], dt="1"), "the sampling time is 1; it must be a positive"),
    "text for a seed": (lambda: oed.simulated(REFERENCE, seed="x"), "the seed is 'x'; it must be a whole number"),
    "a number for a file": (lambda: oed.read_record(5), "a file is given as int; give its name"),
    "bytes for a file": (lambda: oed.read_record(b"x.csv"), "a file is given as bytes"),
    "nothing for a record": (lambda: oed.write_record(None, "x.csv"), "a NoneType is given where a Record is needed"),
    "nothing for a plant file": (lambda: oed.plant_from_json(None), "a plant is given as NoneType; give the name of a JSON file"),
    "a list for a plant file": (lambda: oed.plant_from_json([1]), "a plant is given as list"),
    "a misspelt plant": (lambda: oed.peak("refrence"), "there is no plant named 'refrence' .did you mean reference.."),
}  # fmt: skip


@pytest.mark.parametrize("what", MISTAKES)
def test_a_wrong_object_is_one_line(what):
    call, words = MISTAKES[what]
    with pytest.raises(InputError, match=words) as found:
        call()
    assert "\n" not in str(found.value)
