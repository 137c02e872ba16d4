"""Commands as a person gives them, ended at random moments: what is given again ends with the bytes of an undisturbed run.

`kill -9`, SIGTERM and Ctrl-C hit the first process alone or its workers with it, in turn; in both cases no process is left.
Forks that hit the work and not the imports are in `test_random_kills.py` and `test_kill.py`, every single write in
`test_faults.py`.
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

ENDINGS = {
    "kill -9": (signal.SIGKILL, int(os.environ.get("OED_KILLS", "30"))),
    "SIGTERM": (signal.SIGTERM, 10),
    "Ctrl-C": (signal.SIGINT, 10),
}
"""Signals, and how often each comes."""
IN_A_ROW = 4
"""Signals to one command at the most: then it is let through."""
OF_MANY = 2
"""The same where there are several commands: thirty hit each of a session's."""
LEFT = 10.0
"""Seconds in which workers whose first process is gone are gone too; two are promised, on a machine of one's own."""
COMPARE = "compare --plant reference --noise-variance 1 --methods white power --estimators gain fir-selected"
COMPARE += " --samples 200 --experiments 6 --replicates 300 --profile-replicates 0 --quiet"
ITERATE = (
    "iterate --plant three-by-two --algorithm mimo --samples 2000 --iterations 40 --noise-variance 1 --quiet"
)
SESSION = "--method sequential --samples 200 --dt 0.01 --experiments 4 --orders 2 2 --delay 1 --quiet"
UNTOLD = ("lock", "cost.json", "progress.json", "journal.txt", ".tmp")
"""What a folder keeps of its own history: locks, seconds, a journal with the times of day; and, until the next run, files half written."""
pytestmark = [
    pytest.mark.validate,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes under /proc"),
]
Work = Callable[[Path], Iterator[list[str]]]


def begun(words: list[str], folder: Path) -> subprocess.Popen:
    """The command; Ctrl-C reaches it also where the tests run in the background, which a shell shields from it."""
    call = [sys.executable, "-m", "benchmarks.cli", *words]
    heard = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(call, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True, preexec_fn=heard)  # fmt: skip


