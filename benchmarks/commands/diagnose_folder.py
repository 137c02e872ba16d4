"""`oed diagnose-folder`: every case of a folder, several at a time; resumes."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from oed.errors import InputError

HELP = "diagnose every case of a folder (train.csv, test.csv, meta.json in each); resumes"
EXAMPLE = "oed diagnose-folder cases/public/P --out results.jsonl --jobs 2"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of this command."""
    parser.add_argument("folder", metavar="DIR", help="a folder of case folders")
    parser.add_argument(
        "--out", required=True, metavar="RESULTS.jsonl", help="one line per case; cases there are kept"
    )
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="J", help="processes (default: all cores)"
    )


def _one(folder: str) -> tuple[dict[str, Any] | None, str]:
    """Result line of one case, or the error in words."""
    from estimators.diagnosis.cases import diagnose_files

    path = Path(folder)
    test = path / "test.csv"
    meta = path / "meta.json"
    try:
        result, notes = diagnose_files(
            path / "train.csv", test if test.exists() else None, meta=meta if meta.exists() else None
        )
    except Exception as error:  # one damaged case must not end the folder: it is counted and named
        return None, f"{type(error).__name__}: {error}"
    return {"case": path.name} | result.to_dict() | {"notes": notes}, ""


def _done(out: Path) -> set[str]:
    if not out.exists():
        return set()
    cases = set()
    lines = out.read_text(encoding="utf-8").splitlines()
    whole = []
    for line in lines:
        try:
            cases.add(json.loads(line)["case"])
            whole.append(line)
        except (json.JSONDecodeError, KeyError, TypeError):
            continue  # the line that a killed run was writing
    if len(whole) < len(lines) or (lines and not out.read_text(encoding="utf-8").endswith("\n")):
        part = out.with_name(out.name + ".part")
        part.write_text("".join(line + "\n" for line in whole), encoding="utf-8")
        os.replace(part, out)
    return cases


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Diagnose the cases that the results file does not hold yet."""
    from joblib import Parallel, delayed

    from benchmarks.cli import plain

    folder, out = Path(args.folder), Path(args.out)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; give the folder that holds the case folders.")
    cases = sorted(p for p in folder.iterdir() if (p / "train.csv").exists())
    if not cases:
        raise InputError(
            f"{folder} holds no case: a case is a folder with train.csv, test.csv and meta.json in it."
        )
    if args.jobs < 1:
        raise InputError(f"--jobs is {args.jobs}; it must be at least 1.")
    if not out.parent.is_dir():
        raise InputError(f"the folder of {out} does not exist; make it first.")
    done = _done(out)
    todo = [str(p) for p in cases if p.name not in done]
    failed: dict[str, str] = {}
    count = len(cases) - len(todo)
    with out.open("a", encoding="utf-8") as file:
        results: Any = Parallel(n_jobs=args.jobs, return_as="generator")(delayed(_one)(p) for p in todo)
        for path, (line, error) in zip(todo, results, strict=True):
            count += 1
            if line is None:
                failed[Path(path).name] = error
            else:
                file.write(json.dumps(plain(line), allow_nan=False) + "\n")
                file.flush()
            if not args.quiet:
                what = error if line is None else line["effect"]
                print(f"{count}/{len(cases)} {Path(path).name}: {what}", file=sys.stderr, flush=True)
    payload = {"cases": len(cases), "failed": failed, "out": str(out)}
    text = f"{len(cases)} cases, {len(failed)} failed, results in {out}"
    return payload, "\n".join([text, *(f"{k}: {v}" for k, v in failed.items())])
