"""Processes that are killed: a worker, the first process, a cluster. Nothing is lost, nothing is left, nothing hangs."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

import benchmarks.campaign.cluster as cluster_module
import benchmarks.cli as cli_module
from benchmarks.campaign import processes
from benchmarks.campaign.processes import as_finished
from benchmarks.campaign.settings import Settings
from benchmarks.campaign.users_own import Own
from benchmarks.campaign.whole_campaign import run_campaign
from benchmarks.commands.endings import ended_by_signals
from oed.errors import CampaignError

DEADLY = """
import os, signal

def deadly(samples, n_inputs, n_outputs, rng):
    os.kill(os.getpid(), signal.SIGKILL)
    yield

def leaving(samples, n_inputs, n_outputs, rng):
    raise SystemExit(3)
    yield

def stopped(samples, n_inputs, n_outputs, rng):
    raise SystemError("a compiled function returned a result with an exception set") from KeyboardInterrupt()
    yield

def slow(samples, n_inputs, n_outputs, rng):
    import time
    time.sleep(0.3)
    while True:
        yield rng.standard_normal((samples, n_inputs))
"""
SMALL = {"plants": ("reference",), "noise_variances": (1.0,), "estimators": ("frf",), "samples": 50, "experiments": 2,
         "profile_replicates": 0}  # fmt: skip


@pytest.fixture
def own(tmp_path):
    (tmp_path / "own.py").write_text(DEADLY)
    return lambda name: f"{tmp_path / 'own.py'}:{name}"


@pytest.mark.slow
def test_what_kills_its_worker_is_a_row(tmp_path, own, capfd):
    brought = Own([own("deadly"), "white"], ["frf"])
    settings = Settings(**SMALL | {"methods": brought.methods, "sources": tuple(brought.sources)})
    found = run_campaign(settings, 5, tmp_path / "out", jobs=2, own=brought.functions)
    deadly, white = found
    assert deadly.final["frf"].statuses == {"FAILED": 5}
    assert deadly.final["frf"].messages == ("the process that ran it was killed",)
    assert white.final["frf"].statuses == {"OK": 5}
    said = capfd.readouterr().err
    assert "a worker process was killed; what it had not finished is done again" in said
    assert "Traceback" not in said


def test_what_ends_python_is_a_row(tmp_path, own):
    """One's own method that calls sys.exit ended the whole campaign without a word."""
    brought = Own([own("leaving")], ["frf"])
    settings = Settings(**SMALL | {"methods": brought.methods, "sources": tuple(brought.sources)})
    (found,) = run_campaign(settings, 2, tmp_path / "out", jobs=1, own=brought.functions)
    assert found.final["frf"].statuses == {"FAILED": 2}


def test_an_interruption_inside_compiled_code_leaves_nothing_that_is_believed(tmp_path, own, monkeypatch):
    """It was a failed run, and done when the command was given again."""
    import estimators.diagnosis.cases as module

    words = (
        f"compare --estimators frf --replicates 5 --jobs 1 --quiet --out {tmp_path / 'out'} --methods".split()
    )
    assert cli_module.main([*words, own("stopped")]) == 130
    assert list((tmp_path / "out" / "parts").iterdir()) == []

    def stopped(*files, **options):
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr(module, "diagnose_files", stopped)
    (tmp_path / "P" / "a").mkdir(parents=True)
    (tmp_path / "P" / "a" / "train.csv").write_text("u,y\n1,2\n")
    words = ["diagnose-folder", str(tmp_path / "P"), "--out", str(tmp_path / "r.jsonl"), "--jobs", "1"]
    assert cli_module.main(words) == 130
    assert not (tmp_path / "r.jsonl").exists()


def family(pid: int) -> list[int]:
    """Processes that a process has started, and theirs."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            if parent == pid:
                found += [int(entry.name), *family(int(entry.name))]
    return found


def alive(pid: int) -> bool:
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes under /proc")
@pytest.mark.parametrize(
    "how",
    [signal.SIGKILL, *(pytest.param(n, marks=pytest.mark.validate) for n in (signal.SIGTERM, signal.SIGHUP))],
)
def test_no_process_is_left(tmp_path, own, how):
    """The first process alone is hit, as by `kill`; its workers are in the middle of a part."""
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.cli", "compare", "--plant", "reference", "--noise-variance", "1", "--methods",
         own("slow"), "--estimators", "frf", "--samples", "50", "--experiments", "2", "--replicates", "300", "--jobs", "2",
         "--quiet", "--out", str(out)],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=None if how == signal.SIGKILL else lambda: signal.signal(how, signal.SIG_DFL),  # heard behind `nohup` too
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while (
        len(list(out.glob("parts/*.parquet"))) < 2 and time.monotonic() < deadline and process.poll() is None
    ):
        time.sleep(0.05)
    children = family(process.pid)
    assert len(children) >= 2
    process.send_signal(how)
    _, said = process.communicate(timeout=30)
    if how != signal.SIGKILL:
        assert process.returncode == 128 + how
        assert said.splitlines() == [
            f"oed compare: running the code in {tmp_path / 'own.py'}",
            "oed compare: ended from outside; what was finished is kept.",
        ]
    deadline = time.monotonic() + 10
    while any(map(alive, children)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not [pid for pid in children if alive(pid)]
    assert not list(out.glob("parts/*.tmp")) or how == signal.SIGKILL
    assert len(list(out.glob("parts/*.parquet"))) >= 2


def test_work_that_is_given_up_is_not_commented_on():
    """As by a signal: our own line says it, and the library's advice is none for whoever ended it."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        work = as_finished(time.sleep, [0.1] * 12, 2)
        next(work)
        work.close()
        gc.collect()
    assert not [str(w.message) for w in seen]


