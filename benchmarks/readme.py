"""Write the README's answer and docs/results from a finished comparison (`make campaign`)."""

import argparse
import json
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.page.comparison_words import advice_sentences, by_budget, by_noise, where_it_holds
from benchmarks.tables.answer import KINDS, tied, waste_sentence
from benchmarks.tables.columns import TEXTS, headings
from benchmarks.tables.formats import format_value, from_parquet, to_markdown
from benchmarks.tables.head_to_head import head_to_head_sentence
from oed.errors import InputError
from oed.files.writing import write_whole

START = "<!-- headline: made by `make campaign` -->"
END = "<!-- end of headline -->"


def with_headline(text: str, table: str) -> str:
    """A README with another headline table."""
    if START not in text or END not in text:
        raise InputError(
            f"the README lacks the marks {START!r} and {END!r}, between which the headline table stands."
        )
    head, rest = text.split(START, 1)
    return f"{head}{START}\n{table}\n{END}{rest.split(END, 1)[1]}"


ANSWER = headings("answer")
SHOWN = {
    key: ANSWER[key] for key in ("case", "noise_variance", "c_efficiency", "limit", "best_structure")
} | {
    "rho_structure": "rho, knowing the structure",
    "rho_nothing": "rho, knowing nothing",
    "rho_own": "rho, iterations and their own estimator",
}
"""At most eight columns: a reader takes in no more; the page has the rest."""
CASES = ("reference", "hair-dryer", "three-by-two")
"""Plants in the README's table, beside the families of random ones: the paper's, a real process, several channels."""
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


def session_picture(file: Path) -> None:
    """What `oed session status --picture` draws after eight experiments on a simulated rig."""
    from benchmarks.page.session import draw_session
    from estimators.sessions import Settings, start_session
    from oed.experiments import simulated
    from oed.plants.named import named_plant

    channels: dict[str, Any] = {
        "inputs": ("force",),
        "outputs": ("position",),
        "input_units": ("N",),
        "output_units": ("mm",),
    }
    with TemporaryDirectory() as folder:
        settings = Settings("power", samples=400, dt=0.001, experiments=8, amplitude=(2.0,), **channels)
        start_session(Path(folder), settings).run(simulated(named_plant("reference", 0.25), seed=4))
        draw_session(Path(folder), file)


UNITS = "Noise is the variance at the output, of hair-dryer in multiples of the identified one; ± is one standard error."


def with_ties(row: dict) -> dict:
    """A row whose best ways say how many others tie with them."""
    return row | {f"best_{kind}": tied(row, kind) for kind in KINDS}


def write_readme(results: Path, readme: Path) -> None:
    """Put a comparison's answer, its sentences and its pictures into a README."""
    rows, metadata = from_parquet(results / "tables" / "answer.parquet")
    head, _ = from_parquet(results / "tables" / "head_to_head.parquet")
    compared, _ = from_parquet(results / "tables" / "comparison.parquet")
    spent = rows[0]
    shown = [row for row in rows if row["plant"] in CASES or row["plant"] != row["case"]]
    doubts = "; ".join(
        f"{r['case']}, noise {r['noise_variance']:g}: {r['remark']}" for r in shown if r["remark"]
    )
    lines = [
        f"Every input had {spent['experiments']} experiments, {spent['samples']} samples and energy {spent['energy']:.6g} over all "
        "channels (of Procedure 2 each of the 1 + pq experiments of an iteration counts); `oed report` has them beside every "
        f"row, with the peak amplitude. At most {metadata['replicates']} runs of each, chosen on one half and judged on the other.",
        "",
        to_markdown([with_ties(row) for row in shown], SHOWN),
        f"{UNITS} To be doubted: {doubts}." if doubts else UNITS,
        "",
        head_to_head_sentence(head),
        *(["", oracle_sentence(compared)] if oracle_sentence(compared) else []),
    ]
    write_whole(readme, with_headline(readme.read_text(encoding="utf-8"), "\n".join(lines)))
    folder = readme.parent / "docs"
    folder.mkdir(exist_ok=True)
    session_picture(folder / "session.svg")
    for name, target in PICTURES.items():
        shutil.copyfile(results / "figures" / f"{name}.svg", folder / f"{target}.svg")


