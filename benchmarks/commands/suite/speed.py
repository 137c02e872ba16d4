"""`oed speed`: the speed benchmarks, ours and a baseline in turn in one run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

HELP = "speed benchmarks: ours against a baseline, same work, medians"
EXAMPLE = "oed speed pem --json"

COLUMNS = {
    "name": "benchmark", "size": "size", "seconds": "seconds", "baseline": "baseline", "baseline_seconds": "its seconds",
    "ratio": "ratio", "target": "target", "holds": "holds", "peak_mb": "peak MB", "exponent": "grows as",
    "baseline_exponent": "its growth", "memory_exponent": "memory",
}  # fmt: skip


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of this command."""
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="which files of benchmarks/speed (default all)"
    )
    parser.add_argument("--figure", metavar="FILE.svg", help="draw how cost grows (of `growth`), log-log")
    parser.add_argument("--strict", action="store_true", help="exit 1 where a target is missed")


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Run the benchmarks."""
    import pkgutil
    from importlib import import_module

    import benchmarks.speed
    from benchmarks.tables.formats import to_text
    from estimators.stages import stage
    from oed.errors import OedError, check_names

    known = tuple(info.name for info in pkgutil.iter_modules(benchmarks.speed.__path__))
    check_names(args.names, known, "speed benchmark")
    rows: list[dict[str, Any]] = []
    chosen = args.names or known
    for k, name in enumerate(chosen):
        stage("benchmarks", k, len(chosen))
        rows += import_module(f"benchmarks.speed.{name}").rows()
    if args.figure:
        from benchmarks.page.figures_growth import growth_figure
        from oed.files.writing import write_figure

        write_figure(Path(args.figure), growth_figure([row for row in rows if "points" in row]))
    missed = [row["name"] for row in rows if row.get("holds") is False]
    shown = {key: name for key, name in COLUMNS.items() if any(key in row for row in rows)}
    text = to_text(rows, shown)
    if missed and args.strict:
        raise OedError(f"{len(missed)} targets are missed: {', '.join(missed)}.\n{text}")
    return {"rows": rows}, text
