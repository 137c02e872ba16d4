"""What is said of growth: the exponent is that of the work, and every verb does its work at its smallest size."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.page.figures_growth import growth_figure, growth_page
from benchmarks.speed.growth import Verb, exponent, measured, verbs
from oed.plants.named import named_plant
from oed.plants.norms import peak


def test_exponent_is_that_of_a_power() -> None:
    sizes = (100, 400, 1600)
    assert exponent(sizes, [3e-4 * n**1.5 for n in sizes]) == pytest.approx(1.5)
    assert exponent(sizes, [7.0] * 3) == pytest.approx(0.0)  # the negative control: what does not grow


def test_memory_of_a_list_grows_as_its_length() -> None:
    verb = Verb(
        "list", "entries", (20_000, 80_000, 320_000), lambda n: (lambda: [0.5 * k for k in range(n)], None)
    )
    row = measured(verb)
    assert row["memory_exponent"] == pytest.approx(1.0, abs=0.1)
    assert row["baseline_exponent"] is None
    assert math.isfinite(row["exponent"])
    both = [
        row,
        row | {"baseline": "peer", "baseline_exponent": 1.0, "points": row["points"] | {"peer": [1.0, 2, 3]}},
    ]
    assert [len(ax.get_lines()) for ax in growth_figure(both).axes] == [1, 2]
    page = growth_page(both, "docs/growth.md", "growth.svg", "abc")
    assert "20000 to 320000" in page
    assert "at commit `abc`" in page
    assert page.count("| list | entries |") == 2


def test_every_verb_works_at_its_smallest_size() -> None:
    for verb in verbs():
        for call in verb.made(verb.sizes[0]):
            assert call is None or call() is not None


def test_the_norm_is_computed_in_every_call() -> None:
    """`peak` remembers plants: what was timed after the first call was a look into its memory."""
    verb = next(verb for verb in verbs() if verb.name == "norm")
    ours, _ = verb.made(verb.sizes[0])
    assert ours() is not ours()
    plant = named_plant("reference")
    assert peak(plant) is peak(plant)  # the negative control


def test_the_page_of_the_documentation_has_every_verb() -> None:
    """Its table is of a whole run: every verb and what grows, in turn, with powers and the commit."""
    text = (Path(__file__).parents[2] / "docs" / "growth.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")][2:]
    assert [(row[0].strip("| "), row[1]) for row in rows] == [(verb.name, verb.grows) for verb in verbs()]
    assert [row[2] for row in rows] == [f"{verb.sizes[0]} to {verb.sizes[-1]}" for verb in verbs()]
    assert all(math.isfinite(float(row[4])) for row in rows)
    assert "at commit `" in text
