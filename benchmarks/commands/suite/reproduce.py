"""`oed reproduce`: published figures and statements, recomputed."""

import argparse

HELP = "recompute what was published: figures, tables and theorems"
EXAMPLE = "oed reproduce siso-theorem-9"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `oed reproduce`."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="one of the items; default: all")
    parser.add_argument("--strict", action="store_true", help="exit 1 if a row does not hold")


def run(args: argparse.Namespace) -> tuple[dict, str]:
    """Reproduce."""
    from benchmarks.tables.reproduced import KINDS, rows_of
    from oed.errors import OedError

    rows = rows_of(args.name)
    judged = [r for r in rows if r["kind"] != "illustration"]
    failed = [r["name"] for r in judged if r["holds"] is False]
    if args.strict and failed:
        raise OedError(f"{len(failed)} of {len(judged)} rows that can fail do not hold: {', '.join(failed)}.")
    show = lambda v: f"{v:.8g}" if isinstance(v, float) else "-" if v is None else str(v)
    lines = []
    for r in rows:
        verdict = {True: "holds", False: "DOES NOT HOLD", None: "not judged"}[r["holds"]]
        other = "other way" if r["kind"] == "two ways" else "published"
        lines.append(f"{verdict:13}  {r['name']}  [{r['source']}]")
        lines.append(
            f"{'':15}{KINDS[r['kind']]}: {other} {show(r['published'])}, computed {show(r['computed'])}, "
            f"tolerance {show(r['tolerance'])}"
        )
        lines.append(f"{'':15}{r['why']}")
    count = lambda kind: sum(r["kind"] == kind for r in judged)
    held = sum(r["holds"] is True for r in judged)
    lines.append(
        f"{held} of {len(judged)} rows that can fail hold, {len(failed)} do not: {count('in print')} figures and "
        f"{count('statement')} statements in print, {count('two ways')} recomputed two ways. "
        f"{len(rows) - len(judged)} illustrations are not counted."
    )
    return {"rows": rows}, "\n".join(lines)
