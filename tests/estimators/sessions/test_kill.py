"""Kill -9 at random moments and around every call that changes the disk: the session goes on as if undisturbed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from estimators.sessions import Session, Settings, open_session
from oed.experiments import simulated
from oed.plants.named import named_plant

DRIVER = Path(__file__).with_name("kill_driver.py")


def drive(folder: Path, *words: object) -> dict:
    done = subprocess.run(
        [sys.executable, str(DRIVER), str(folder), *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def numbers(folder: Path) -> dict[str, bytes]:
    return {f.name: f.read_bytes() for f in folder.iterdir() if f.suffix in (".csv", ".json")}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed") / "rig"
    drive(folder, "0", 0)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("mode, seed", [("50", 1), ("calls", 2)])
def test_killed_sessions_end_with_the_numbers_of_an_undisturbed_one(
    undisturbed, tmp_path, mode, seed, record_figure
):
    disturbed = tmp_path / "rig"
    report = drive(disturbed, mode, seed)
    record_figure("kills", report)
    if mode == "calls":  # each command changes the disk by several calls, each with a before and an after
        assert min(report["kills"].values()) >= 12
    else:
        assert sum(report["kills"].values()) == 50
        assert min(report["kills"].values()) >= 15
    assert numbers(disturbed) == numbers(undisturbed)
    assert not [f for f in disturbed.iterdir() if f.suffix == ".tmp"]
    a, b = (open_session(folder).estimate() for folder in (undisturbed, disturbed))
    assert (a.value, a.standard_error, a.gains[1:]) == (b.value, b.standard_error, b.gains[1:])
    journal = [line.split() for line in (disturbed / "journal.txt").read_text().splitlines()]
    noted = [words[3] for words in journal if words[2] != "settings"]
    assert sorted(set(noted)) == sorted(
        f"{kind}-{k:04d}.csv" for kind in ("input", "output") for k in range(1, 17)
    )
    # and the undisturbed one is the session without files
    session = Session(Settings("power", samples=100, experiments=16, dt=0.01, seed=3))
    plain = session.run(simulated(named_plant("reference", 0.01), seed=8))
    assert plain.value == a.value
    np.testing.assert_array_equal(plain.gains, a.gains)


@pytest.mark.slow
def test_outputs_taken_back_under_kills_end_as_if_undisturbed(tmp_path, record_figure):
    whole, disturbed = tmp_path / "whole" / "rig", tmp_path / "disturbed" / "rig"
    for folder in (whole, disturbed):
        folder.parent.mkdir()
    assert drive(whole, "undo", 0, 4)["kills"] == 0
    report = drive(disturbed, "undo", 30, 4)
    record_figure("kills of undo", report)
    assert report["kills"] == 30
    assert numbers(disturbed) == numbers(whole)
    assert len(list(whole.glob("undone-output-*"))) == 16
    assert not list(disturbed.glob("*.tmp"))
    entries = lambda folder: [line.split()[1:] for line in (folder / "journal.txt").read_text().splitlines()]
    assert sorted(entries(disturbed)) == sorted(entries(whole))
