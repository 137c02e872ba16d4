"""Every write and every rename fails once, or the process is killed there: afterwards nothing is lost or misread.

As SQLite does it: the calls of an undisturbed run are counted, then the run is repeated with the first of them failing,
then the second, and so on to the last; each time what is left is looked at, and the work is taken up again.
"""

from __future__ import annotations

import contextlib
import errno
import io
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import estimators.diagnosis.cases as cases_module
import estimators.sessions.folder as folder_module
from benchmarks.campaign.settings import Settings
from benchmarks.campaign.whole_campaign import run_campaign
from benchmarks.cli import main
from estimators.sessions import Settings as SessionSettings
from estimators.sessions import open_session, start_session
from oed.errors import OedError
from oed.experiments import simulated
from oed.files import writing
from oed.files.writing import append_line, tidy, write_whole
from oed.plants.named import named_plant

SMALL = Settings(
    plants=("reference",), noise_variances=(1.0,), methods=("white",), estimators=("frf",), samples=20, experiments=2,
    profile_replicates=0,
)  # fmt: skip
KILLED = 77


class Torn(io.FileIO):
    """A file of which a failing write keeps the first half."""

    hook = staticmethod(lambda: None)

    def write(self, data) -> int:
        try:
            type(self).hook()
        except BaseException:
            super().write(bytes(data)[: len(data) // 2])
            raise
        return super().write(data)


@contextlib.contextmanager
def faults(monkeypatch, at: int, strike):
    """Call number `at` of open, write, fsync and replace is struck; yields the list of calls so far."""
    calls: list[str] = []

    def hit(name: str) -> None:
        calls.append(name)
        if len(calls) - 1 == at:
            strike()

    def around(name, call):
        def wrapped(*args, **keywords):
            hit(name)
            return call(*args, **keywords)

        return wrapped

    opened = Path.open

    def opening(path, mode="r", *args, **keywords):
        if mode not in ("xb", "ab+") or path.name.endswith("lock"):
            return opened(path, mode, *args, **keywords)
        hit("open")
        file = Torn(path, mode)
        file.hook = lambda: hit("write")
        Torn.hook = file.hook
        return file

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", opening)
        patch.setattr(os, "fsync", around("fsync", os.fsync))
        patch.setattr(os, "replace", around("replace", os.replace))
        patch.setattr(os, "rename", around("rename", os.rename))
        yield calls


def refuse(number: int):
    def strike():
        raise OSError(number, os.strerror(number))

    return strike


def each_fault(monkeypatch, work, kinds=("ENOSPC", "EIO", "kill")):
    """Run the work with every call struck in every way; yields after each what was struck."""
    with faults(monkeypatch, -1, lambda: None) as calls:
        work()
    assert {"open", "write", "fsync", "replace"} & set(calls)
    for at in range(len(calls)):
        for kind in kinds:
            if kind != "kill":
                with faults(monkeypatch, at, refuse(getattr(errno, kind))):
                    work()
            else:
                pid = os.fork()
                if not pid:
                    with faults(monkeypatch, at, lambda: os._exit(KILLED)):
                        work()
                    os._exit(0)
                assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == KILLED
            yield f"{kind} at {calls[at]} {at}"


pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a fork of itself"),
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded"),
]


def test_a_file_is_the_old_one_or_the_new_one(tmp_path, monkeypatch):
    path = tmp_path / "x"
    old, new = b"old" * 100, b"new" * 200
    first = tmp_path.parent / "old"
    first.write_bytes(old)

    def work():
        shutil.copyfile(first, path)
        with contextlib.suppress(OedError):
            write_whole(path, new)

    for what in each_fault(monkeypatch, work):
        assert path.read_bytes() in (old, new), what
        if "kill" not in what:
            assert [p.name for p in tmp_path.iterdir()] == ["x"], what
        tidy(tmp_path)
        assert [p.name for p in tmp_path.iterdir()] == ["x"], what


def test_a_journal_loses_no_line(tmp_path, monkeypatch):
    path, first = tmp_path / "journal", tmp_path / "first"
    first.write_text("first\n")

    def work():
        shutil.copyfile(first, path)
        with contextlib.suppress(OedError):
            append_line(path, "second")

    for what in each_fault(monkeypatch, work):
        append_line(path, "third")
        lines = path.read_text().splitlines()
        assert (lines[0], lines[-1]) == ("first", "third"), what
        assert all("second".startswith(line) for line in lines[1:-1]), what


def plain(runs) -> str:
    return repr([(r.key, [(k, e.estimate.tobytes(), e.statuses) for k, e in r.final.items()]) for r in runs])


def test_a_campaign_goes_on_where_it_was(tmp_path, monkeypatch):
    whole = plain(run_campaign(SMALL, 7, tmp_path / "whole", jobs=1))
    number = iter(range(10_000))
    folder = tmp_path / "x"

    def work():
        nonlocal folder
        with contextlib.suppress(OedError):
            run_campaign(SMALL, 7, folder, jobs=1)

    for what in each_fault(monkeypatch, work, ("EIO", "kill")):
        assert plain(run_campaign(SMALL, 7, folder, jobs=1)) == whole, what
        assert not list(folder.rglob("*.tmp")), what
        folder = tmp_path / f"x{next(number)}"


class Told:
    def to_dict(self) -> dict:
        return {"effect": "none"}


def test_a_folder_of_cases_goes_on_where_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(cases_module, "diagnose_files", lambda *_, **__: (Told(), []))
    for name in ("a", "b"):
        (tmp_path / "P" / name).mkdir(parents=True)
        (tmp_path / "P" / name / "train.csv").write_text("u,y\n1,2\n")
    out = tmp_path / "r.jsonl"
    words = ["diagnose-folder", str(tmp_path / "P"), "--out", str(out), "--jobs", "1", "--quiet"]

    def work():
        out.unlink(missing_ok=True)
        main(words)

    work()
    whole = out.read_text()
    for what in each_fault(monkeypatch, work, ("ENOSPC", "kill")):
        assert main(words) == 0, what
        assert out.read_text() == whole, what
    assert [json.loads(line)["case"] for line in whole.splitlines()] == ["a", "b"]


def measured(session, file: Path) -> Path:
    """What a rig would write: its output depends on the step alone, so that it can be measured again."""
    u = np.loadtxt(session.next_input(), delimiter=",", skiprows=1)[:, 1:]
    y = simulated(named_plant("reference", 0.01), seed=8, first=session.step - 1)(u)
    file.write_text("y\n" + "".join(f"{v!r}\n" for v in y[:, 0].tolist()))
    return file


@pytest.mark.slow
def test_a_session_goes_on_where_it_was(tmp_path, monkeypatch):
    """Start, two experiments, the last taken back and measured again; each call struck, then all of it once more."""
    settings = SessionSettings("power", samples=20, experiments=2, dt=0.01, seed=3)
    number = iter(range(10_000))
    folder = tmp_path / "whole"

    def go():
        start_session(folder, settings)
        while (session := open_session(folder)).step is not None or not list(folder.glob("undone-*")):
            if session.step is None:
                session.undo()
            else:
                session.record(measured(session, tmp_path / "m.csv"))

    def work():
        with contextlib.suppress(OedError):
            go()

    numbers = lambda at: {
        f.name: f.read_bytes() for f in at.iterdir() if f.name not in ("lock", "journal.txt")
    }
    go()
    whole, estimate = numbers(folder), open_session(folder).estimate()
    assert len(whole) == 7  # settings, readme, two inputs, two outputs, and one that was taken back
    folder = tmp_path / "x"
    for what in each_fault(monkeypatch, work, ("EIO", "kill")):
        go()
        found = numbers(folder)
        assert found == whole, what
        assert open_session(folder).estimate().value == estimate.value, what
        open_session(folder).next_input()  # mends the journal
        journal = (folder / "journal.txt").read_text()
        assert all(f" {name} " in journal for name in found if name.startswith(("input", "output"))), what
        folder = tmp_path / f"x{next(number)}"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no folder is read-only for every user here")
def test_a_folder_that_may_not_be_written_to(capsys):
    """/proc refuses every user, the superuser too."""
    with pytest.raises(OedError, match="cannot create /proc/oed.*choose another --out"):
        run_campaign(SMALL, 7, Path("/proc/oed"), jobs=1)
    with pytest.raises(OedError, match="the folder /proc/oed cannot be made"):
        start_session(Path("/proc/oed"), SessionSettings("power", samples=20))
    assert main(["design", "--plant", "reference", "--out", "/proc/oed", "--quiet"]) == 2
    assert "/proc/oed" in capsys.readouterr().err


def test_a_folder_that_was_moved_goes_on(tmp_path):
    whole = plain(run_campaign(SMALL, 7, tmp_path / "a", jobs=1))
    run_campaign(SMALL, 5, tmp_path / "b", jobs=1)
    (tmp_path / "b").rename(tmp_path / "c")
    (tmp_path / "c" / "figures").mkdir()
    for place in ("parts", "figures"):  # what a kill left half written
        (tmp_path / "c" / place / ".1-0.tmp").touch()
    assert plain(run_campaign(SMALL, 7, tmp_path / "c", jobs=1)) == whole
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_clock_that_is_set_back_changes_nothing(tmp_path, monkeypatch):
    """A day earlier at every look: half a campaign, a session's first step; then the rest."""
    rest = SessionSettings("power", samples=20, experiments=2, dt=0.01, seed=3)

    def go(at):
        run_campaign(SMALL, 5, at / "campaign", jobs=1)
        start_session(at / "rig", rest)
        for _ in range(2):
            session = open_session(at / "rig")
            session.record(measured(session, at / "m.csv"))
        return plain(run_campaign(SMALL, 7, at / "campaign", jobs=1)), {
            f.name: f.read_bytes() for f in (at / "rig").glob("*put-*.csv")
        }

    whole = go(tmp_path / "a")
    now = itertools.count(4e9, -86400.0)
    clock = SimpleNamespace(now=lambda zone: datetime.fromtimestamp(next(now), zone))
    monkeypatch.setattr(folder_module, "datetime", clock)
    monkeypatch.setattr(time, "time", lambda: next(now))
    assert go(tmp_path / "b") == whole
    stamps = [line[:10] for line in (tmp_path / "b" / "rig" / "journal.txt").read_text().splitlines()]
    assert stamps == sorted(set(stamps), reverse=True)  # it did run backwards


def test_what_a_killed_process_left_beside_a_file_goes_with_the_next_writing(tmp_path):
    """Of a process of this machine that is no more; what one that lives, or one of another machine, is writing stays."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    names = [
        f".{writing._HERE}-{gone.pid}-0.tmp",
        f".{writing._HERE}-{os.getppid()}-0.tmp",
        f".ffffff-{gone.pid}-0.tmp",
        f".{writing._HERE}-x-0.tmp",
    ]
    for name in names:
        (tmp_path / name).touch()
    write_whole(tmp_path / "o.csv", "1\n")
    assert {file.name for file in tmp_path.iterdir()} == {"o.csv", *names[1:]}
