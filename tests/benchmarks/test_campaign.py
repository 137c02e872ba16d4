"""Campaigns: the same tables however the work is done, and nothing lost when it is interrupted."""

from __future__ import annotations

import errno
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import benchmarks.campaign.registry as methods
from benchmarks.campaign.one_part import CHUNK, boundaries, checkpoints, parts
from benchmarks.campaign.settings import Limit, Settings
from benchmarks.campaign.whole_campaign import fill_store, run_campaign, stored_runs
from benchmarks.tables.statistics import mean_with_error
from benchmarks.tables.tabulation import tabulate
from oed.errors import CampaignError, InputError
from tests.benchmarks.small_campaign import SMALL, same


def test_serial_and_processes_agree_bit_for_bit(tmp_path):
    serial = run_campaign(SMALL, 12, tmp_path / "serial", jobs=1)
    processes = run_campaign(SMALL, 12, tmp_path / "processes", jobs=2)
    assert same(serial, processes)


def test_more_replicates_extend_and_fewer_parts_are_reread(tmp_path):
    run_campaign(SMALL, CHUNK, tmp_path / "a", jobs=1)
    stamps = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "a" / "parts").iterdir()}
    extended = run_campaign(SMALL, 2 * CHUNK, tmp_path / "a", jobs=1)
    assert {p: (tmp_path / "a" / "parts" / p).stat().st_mtime_ns for p in stamps} == stamps
    assert same(extended, run_campaign(SMALL, 2 * CHUNK, tmp_path / "b", jobs=1))


