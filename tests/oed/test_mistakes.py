"""Objects that are not what is asked for: one line that says what was given, what is wanted and what to do."""

from __future__ import annotations

from datetime import datetime, timedelta
from functools import partial

import control
import numpy as np
import pandas as pd
import pytest

import oed
from estimators import diagnose, identify, power_iterations, run
from estimators.rules.inputs import white
from estimators.sessions import Settings
from oed.errors import InputError

U = np.sign(np.sin(np.arange(60)))
RECORD = oed.Record(U, np.roll(U, 1))
REFERENCE = oed.named_plant("reference")
attempt = partial(run, samples=20, experiments=2, rng=1)
MISTAKES = {
    "dates for a signal": (lambda: oed.Record(np.array([datetime(2026, 1, 1)] * 9, dtype="M8[s]"), U[:9]), "dates.; give numbers"),
    "text for a signal": (lambda: oed.Record(np.array(["1"] * 9), U[:9]), "text.; give numbers"),
    "no orders": (lambda: identify(RECORD, "oe", None), "the orders are None; oe takes nb nf"),
    "no plant": (lambda: oed.Plant(None, None), "num is None; give a list of coefficients"),
    "an empty plant": (lambda: oed.Plant([], []), "num is ..; give a list of coefficients"),
    "a number for a list": (lambda: oed.Plant(1, 1), "num is 1; give a list"),
    "text for a list": (lambda: oed.Plant("1", "2"), "num is '1'; give a list"),
    "text for a sampling time": (lambda: oed.Plant([0, 1], [1, -0.5], dt="1"), "the sampling time is the text '1'; it must be a number"),
    "text for a session's sampling time": (lambda: Settings("power", samples=100, dt="0.1"), "the sampling time is the text '0.1'"),
    "a duration for a sampling time": (lambda: identify((U, U, timedelta(seconds=1)), "oe", (1, 1)), "the sampling time is 0:00:01; it must be a positive"),
    "lists of text": (lambda: identify((["1,5", "2"], ["1", "2"], 1.0), "oe", (1, 1)), "text.; give numbers"),
    "continuous time": (lambda: oed.peak(control.tf([1], [1, 1])), "sample it first, for example oed.Plant.from_control"),
    "text for a seed": (lambda: oed.simulated(REFERENCE, seed="x"), "the seed is 'x'; it must be a whole number"),
    "a number for a file": (lambda: oed.read_record(5), "a file is given as int; give its name"),
    "bytes for a file": (lambda: oed.read_record(b"x.csv"), "a file is given as bytes"),
    "two inputs of one name": (lambda: oed.Record(np.column_stack([U, U]), U, input_names=("a", "a")), "two inputs are called 'a'; give each"),
    "two outputs of one name": (lambda: oed.Record(U, np.column_stack([U, U]), output_names=["a", "a"]), "two outputs are called 'a'; give each"),
    "a number for a name": (lambda: oed.Record(U, U, input_names=(3,)), "input_names is .3,.; give text"),
    "one text for two names": (lambda: oed.Record(np.column_stack([U, U]), U, input_names="ab"), "1 input names for 2 input channels"),
    "text for a first time": (lambda: oed.Record(U, U, t0="x"), "the time of the first sample is x; it must be a finite number"),
    "a truth for a sampling time": (lambda: oed.Record(U, U, dt=True), "the sampling time is True; it must be a positive number"),
    "a still output": (lambda: diagnose(oed.Record(U, np.full(60, 3.0))), "output y is constant .3. in all records"),
    "masked samples": (lambda: identify((np.ma.masked_less(U, 0), U, 1.0), "oe", (1, 1)), "missing samples .NaN."),
    "dates as text": (lambda: identify(pd.DataFrame({"u": U, "y": U}, index=pd.date_range("2026", periods=60).astype(str)), "oe", (1, 1)),
                      "the index of the DataFrame holds '2026-01-01', .*pandas.to_datetime"),
    "two indices": (lambda: identify(pd.DataFrame({"u": U, "y": U}, index=pd.MultiIndex.from_arrays([U, U])), "oe", (1, 1)),
                    "the index of the DataFrame holds .*reset_index"),
    "nothing for a record": (lambda: oed.write_record(None, "x.csv"), "a NoneType is given where a Record is needed"),
    "nothing for a plant file": (lambda: oed.plant_from_json(None), "a plant is given as NoneType; give the name of a JSON file"),
    "a list for a plant file": (lambda: oed.plant_from_json([1]), "a plant is given as list"),
    "u and y apart": (lambda: identify(U, U), "data are given as ndarray; give a Record"),
    "signals by name": (lambda: identify({"u": U, "y": U}), "data are given as dict"),
    "no data": (lambda: identify([]), "the sequence of data is empty"),
    "one that is no record": (lambda: identify([RECORD, "x.csv"]), "item 1 .counting from 0. of the data is a str"),
    "a response for a record": (lambda: identify(control.frd([1, 2], [1, 2])), "made by estimators.pem.identify_response"),
    "a plant for a rig": (lambda: attempt(power_iterations, REFERENCE), "given as Plant; give oed.simulated.plant. of a plant"),
    "a name for a method": (lambda: attempt("power", oed.simulated(REFERENCE)), "the method is 'power'; give a generator function"),
    "a name for an effect": (lambda: diagnose(RECORD, effects="play"), "an effect is given as 'p'; give objects"),
    "a function for a criterion": (lambda: oed.solve_design(REFERENCE, print), "the criterion is given as builtin_function_or_method; give its name or"),
    "a misspelt plant": (lambda: oed.peak("refrence"), "there is no plant named 'refrence' .did you mean reference.."),
}  # fmt: skip


@pytest.mark.parametrize("what", MISTAKES)
def test_a_wrong_object_is_one_line(what):
    call, words = MISTAKES[what]
    with pytest.raises(InputError, match=words) as found:
        call()
    assert "\n" not in str(found.value)


@pytest.mark.parametrize("u", [U.tolist(), pd.Series(U, index=range(5, 65))])
def test_lists_and_columns_are_signals(u):
    assert identify((u, RECORD.y, 1.0), "arx", (1, 1)).theta == pytest.approx(
        identify(RECORD, "arx", (1, 1)).theta
    )


def test_a_seed_will_do_for_a_generator():
    traces = [
        run(white, oed.simulated(REFERENCE), samples=20, experiments=2, rng=rng)
        for rng in (3, np.random.default_rng(3))
    ]
    assert (traces[0].records[1].u == traces[1].records[1].u).all()
