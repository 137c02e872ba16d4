"""Speed of the comparison at scale: tabulating a million runs, and what a second worker is worth."""

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
        plants=("reference",), noise_variances=(1.0,), methods=("white", "power"), estimators=("frf", "pem"),
        samples=500, profile_replicates=0,
    )  # fmt: skip
    store = Store(folder, asdict(settings))
    rng = np.random.default_rng(0)
    marks = checkpoints(settings.experiments)
    matrix = (np.eye(4) + 0.1).ravel()
    for part in parts(settings, runs // 2):
        n = part.stop - part.start
        tables = []
        for name in settings.estimators:
            estimate = 2.41 + 0.02 * rng.standard_normal(n)
            own = {
                "replicate": np.arange(part.start, part.stop),
                "estimator": name,
                "estimate": estimate,
                "energy": 1e4,
            }
            tables.append(
                _columns(part, n, **own, experiments=20, final=True, count=0, information=[[np.nan]] * n)
            )
        own = {
            "replicate": part.start,
            "estimator": "",
            "estimate": np.nan,
            "energy": 500.0 * n * np.array(marks),
        }
        carried = [(n * k * 500 * matrix).tolist() for k in marks]
        tables.append(
            _columns(
                part,
                len(marks),
                **own,
                experiments=np.array(marks),
                final=False,
                count=n,
                information=carried,
            )
        )
        store.write(part.key, pa.concat_tables(tables))
    return settings, runs // 2


def _columns(part: Any, n: int, *, information: Any, **own: Any) -> Any:
    """The columns of n rows of a part: one value for all rows, or (n,)."""
    import pyarrow as pa

    own |= {"plant": part.plant, "noise_variance": part.noise_variance, "method": part.method, "status": "OK", "message": "",
            "samples": 500 * np.asarray(own["experiments"]), "peak_amplitude": 4.0, "standard_error": 0.02}  # fmt: skip
    columns = {name: np.broadcast_to(np.asarray(value), n) for name, value in own.items()}
    columns = {k: pa.array(v.tolist() if v.dtype.kind == "U" else v) for k, v in columns.items()}
    return pa.table(columns | {"information": pa.array(information, type=pa.list_(pa.float64()))})


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
        plants=("reference",), noise_variances=(1.0,), methods=("white", "power"),
        estimators=("gain", "fir-selected", "frf"), samples=500, profile_replicates=0,
    )  # fmt: skip
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
