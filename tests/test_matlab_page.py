"""The how-to page with MATLAB's three jobs: its lines run, draw what they say, and are no more than there."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np

from benchmarks.cli import main

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "matlab.md"
CELL, MATLAB = r"```\{code-cell\}\n(.*?)```", r"```matlab\n(.*?)```"


def stories() -> list[tuple[list[str], list[str]]]:
    """MATLAB's lines and the cells of each section."""
    parts = PAGE.read_text().split("\n## ")[1:]
    return [
        (re.findall(MATLAB, part, re.S)[0].split("\n")[:-1], re.findall(CELL, part, re.S)) for part in parts
    ]


def test_the_lines_run_draw_and_are_no_more() -> None:
    names: dict[str, Any] = {}
    drawn = []
    for theirs, cells in stories():
        ours = [
            line for cell in cells for line in cell.splitlines() if line and not line.startswith("print(")
        ]
        assert len(ours) <= len(theirs)
        assert max(map(len, ours)) <= 100
        for cell in cells:
            *before, last = [line for line in cell.splitlines() if line]
            exec("\n".join(before), names)
            value = eval(last, names)
            if isinstance(value, matplotlib.figure.Figure):
                drawn.append([ax.get_xlabel() for ax in value.axes])
    assert len(drawn) == 4  # compare, bode, residuals, compare
    assert any("Hz" in label for label in drawn[1])
    zv, y = names["zv"], names["y"]
    assert np.sqrt(np.mean((y - zv.y)[20:] ** 2)) < 0.15  # a tenth of what the output varies by


def test_the_commands_run_as_printed(tmp_path, monkeypatch, capfd) -> None:
    assert main(["demo", str(tmp_path / "try")]) == 0
    monkeypatch.chdir(tmp_path / "try")
    lines = re.findall(r"^oed (.*)$", PAGE.read_text(), re.M)
    assert len(lines) == 3
    for line in lines:
        assert main(shlex.split(line, comments=True)) == 0
    assert (tmp_path / "try" / "bode.svg").stat().st_size > 10_000
    assert (tmp_path / "try" / "model" / "report.html").exists()
