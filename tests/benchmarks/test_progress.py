"""What a long command says of itself: stage, elapsed, and what remains where the work is known."""

from __future__ import annotations

import io
import subprocess
import sys
import time

import numpy as np
import pytest

from benchmarks.progress import QUIET, _Line, in_words, shown
from estimators.pem.choice import automatic
from estimators.stages import listening, stage
from oed.data import Record
from oed.experiments import simulated
from oed.plants.named import named_plant


class Stream(io.StringIO):
    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self.terminal = terminal

    def isatty(self) -> bool:
        return self.terminal


def line_at(terminal: bool) -> tuple[_Line, Stream, list[float]]:
    clock = [0.0]
    stream = Stream(terminal)
    return _Line("x", stream, lambda: clock[0]), stream, clock


def test_remaining_is_at_the_pace_of_the_stage():
    line, stream, clock = line_at(terminal=True)
    line.hear("reading", 0, 0)
    clock[0] = 10.0
    line.hear("models", 0, 8)
    assert "left" not in line.text()  # nothing is known of the pace yet
    clock[0] = 16.0
    line.hear("models", 2, 8)
    assert line.text() == "oed x: 16 s, models (2 of 8), about 18 s left in this stage"
    line.look()
    assert stream.getvalue() == f"\r\033[K{line.text()}"
    line.clear()
    assert stream.getvalue().endswith("\r\033[K")


def test_elsewhere_a_line_per_stage_and_nothing_of_what_is_quick():
    line, stream, clock = line_at(terminal=False)
    line.hear("reading", 0, 0)
    clock[0] = QUIET / 2
    line.look()
    assert stream.getvalue() == ""
    clock[0] = QUIET + 1
    line.look()
    line.look()
    line.hear("the fit", 0, 0)
    line.look()
    line.clear()
    assert stream.getvalue() == "oed x: 3 s, reading\noed x: 3 s, the fit\n"


@pytest.mark.parametrize(
    "seconds, words", [(0.05, "0.05 s"), (59.2, "59 s"), (800, "13 min 20 s"), (7260, "2 h 1 min")]
)
def test_seconds_in_words(seconds, words):
    assert in_words(seconds) == words


def test_the_listener_hears_the_work_and_nobody_else():
    heard: list[tuple[str, int, int]] = []
    stage("before")
    plant = named_plant("reference", 0.01)
    u = np.random.default_rng(1).standard_normal((300, 1))
    record = Record(u, simulated(plant, seed=1)(u))
    with listening(lambda *words: heard.append(words)):
        automatic(record, "oe", "auto", 1)
    stage("after")
    assert {what for what, _, _ in heard} == {"orders, at most"}
    assert [done for _, done, _ in heard] == list(range(len(heard)))


def test_a_command_that_waits_shows_it(monkeypatch):
    import benchmarks.progress as module

    monkeypatch.setattr(module, "QUIET", 0.0)
    monkeypatch.setattr(module, "BEAT", 0.01)
    stream = Stream(True)
    with shown("x", stream):
        stage("work", 1, 2)
        deadline = time.monotonic() + 20
        while "work (1 of 2)" not in stream.getvalue() and time.monotonic() < deadline:
            time.sleep(0.01)
    assert "work (1 of 2)" in stream.getvalue()
    assert stream.getvalue().endswith("\r\033[K")


def test_the_summary_comes_before_the_drawing(tmp_path):
    """The process is stopped where it begins to draw: the answer is out by then."""
    program = (
        "import sys, benchmarks.page.design as page\n"
        "def stop(*a): raise SystemExit(7)\n"
        "page.write_design = stop\n"
        "from benchmarks.cli import main\n"
        "main(sys.argv[1:])\n"
    )
    words = [sys.executable, "-c", program, "design", "--plant", "reference", "--out", str(tmp_path / "new")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 7
    assert "apply " in done.stdout
