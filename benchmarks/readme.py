"""Write the headline table and the picture of the README from a finished comparison (`make readme`)."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from benchmarks.compare_report import HEADLINE
from benchmarks.store import write_atomically
from benchmarks.tables import from_parquet, to_markdown
from oed.errors import InputError

__all__ = ["with_headline", "write_readme"]

START = "<!-- headline: made by `make readme` from results/compare -->"
END = "<!-- end of headline -->"


def with_headline(text: str, table: str) -> str:
    """A README with another headline table.

    Parameters
    ----------
    text : str
        The README.
    table : str
        Markdown.

    Returns
    -------
    str
        The README with the table between its marks.
    """
    if START not in text or END not in text:
        raise InputError(
            f"the README lacks the marks {START!r} and {END!r}, between which the headline table stands."
        )
    head, rest = text.split(START, 1)
    return f"{head}{START}\n{table}\n{END}{rest.split(END, 1)[1]}"


def write_readme(results: Path, readme: Path) -> None:
    """Put a comparison's headline table and picture into a README.

    Parameters
    ----------
    results : Path
        Folder of a finished comparison.
    readme : Path
        The README; its picture is `docs/efficiency.svg` beside it.
    """
    rows, _ = from_parquet(results / "tables" / "headline.parquet")
    write_atomically(readme, with_headline(readme.read_text(encoding="utf-8"), to_markdown(rows, HEADLINE)))
    picture = readme.parent / "docs" / "efficiency.svg"
    picture.parent.mkdir(exist_ok=True)
    shutil.copyfile(results / "figures" / "efficiency-reference.svg", picture)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("readme", type=Path)
    arguments = parser.parse_args()
    write_readme(arguments.results, arguments.readme)
