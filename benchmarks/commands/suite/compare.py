"""`oed compare`: the main job."""

import argparse
import sys
from importlib.util import find_spec
from typing import Any

from oed.errors import InputError

HELP = "compare inputs and estimators for the H-infinity norm: tables, figures, report"
EXAMPLE = "oed compare --plant reference --noise-variance 1 --replicates 100 --out results/mine"

LISTS = {"plant": "plants", "noise_variance": "noise_variances", "limit": "limits"}
PLAIN = (
    "methods", "estimators", "samples", "experiments", "replicates", "profile_replicates", "time_limit", "out",
)  # fmt: skip

NEEDED = ("joblib", "tqdm", "pandas", "pyarrow", "matplotlib", "altair", "vl_convert")
"""The extra `compare`."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of this command."""
    add = parser.add_argument
    # fmt: off
    add("--config", metavar="FILE",
        help="TOML file with any of these options as keys (plants, noise_variances, [[limit]] ..); what is given on the command line goes before it")
    add("--plant", action="append", metavar="P",
        help="named plant, random-fir-1, random-fir-2 .., or JSON file; repeat for several (default reference, hair-dryer, random-fir-1, three-by-two)")
    add("--noise-variance", action="append", type=float, metavar="V",
        help="repeat for several (default 1, 4, 9); for hair-dryer in multiples of the identified one")
    add("--samples", type=int, metavar="N", help="length of every experiment (default 1000)")
    add("--experiments", type=int, metavar="n", help="experiments per run (default 20)")
    add("--replicates", type=int, metavar="R", help="Monte-Carlo runs of everything (default 100)")
    add("--methods", nargs="+", metavar="M",
        help="inputs to compare (default white multisine power procedure-2 sequential sequential-selected oracle-D oracle-hinf); your own as FILE.py:FUNCTION")
    add("--estimators", nargs="+", metavar="E",
        help="estimators (default rayleigh gain mu corrected fir-selected fir-regularised pem pem-selected); your own as FILE.py:FUNCTION")
    add("--limit", action="append", metavar="replicates=R[,plant=P][,method=M][,estimator=E]",
        help="fewer replicates of what is named; repeat for several")
    add("--profile-replicates", type=int, metavar="R",
        help="replicates in which the estimators also run after parts of the budget (default 3)")
    add("--time-limit", type=float, metavar="SECONDS",
        help="for one run of a method, and for one estimate (default 300); what takes longer is a row that says so")
    add("--out", metavar="DIR", help="results folder; the same settings resume it (default results/compare)")
    add("--merge", nargs="+", metavar="DIR", help="put the results of these folders together in --out first, then compute what is missing")
    add("--against", metavar="DIR", help="say what is better, worse and within the error of an earlier comparison, such as docs/results")
    add("--jobs", type=int, metavar="J", help="worker processes (default: one per core)")
    add("--scheduler", metavar="ADDRESS", help="address of a Dask scheduler to run on instead")
    add("--dry-run", action="store_true", help="only say what would be run, after trying it on a tiny size")
    # fmt: on


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Run or resume the comparison."""
    absent = [name for name in NEEDED if find_spec(name) is None]
    if absent:  # all at once: one by one they would be named after what had run so far
        raise InputError(
            f"{', '.join(absent)} not installed; pip install 'oed[compare]' brings what a comparison needs."
        )
    from pathlib import Path

    from benchmarks.campaign.settings import campaign_from_toml, limit_from_text
    from benchmarks.comparison import Comparison, compare

    options: dict[str, Any] = {"seed": args.seed}
    merged: dict[str, Any] = {}
    if args.merge:
        from benchmarks.campaign.merging import merge_stores

        merged = merge_stores([Path(folder) for folder in args.merge], Path(args.out or "results/compare"))
        options |= merged
    if args.config:
        options |= campaign_from_toml(args.config)
        if args.seed:  # 0 is the default and gives way to the file's
            options["seed"] = args.seed
    if args.limit:
        args.limit = [limit_from_text(text) for text in args.limit]
    given = {LISTS.get(name, name): getattr(args, name) for name in (*LISTS, *PLAIN)}
    options |= {name: value for name, value in given.items() if value is not None}
    own = [*options.get("methods", ()), *options.get("estimators", ())]
    for file in dict.fromkeys(name.rpartition(":")[0] for name in own if ".py:" in name):
        print(f"oed compare: running the code in {file}", file=sys.stderr)
    if args.against:
        from benchmarks.tables.pairs import check_budget

        # an hour of runs is not the moment to learn that it is not there, or of another budget
        check_budget(args.against, **{k: options[k] for k in ("samples", "experiments") if k in options})
    told: list[Comparison] = []

    def tell(early: Comparison) -> None:
        """The answer first: the figures take their time."""
        if not args.json:
            print(early, flush=True)
            told.append(early)

    result = compare(
        **options, jobs=args.jobs, scheduler=args.scheduler, dry_run=args.dry_run,
        quiet=args.quiet or args.json, tell=tell,
    )  # fmt: skip
    payload, text = result.to_dict(), str(result)
    if told:
        new = [sentence for sentence in result.sentences if sentence not in told[0].sentences]
        text = "\n".join([*new, f"report: {result.page}"])
    if args.against and not args.dry_run:
        from benchmarks.tables.formats import to_text
        from benchmarks.tables.pairs import AGAINST, against_rows, against_sentence

        table = against_rows(result.rows, args.against)
        payload["against"] = table
        text += "\n\n" + to_text(table, AGAINST) + "\n" + against_sentence(table, args.against)
    return payload, text
