"""The examples run as a reader would run them, and their stories come out as they are told."""

from __future__ import annotations

import contextlib
import io
import runpy
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def example(name: str, run_name: str = "__main__") -> dict[str, Any]:
    """What an example leaves, with what it said as `said` and its figures counted as `figures`; none stays open."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), pytest.MonkeyPatch.context() as patch:
        patch.setattr(plt, "show", lambda: None)
        patch.setattr("sys.argv", [name])
        left = runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name=run_name)
    left |= {"said": said.getvalue(), "figures": len(plt.get_fignums())}
    plt.close("all")
    return left


def test_every_example_is_run_here():
    text = Path(__file__).read_text(encoding="utf-8")
    for file in EXAMPLES.glob("*.py"):
        assert f'example("{file.stem}")' in text, f"{file.name} is not run by this file"


def test_the_norm_of_an_unknown_system():
    left = example("norm_of_an_unknown_system")
    found = left["now"]
    assert abs(found.value - left["true"].value) < 3 * found.standard_error < 0.02
    assert left["session"].trace.usage.peak <= 3 * (1 + 1e-9)
    assert left["said"].count("\n") >= 13
    assert left["figures"] == 2


def test_a_better_input_for_tomorrow():
    left = example("better_input_for_tomorrow")
    assert left["design"].gap < 1e-9
    reached = {name: fit.hinf_norm[1] for name, fit in left["fits"].items()}
    # the information promises what the fit then has, to the noise variance's error
    for kind in ("the same again", "the designed one"):
        assert reached[kind] == pytest.approx(left["promised"][kind], rel=0.15)
    assert reached["the designed one"] < 0.7 * reached["the same again"]
    assert "apply a constant alone; " in left["said"]
    assert left["figures"] == 2


def test_what_is_my_model_missing():
    """The rig's second mode: gain 1.997 at 121 Hz, by construction."""
    left = example("what_is_my_model_missing")
    assert left["low"] < 1.997 < left["high"]
    assert left["high"] - left["low"] < 0.02
    assert left["found"].frequency / left["turn"] == pytest.approx(121, abs=0.1)
    assert left["cause"].name == "mode"
    assert left["cause"].after < 0.02 * left["cause"].before
    assert "missing from the model" in left["said"]
    assert left["figures"] == 2


def test_a_rig_by_files(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.mkdtemp", lambda: str(tmp_path))
    left = example("rig_by_files")
    assert left["refused"] == 1
    found, true = left["estimates"][-1], left["peak"](left["PLANT"]).value
    assert abs(found.value - true) < 3 * found.standard_error < 0.05
    assert "times" in (tmp_path / "rig" / "journal.txt").read_text()  # the rate limit scaled an input
    assert "half written" in left["said"]
    assert left["figures"] == 2


@pytest.mark.validate
def test_the_temperature_lab():
    pytest.importorskip("tclab", reason="the rig extra is not installed: pip install tclab")
    lab = example("temperature_lab")
    found = lab["told"]
    # What the simulator is: a heater and its sensor in series (two lags), heaters coupled, readings 0.3223 apart.
    assert found["effect"] in ("quantisation", "sensor_lag", "mimo_cross")
    variant = found["variant"]
    assert "quantised" in variant
    assert "cross" in variant
    assert "lag" in variant or "order" in variant
    # before is the error of the best linear model by cross-validation, which is better than the textbook one
    assert found["after"] < 0.3 * found["before"]
    errors = {name.strip(): value for name, value, _ in found["rows"]}
    spread = {name.strip(): value for name, _, value in found["rows"]}
    assert (
        errors["and the designed input"]
        < errors["second order, coupled, same record"]
        < 0.3 * found["before"]
    )
    assert errors["and the designed input"] < 1.5 * 0.3223 / np.sqrt(12)
    assert spread["and the designed input"] < 0.95 * spread["and the same kind of input again"]
    # Of what the textbook model is wrong by, nothing is left that its own interval tells from the sensor's step; the value
    # itself, a maximum over noise, moves by threefold with the fourth digit of the designed input.
    step = 0.3223 / np.sqrt(12)
    assert found["norm_after"].interval[0] < step < found["norm_before"].interval[0]
    assert found["gap"] < 1e-6
    assert np.abs(found["planned"]).max() <= lab["RANGE"]
    assert lab["figures"] == 4
    assert "0.3223 apart" in lab["said"]


def test_the_temperature_lab_against_its_own_clock():
    """The same lab with its clock running 400 times as fast agrees with the one stepped by hand.

    The wall clock is uneven by some milliseconds, seconds of the lab's; the temperature moves by up to 0.2 degC a second.
    """
    pytest.importorskip("tclab", reason="the rig extra is not installed: pip install tclab")
    lab = example("temperature_lab", run_name="lab")
    stepped = lab["stepped"](np.full((5, 2), 50.0), 1)
    np.testing.assert_array_equal(stepped, lab["stepped"](np.full((5, 2), 50.0), 1))
    u = np.column_stack([np.repeat([80.0, 0.0, 60.0], 15), np.repeat([0.0, 90.0, 20.0], 15)])
    y = lab["clocked"](u, 400)
    assert np.ptp(y, axis=0).min() > 8
    # step by step by the published equations, at rest at 21 degC
    H, T, expected = np.full(2, 21.0), np.full(2, 21.0), []
    for row in u:
        expected.append(T.copy())
        for _ in range(40):
            flow = (H[0] - H[1]) / 100
            H, T = (
                H + 0.2 * (np.array([200.0, 100.0]) * row / 5720 + (21 - H) / 20 + np.array([-flow, flow])),
                T + 0.2 * (H - T) / 140,
            )
    expected = np.array(expected)
    for j in range(2):
        assert np.corrcoef(y[:, j], expected[:, j])[0, 1] > 0.98
