"""The map of [S] Sec. 4.2's claim as a table and a figure, every row with its certificate.

Where is the sinusoid at the peak, where is the limit spectrum, an optimal experiment for the peak gain?

    rows = claim_rows()              for `benchmarks.tables.formats`, with the headings COLUMNS
    figure = claim_figure(rows)      c-efficiencies, case by case (`benchmarks.page.comparison_figures`)"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from oed.theory.cases import ClaimCase, claim_cases, claim_map
from oed.theory.claim import ClaimRow

COLUMNS = {
    "group": "Varied",
    "plant": "Case",
    "theorem": "Gain scaling",
    "optimum": "Optimum / noise variance",
    "gap": "Certified gap",
    "sinusoid": "Sinusoid at the peak",
    "limit": "Limit spectrum",
    "white": "White noise",
    "note": "Note",
}


def row_of(group: str, row: ClaimRow) -> dict[str, Any]:
    """One row of the table."""
    return {
        "group": group,
        "plant": row.plant,
        "theorem": row.closed,
        "optimum": row.optimum,
        "gap": row.gap,
        "sinusoid": row.sinusoid,
        "limit": row.limit,
        "white": row.white,
        "note": row.note,
        "noise_variance": row.noise_variance,
        "bound": row.bound,
        "largest_price": row.largest_price,
        "price_frequency": row.price_frequency,
    }


def claim_tasks(cases: Sequence[ClaimCase] | None = None) -> list[Callable[[], list[dict[str, Any]]]]:
    """The map case by case; the usual ones take about 20 seconds of one core."""
    return [partial(_mapped, case) for case in (claim_cases() if cases is None else cases)]


def claim_rows(cases: Sequence[ClaimCase] | None = None) -> list[dict[str, Any]]:
    """The map as rows of plain values."""
    return [row for task in claim_tasks(cases) for row in task()]


def _mapped(case: ClaimCase) -> list[dict[str, Any]]:
    return [row_of(group, row) for group, row in claim_map([case])]
