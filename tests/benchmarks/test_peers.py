"""The table of peers: one row per record and tool, failures as rows with their reason, and parts that are kept while they hold."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks import peers, peers_runner
from benchmarks.peers import Case, cases, table
from oed.data import Record

rng = np.random.default_rng(5)
INPUT = rng.standard_normal(400)
RECORD = Record(INPUT, lfilter([0, 0.5], [1, -0.7], INPUT) + 0.01 * rng.standard_normal(400), dt=0.1)
CASE = Case("tiny", RECORD[:300], RECORD[300:], 20)


def held(case: Case) -> dict:
    return {name: np.asarray(value) for name, value in peers.signals(case).items()}


def test_a_tool_that_is_not_there_is_a_row_with_its_reason_and_is_kept(tmp_path: Path) -> None:
    (row,) = table(iter([CASE]), tmp_path, sys.executable, ["sippy"])
    assert row["rmse"] is None
    assert "sippy_unipi" in row["reason"]
    made = (tmp_path / "parts" / "tiny--sippy.json").stat().st_mtime_ns
    table(iter([CASE]), tmp_path, sys.executable, ["sippy"])
    assert (tmp_path / "parts" / "tiny--sippy.json").stat().st_mtime_ns == made
    table(
        iter([CASE._replace(skip=21)]), tmp_path, sys.executable, ["sippy"]
    )  # another question: asked again
    assert (tmp_path / "parts" / "tiny--sippy.json").stat().st_mtime_ns > made
    assert "| tiny | sippy |" in (tmp_path / "peers.md").read_text()
    assert (tmp_path / "peers.csv").read_text().count("\n") == 2


def test_a_tool_that_takes_too_long_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    endless = tmp_path / "endless.py"
    endless.write_text("while True: pass\n")
    monkeypatch.setattr(peers_runner, "__file__", str(endless))
    monkeypatch.setattr(peers, "WALL", 300)  # a crowded machine gives a second of CPU late
    assert peers.run(CASE, "sippy", sys.executable, 1)["reason"] == "stopped at 1 s of CPU"


def test_records_are_found_with_their_split(tmp_path: Path) -> None:
    folder = tmp_path / "more" / "mine"
    folder.mkdir(parents=True)
    for name, n in (("train", 30), ("test", 20)):
        lines = [f"{k},{INPUT[k]},{INPUT[k]}" for k in range(n)]
        (folder / f"{name}.csv").write_text("\n".join(["t,u,y", *lines]) + "\n")
    (folder / "meta.json").write_text('{"skip": 7}')
    (found,) = cases(tmp_path)
    assert (found.name, len(found.train), len(found.test), found.skip) == ("mine", 30, 20, 7)
    (found,) = cases(tmp_path, short=10)
    assert (len(found.train), len(found.test)) == (10, 5)
    assert not list(cases(tmp_path, only=["others"]))


def test_boosting_on_lags_runs_free() -> None:
    pytest.importorskip("sklearn", reason="scikit-learn is in the environment of `make peers` only")
    row = peers_runner.ran("scikit-learn", held(CASE))
    assert row["rmse"] < 0.5 * RECORD.y[320:].std()
    assert not row["explains"]
    worse = Case("noise", RECORD.replace(y=rng.permutation(RECORD.y))[:300], RECORD[300:], 20)
    assert peers_runner.ran("scikit-learn", held(worse))["rmse"] > row["rmse"]


def test_the_test_outputs_after_the_start_are_not_used() -> None:
    """Ours, as every tool: what is measured after `skip` changes the error and nothing of the free run."""

    class Mean:  # stands in for the tool: predicts its first regressor, the output LAGS samples before
        def __init__(self, random_state: int) -> None:
            self._predictors = ()

        def fit(self, X: np.ndarray, y: np.ndarray) -> Mean:
            return self

        def predict(self, X: np.ndarray) -> np.ndarray:
            return X[:, 0]

    tool = type("Ensemble", (), {"HistGradientBoostingRegressor": Mean})
    u, y = RECORD.u, RECORD.y
    split = peers_runner.Split(u[:300], y[:300], u[300:], y[300:], 20)
    other = split.y2.copy()
    other[20:] += 1.0
    run = peers_runner.scikit_learn(split, tool).run
    assert np.array_equal(run, peers_runner.scikit_learn(split._replace(y2=other), tool).run)
    assert np.array_equal(run[:12, 0], y[[*range(310, 320), 310, 311], 0])


def test_ours_is_in_it_as_it_is() -> None:
    row = peers_runner.ran("oed", held(CASE))
    assert row["rmse"] < 0.05
    assert row["parameters"] >= 2
    assert not row["explains"]
