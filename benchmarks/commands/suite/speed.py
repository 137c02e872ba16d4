"""`oed speed`: the speed benchmarks, ours and a baseline in turn in one run."""

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
    parser.add_argument(
        "--page", metavar="FILE.md", help="write how cost grows as a page, its figure beside it (of `growth`)"
    )
    parser.add_argument("--commit", default="", help="what the page names as its source")
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
    page = Path(args.page) if args.page else None
    if args.figure or page:
        from benchmarks.page.figures_growth import growth_figure, growth_page
        from oed.files.writing import write_figure, write_whole

        grown = [row for row in rows if "points" in row]
        figure = Path(args.figure) if args.figure or page is None else page.with_suffix(".svg")
        write_figure(figure, growth_figure(grown))
        if page:
            write_whole(page, growth_page(grown, str(page), figure.name, args.commit))
    missed = [row["name"] for row in rows if row.get("holds") is False]
    shown = {key: name for key, name in COLUMNS.items() if any(key in row for row in rows)}
    text = to_text(rows, shown)
    if missed and args.strict:
        raise OedError(f"{len(missed)} targets are missed: {', '.join(missed)}.\n{text}")
    return {"rows": rows}, text
