"""The README's Python runs, top to bottom, in one namespace, as a reader would paste it."""

from __future__ import annotations

import contextlib
import csv
import doctest
import io
import os
import re
from pathlib import Path

import pytest

from benchmarks.readme import oracle_sentence

README = Path(__file__).resolve().parent.parent / "README.md"
FENCE = re.compile(r"^(?P<indent> *)```python[^\n]*\n(?P<code>.*?)^ *```", re.MULTILINE | re.DOTALL)
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def blocks(text: str) -> list[tuple[int, str]]:
    """Each ```python block's first line number and its code, the fence's indent removed."""
    found = []
    for hit in FENCE.finditer(text):
        code = re.sub(rf"^{hit['indent']}", "", hit["code"], flags=re.MULTILINE)
        found.append((text[: hit.start("code")].count("\n") + 1, code))
    return found


def run(text: str, name: str) -> int:
    """Run every block of the text in order; the number of blocks. A wrong example raises AssertionError."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    found = blocks(text)
    for line, code in found:
        if ">>>" not in code:
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile("\n" * (line - 1) + code, name, "exec"), namespace)
            continue
        test = doctest.DocTestParser().get_doctest(code, namespace, f"{name}, line {line}", name, line - 1)
        runner, said = doctest.DocTestRunner(optionflags=FLAGS), []
        runner.run(test, out=said.append, clear_globs=False)
        namespace = test.globs
        if runner.failures:
            raise AssertionError("".join(said))
    return len(found)


@pytest.mark.skipif(not README.exists(), reason="there is no README.md yet")
def test_readme(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(README.read_text(encoding="utf-8"), "README.md") > 0, "README.md shows no Python"
    assert os.getcwd() == str(tmp_path)


def test_a_wrong_example_is_caught() -> None:
    assert run("```python\na = 2\n```\n\n```python\n>>> a + 1\n3\n```\n", "right") == 2
    with pytest.raises(AssertionError, match="Expected"):
        run("```python\n>>> 1 + 1\n3\n```\n", "wrong")
    with pytest.raises(ZeroDivisionError):
        run("```python\n1 / 0\n```\n", "wrong")
    assert run("no code\n", "none") == 0


def typed_figures(text: str) -> list[str]:
    """Figures with a +- outside what `make campaign` writes and outside code, which runs."""
    outside = re.sub(r"<!-- headline.*?<!-- end of headline -->", "", text, flags=re.DOTALL)
    return re.findall(r"[\d.]+ ±[^,;)\n]*", re.sub(r"```.*?```", "", outside, flags=re.DOTALL))


def test_no_measured_figure_is_typed_into_the_readme() -> None:
    """A typed 3.9 ± 0.9 stood beside a table with 2.65 ± 0.33."""
    assert typed_figures(README.read_text(encoding="utf-8")) == []
    assert typed_figures("rho 3.9 ± 0.9 at noise 9, or so") == ["3.9 ± 0.9 at noise 9"]
    assert typed_figures("<!-- headline: x -->\n1 ± 2\n<!-- end of headline -->\n```\n3 ± 4\n```") == []


def test_the_sentence_on_the_optimum_is_made_from_the_comparison() -> None:
    row = {"plant": "reference", "method": "oracle-hinf", "estimator": "pem", "rho": 3.034, "rho_se": 0.288}
    rows = [
        row | {"noise_variance": 9.0},
        row | {"method": "white", "noise_variance": 9.0},
        row | {"plant": "other"},
    ]
    assert oracle_sentence(rows).endswith("with PEM on reference: rho 3.03 ± 0.29 at noise 9.")
    assert oracle_sentence(rows[1:2]) == ""


def test_what_the_readme_says_of_the_claim_is_in_the_published_table():
    """Its words after the table: halves, quarters and fifths of the optimum, and where white noise is nearly as good."""
    with (README.parent / "docs" / "results" / "answer.csv").open(encoding="utf-8") as file:
        rows = [r for r in csv.DictReader(file) if "plants" not in r["case"]]
    number = lambda r, key: float(r[key])
    hard = ("two-peaks", "three-by-two")
    for r in rows:
        noise, share = number(r, "noise_variance"), number(r, "c_efficiency")
        if noise == 0.1:
            assert number(r, "limit") > 0.9 or r["case"] == "three-by-two"
            assert 0.2 < share < 0.33 if r["case"] in hard else share > 0.5
        if noise == 9 and r["case"] != "hair-dryer":
            assert number(r, "over_white") < 1.7
        near = (r["case"], noise) == ("bandit-fir", 9.0)
        assert number(r, "d_efficiency") > 0.9 if near else 0.2 < number(r, "d_efficiency") < 0.82


def test_what_the_prose_says_of_random_families_is_published():
    with (README.parent / "docs" / "results" / "answer.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["case"].startswith("random")]
    said = [
        f"{100 * extreme(float(row[key]) for row in rows):.0f}"
        for key in ("c_efficiency", "limit")
        for extreme in (min, max)
    ]
    text = " ".join(README.read_text(encoding="utf-8").split())
    assert "have {} to {} %, in the limit {} to {} %".format(*said) in text
