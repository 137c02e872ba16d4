"""`oed compare`: the main job."""

from __future__ import annotations

import argparse
from typing import Any

HELP = "compare inputs and estimators for the H-infinity norm: tables, figures, report"
EXAMPLE = "oed compare --plant reference --noise-variance 1 --replicates 100 --out results/mine"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of this command."""
    add = parser.add_argument
    add(
        "--plant",
        action="append",
        metavar="P",
        help="named plant or JSON file; repeat for several (default reference, hair-dryer)",
    )
    add(
        "--noise-variance",
        action="append",
        type=float,
        metavar="V",
        help="repeat for several (default 1, 4, 9); for hair-dryer in multiples of the identified one",
    )
    add("--samples", type=int, default=1000, metavar="N", help="length of every experiment (default 1000)")
    add("--experiments", type=int, default=20, metavar="n", help="experiments per run (default 20)")
    add(
        "--replicates",
        type=int,
        default=100,
        metavar="R",
        help="Monte-Carlo runs of everything (default 100)",
    )
    add(
        "--methods",
        nargs="+",
        metavar="M",
        help="inputs to compare (default white multisine power oracle-D oracle-hinf)",
    )
    add("--estimators", nargs="+", metavar="E", help="estimators (default rayleigh gain mu pem)")
    add(
        "--out",
        default="results/compare",
        metavar="DIR",
        help="results folder; the same settings resume it (default results/compare)",
    )
    add("--jobs", type=int, metavar="J", help="worker processes (default: one per core)")
    add("--scheduler", metavar="ADDRESS", help="address of a Dask scheduler to run on instead")
    add("--dry-run", action="store_true", help="only say what would be run, after trying it on a tiny size")


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Run or resume the comparison."""
    from benchmarks.comparison import compare

    result = compare(
        plants=args.plant,
        noise_variances=args.noise_variance,
        samples=args.samples,
        experiments=args.experiments,
        replicates=args.replicates,
        methods=args.methods,
        estimators=args.estimators,
        seed=args.seed,
        out=args.out,
        jobs=args.jobs,
        scheduler=args.scheduler,
        dry_run=args.dry_run,
        quiet=args.quiet or args.json,
    )
    return result.to_dict(), str(result)