PUBLISHED_TABLES = ("answer", "growth", "comparison", "not_run")


def _three_columns(row: dict) -> dict:
    """A row of the answer whose best ways stand with their rho in one cell each."""
    way = lambda kind: f"{tied(row, kind)}: {format_value(row[f'rho_{kind}'], row[f'rho_{kind}_se'])}"
    return {"case": row["case"], **{k: row[k] for k in ("channels", "noise_variance", "c_efficiency", "c_efficiency_se", "limit")},
            **{kind: way(kind) if row[f"best_{kind}"] else None for kind in KINDS}}  # fmt: skip


THREE = {key: ANSWER[key] for key in ("case", "channels", "noise_variance", "c_efficiency", "limit")} | KINDS


def write_results(results: Path, folder: Path, name: str, commit: str) -> None:
    """The page, its tables and an answer of two pages in a folder of the documentation, with commit, seed, machine and cost."""
    rows, metadata = from_parquet(results / "tables" / "answer.parquet")
    growth, _ = from_parquet(results / "tables" / "growth.parquet")
    head, _ = from_parquet(results / "tables" / "head_to_head.parquet")
    answer = json.loads((results / "report.json").read_text(encoding="utf-8"))
    cost = json.loads((results / "cost.json").read_text(encoding="utf-8"))
    folder.mkdir(parents=True, exist_ok=True)
    made = {
        "campaign": name,
        "commit": commit,
        **{k: metadata[k] for k in ("seed", "samples", "experiments", "replicates")},
        **cost,
    }
    lines = [
        "---", "orphan: true", "---", "",
        f"# Are the iterations optimal experiment design? The {name} campaign", "", f"**{answer['answer']}**", "",
        "Made by a program from the campaign's tables; [the page](report.html) has every figure and table, the CSV files all digits.",
        "", "## As an input: where it holds, how nearly, where it fails", "",
        "Share of the certified optimum for the peak gain that the inputs of the iterations carry: median (least to most) over the "
        f"cases, each a plant or a family of random ones. The budget is {metadata['experiments']} experiments of {metadata['samples']} samples.", "",
        to_markdown(by_noise(rows)), *(f"- {words}" for words in where_it_holds(rows)), "",
        "## As an estimator, and what to do instead", "", *(f"- {words}" for words in [*waste_sentence(rows), *advice_sentences(rows, []), head_to_head_sentence(head)]),
        "", "## Who knows what: the best way of each", "", to_markdown([_three_columns(row) for row in rows], THREE),
        f"{TEXTS['three']} {TEXTS['below']} {TEXTS['shared']}", "",
        *(f"- {row['case']}, noise {row['noise_variance']:g}: {row['remark']}." for row in rows if row["remark"]), "",
        "## By budget", "", TEXTS["growth"], "", to_markdown(by_budget(growth, metadata["experiments"])), "## What it is and what it cost", "",
        *(f"- {key.replace('_', ' ')}: {value}" for key, value in made.items()), "",
        f"Command: `make campaign CAMPAIGN={name}`", "",
    ]  # fmt: skip
    write_whole(folder / "README.md", "\n".join(lines))
    for table in PUBLISHED_TABLES:
        if (results / "tables" / f"{table}.csv").exists():
            shutil.copyfile(results / "tables" / f"{table}.csv", folder / f"{table}.csv")
    shutil.copyfile(results / "report.html", folder / "report.html")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("readme", type=Path)
    parser.add_argument(
        "--publish", type=Path, metavar="DIR", help="docs/results: the page, its tables and a written answer"
    )
    parser.add_argument("--name", default="published", help="what the campaign is called there")
    parser.add_argument("--commit", default="unknown", help="of the source that made it")
    arguments = parser.parse_args()
    if arguments.publish:
        write_results(arguments.results, arguments.publish, arguments.name, arguments.commit)
    write_readme(arguments.results, arguments.readme)
