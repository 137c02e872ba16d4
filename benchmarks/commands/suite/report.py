"""`oed report`: the HTML page of whatever result a folder holds."""

import argparse
import sys
from pathlib import Path
from typing import Any

HELP = "the HTML page of a comparison, diagnosis, identification, design or session; --serve follows one that runs"
EXAMPLE = "oed report results/compare"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of this command."""
    parser.add_argument(
        "folder", metavar="DIR", help="the --out folder of a command, or the folder of a session"
    )
    parser.add_argument(
        "--serve", action="store_true",
        help="open it at an address of this machine only, follow what still runs, and end with Ctrl-C",
    )  # fmt: skip


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Write the page, or serve it until interrupted."""
    from benchmarks.page.serve import page_of, server
    from benchmarks.page.skeleton import html
    from estimators.stages import stage
    from oed.errors import InputError
    from oed.files.writing import write_whole

    folder = Path(args.folder)
    if not folder.is_dir():
        raise InputError(
            f"there is no folder {folder}; give the --out folder of a command, or that of a session."
        )
    if args.serve:
        with server(folder) as site:
            host, port = site.server_address[:2]
            print(f"http://{host}:{port}/ shows {folder}; Ctrl-C ends it.", file=sys.stderr, flush=True)
            site.serve_forever()
    stage("the page")
    path = write_whole(folder / "report.html", html(page_of(folder)))
    return {"path": str(path)}, f"report: {path}"