def is_ended(
    words: list[str], folder: Path, moment: float | None, how: signal.Signals, everybody: bool
) -> bool:
    """Whether the command was ended at that moment; if it was through before, it must have gone well, or find its file."""
    process = begun(words, folder)
    try:
        said = process.communicate(timeout=moment)[1].decode()
        assert process.returncode == 0 or "exists; nothing is overwritten" in said, said
        return False
    except subprocess.TimeoutExpired:
        workers = family(process.pid)
    (os.killpg if everybody else os.kill)(process.pid, how)
    said = process.communicate()[1].decode()
    deadline = time.monotonic() + LEFT
    while any(map(alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not [pid for pid in workers if alive(pid)]
    if how == signal.SIGKILL:
        return True
    if process.returncode == 0:  # it was through before it heard of it
        return False
    if (
        process.returncode == -how
    ):  # before there was a command or after it, which a shell calls 128 + how too
        assert not said, said
        return True
    assert process.returncode == 128 + how, (process.returncode, said)
    assert len(said.splitlines()) == 1, said
    assert said.startswith(f"oed {words[0]}: ") or not told(folder), said
    return True


def told(folder: Path) -> dict[str, object]:
    """Every file of a result; lines of cases come in the order in which processes end."""
    files = (f for f in sorted(folder.rglob("*")) if f.is_file() and not f.name.endswith(UNTOLD))
    return {
        str(f.relative_to(folder)): sorted(f.read_bytes().splitlines()) if f.suffix == ".jsonl" else f.read_bytes()
        for f in files
    }  # fmt: skip


def ended_and_resumed(work: Work, place: Path, how: signal.Signals, times: int) -> tuple[int, int, list[int]]:
    """End the work on one folder after the other; signals, folders, and how many files stood there at each."""
    draw, usual, there, ended = random.Random(11), {}, [], 0
    whole = place / "whole" / "rig"
    whole.mkdir(parents=True)
    for number, words in enumerate(work(whole)):
        began = time.perf_counter()
        is_ended(words, whole, None, how, False)
        usual[number] = time.perf_counter() - began
    expected, folders = told(whole), 0
    while ended < times:
        folder = place / f"x{folders}" / "rig"
        folder.mkdir(parents=True)
        before, folders = ended, folders + 1
        for number, words in enumerate(work(folder)):
            for _ in range(
                min(OF_MANY if len(usual) > 1 else IN_A_ROW, times - ended)
            ):  # before a third of its time a command only imports
                if not is_ended(words, folder, draw.uniform(0.3, 1) * usual[number], how, ended % 2 == 1):
                    break
                ended += 1
                there.append(len(told(folder)))
                if words[0] in ANEW:
                    assert told(folder).items() <= expected.items()  # each file is there whole or not at all
                    shutil.rmtree(folder / "o", ignore_errors=True)
            else:
                is_ended(words, folder, None, how, False)
        assert told(folder) == expected, folder
        assert not list(folder.rglob("*.tmp"))
        shutil.rmtree(folder.parent)
        if ended == before:  # through before its moment: this machine is faster now
            usual = {number: 0.8 * seconds for number, seconds in usual.items()}
    return ended, folders, there


def cases(place: Path) -> Path:
    """Four short records of a second-order plant, two with a curve behind it."""
    rng = np.random.default_rng(5)
    for k in range(4):
        folder = place / "cases" / f"case{k}"
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("train", "test"):
            u, x = rng.standard_normal(240), np.zeros(240)
            for t in range(2, 240):
                x[t] = 1.2 * x[t - 1] - 0.5 * x[t - 2] + 0.4 * u[t - 1]
            y = (x + 0.2 * (k % 2) * x**2) + 0.05 * rng.standard_normal(240)
            rows = "".join(f"{a!r},{b!r}\n" for a, b in zip(u.tolist(), y.tolist(), strict=True))
            (folder / f"{name}.csv").write_text("u,y\n" + rows)
    return place / "cases"


def session(folder: Path) -> Iterator[list[str]]:
    """A rig by hand; whoever gives a step again gives the same measurement. (`undo` given again takes back one more.)"""
    rig, inbox = folder / "s", folder / "inbox"
    inbox.mkdir()
    yield ["session", "start", str(rig), *SESSION.split()]
    yield ["session", "rest", str(rig)]
    rested = measured(rig, 1, rig / "rest-input-0001.csv")
    yield ["session", "rest", str(rig), str(rested)]
    for step in range(1, 5):
        yield ["session", "next", str(rig)]
        made = measured(rig, step)
        if step % 2:
            yield ["session", "record", str(rig), str(made)]
        else:
            made.rename(inbox / f"output-{step:04d}.csv")
            yield ["session", "watch", str(rig), str(inbox), "--once", "--quiet"]
    yield ["session", "status", str(rig), "--picture", "o.html"]


def once(words: str, place: Path | None = None) -> Work:
    """One command, its files beside `place`."""
    return lambda folder: iter([words.format(cases=place and cases(place)).split()])


TRAIN = "{cases}/case1/train.csv --test {cases}/case1/test.csv --quiet --out o"
WORKS: dict[str, Callable[[Path], Work]] = {
    "compare": lambda _: once(f"{COMPARE} --jobs 1 --out o"),
    "compare with two workers": lambda _: once(f"{COMPARE} --jobs 2 --out o"),
    "compare with four workers": lambda _: once(f"{COMPARE} --jobs 4 --out o"),
    "diagnose-folder": lambda place: once("diagnose-folder {cases} --jobs 2 --quiet --out o.jsonl", place),
    "session": lambda _: session,
    "iterate": lambda _: once(f"{ITERATE} --out o.csv"),
    "identify": lambda place: once(f"identify {TRAIN} --structure oe --orders 2 2", place),
    "diagnose": lambda place: once(f"diagnose {TRAIN}", place),
    "design": lambda _: once("design --plant reference --criterion D --realise 1000 --quiet --out o"),
}
ANEW = ("identify", "diagnose", "design")
"""Commands that want a new folder: what one that was ended has left there is removed."""


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("what", WORKS)
def test_ended_commands_end_as_if_undisturbed(what, ending, tmp_path, record_figure):
    how, times = ENDINGS[ending]
    ended, folders, there = ended_and_resumed(WORKS[what](tmp_path), tmp_path, how, times)
    record_figure(f"{ending} of {what}, folders", (ended, folders))
    record_figure("files there at each", there)
    assert ended == times
    assert what == "iterate" or max(there) > min(there)  # some fell into the work