def test_a_damaged_part_is_named_and_computed_again(tmp_path, capsys):
    whole = run_campaign(SMALL, CHUNK, tmp_path, jobs=1)
    victim = sorted((tmp_path / "parts").iterdir())[0]
    victim.write_bytes(victim.read_bytes()[: victim.stat().st_size // 2])
    assert same(run_campaign(SMALL, CHUNK, tmp_path, jobs=1), whole)
    assert victim.name in capsys.readouterr().err


@pytest.mark.slow
def test_killed_campaign_resumes_bit_identical(tmp_path):
    """kill -9 of the command after its first part; the resumed table equals an undisturbed one."""
    command = [
        sys.executable, "-m", "benchmarks.cli", "compare", "--plant", "reference", "--noise-variance", "1", "--methods",
        "white", "power", "--samples", "100", "--experiments", "3", "--replicates", "60",
        "--estimators", "gain", "mu", "frf", "--profile-replicates", "2", "--jobs", "1", "--quiet",
    ]  # fmt: skip
    folder = tmp_path / "killed"
    process = subprocess.Popen(
        [*command, "--out", str(folder)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120
    while not list(folder.glob("parts/*.parquet")) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    done = len(list(folder.glob("parts/*.parquet")))
    assert 0 < done < len(parts(SMALL, 60))
    assert same(run_campaign(SMALL, 60, folder, jobs=1), run_campaign(SMALL, 60, tmp_path / "whole", jobs=1))


@pytest.mark.slow
def test_ctrl_c_is_one_line_and_leaves_a_store_that_resumes(tmp_path):
    folder = tmp_path / "stopped"
    process = subprocess.Popen(
        [
            sys.executable, "-m", "benchmarks.cli", "compare", "--plant", "reference", "--noise-variance", "1",
            "--methods", "white", "power", "--samples", "100", "--experiments", "3", "--replicates", "300",
            "--estimators", "gain", "mu", "frf", "--profile-replicates", "2", "--jobs", "2", "--quiet", "--out", str(folder),
        ],
        stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True,
        # Where the tests run in the background of a shell, Ctrl-C is ignored, and a child would inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while not list(folder.glob("parts/*.parquet")) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted; what was finished is kept." in said
    assert "Traceback" not in said
    assert len(list(folder.glob("parts/*.parquet"))) < len(parts(SMALL, 300))
    assert same(
        run_campaign(SMALL, 300, folder, jobs=1), run_campaign(SMALL, 300, tmp_path / "whole", jobs=1)
    )


def test_another_campaigns_folder_is_left_alone(tmp_path):
    run_campaign(SMALL, 2, tmp_path / "a", jobs=1)
    before = {p: p.read_bytes() for p in sorted((tmp_path / "a").rglob("*")) if p.is_file()}
    other = Settings(
        plants=("reference",), noise_variances=(4.0,), methods=("white",), samples=100, experiments=3
    )
    with pytest.raises(
        CampaignError,
        match=r"other settings .*noise_variances: there \[1.0\], asked \[4.0\].*Nothing was written",
    ):
        run_campaign(other, 2, tmp_path / "a")
    assert {p: p.read_bytes() for p in sorted((tmp_path / "a").rglob("*")) if p.is_file()} == before


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(CampaignError, match="not empty and holds no readable campaign.json"):
        run_campaign(SMALL, 2, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_another_version_is_said_not_mixed(tmp_path):
    run_campaign(SMALL, 2, tmp_path, jobs=1)
    file = tmp_path / "campaign.json"
    content = json.loads(file.read_text())
    content["versions"]["numpy"] = "1.0"
    file.write_text(json.dumps(content))
    with pytest.raises(CampaignError, match=r"other versions \(numpy: there 1.0"):
        run_campaign(SMALL, 2, tmp_path, jobs=1)


def test_a_method_that_raises_is_a_row(tmp_path, monkeypatch):
    def broken(plant):
        def method(experiment, **kwargs):
            raise RuntimeError("the amplifier is off")

        return method

    monkeypatch.setitem(methods.METHODS, "broken", methods.Input(broken, "", methods.Told.PLANT))
    settings = Settings(
        plants=("reference",),
        noise_variances=(1.0,),
        methods=("broken", "white"),
        estimators=("pem",),
        samples=100,
        experiments=2,
    )
    raw = run_campaign(settings, 4, tmp_path, jobs=1)
    rows = {r["method"]: r for r in tabulate(raw, settings).rows}
    assert rows["broken"]["n_failed"] == rows["broken"]["n"] == 4
    assert rows["broken"]["failures"] == "4 failed"
    assert rows["white"]["n_failed"] == 0
    broken = next(runs for runs in raw if runs.method == "broken")
    assert broken.final["pem"].messages == ("RuntimeError: the amplifier is off",)


def test_a_method_that_hangs_and_one_that_returns_nan_are_rows(tmp_path, monkeypatch):
    """One sleeps and one never leaves Python; the campaign goes on after the time limit and says so."""

    def hanging(plant):
        def method(experiment, **kwargs):
            while True:
                time.sleep(0.01)

        return method

    monkeypatch.setitem(methods.METHODS, "hanging", methods.Input(hanging, "", methods.Told.PLANT))
    nothing = methods.Estimator(lambda trace: methods.Estimate(float("nan")), "")
    monkeypatch.setitem(methods.ESTIMATORS, "nothing", nothing)
    settings = Settings(
        plants=("reference",),
        noise_variances=(1.0,),
        methods=("hanging", "white"),
        estimators=("nothing",),
        samples=50,
        experiments=2,
    )
    raw = run_campaign(settings, 2, tmp_path, jobs=1, time_limit=0.5)
    rows = {r["method"]: r for r in tabulate(raw, settings).rows}
    assert rows["hanging"]["failures"] == "2 time limit"
    assert raw[0].final["nothing"].messages == ("stopped after 0.5 s",)
    assert rows["white"]["failures"] == "2 not finite"
    with pytest.raises(InputError, match="time limit is 0 s"):
        run_campaign(settings, 2, tmp_path, jobs=1, time_limit=0.0)


def test_a_full_disk_is_one_line_and_what_was_written_stays(tmp_path):
    """The kernel refuses files above a limit, as a full disk does; with room again the campaign goes on."""
    resource = pytest.importorskip("resource")
    run_campaign(SMALL, CHUNK, tmp_path, jobs=1)
    kept = {p: p.read_bytes() for p in (tmp_path / "parts").iterdir()}
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (600, before[1]))
    try:
        with pytest.raises(
            CampaignError, match=r"cannot write .*What was finished before is kept: make room"
        ):
            run_campaign(SMALL, 3 * CHUNK, tmp_path, jobs=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert {p: p.read_bytes() for p in (tmp_path / "parts").iterdir()} == kept
    assert same(
        run_campaign(SMALL, 3 * CHUNK, tmp_path, jobs=1),
        run_campaign(SMALL, 3 * CHUNK, tmp_path / "other", jobs=1),
    )


def test_all_methods_meet_the_same_noise(tmp_path):
    """The output noise of experiment k in replicate r is the same whatever the method."""
    from oed.experiments import simulated
    from oed.plants.named import named_plant

    plant = named_plant("reference")
    errors = []
    for name in ("white", "multisine", "power"):
        experiment = simulated(plant, seed=0, replicate=3)
        trace = methods.method_for(name, plant)(
            experiment, samples=100, iterations=2, rng=np.random.default_rng(0)
        )
        errors.append(np.concatenate([r.y - plant.simulate(r.u) for r in trace.records]))
    assert np.allclose(errors[0], errors[1], atol=1e-12)
    assert np.allclose(errors[0], errors[2], atol=1e-12)


def test_rho_of_a_known_estimator(tmp_path):
    """Energy, RMSE and rho by hand from the stored rows."""
    raw = run_campaign(SMALL, 10, tmp_path, jobs=1)
    tables = tabulate(raw, SMALL)
    row = next(r for r in tables.rows if (r["method"], r["estimator"]) == ("power", "mu"))
    mine = raw[1].final["mu"].estimate
    gamma = tables.known["reference", 1.0].gamma
    assert np.isclose(row["energy"], 300.0)
    assert np.isclose(row["rho"], np.sqrt(np.mean((mine - gamma) ** 2) * 300), rtol=1e-12)
    mean, se = mean_with_error(mine - gamma)
    assert (row["bias"], row["bias_se"]) == (mean, se)
    assert (row["channels"], row["samples"], row["experiments"]) == ("1 x 1", 300, 3)


def test_information_of_a_campaign_against_a_plain_loop(tmp_path):
    """The stored sums, divided by their counts, are the mean information of the same runs done here one by one."""
    from benchmarks.campaign.one_part import seed_for
    from oed.experiments import simulated
    from oed.information import information_of_signal
    from oed.plants.named import named_plant

    raw = run_campaign(SMALL, 7, tmp_path, jobs=1)
    plant = named_plant("reference")
    total = np.zeros((4, 4))
    for replicate in range(7):
        trace = methods.method_for("power", plant)(
            simulated(plant, seed=0, replicate=replicate),
            samples=100,
            iterations=3,
            rng=seed_for(0, "reference", "power", replicate),
        )
        total += sum(information_of_signal(plant, r.u) for r in trace.records)
    stored = [row for row in raw[1].information if row["experiments"] == 3]
    assert sum(row["count"] for row in stored) == 7
    assert np.allclose(sum(np.array(row["information"]) for row in stored), total.ravel(), rtol=1e-12)


def test_parts_grow_so_that_a_million_replicates_are_few_files():
    for replicates in (1, 7, 100, 1234, 1_000_000):
        ends = boundaries(replicates)
        assert ends[0][0] == 0
        assert ends[-1][1] == replicates
        assert all(a[1] == b[0] for a, b in itertools.pairwise(ends))
    assert boundaries(1_000_000)[:200] == boundaries(2_000_000)[:200]
    assert len(boundaries(1_000_000)) < 1200


def test_limits_leave_replicates_and_estimates_out(tmp_path):
    settings = Settings(
        plants=("reference",),
        noise_variances=(1.0,),
        methods=("white", "power", "multisine"),
        estimators=("gain", "frf"),
        samples=50,
        experiments=2,
        profile_replicates=0,
        limits=(Limit(2, estimator="frf"), Limit(3, method="white"), Limit(0, method="multisine")),
    )
    counts = {
        (r.method, name): len(found)
        for r in run_campaign(settings, 7, tmp_path, jobs=1)
        for name, found in r.final.items()
    }
    assert counts == {("white", "frf"): 2, ("power", "gain"): 7, ("power", "frf"): 2}


def test_inputs_for_one_channel_are_left_out_on_several(tmp_path):
    settings = Settings(
        plants=("three-by-two",),
        noise_variances=(1.0,),
        methods=("power", "procedure-2"),
        estimators=("frf",),
        samples=50,
        experiments=7,
    )
    raw = run_campaign(settings, 2, tmp_path / "a", jobs=1)
    assert [r.method for r in raw] == ["procedure-2"]
    used = raw[0].final["frf"]
    assert set(used.experiments) == {7}  # 1 + pq of Procedure 2, counted one by one
    assert np.allclose(used.energy, 7 * 50)
    alone = Settings(plants=("three-by-two",), noise_variances=(1.0,), methods=("power",), samples=50)
    with pytest.raises(InputError, match="nothing is left to run"):
        run_campaign(alone, 2, tmp_path / "b", jobs=1)


def test_a_disk_that_fills_while_the_report_is_written(tmp_path, monkeypatch):
    """The figures hit the end of the disk: one line, all runs kept, and the next call writes the report."""
    from benchmarks.comparison import compare
    from benchmarks.page import comparison

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    options = {
        "plants": ["reference"],
        "noise_variances": [1.0],
        "methods": ["white"],
        "estimators": ["frf"],
        "samples": 50,
    }
    options |= {"experiments": 2, "replicates": 3, "jobs": 1, "quiet": True, "out": tmp_path}
    with monkeypatch.context() as patch:
        patch.setattr(comparison, "save_page", full)
        with pytest.raises(CampaignError, match=r"No space left on device.*all runs are kept: make room"):
            compare(**options)
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "parts").iterdir()}
    assert compare(**options).page.exists()
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "parts").iterdir()} == kept


def test_parts_say_what_made_them(tmp_path):
    import pyarrow.parquet as pq

    run_campaign(SMALL, 2, tmp_path, jobs=1)
    part = next((tmp_path / "parts").iterdir())
    said = json.loads(pq.read_schema(part).metadata[b"oed.campaign"])
    assert said["settings"]["samples"] == 100
    assert said["versions"]["numpy"] == np.__version__
    assert said["machine"]


def test_a_part_damaged_inside_is_computed_again(tmp_path, capsys):
    """The end of the file is whole, its columns are not: found when the part is read."""
    whole = run_campaign(SMALL, CHUNK, tmp_path, jobs=1)
    victim = sorted((tmp_path / "parts").iterdir())[0]
    content = bytearray(victim.read_bytes())
    content[4:400] = bytes(396)
    victim.write_bytes(content)
    store = fill_store(SMALL, CHUNK, tmp_path, jobs=1)
    assert same(list(stored_runs(store, SMALL, CHUNK)), whole)
    assert victim.name in capsys.readouterr().err


def test_checkpoints():
    assert checkpoints(20) == [1, 2, 5, 10, 20]
    assert checkpoints(1) == [1]


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"plants": ("referense",)}, "did you mean reference"),
        ({"methods": ("whit",)}, "did you mean white"),
        ({"noise_variances": (-1.0,)}, "noise variance is -1"),
        ({"noise_variances": (1.0, 1.0)}, "each once"),
        ({"samples": 2}, "samples is 2"),
        ({"experiments": 0}, "experiments is 0"),
    ],
)
def test_settings_are_checked(changes, words):
    with pytest.raises(InputError, match=words):
        Settings(**changes)


def test_one_replicate_is_refused(tmp_path):
    with pytest.raises(InputError, match="replicates is 1"):
        run_campaign(SMALL, 1, tmp_path)
    assert not list(Path(tmp_path).iterdir())
