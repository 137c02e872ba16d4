"""`oed diagnose --out`: the folder, the page and what it says."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.commands.record import diagnose as command
from benchmarks.page.diagnosis import _uncovered, _words
from benchmarks.page.skeleton import write_report
from estimators.diagnosis.effects import CATALOGUE
from estimators.diagnosis.ladder.first_line import NAMELESS
from estimators.diagnosis.ladder.verdicts import ECHO, NOTHING, UNCLAIMED
from estimators.diagnosis.result.words import in_seconds, in_units, named_plainly
from oed import Record


@pytest.mark.parametrize(
    "system, after, answer",
    [
        (
            "a limit at the input",
            0.1,
            "The linear model lacks a limit at the input (static); the simulation error falls from 0.2 to 0.1.",
        ),
        (
            f"{NAMELESS} (static): y = u^2",
            0.1,
            f"The linear model lacks {NAMELESS} (static): y = u^2; the simulation error falls from 0.2 to 0.1.",
        ),
        (
            "a limit at the input",
            0.2,
            "The linear model lacks a limit at the input (static); the simulation error stays at 0.2.",
        ),
        (NOTHING, 0.2, f"N{NOTHING[1:]}; the simulation error stays at 0.2."),
        (NOTHING, 0.3, f"N{NOTHING[1:]}; the simulation error rises from 0.2 to 0.3."),
        (UNCLAIMED, 0.3, f"N{UNCLAIMED[1:]}; the simulation error rises from 0.2 to 0.3."),
        (ECHO, 0.2, f"T{ECHO[1:]}; the simulation error stays at 0.2."),
    ],
)
def test_the_answer_is_a_sentence(system, after, answer):
    figure = lambda value: SimpleNamespace(value=value, low=0.0, high=1.0)
    result = SimpleNamespace(
        detected=True, system=f"{system}; error on fresh data", effect="x", nature="static", rmse_before=figure(0.2),
        rmse_after=figure(after), difference=figure(0.0), held_out="test record", p_value=1e-9, confusable=(), warnings=(),
        evidence=["the noise is correlated in time"],
        remaining="", model=None, extra={"test": SimpleNamespace(output_units=("V",))},
    )  # fmt: skip
    said, sure, todo = _words(result)  # type: ignore[arg-type]
    assert said == answer[:-1] + " V."
    assert any("[0, 1] V." in words for words in sure)  # the difference has a unit too
    assert not any("residual" in words for words in todo)  # what is left is nothing to do
    # a tiny p beside "nothing is missing" was read as its opposite: it says what is left
    assert any("what is left in it: the noise is correlated" in words for words in sure) is system.startswith(
        "nothing"
    )
    worse = after >= 0.2  # an answer that does not lower the error is not to be used
    assert any("Keep the linear model" in words for words in todo) is (system.startswith("nothing") or worse)
    assert any("Use the answer" in words for words in todo) is not (system.startswith("nothing") or worse)
    result.detected = False
    assert _words(result)[0].startswith("Nothing is missing")  # type: ignore[arg-type]
    result.remaining = "the residual still depends on past values of the input"
    assert _words(result)[0].startswith("More is left than noise")  # type: ignore[arg-type]


@pytest.mark.parametrize("outside", [5, 40])
def test_a_test_record_beyond_the_training_data_asks_for_others(outside):
    """Two of five samples beyond the range of input and output are another experiment; one in twenty is not."""
    u = np.linspace(-1.0, 1.0, 100)
    far = u.copy()
    far[:outside] = 3.0
    train = Record(u, 2 * u, input_units=("V",))
    test = Record(far, 2 * far, input_units=("V",))
    result = SimpleNamespace(extra={"records": [train], "test": test}, held_out="test record")
    asked = "Train on a record that has u from -0.1919 to 3 V and y from -0.3838 to 6: 40 % of the test record lies where "
    said = _uncovered(result)  # type: ignore[arg-type]
    assert [words.startswith(asked) for words in said] == ([True] if outside == 40 else [])


@pytest.mark.parametrize(
    "unit, stated",
    [("y", "m/s"), ("y/u", "(m/s)/V"), ("1/u^2", "1/V^2"), ("u/sample", "V/sample"), ("sample", "sample")],
)
def test_units_are_those_of_the_record(unit, stated):
    record = Record(np.zeros((2, 2)), np.zeros(2), input_units=("V", "V"), output_units=("m/s",))
    unknown = Record(np.zeros((2, 2)), np.zeros(2), input_units=("V", "A"))
    assert in_units(unit, record) == stated
    assert in_units(unit, unknown) == unit


def test_no_parameter_of_the_catalogue_is_said_by_its_letter():
    """Every name has a word, every number a unit; samples are seconds where the sampling time is known."""
    record = Record(np.zeros(2), np.zeros(2), dt=0.5)
    for effect in CATALOGUE:
        rows = [*effect.parameters.items(), *(effect.shape(2, 2) if effect.shape else ())]
        for name, unit in rows:
            assert len(named_plainly(f"{effect.key}.{name}", alone=True)) > 2, (effect.key, name)
            assert "sample" not in in_seconds(1.0, 0.1, unit, record)[2], (effect.key, name, unit)
            assert in_seconds(1.0, 0.1, unit, record)[2], (effect.key, name)
    assert in_seconds(np.pi, 0.0, "rad/sample", record) == (1.0, 0.0, "Hz")
    assert in_seconds(np.log(2.0), 0.1, "log", record) == (
        pytest.approx(2.0),
        pytest.approx(0.2),
        "(no unit)",
    )
    per_record = ("1/record", "y/record", "sample/record", "record")
    assert [in_seconds(1.0, 0.0, unit, record)[2] for unit in per_record] == [
        "per record", "y per record", "s per record", "of the record",
    ]  # fmt: skip
    assert named_plainly("y1.plays.weight2") == "2nd weight of play of plays of y1"
    assert named_plainly("y1.term 2.at of y2") == "at of y2 of term 2 of y1"  # no "2nd at of y"


@pytest.mark.slow
def test_the_page_tells_the_cause_and_both_errors(tmp_path):
    rng = np.random.default_rng(3)
    files = []
    for name, start, n in (("train", 0, 400), ("test", 500, 200)):
        u = np.repeat(rng.uniform(-2, 2, n // 4), 4)
        y = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], np.clip(u, -1.1, 1.1)) + 0.02 * rng.standard_normal(n)
        rows = np.column_stack((np.arange(start, start + n), u, y))
        files.append(tmp_path / f"{name}.csv")
        np.savetxt(files[-1], rows, delimiter=",", header="t,u,y", comments="", fmt="%.9g")
    meta = tmp_path / "meta.json"
    meta.write_text(json.dumps({"sampling_time": 1.0, "structure": "SISO", "suggested_order": 2}))
    parser = command.argparse.ArgumentParser()
    command.configure(parser)
    out = tmp_path / "out"
    parser.add_argument("--quiet", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(
        [str(files[0]), "--quiet", "--test", str(files[1]), "--meta", str(meta), "--out", str(out)]
    )
    payload, _ = command.run(args)
    assert payload["effect"] == "input_saturation"
    page = (out / "report.html").read_text()
    head = page[: page.index("<script")]
    assert "The linear model lacks input saturation" in head
    content = json.loads((out / "report.json").read_text())
    ladder = content["hero"][0]["rows"]
    assert {r["y"] for r in ladder} >= {"linear model", "+ named effect"}
    assert [r["x"] for r in ladder if r["series"].startswith("noise floor")] == [payload["noise_floor"]]
    titles = {s["title"]: s for s in content["sections"]}
    assert [f["name"] for f in titles["The effect"]["figures"]] == ["curve-1-1"]
    (curve,) = titles["The effect"]["figures"]
    found = [r for r in curve["rows"] if r["series"].startswith("found")]
    assert max(r["y"] for r in found) == pytest.approx(1.1, abs=0.1)  # where the input was clipped
    assert all(r["low"] <= r["y"] <= r["high"] for r in found)
    why = {
        r["variant"]: r["why"]
        for t in titles["What was tried, and why it lost"]["tables"]
        if t["name"] == "causes"
        for r in t["rows"]
    }
    assert "taken" in why.values()
    assert len(set(why.values())) > 1
    assert titles["The linear model"]["tables"][0]["rows"]
    rows = json.loads((out / "diagnosis.json").read_text())
    assert rows["rmse_after"] < 0.5 * rows["rmse_before"]
    before = page
    write_report(out)  # `oed report DIR` makes the same page again from what the folder holds
    assert (out / "report.html").read_text() == before
