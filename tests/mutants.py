"""`make mutants`: mutation scores by mutmut, file by file, each with the fast tests that concern it.

    python tests/mutants.py [FILE ..] [--seconds 600] [--out mutants.json]

Every file of `mutants.toml` (or those named) is mutated in a copy of the tree, so that a killed run leaves nothing behind.
A mutant that its tests do not notice survives; what nobody could notice is listed in `mutants.toml` by the line that
mutmut writes, with the reason, and does not count. Lines that are only words (messages of errors, which tests of their
own read) are not mutated. numba's compiled loops are left out: mutmut cannot wrap them; their plain twins are the check.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABLE = Path(__file__).with_name("mutants.toml")
WORDS = [r'^\s*f?"', r"raise \w+\($", r'raise \w+\(f?"']
"""Lines whose mutants only change words."""
READ = """
import json, sys
from mutmut.mutation.data import SourceFileMutationData
from mutmut.mutation.diff_apply import get_diff_for_mutant
from mutmut.stats import status_by_exit_code
data = SourceFileMutationData(path=sys.argv[1])
data.load()
rows = {name: status_by_exit_code[code] for name, code in data.exit_code_by_key.items()}
told = lambda name, status: get_diff_for_mutant(name, path=sys.argv[1]) if status in ("survived", "no tests") else ""
print(json.dumps({name: (status, told(name, status)) for name, status in rows.items()}))
"""
"""Run in the mutated copy, where mutmut's own functions find its files."""
GOAL = 0.90
NOTICED = ("killed", "timeout", "suspicious", "segfault", "caught by type check")


def settings(file: str, tests: list[str]) -> str:
    """What mutmut is told: the whole packages are there, one file is mutated."""
    told = {
        "source_paths": ["oed", "estimators"],
        "only_mutate": [file],
        "also_copy": ["benchmarks", "README.md"],
        "do_not_mutate_patterns": WORDS,
        "pytest_add_cli_args": ["-p", "no:cacheprovider"],
        "pytest_add_cli_args_test_selection": tests,
    }
    return (
        "\n[tool.mutmut]\n"
        + "".join(f"{key} = {json.dumps(value)}\n" for key, value in told.items())
        + ("debug = true\ntrack_dependencies = false\nuse_git_change_detection = false\n")
    )


def mutated(file: str, tests: list[str], seconds: float) -> dict[str, str]:
    """The status of every mutant by the lines that its diff removes and adds; those not reached are "not checked"."""
    with tempfile.TemporaryDirectory(prefix="oed-mutants-") as name:
        copy = Path(name)
        for part in ("oed", "estimators", "benchmarks", "tests"):
            shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
        for part in ("README.md", "pyproject.toml"):
            shutil.copy(ROOT / part, copy / part)
        with (copy / "pyproject.toml").open("a", encoding="utf-8") as settings_file:
            settings_file.write(settings(file, tests))
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}  # mutmut puts its copy first
        log = copy / "log"
        with log.open("w") as out:
            run = subprocess.Popen(
                [sys.executable, "-m", "mutmut", "run", "--max-children", "1"],
                cwd=copy, env=environment, stdout=out, stderr=out, start_new_session=True,
            )  # fmt: skip
            try:
                run.wait(seconds)
            except subprocess.TimeoutExpired:
                os.killpg(run.pid, signal.SIGKILL)  # its forked workers too
                run.wait()
                print(
                    f"{file}: stopped after {seconds:g} s; what was not reached does not count",
                    file=sys.stderr,
                )
        said = log.read_text(encoding="utf-8", errors="replace")
        if "Stopping early" in said or "failed to collect" in said:
            raise SystemExit(
                f"{file}: its tests do not pass, or do not reach it, where nothing is mutated:\n{said[-3000:]}"
            )
        read = subprocess.run(
            [sys.executable, "-c", READ, file],
            cwd=copy,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        rows = json.loads(read.stdout)
        return {
            name: f"{status}\n{_change(diff)}" if diff else status for name, (status, diff) in rows.items()
        }


def _change(diff: str) -> str:
    lines = [line for line in diff.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    return "\n".join(f"{line[0]} {line[1:].strip()}" for line in lines)


def score(found: dict[str, str], equivalent: list[dict[str, str]]) -> dict[str, object]:
    """Shares of one file: noticed over all that were reached and that anybody could notice."""
    known = {entry["change"].strip() for entry in equivalent}
    kinds, left = Counter(), []
    for mutant, text in found.items():
        status, _, change = text.partition("\n")
        if status in NOTICED:
            kinds["noticed"] += 1
        elif status == "not checked":
            kinds["not reached"] += 1
        elif change.strip() in known:
            kinds["equivalent"] += 1
        else:
            kinds["survived"] += 1
            left.append(f"{mutant} ({status})\n{change}")
    counted = kinds["noticed"] + kinds["survived"]
    return dict(kinds) | {"score": kinds["noticed"] / counted if counted else None, "left": left}


def main() -> int:
    table = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", help="of those in mutants.toml; default all")
    parser.add_argument("--seconds", type=float, default=3600.0, help="most for one file")
    parser.add_argument("--out", type=Path, default=Path("mutants.json"))
    arguments = parser.parse_args()
    report = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    for file in arguments.files or table["tests"]:
        own = [entry for entry in table.get("equivalent", []) if entry["file"] == file]
        report[file] = score(mutated(file, table["tests"][file], arguments.seconds), own)
        arguments.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        print(file, {k: v for k, v in report[file].items() if k != "left"}, flush=True)
    return int(any((row["score"] or 0) < GOAL for row in report.values()))


if __name__ == "__main__":
    sys.exit(main())
