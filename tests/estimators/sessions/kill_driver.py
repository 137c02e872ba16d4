"""Drives `oed session` in forked processes and kills them with SIGKILL: by the clock, or at a given call.

usage: kill_driver.py FOLDER KILLS SEED        kill at KILLS random moments
       kill_driver.py FOLDER calls SEED        kill before and after every call that changes the disk
       kill_driver.py FOLDER undo KILLS SEED   take every output back once, killed at KILLS random moments

Prints one JSON object: kills that landed, and how often a command had to be given. It forks because a fresh
interpreter for each command would spend its life importing, and the kills would hit nothing else.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

from benchmarks.cli import main
from estimators.sessions import Settings, open_session, start_session
from oed.experiments import simulated
from oed.plants.named import named_plant

EXPERIMENTS, SAMPLES = 16, 100
PLANT = named_plant("reference", 0.01)


def measured(folder: Path, step: int, applied: Path | None = None) -> Path:
    """The rig: its output depends on the step alone, so it can be measured again."""
    applied = applied or folder / f"input-{step:04d}.csv"
    rows = [line.split(",") for line in applied.read_text().splitlines()[1:]]
    y = simulated(PLANT, seed=8, first=step - 1)([[float(u)] for _, u in rows])
    file = folder.parent / "measured.csv"
    file.write_text(
        "t_s,y\n" + "".join(f"{t},{v!r}\n" for (t, _), (v,) in zip(rows, y.tolist(), strict=True))
    )
    return file


def child(words: list[str], crash_at: int | None) -> int:
    """Run one command in a fork; its process id. With crash_at it kills itself around that call."""
    pid = os.fork()
    if pid:
        return pid
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    if crash_at is not None:
        count = 0

        def around(call):
            def wrapped(*args, **keywords):
                nonlocal count
                for moment in ("before", "after"):
                    if count == crash_at:
                        os.kill(os.getpid(), signal.SIGKILL)
                    count += 1
                    if moment == "before":
                        result = call(*args, **keywords)
                return result

            return wrapped

        for name in ("fsync", "replace"):
            setattr(os, name, around(getattr(os, name)))
        Path.open = around(Path.open)
        Path.unlink = around(Path.unlink)
    os._exit(main(words))


def killed(words: list[str], moment: float | None, crash_at: int | None) -> bool:
    """Whether the command was killed; one that fails by itself is an error."""
    pid = child(words, crash_at)
    if moment is not None:
        time.sleep(moment)
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    if os.WIFSIGNALED(status):
        return True
    if os.WEXITSTATUS(status):
        raise RuntimeError(f"{words} ended with {os.WEXITSTATUS(status)}")
    return False


def durations(folder: Path) -> dict[str, float]:
    """How long each command takes, from a session of its own; everything is imported once it is through."""
    start_session(folder, Settings("power", samples=SAMPLES, experiments=3, dt=0.01))
    null = os.open(os.devnull, os.O_WRONLY)
    kept = os.dup(1)
    os.dup2(null, 1)
    for step in (1, 2):
        main(["session", "next", str(folder)])
        main(["session", "record", str(folder), str(measured(folder, step))])
    sys.stdout.flush()
    os.dup2(kept, 1)
    found = {}
    for action in ("next", "record"):
        words = ["session", action, str(folder)] + ([str(measured(folder, 3))] if action == "record" else [])
        began = time.perf_counter()
        killed(words, None, None)
        found[action] = time.perf_counter() - began
    return found


def drive(folder: Path, mode: str, seed: int) -> dict:
    draw = random.Random(seed)
    usual = durations(folder.parent / "scratch")
    start_session(folder, Settings("power", samples=SAMPLES, experiments=EXPERIMENTS, dt=0.01, seed=3))
    wanted = 0 if mode == "calls" else int(mode)
    kills = {"next": 0, "record": 0}
    for step in range(1, EXPERIMENTS + 1):
        for action in ("next", "record"):
            words = ["session", action, str(folder)]
            words += [str(measured(folder, step))] if action == "record" else []
            crash_at = 0 if mode == "calls" and step <= 2 else None
            here = 0
            while True:
                random_kill = sum(kills.values()) < wanted and here < 4
                moment = draw.uniform(0, usual[action]) if random_kill else None
                if not killed(words, moment, crash_at):
                    if moment is not None:  # it was through before: this machine is faster now
                        usual[action] *= 0.8
                    break
                kills[action] += 1
                here += 1
                crash_at = None if crash_at is None else crash_at + 1
                open_session(folder).status()  # whatever is there can be read at any moment
    return {"kills": kills, "seconds": usual}


def drive_undo(folder: Path, wanted: int, seed: int) -> dict:
    """Whoever finds the output still there after a kill takes it back again; its rig then measures the same."""
    durations(folder.parent / "scratch")  # imports everything, so that kills hit the work
    draw, landed, half_done, usual = random.Random(seed), 0, 0, 0.0
    start_session(folder, Settings("power", samples=SAMPLES, experiments=EXPERIMENTS, dt=0.01, seed=3))
    give = lambda *words, moment=None: killed(["session", words[0], str(folder), *words[1:]], moment, None)
    for step in range(1, EXPERIMENTS + 1):
        give("next")
        give("record", str(measured(folder, step)))
        give("next")  # an input that is made from the output, and goes aside with it
        output, later = folder / f"output-{step:04d}.csv", folder / f"input-{step + 1:04d}.csv"
        here = 0
        while output.exists():
            moment = draw.uniform(0, usual) if usual and landed < wanted and here < 4 else None
            began = time.perf_counter()
            if give("undo", moment=moment):
                landed, here = landed + 1, here + 1
                half_done += output.exists() and not later.exists() and step < EXPERIMENTS
                open_session(folder).status()
            elif moment is None:
                usual = usual or time.perf_counter() - began
            else:  # it was through before: this machine is faster now
                usual *= 0.8
        give("record", str(measured(folder, step)))
    return {"kills": landed, "between its renames": half_done}


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    where, mode, *numbers = sys.argv[1:]
    report = (
        drive_undo(Path(where), *map(int, numbers))
        if mode == "undo"
        else drive(Path(where), mode, int(numbers[0]))
    )
    sys.stdout.write(json.dumps(report) + "\n")