def test_no_more_processes_are_started_than_there_is_work_for(monkeypatch):
    """`--jobs 1000` had started a thousand, for three tables."""
    import joblib

    asked, usual = [], joblib.parallel_config
    monkeypatch.setattr(
        joblib, "parallel_config", lambda **how: (asked.append(how["n_jobs"]), usual(**how))[1]
    )
    monkeypatch.setattr(processes, "PER_CORE", 1)
    for count in (1, 3, 1000):
        assert len(list(as_finished(abs, range(count), 30))) == count
    assert asked == [2, min(3, max(2, os.cpu_count() or 1)), max(2, os.cpu_count() or 1)]


@pytest.mark.slow
def test_a_cluster_without_workers_and_one_that_is_lost(tmp_path, monkeypatch, capsys):
    distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    for name, seconds in (("SAY", 0.5), ("END", 2.5), ("LOOK", 0.2)):
        monkeypatch.setattr(cluster_module, name, seconds)
    settings = Settings(**SMALL | {"methods": ("white",)})
    with distributed.LocalCluster(
        n_workers=0, processes=True, dashboard_address=":0", silence_logs=50
    ) as cluster:
        began = time.monotonic()
        with pytest.raises(CampaignError, match="has no worker, for 2 s now; what was finished is kept"):
            run_campaign(settings, 2, tmp_path / "a", scheduler=cluster.scheduler_address)
        assert time.monotonic() - began < 15
    assert "has no worker; waiting until" in capsys.readouterr().err


def test_a_scheduler_that_hangs_is_not_waited_for(monkeypatch, capsys):
    """Stopped, or behind a cable that was pulled: its system keeps the connection, and no answer comes."""

    def sync(ask, n_workers, callback_timeout=None):
        assert callback_timeout, "it would be waited for for ever"
        raise TimeoutError

    monkeypatch.setattr(cluster_module, "SAY", 0.0)
    client = SimpleNamespace(status="running", scheduler=SimpleNamespace(address="tcp://x:1", identity=None), sync=sync)  # fmt: skip
    watch = cluster_module._Watch(client)
    watch.look()
    assert "the Dask cluster at tcp://x:1 does not answer; waiting until" in capsys.readouterr().err
    monkeypatch.setattr(cluster_module, "END", 0.0)
    with pytest.raises(CampaignError, match="does not answer, for 0 s now; what was finished is kept"):
        watch.look()


def test_a_worker_that_was_stopped_is_said_once(monkeypatch, capsys):
    """It keeps its connection and what it holds; its neighbour goes on sending signs of life."""
    signs = {"tcp://a:1": 7.0, "tcp://b:2": 7.0}
    identity = lambda *_, **__: {"workers": {name: {"last_seen": sign} for name, sign in signs.items()}}
    client = SimpleNamespace(status="running", scheduler=SimpleNamespace(address="tcp://x:1", identity=None), sync=identity)  # fmt: skip
    clock = [100.0]
    monkeypatch.setattr(cluster_module.time, "monotonic", lambda: clock[0])
    watch = cluster_module._Watch(client)
    for second in range(100):
        clock[0], signs["tcp://b:2"] = 100.0 + second, float(second)
        watch.look()
        assert bool(capsys.readouterr().err.count("tcp://a:1")) == (second == cluster_module.SILENT + 1)
    assert "tcp://b:2" not in capsys.readouterr().err


class Lost:
    """A future whose result was on its way when the scheduler was killed, and the client that gave it."""

    status, key = "finished", "oed-1"

    def submit(self, *_, **__):
        return self

    def add_done_callback(self, call):
        call(self)

    def exception(self, timeout):
        return None

    def result(self, timeout):
        from distributed.comm.core import CommClosedError

        raise CommClosedError("in <TCP>: ConnectionResetError: connection reset by peer")


