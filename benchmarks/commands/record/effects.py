"""`oed effects`: the effects that a diagnosis can name."""

import argparse

HELP = "the effects that oed diagnose can name, and where each acts"
EXAMPLE = "oed effects --nature 'dynamic nonlinearity'"


def configure(parser: argparse.ArgumentParser) -> None:
    """The one filter."""
    parser.add_argument("--nature", help="only effects of this nature")


def run(args: argparse.Namespace) -> tuple[dict, str]:
    """The payload and the text: one row per effect of the catalogue."""
    from estimators.diagnosis.effects import CATALOGUE, Nature
    from oed.errors import check_names

    if args.nature is not None:
        check_names([args.nature], tuple(str(nature) for nature in Nature), "nature")
    chosen = [e for e in CATALOGUE if args.nature in (None, str(e.nature))]
    rows = [
        {"name": e.key, "cause": e.cause, "nature": str(e.nature), "acts_on": str(e.slot), "sentence": e.sentence}
        for e in chosen
    ]  # fmt: skip
    lines = [f"{r['name']:24s} {r['nature']:28s} {r['sentence']}" for r in rows]
    return {"rows": rows}, "\n".join([f"{'name':24s} {'nature':28s} what it is", *lines])
