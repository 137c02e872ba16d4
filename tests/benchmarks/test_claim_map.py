"""The map of the claim as table and figure."""

from __future__ import annotations

import math

import pytest

from benchmarks.page.comparison_figures import claim_figure
from benchmarks.page.figures_static import drawn
from benchmarks.tables.columns import headings
from benchmarks.tables.formats import to_markdown
from benchmarks.tables.predictions import claim_tasks
from oed.theory import ClaimCase, claim_cases


def test_rows_become_a_table_and_a_figure():
    wanted = ("reference, variance 1", "reference, b1 and b2 known", "reference, amplitude 1")
    cases = [case for case in claim_cases() if case.plant.name in wanted]
    assert all(isinstance(case, ClaimCase) for case in cases)
    rows = [row for task in claim_tasks(cases) for row in task()]
    assert [row["theorem"] for row in rows] == [True, False, True]
    assert rows[0]["limit"] == pytest.approx(0.81125, abs=5e-6)
    assert math.isnan(rows[2]["limit"])
    text = to_markdown(rows, headings("claim_map"))
    assert text.count("\n") == len(rows) + 2
    figure = claim_figure(rows)
    shown = [p["x"] for p in figure.rows if p["series"] == "limit of the iterations"]
    assert shown == pytest.approx([0.81125, 0.80737], abs=5e-6)
    ax = drawn(figure).axes[0]
    assert len(ax.get_yticks()) == len(rows)
    lines = {line.get_label(): line.get_xdata() for line in ax.get_lines()}
    assert list(lines["limit of the iterations"]) == shown
