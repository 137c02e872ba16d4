"""`make peers`: other people's tools beside ours, on every record that is there, at the settings their documentation has.

One process and one thread per record and tool, with a limit in CPU seconds: what fails is a row with its reason. A part is
bound to the digest of its signals, of the runner and of the tools' versions; a table that was cut short goes on where it was.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import peers_runner
from benchmarks.campaign.store import versions
from benchmarks.commands.record.data import RECORDS, Benchmark
from benchmarks.tables.formats import to_csv, to_markdown
from oed.data import Record
from oed.errors import OedError
from oed.files import read_record
from oed.files.writing import write_whole

HALVES = {
    "hydraulic-motor": Benchmark(
        "hydraulic_motor.csv[0:7623]", "hydraulic_motor.csv[7623:15246]", 20, "", ""
    ),
    "robot-arm": Benchmark("robot_arm.csv[0:512]", "robot_arm.csv[512:1024]", 20, "", ""),
    "hair-dryer": Benchmark("hair_dryer.csv[0:500]", "hair_dryer.csv[500:1000]", 20, "V", ""),
    "gas-furnace": Benchmark("gas_furnace.csv[0:200]", "gas_furnace.csv[200:296]", 20, "%", ""),
}
"""Records of one file, split as their meta.json says."""
# Seconds; the slowest that ends, the recurrent network on 65 000 samples, needs about as many.
CPU_LIMIT = 600
WALL = 20  # times as long on the clock: other work may share the machine, and a tool that waits uses no CPU
COLUMNS = {"record": "record", "tool": "tool", "rmse": "error, free run", "parameters": "parameters", "cpu_s": "CPU s",
           "explains": "explains", "remark": "remark"}  # fmt: skip


class Case(NamedTuple):
    """A record with its split."""

    name: str
    train: Record
    test: Record
    skip: int


def cases(data: Path, only: Sequence[str] = (), short: int | None = None) -> Iterator[Case]:
    """Every record under the folder; `short` keeps the first so many training samples and half as many of the test."""

    def case(name: str, skip: int, train: str, test: str, options: dict[str, str]) -> Case:
        dt = float(options["--dt"]) if "--dt" in options else None
        names = {"inputs": options.get("--inputs"), "outputs": options.get("--outputs"), "dt": dt}
        read = [read_record(path, **names, missing=True, notes=[]) for path in (train, test)]  # type: ignore[arg-type]
        first, second = (r[: short // n] if short else r for r, n in zip(read, (1, 2)))
        return Case(name, first, second, skip)

    for name, known in (RECORDS | HALVES).items():
        paths = [(part, sorted(data.rglob(part.partition("[")[0]))) for part in (known.train, known.test)]
        if all(found for _, found in paths) and (not only or name in only):
            train, test = (f"{found[0].parent / part}" for part, found in paths)
            words = known.options.split()
            yield case(name, known.skip, train, test, dict(zip(words[::2], words[1::2])))
    for meta in sorted(data.rglob("meta.json")):
        files = sorted(meta.parent.glob("train.csv*")) + sorted(meta.parent.glob("test.csv*"))
        if len(files) == 2 and (not only or meta.parent.name in only):
            skip = json.loads(meta.read_text(encoding="utf-8")).get("skip", 20)
            yield case(meta.parent.name, skip, str(files[0]), str(files[1]), {})


def installed(python: str) -> str:
    """The tools' versions in their environment; part of what a result is bound to."""
    names = (
        "from importlib.metadata import distributions as d; print(sorted((x.name, x.version) for x in d()))"
    )
    return subprocess.run([python, "-P", "-c", names], capture_output=True, text=True, check=False).stdout


def signals(case: Case) -> dict[str, Any]:
    """What the runner reads."""
    clocks = [[r.dt, r.t0] for r in (case.train, case.test)]
    return {
        "u": case.train.u, "y": case.train.y, "u2": case.test.u, "y2": case.test.y, "skip": case.skip,
        "clocks": clocks,
    }  # fmt: skip


def run(case: Case, peer: str, python: str, limit: int) -> dict[str, Any]:
    """The row of one record and one tool, from a process of its own; a failure is a row with its last line as the reason."""
    threads: dict[str, str] = dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
    )
    threads["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    call = ["-m", "benchmarks.peers_runner"] if peer == "oed" else ["-P", str(Path(peers_runner.__file__))]
    threads["JAX_TRACEBACK_FILTERING"] = "off"  # the last line is then the error
    failed: dict[str, Any] = {"rmse": None, "parameters": None, "cpu_s": None, "explains": False, "what": ""}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "case.npz"
        np.savez(file, **signals(case))
        try:
            done = subprocess.run(
                [python, *call, peer, str(file)], capture_output=True, text=True, timeout=WALL * limit, check=False,
                env=os.environ | threads, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5)),
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return failed | {"reason": f"no result after {WALL * limit} s"}
    if done.returncode == 0:
        return json.loads(done.stdout.splitlines()[-1])
    if done.returncode < 0:
        return failed | {"reason": f"stopped at {limit} s of CPU", "cpu_s": float(limit)}
    return failed | {"reason": (done.stderr.strip().splitlines() or ["it failed without a word"])[-1][:200]}


def table(
    every: Iterator[Case], out: Path, python: str, peers: Sequence[str], limit: int = CPU_LIMIT
) -> list[dict[str, Any]]:
    """The rows of all records and tools, and peers.csv and peers.md in the folder; what is there and unchanged is kept."""
    parts = out / "parts"
    parts.mkdir(parents=True, exist_ok=True)
    runner, theirs, ours = (
        Path(peers_runner.__file__).read_bytes(),
        installed(python),
        repr(sorted(versions().items())),
    )
    rows: list[dict[str, Any]] = []
    for case in every:
        for peer in peers:
            made = blake2b(
                f"{peer} {limit} {ours if peer == 'oed' else theirs}".encode() + runner, digest_size=8
            )
            for name, value in signals(case).items():
                made.update(name.encode() + np.ascontiguousarray(value).tobytes())
            path = parts / f"{case.name}--{peer}.json"
            part = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
            if part.get("made") != made.hexdigest():
                row = run(case, peer, sys.executable if peer == "oed" else python, limit)
                part = {"made": made.hexdigest(), "row": row}
                write_whole(path, json.dumps(part) + "\n")
            found = part["row"]
            remark = found["reason"] or found["what"]
            rows.append({
                "record": case.name, "tool": peer, **found,
                "remark": remark if len(remark) < 90 else remark[:87] + "...",
            })  # fmt: skip
            sys.stderr.write(f"{case.name} {peer}: {found['rmse']} {found['reason']}\n")
    to_csv(rows, out / "peers.csv", overwrite=True)
    write_whole(out / "peers.md", to_markdown(rows, COLUMNS))
    return rows


def main() -> int:
    """The command of `make peers`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with the records, at any depth")
    parser.add_argument("--out", type=Path, default=Path("results/peers"))
    parser.add_argument("--python", default=".venv-peers/bin/python", help="the Python that has the tools")
    parser.add_argument("--only", default="", help="names of records, separated by commas")
    parser.add_argument(
        "--peers", default=",".join(peers_runner.PEERS), help="names of tools, separated by commas"
    )
    parser.add_argument(
        "--short", type=int, help="only so many training samples, and half as many of the test"
    )
    parser.add_argument("--limit", type=int, default=CPU_LIMIT, help="CPU seconds of one tool on one record")
    args = parser.parse_args()
    only = [name for name in args.only.split(",") if name]
    try:
        table(cases(args.data, only, args.short), args.out, args.python, args.peers.split(","), args.limit)
    except OedError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())
