"""Write the answer and the pictures of the README from a finished comparison (`make readme`)."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from benchmarks.tables.answer import ANSWER
from benchmarks.tables.formats import from_parquet, to_markdown
from benchmarks.tables.head_to_head import head_to_head_sentence
from oed.errors import InputError
from oed.files.writing import write_whole

__all__ = ["oracle_sentence", "with_headline", "write_readme"]

START = "<!-- headline: made by `make readme` from results/compare -->"
END = "<!-- end of headline -->"


def with_headline(text: str, table: str) -> str:
    """A README with another headline table."""
    if START not in text or END not in text:
        raise InputError(
            f"the README lacks the marks {START!r} and {END!r}, between which the headline table stands."
        )
    head, rest = text.split(START, 1)
    return f"{head}{START}\n{table}\n{END}{rest.split(END, 1)[1]}"


SHOWN = (
    "case",
    "noise_variance",
    "c_efficiency",
    "limit",
    "best_structure",
    "rho_structure",
    "rho_nothing",
    "rho_own",
)
"""At most eight columns: a reader takes in no more; the page has the rest."""
PICTURES = {
    "efficiency-reference": "efficiency",
    "answer-where": "answer-where",
    "answer-advice": "answer-advice",
}


def oracle_sentence(rows: list[dict]) -> str:
    """What PEM makes of the optimal input itself, one sinusoid at the peak, on the first plant at every noise."""
    of = [
        r
        for r in rows
        if (r["method"], r["estimator"]) == ("oracle-hinf", "pem") and r["plant"] == rows[0]["plant"]
    ]
    if not of:
        return ""
    told = ", ".join(f"{r['rho']:.2f} ± {r['rho_se']:.2f} at noise {r['noise_variance']:g}" for r in of)
    return f"The optimum itself, `oracle-hinf`, with PEM on {of[0]['plant']}: rho {told}."


def write_readme(results: Path, readme: Path) -> None:
    """Put a comparison's answer, its sentences and its pictures into a README."""
    rows, _ = from_parquet(results / "tables" / "answer.parquet")
    head, _ = from_parquet(results / "tables" / "head_to_head.parquet")
    compared, _ = from_parquet(results / "tables" / "comparison.parquet")
    spent = rows[0]
    lines = [
        f"Every input had {spent['experiments']} experiments, {spent['samples']} samples and energy {spent['energy']:.6g} over all "
        "channels (of Procedure 2 each of the 1 + pq experiments of an iteration counts); `oed report` has them beside every "
        "row, with the peak amplitude.",
        "",
        to_markdown(rows, {key: ANSWER[key] for key in SHOWN}),
        head_to_head_sentence(head),
        *(["", oracle_sentence(compared)] if oracle_sentence(compared) else []),
    ]
    write_whole(readme, with_headline(readme.read_text(encoding="utf-8"), "\n".join(lines)))
    folder = readme.parent / "docs"
    folder.mkdir(exist_ok=True)
    for name, target in PICTURES.items():
        shutil.copyfile(results / "figures" / f"{name}.svg", folder / f"{target}.svg")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("readme", type=Path)
    arguments = parser.parse_args()
    write_readme(arguments.results, arguments.readme)
