"""`oed report`: the HTML page of a results folder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

HELP = "make the HTML report of a comparison or a diagnosis"
EXAMPLE = "oed report results/compare"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of this command."""
    parser.add_argument("folder", metavar="DIR", help="the --out folder of a comparison or a diagnosis")


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Write the page."""
    from benchmarks.page.report import write_report

    path = write_report(Path(args.folder))
    return {"path": str(path)}, f"report: {path}"
