"""Speed of the comparison at scale: tabulating a million runs, and what a second worker is worth."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables.timings import speed_row, timed

RUNS = 1_000_000
CORES = os.cpu_count() or 1


def synthetic_store(folder: Path, runs: int) -> tuple[Any, int]:
    """A store as a campaign of two inputs would leave it, with invented estimates."""
    import pyarrow as pa

    from benchmarks.campaign.one_part import checkpoints, parts
    from benchmarks.campaign.settings import Settings
    from benchmarks.campaign.store import Store

    settings = Settings(
        plants=("reference",),
        noise_variances=(1.0,),
        methods=("white", "power"),
        estimators=("frf", "pem"),
        samples=500,
        profile_replicates=0,
    )
    store = Store(folder, asdict(settings))
    rng = np.random.default_rng(0)
    marks = checkpoints(settings.experiments)
    matrix = (np.eye(4) + 0.1).ravel()
    for part in parts(settings, runs // 2):
        n = part.stop - part.start
        tables = []
        for name in settings.estimators:
            replicate = np.arange(part.start, part.stop)
            estimate, nothing = 2.41 + 0.02 * rng.standard_normal(n), [[np.nan]] * n
            tables.append(_columns(part, n, replicate, name, 20, 10000.0, estimate, True, 0, nothing))
        m = len(marks)
        carried = [(n * k * 500 * matrix).tolist() for k in marks]
        tables.append(
            _columns(
                part, m, np.full(m, part.start), "", np.array(marks), 500.0 * n * np.array(marks),
                np.full(m, np.nan), False, n, carried,
            )
        )  # fmt: skip
        store.write(part.key, pa.concat_tables(tables))
    return settings, runs // 2


def _columns(
    part: Any, n: int, replicate: Any, estimator: str, experiments: Any, energy: Any, estimate: Any, final: bool,
    count: int, information: Any,
) -> Any:  # fmt: skip
    import pyarrow as pa

    number = lambda value: pa.array(np.broadcast_to(np.asarray(value, dtype=float), n))
    whole = lambda value: pa.array(np.broadcast_to(np.asarray(value, dtype=np.int64), n))
    return pa.table(
        {
            "experiments": whole(experiments),
            "samples": whole(500 * np.asarray(experiments)),
            "energy": number(energy),
            "peak_amplitude": number(4.0),
            "estimate": number(estimate),
            "standard_error": number(0.02),
            "status": pa.array(["OK"] * n),
            "message": pa.array([""] * n),
            "final": pa.array([final] * n),
            "count": whole(count),
            "information": pa.array(information, type=pa.list_(pa.float64())),
            "plant": pa.array([part.plant] * n),
            "noise_variance": number(part.noise_variance),
            "method": pa.array([part.method] * n),
            "replicate": whole(replicate),
            "estimator": pa.array([estimator] * n),
        }
    )


TABULATE = """
import json, resource, sys, time
from pathlib import Path
from benchmarks.campaign.whole_campaign import fill_store, stored_runs
from benchmarks.campaign.settings import Settings
from benchmarks.tables.tabulation import tabulate
given = json.loads(sys.argv[2])
settings = Settings(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})
start = time.perf_counter()
replicates = int(sys.argv[3])
store = fill_store(settings, replicates, Path(sys.argv[1]), jobs=1)
tables = tabulate(stored_runs(store, settings, replicates), settings)
seconds = time.perf_counter() - start
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"seconds": seconds, "peak_mb": peak, "n": [r["n"] for r in tables.rows]}))
"""


def tabulated(runs: int = RUNS) -> dict[str, Any]:
    """Tabulate a synthetic store in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        settings, replicates = synthetic_store(Path(folder) / "store", runs)
        command = [
            sys.executable, "-c", TABULATE, str(Path(folder) / "store"), json.dumps(asdict(settings)), str(replicates)
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def two_workers(replicates: int = 2000) -> tuple[float, float]:
    """Seconds of the same campaign in one process and on two workers, each after its first parts have warmed
    it."""
    from benchmarks.campaign.settings import Settings
    from benchmarks.campaign.whole_campaign import fill_store

    settings = Settings(
        plants=("reference",),
        noise_variances=(1.0,),
        methods=("white", "power"),
        estimators=("gain", "fir-selected", "frf"),
        samples=500,
        profile_replicates=0,
    )
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        for jobs in (1, 2):
            fill_store(settings, 20, Path(folder) / str(jobs), jobs=jobs)
            work = partial(fill_store, settings, replicates, Path(folder) / str(jobs), jobs=jobs)
            seconds.append(timed(work)[0])
    return seconds[0], seconds[1]


def rows() -> list[dict[str, Any]]:
    """The rows of `oed speed campaign`."""
    table = tabulated()
    alone, together = two_workers()
    # No baseline: a limit in seconds, and one in memory.
    limit = speed_row(
        "tabulate a campaign", f"{RUNS} runs", table["seconds"], "", None, 30.0, peak=table["peak_mb"]
    )
    second = speed_row("two workers", "2 x 2000 runs", together, "one process", alone, 1.7)
    return [
        limit | {"holds": table["seconds"] < 30 and table["peak_mb"] < 2000},
        second if CORES >= 2 else second | {"holds": None},
    ]
