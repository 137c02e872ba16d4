"""Commands as a person gives them, killed at random moments: what is given again ends with the bytes of an undisturbed run.

`kill -9` hits the first process alone or its workers with it, in turn; in both cases no process is left. Forks that hit
the work and not the imports are in `test_random_kills.py` and `test_kill.py`, every single write in `test_faults.py`.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.test_killed import alive, family
from tests.estimators.sessions.kill_driver import measured

KILLS = int(os.environ.get("OED_KILLS", "30"))
IN_A_ROW = 4
"""Kills of one command at the most: then it is let through, so that the next ones are hit too."""
LEFT = 10.0
"""Seconds in which workers whose first process is gone are gone too; two are promised, on a machine of one's own."""
COMPARE = "compare --plant reference --noise-variance 1 --methods white power --estimators gain fir-selected"
COMPARE += " --samples 200 --experiments 6 --replicates 300 --profile-replicates 0 --quiet"
ITERATE = (
    "iterate --plant three-by-two --algorithm mimo --samples 2000 --iterations 40 --noise-variance 1 --quiet"
)
SESSION = "--method sequential --samples 200 --dt 0.01 --experiments 4 --orders 2 2 --delay 1 --quiet"
UNTOLD = ("lock", "cost.json", "progress.json", "journal.txt")
"""What a folder keeps of its own history: locks, seconds, and a journal with the times of day."""
pytestmark = [
    pytest.mark.validate,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes under /proc"),
]
Work = Callable[[Path], Iterator[list[str]]]


def begun(words: list[str], folder: Path) -> subprocess.Popen:
    call = [sys.executable, "-m", "benchmarks.cli", *words]
    return subprocess.Popen(call, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)  # fmt: skip


def is_killed(words: list[str], folder: Path, moment: float | None, everybody: bool) -> bool:
    """Whether the command was killed at that moment; if it was through before, it must have gone well, or find its file."""
    process = begun(words, folder)
    try:
        said = process.communicate(timeout=moment)[1].decode()
        assert process.returncode == 0 or "exists; nothing is overwritten" in said, said
        return False
    except subprocess.TimeoutExpired:
        workers = family(process.pid)
    (os.killpg if everybody else os.kill)(process.pid, signal.SIGKILL)
    process.communicate()
    deadline = time.monotonic() + LEFT
    while any(map(alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not [pid for pid in workers if alive(pid)]
    return True


def told(folder: Path) -> dict[str, object]:
    """Every file of a result; lines of cases come in the order in which processes end."""
    files = (f for f in sorted(folder.rglob("*")) if f.is_file() and not f.name.endswith(UNTOLD))
    return {
        str(f.relative_to(folder)): sorted(f.read_bytes().splitlines()) if f.suffix == ".jsonl" else f.read_bytes()
        for f in files
    }  # fmt: skip


def killed_and_resumed(work: Work, place: Path, seed: int) -> tuple[int, int, list[int]]:
    """Kill the work on one folder after the other; kills, folders, and how many files stood there at each kill."""
    draw, usual, there, kills = random.Random(seed), {}, [], 0
    whole = place / "whole" / "rig"
    whole.mkdir(parents=True)
    for number, words in enumerate(work(whole)):
        began = time.perf_counter()
        is_killed(words, whole, None, False)
        usual[number] = time.perf_counter() - began
    expected, folders = told(whole), 0
    while kills < KILLS:
        folder = place / f"x{folders}" / "rig"
        folder.mkdir(parents=True)
        before, folders = kills, folders + 1
        for number, words in enumerate(work(folder)):
            for _ in range(min(IN_A_ROW, KILLS - kills)):  # before a third of its time a command only imports
                if not is_killed(words, folder, draw.uniform(0.3, 1) * usual[number], kills % 2 == 1):
                    break
                kills += 1
                there.append(len(told(folder)))
            else:
                is_killed(words, folder, None, False)
        assert told(folder) == expected, folder
        assert not list(folder.rglob("*.tmp"))
        shutil.rmtree(folder.parent)
        if kills == before:  # through before its moment: this machine is faster now
            usual = {number: 0.8 * seconds for number, seconds in usual.items()}
    return kills, folders, there


def cases(place: Path) -> Path:
    """Four short records of a second-order plant, two with a curve behind it."""
    rng = np.random.default_rng(5)
    for k in range(4):
        folder = place / "cases" / f"case{k}"
        folder.mkdir(parents=True)
        for name in ("train", "test"):
            u, x = rng.standard_normal(240), np.zeros(240)
            for t in range(2, 240):
                x[t] = 1.2 * x[t - 1] - 0.5 * x[t - 2] + 0.4 * u[t - 1]
            y = (x + 0.2 * (k % 2) * x**2) + 0.05 * rng.standard_normal(240)
            rows = "".join(f"{a!r},{b!r}\n" for a, b in zip(u.tolist(), y.tolist(), strict=True))
            (folder / f"{name}.csv").write_text("u,y\n" + rows)
    return place / "cases"


def session(folder: Path) -> Iterator[list[str]]:
    """A rig by hand; whoever gives a step again gives the same measurement."""
    rig = folder / "s"
    assert not is_killed(["session", "start", str(rig), *SESSION.split()], folder, None, False)
    for step in range(1, 5):
        yield ["session", "next", str(rig)]
        yield ["session", "record", str(rig), str(measured(rig, step))]


WORKS: dict[str, Callable[[Path], Work]] = {
    "compare": lambda _: lambda folder: iter([[*COMPARE.split(), "--jobs", "1", "--out", "o"]]),
    "compare with four workers": lambda _: lambda folder: iter([[*COMPARE.split(), "--jobs", "4", "--out", "o"]]),
    "diagnose-folder": lambda place: (
        lambda of: lambda folder: iter([["diagnose-folder", of, "--jobs", "2", "--quiet", "--out", "o.jsonl"]])
    )(str(cases(place))),
    "session": lambda _: session,
    "iterate": lambda _: lambda folder: iter([[*ITERATE.split(), "--out", "o.csv"]]),
}  # fmt: skip


@pytest.mark.parametrize("what", WORKS)
def test_killed_commands_end_as_if_undisturbed(what, tmp_path, record_figure):
    kills, folders, there = killed_and_resumed(WORKS[what](tmp_path), tmp_path, 11)
    record_figure(f"kills of {what}, folders", (kills, folders))
    record_figure("files there at each kill", there)
    assert kills == KILLS
    assert what == "iterate" or max(there) > min(there)  # some fell into the work
