"""Thirty kills at random moments, inside parts and lines too: what is taken up again ends bit for bit as if undisturbed.

The work is forked, since a fresh interpreter would spend its life importing and the kills would hit nothing else;
kills at every call that changes the disk are in `test_faults.py`, those of a session in `test_kill.py`.
"""

from __future__ import annotations

import json
import os
import random
import signal
import time
from pathlib import Path

import pytest

import estimators.diagnosis.cases as cases_module
from benchmarks.campaign.settings import Settings
from benchmarks.campaign.whole_campaign import run_campaign
from benchmarks.cli import main

KILLS = 30
SMALL = Settings(
    plants=("reference",), noise_variances=(1.0,), methods=("white", "power"), estimators=("frf", "gain"), samples=50,
    experiments=3, profile_replicates=0,
)  # fmt: skip
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a fork of itself"),
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded"),
]


def forked(work, moment: float | None) -> bool:
    """Whether the work was killed at that moment; if it was through before, it must have gone well."""
    pid = os.fork()
    if not pid:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        work()
        os._exit(0)
    if moment is not None:
        time.sleep(moment)
        os.kill(pid, signal.SIGKILL)
    status = os.waitpid(pid, 0)[1]
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
    return os.WIFSIGNALED(status)


def kill_thirty_times(work, folders, seed: int) -> dict[Path, int]:
    """Work on one folder after the other until thirty kills have landed; how many in each."""
    draw, landed = random.Random(seed), {}
    began = time.perf_counter()
    forked(lambda: work(next(folders)), None)
    usual = time.perf_counter() - began
    while sum(landed.values()) < KILLS:
        folder, landed_here = next(folders), 0
        while forked(lambda folder=folder: work(folder), draw.uniform(0, usual)):
            landed_here += 1
        if not landed_here:  # it was through before: this machine is faster now
            usual *= 0.8
        landed[folder] = landed_here
    return landed


def test_a_campaign(tmp_path, record_figure):
    plain = lambda runs: repr([(r.key, [e.estimate.tobytes() for e in r.final.values()]) for r in runs])
    go = lambda folder: run_campaign(SMALL, 24, folder, jobs=1)
    whole = plain(go(tmp_path / "whole"))
    landed = kill_thirty_times(go, (tmp_path / f"x{k}" for k in range(1000)), 7)
    record_figure("kills of a campaign", sorted(landed.values()))
    for folder in landed:
        assert plain(go(folder)) == whole
        assert not list(folder.rglob("*.tmp"))


class Told:
    """Stands for a diagnosis that takes a while."""

    def __init__(self, length: int) -> None:
        self.length = length

    def to_dict(self) -> dict:
        return {"effect": f"n{self.length}" * 50}


def test_a_folder_of_cases(tmp_path, monkeypatch, record_figure):
    def told(train, test, meta):
        time.sleep(0.003)
        return Told(len(Path(train).read_text())), []

    monkeypatch.setattr(cases_module, "diagnose_files", told)
    for k in range(12):
        (tmp_path / "P" / f"case{k:02d}").mkdir(parents=True)
        (tmp_path / "P" / f"case{k:02d}" / "train.csv").write_text("u,y\n" + "1,2\n" * k)
    words = ["diagnose-folder", str(tmp_path / "P"), "--jobs", "1", "--quiet", "--out"]

    def go(out):
        assert main([*words, str(out)]) == 0

    go(tmp_path / "whole.jsonl")
    whole = (tmp_path / "whole.jsonl").read_bytes()
    assert [json.loads(line)["case"] for line in whole.splitlines()] == [f"case{k:02d}" for k in range(12)]
    landed = kill_thirty_times(go, (tmp_path / f"r{k}.jsonl" for k in range(1000)), 8)
    record_figure("kills of a folder of cases", sorted(landed.values()))
    assert all(out.read_bytes() == whole for out in landed)