def test_a_scheduler_killed_while_a_result_is_on_its_way(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    monkeypatch.setattr(cluster_module, "_connected", lambda address: contextlib.nullcontext(Lost()))
    monkeypatch.setattr(
        cluster_module, "_Watch", lambda client: SimpleNamespace(seen=lambda: None, look=lambda: None)
    )
    with pytest.raises(
        CampaignError, match="the Dask scheduler at tcp://x:1 was lost; what was finished is kept"
    ):
        run_campaign(Settings(**SMALL | {"methods": ("white",)}), 2, tmp_path / "a", scheduler="tcp://x:1")


class LostOnce(Lost):
    """A future whose worker was lost with its result; another computes it again."""

    late, status = True, "lost"

    def submit(self, function, item, **_):
        self.work = lambda: function(item)
        return self

    def add_done_callback(self, call):
        call(self)
        self.status = "finished" if self.asked else "lost"
        self.asked = True

    asked = False

    def result(self, timeout):
        if self.late:
            self.late = False
            raise TimeoutError
        return self.work()

    def release(self):
        pass


def test_a_worker_lost_with_a_result_that_was_not_fetched(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    looks = []
    monkeypatch.setattr(cluster_module, "_connected", lambda address: contextlib.nullcontext(LostOnce()))
    watch = SimpleNamespace(seen=lambda: looks.append("seen"), look=lambda: looks.append("look"))
    monkeypatch.setattr(cluster_module, "_Watch", lambda client: watch)
    found = run_campaign(
        Settings(**SMALL | {"methods": ("white",)}), 2, tmp_path / "a", scheduler="tcp://x:1"
    )
    assert found[0].final["frf"].statuses == {"OK": 2}
    assert looks == ["look", "look", "seen"]


@pytest.mark.validate
def test_one_worker_of_one_thread_does_the_work(tmp_path, own):
    distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    (tmp_path / "who.py").write_text("import os\ndef who(trace, plant):\n    return float(os.getpid())\n")
    brought = Own(["white"], [f"{tmp_path / 'who.py'}:who"])
    settings = Settings(
        **SMALL | {"methods": ("white",), "estimators": brought.estimators, "sources": tuple(brought.sources)}
    )
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
    ) as cluster:
        pids = {worker.process.pid for worker in cluster.workers.values()}
        found = run_campaign(
            settings, 10, tmp_path / "a", scheduler=cluster.scheduler_address, own=brought.functions
        )
    (estimates,) = found[0].final.values()
    assert {int(v) for v in estimates.estimate} == pids
    assert os.getpid() not in pids


USUAL = """
import signal
signal.signal(%d, signal.%s)  # as in a terminal: a background job of a shell is born deaf to Ctrl-C
"""
HEARD = {signal.SIGINT: "default_int_handler", signal.SIGTERM: "SIG_DFL"}

IN_TEXT = """
import sys, benchmarks.cli as cli
cli._main = lambda argv, out: exec("import signal; signal.raise_signal(%d)")
sys.exit(cli.main(["plants"]))
"""


@pytest.mark.parametrize(
    "number, how", [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "ended from outside")]
)
def test_the_exit_status_is_the_same_while_text_is_executed(number, how, tmp_path):
    """As where libraries are imported: started by `-m`, the interpreter ended itself by SIGINT, with the line said."""
    (tmp_path / "text.py").write_text(USUAL % (number, HEARD[number]) + IN_TEXT % number)
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    done = subprocess.run(
        [sys.executable, "-m", "text"], env=env, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (128 + number, f"oed: {how}.\n")


AT_EXIT = """
import atexit, signal, sys
from benchmarks.cli import main
for _ in range(%d):
    atexit.register(signal.raise_signal, %d)
sys.argv = ["oed", "--version"]
sys.exit(main())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_after_the_work_changes_nothing_and_the_second_ends_it(number):
    """Of Ctrl-C there had been a traceback, of SIGTERM warnings of semaphores that were left."""
    for times, status in ((1, 0), (2, -number)):
        text = USUAL % (number, HEARD[number]) + AT_EXIT % (times, number)
        call = [sys.executable, "-c", text]
        done = subprocess.run(call, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (status, "")


@pytest.mark.skipif(not hasattr(os, "kill"), reason="signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_that_a_finaliser_drops_ends_the_command_all_the_same(number, capsys):
    """Python drops what is raised inside a finaliser or a weak reference's callback, with lines of its own."""

    class Finalised:
        def __del__(self):
            signal.raise_signal(number)

    ended = False
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)  # behind nohup it is ignored, and stays so
    try:
        with ended_by_signals():
            Finalised()
            time.sleep(10)
    except KeyboardInterrupt as error:
        ended = getattr(error, "number", signal.SIGINT) == number
    finally:
        signal.signal(number, before)
    assert ended
    assert "Traceback" not in capsys.readouterr().err
