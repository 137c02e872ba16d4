"""`oed diagnose-folder`: every case of a folder, several at a time; resumes."""

import argparse
import json
import os
import sys
import time
from hashlib import blake2b
from pathlib import Path
from typing import Any

from oed.errors import InputError, interruption
from oed.files.limits import file_content
from oed.files.lock import locked
from oed.files.writing import append_line, write_whole

HELP = "diagnose every case of a folder (train.csv, test.csv, meta.json in each); resumes"
EXAMPLE = "oed diagnose-folder cases/public/P --out results.jsonl --jobs 2"
BEGIN = '{"case": '
"""Of every line of results."""
SEALED = ', "digest": "'
"""What ends every line, before the digest of all that is before it."""
FILES = ("train.csv", "test.csv", "meta.json")


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
        content = _content(path)
        result, notes = diagnose_files(
            path / "train.csv", test if test.exists() else None, meta=meta if meta.exists() else None
        )
        if content != _content(path):
            return None, "its files were changed while it was diagnosed"
    except Exception as error:  # one damaged case must not end the folder: it is counted and named
        if stop := interruption(error):
            raise stop from None
        return None, f"{type(error).__name__}: {error}"
    return {"case": path.name} | result.to_dict() | {
        "notes": notes,
        "content": content,
        "version": _version(),
    }, ""


def _content(folder: Path) -> str:
    """Digest of the files that a diagnosis is made from."""
    found = blake2b(digest_size=8)
    for name in FILES:
        file = folder / name
        found.update(name.encode() + (file_content(file) if file.exists() else b"") + b"\0")
    return found.hexdigest()


def _sealed(line: str) -> str:
    """A line of JSON with its own digest as the last entry."""
    return f'{line[:-1]}{SEALED}{blake2b(line.encode(), digest_size=8).hexdigest()}"}}'


def _intact(line: str) -> bool:
    """Whether a line is as it was sealed."""
    return line == _sealed(line.rpartition(SEALED)[0] + "}")


def _version() -> str:
    from benchmarks.campaign.store import versions

    return blake2b(repr(sorted(versions().items())).encode(), digest_size=8).hexdigest()


def _done(out: Path, cases: list[Path]) -> set[str]:
    """Cases whose line was made from the same files by the same version, and is as it was written. Other lines are set
    aside in a file of their own; the line that a killed run was writing is dropped. Another file is refused."""
    if not out.exists():
        return set()
    wanted = {path.name: (_content(path), _version()) for path in cases}
    done: set[str] = set()
    text = file_content(out).decode(errors="replace")
    kept, aside = [], []
    lines = text.split("\n")
    for number, line in enumerate(lines, 1):
        try:
            found = json.loads(line)
            case, made = "" + found["case"], (found.get("content"), found.get("version"))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            if number == len(lines) and BEGIN.startswith(line[: len(BEGIN)]):
                continue
            raise InputError(
                f"line {number} of {out} is no result of this command; give another --out. Nothing was changed."
            ) from None
        good = case not in done and wanted.get(case, made) == made and _intact(line)
        (kept if good else aside).append(line)
        if good:
            done.add(case)
    if aside:
        before = out.with_name(out.name + ".before")
        print(
            f"{len(aside)} lines of {out} were made from other files or by another version, or changed since: they are kept in "
            f"{before.name}, and their cases are diagnosed again.",
            file=sys.stderr,
        )
        for line in aside:
            append_line(before, line)
    content = "".join(line + "\n" for line in kept)
    if content != text:
        write_whole(out, content)
    return done


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str, int]:
    """Diagnose the cases that the results file does not hold yet; exit status 1 where one failed."""
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
    if out.is_dir():
        raise InputError(f"--out {out} is a folder; give the name of a file.")
    with locked(out.with_name(f".{out.name}.lock"), f"the results {out}"):
        failed = _diagnosed(cases, out, args.jobs, args.quiet)
    payload = {"cases": len(cases), "failed": failed, "out": str(out)}
    text = f"{len(cases)} cases, {len(failed)} failed, results in {out}"
    return payload, "\n".join([text, *(f"{k}: {v}" for k, v in failed.items())]), int(bool(failed))


def _diagnosed(cases: list[Path], out: Path, jobs: int, quiet: bool) -> dict[str, str]:
    """Append a line for every case that is not done; what failed, by name."""
    from benchmarks.campaign.processes import as_finished
    from benchmarks.cli import plain
    from benchmarks.progress import in_words

    done = _done(out, cases)
    todo = [str(p) for p in cases if p.name not in done]
    failed: dict[str, str] = {}
    begin = time.monotonic()
    results = as_finished(_one, todo, jobs) if jobs > 1 else ((p, _one(p), True) for p in todo)
    for count, (path, found, ended) in enumerate(results, len(cases) - len(todo) + 1):
        line, error = found if ended else (None, "the process that diagnosed it was killed")
        if line is None:
            failed[Path(path).name] = error
        else:
            append_line(out, _sealed(json.dumps(plain(line), allow_nan=False)))
        if not quiet:
            what = error if line is None else line["effect"]
            each = (time.monotonic() - begin) / (count - len(cases) + len(todo))
            left = f"about {in_words(each * (len(cases) - count))} left" if count < len(cases) else "done"
            name = " ".join(Path(path).name.split())  # on one line, as everything here
            print(f"{count}/{len(cases)} {name}: {what}; {left}", file=sys.stderr, flush=True)
    if out.exists():  # the same bytes whoever did the work
        lines = out.read_text(encoding="utf-8").splitlines()
        write_whole(
            out, "".join(line + "\n" for line in sorted(lines, key=lambda line: json.loads(line)["case"]))
        )
    return failed
