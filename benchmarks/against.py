"""A comparison against an earlier one, such as the published: what is better, what is worse, what is within the error."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from benchmarks.tables.pairs import holm
from oed.errors import InputError

__all__ = ["AGAINST", "against", "against_sentence"]

Row = dict[str, Any]
KEY = ("plant", "method", "estimator")
BUDGET = ("noise_variance", "samples", "experiments")
SURE = 0.05
"""Chance of any wrong "better" or "worse" in the whole table where nothing has changed, by Holm's rule."""
AGAINST = {
    "plant": "plant",
    "noise_variance": "noise",
    "method": "input",
    "estimator": "estimator",
    "rho": "rho here",
    "rho_there": "rho there",
    "difference": "difference",
    "p_holm": "p (Holm)",
    "verdict": "so it is",
}


def against(rows: Sequence[Row], folder: str | Path) -> list[Row]:
    """Rho of every way that both have at the same budget, its difference, and whether that is more than chance."""
    there = {_key(row): row for row in _published(Path(folder))}
    both = [(row, there[_key(row)]) for row in rows if _key(row) in there]
    if not both:
        raise InputError(
            f"{folder} has no plant, noise level, input and estimator in common with this comparison at its budget; compare "
            "with --samples, --experiments and --plant as there."
        )
    table = []
    for mine, theirs in both:
        row = {key: mine[key] for key in (*KEY, "noise_variance", "rho", "rho_se")}
        row |= {"rho_there": float(theirs["rho"]), "rho_there_se": float(theirs["rho_se"] or "nan")}
        row["difference"] = row["rho"] - row["rho_there"]
        row["difference_se"] = float(np.hypot(row["rho_se"], row["rho_there_se"]))
        table.append(row)
    z = np.array(
        [
            abs(row["difference"]) / row["difference_se"] if row["difference_se"] > 0 else np.nan
            for row in table
        ]
    )
    for row, p in zip(table, holm((2 * norm.sf(z)).tolist()), strict=True):
        row["p_holm"] = float(p)
        changed = "better" if row["difference"] < 0 else "worse"
        row["verdict"] = changed if p <= SURE else "within the error"
    return table


def against_sentence(table: Sequence[Row], folder: str | Path) -> str:
    """How many are better, worse and within the error."""
    count = Counter(row["verdict"] for row in table)
    return (
        f"Against {folder}: {count['better']} better, {count['worse']} worse, {count['within the error']} within the error, of "
        f"{len(table)} ways that both have (5 % chance of any wrong word, noise taken as independent)."
    )


def _key(row: Row) -> tuple[Any, ...]:
    return (*(row[key] for key in KEY), *(float(row[key]) for key in BUDGET))


def _published(folder: Path) -> list[Row]:
    """comparison.csv of a published folder, or of the tables of a results folder."""
    for file in (folder / "comparison.csv", folder / "tables" / "comparison.csv"):
        if file.is_file():
            try:
                with file.open(encoding="utf-8", newline="") as stream:
                    rows = [dict(row) for row in csv.DictReader(stream)]
                _ = [(_key(row), float(row["rho"])) for row in rows]
                return rows
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise InputError(
                    f"{file} is no table of a comparison ({type(error).__name__}: {error})."
                ) from None
    raise InputError(f"{folder} holds no comparison.csv; give a folder of results, or docs/results.")
