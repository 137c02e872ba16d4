"""`oed design`: parametrisations, written files, refusals; and that the speed rows measure the same work."""

from __future__ import annotations

import argparse
import json
import re

import numpy as np
import pytest

from benchmarks.cli import main
from benchmarks.commands.plant import design
from benchmarks.speed.design import against_cvxpy
from oed.design.problem.criteria_by_name import NAMES
from oed.errors import InputError


def _run(*words: str) -> dict:
    parser = argparse.ArgumentParser()
    design.configure(parser)
    args = parser.parse_args(["--plant", "reference", *words])
    args.seed, args.quiet, args.json = 0, True, True
    return design.run(args)[0]


def test_grid_and_moments_agree_and_autocorrelation_is_above():
    grid = _run("--criterion", "A")
    moments = _run("--criterion", "A", "--parametrisation", "moments")
    lags = _run("--criterion", "A", "--parametrisation", "autocorrelation", "--lags", "6")
    assert moments["loss"] == pytest.approx(grid["loss"], rel=1e-7)
    assert moments["gap"] < 1e-7
    assert lags["loss"] > grid["loss"]
    assert lags["gap"] > 0.1
    assert len(lags["coefficients"]) == 7
    assert sum(line["power"] for line in grid["support"]) == pytest.approx(1.0)


def test_a_realised_signal_is_written_once(tmp_path):
    out = tmp_path / "input.csv"
    payload = _run("--realise", "300", "--out", str(out), "--input-power", "2")
    t, u = np.loadtxt(out, delimiter=",", skiprows=1).T
    assert out.read_text().startswith("t,u\n")
    assert t.tolist() == list(range(300))
    assert np.mean(u**2) == pytest.approx(2.0) == pytest.approx(payload["realised_power"])
    assert payload["realised_loss"] > payload["loss"]
    with pytest.raises(InputError, match="exists already"):
        _run("--realise", "300", "--out", str(out))
    described = tmp_path / "design.json"
    _run("--out", str(described))
    assert json.loads(described.read_text())["loss"] == pytest.approx(0.033674015758, rel=1e-9)


def test_amplitude_limits_and_multisine_lines(tmp_path):
    payload = _run("--criterion", "hinf", "--amplitude", "1.5", "--realise", "600")
    # The relaxation: power a^2. A square wave has 8 / pi^2 of it in its fundamental, so 1.2337 at best.
    assert payload["bound"] == pytest.approx(1 / 1.5**2, rel=1e-9)
    assert payload["realised_power"] <= 1.5**2 * (1 + 1e-12)
    assert 1.2 < payload["realised_loss"] / payload["bound"] < 1.6
    for limits in (["--amplitude", "1.5"], ["--amplitude", "1.5", "--rate", "0.4"]):
        file = str(tmp_path / f"{len(limits)}.csv")
        asked = _run("--criterion", "D", "--signal", "multisine", "--realise", "600", "--out", file, *limits)
        u = np.loadtxt(file, delimiter=",", skiprows=1)[:, 1]
        assert np.abs(u).max() <= 1.5 * (1 + 1e-12)
        assert np.abs(np.diff(u)).max() <= 0.4 * (1 + 1e-12) or len(limits) == 2
        assert (
            np.count_nonzero(np.abs(np.fft.rfft(u)) > 1e-9 * len(u)) <= 8
        )  # lines and nothing between: it is not clipped
        assert asked["crest_factor"] > 1.2
    lines = _run("--parametrisation", "multisine", "--realise", "500")
    for line in lines["support"]:
        assert line["frequency"] * 500 / (2 * np.pi) == pytest.approx(
            round(line["frequency"] * 500 / (2 * np.pi))
        )
    assert lines["loss"] > _run()["loss"]
    with pytest.raises(InputError, match="say its length"):
        _run("--amplitude", "1")
    with pytest.raises(InputError, match="say N"):
        _run("--parametrisation", "multisine")


def test_bad_options_are_named(tmp_path):
    with pytest.raises(InputError, match="say its length"):
        _run("--out", str(tmp_path / "u.csv"))
    with pytest.raises(InputError, match="csv"):
        _run("--out", str(tmp_path / "u.txt"))
    with pytest.raises(InputError, match="input power only"):
        _run("--parametrisation", "moments", "--output-power", "1")
    with pytest.raises(InputError, match="at least 8"):
        _run("--points", "3")


def test_speed_rows_reach_the_gap():
    row = against_cvxpy("D", 4, 300, 1.0, repeats=1)
    assert row["seconds"] > 0
    assert row["baseline_seconds"] > 0
    assert "gap" in row["note"]


def test_shaped_spectra_and_rates_from_the_command():
    grid = _run("--criterion", "D")
    for words in (["ar", "--lags", "2"], ["bands", "--lags", "12"]):
        shaped = _run("--criterion", "D", "--parametrisation", *words, "--realise", "300")
        assert shaped["loss"] > grid["loss"]
        assert shaped["gap"] > 0.01
        assert shaped["power_used"]["input power"] == pytest.approx(1.0, rel=1e-9)
        assert shaped["realised_power"] == pytest.approx(1.0, rel=1e-9)
    slow = _run("--amplitude", "1", "--rate", "0.3", "--realise", "200")
    assert slow["limits"]["rate of input 1"] == pytest.approx(0.09)
    assert _run("--criterion", "modified-E")["gap"] < 1e-7
    with pytest.raises(InputError, match="--amplitude too"):
        _run("--rate", "0.3")


def test_the_help_names_every_criterion(capsys):
    with pytest.raises(SystemExit):
        main(["design", "--help"])
    said = re.findall(r"[\w-]+", capsys.readouterr().out)
    assert set(NAMES) <= set(said)
