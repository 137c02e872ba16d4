"""Figure and page of how cost grows with the work: log-log, one panel for each thing that grows, ours and the peer."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from benchmarks.page.charts import COLOURS
from benchmarks.page.figures_static import panels
from benchmarks.tables.formats import to_markdown

PAGE = """# How cost grows with the work

CPU seconds of one thread, the least of three calls (of one, for diagnoses), beside the tool that a user would otherwise take for
the same job, called in turn in the same run; imports and compiling are done before. *MB* is the most that Python's allocator held
during a call at the largest size. Cost *grows as* the power of the size that fits best: 1 where twice the work costs twice as much.
The peers' fits begin near the truth, ours find their starts; their designs take all lines of the grid, ours end with a certificate.

{table}

![CPU seconds against size, log-log]({figure})

Made by `oed speed growth --page {page}`{commit}, on {cores} cores with a load of {load:.1f} while it ran. CPU seconds
leave out the time that other work had, but not what that takes of the caches.
"""
"""The page of the documentation; the sizes are what ten minutes of CPU time allow."""
SHOWN = {
    "verb": "verb", "grows": "what grows", "sizes": "from, to", "seconds": "CPU s", "exponent": "grows as", "baseline": "peer",
    "baseline_seconds": "its CPU s", "baseline_exponent": "its growth", "peak_mb": "MB", "memory_exponent": "MB grows as",
}  # fmt: skip


def growth_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Seconds against size of the rows of `benchmarks.speed.growth`."""
    figure, axes = panels(len(rows), width=11.0, height=2.4 * -(-len(rows) // 4), columns=4)
    for ax, row in zip(axes, rows, strict=True):
        points, grows = row["points"], str(row["size"]).split()[0]
        lines = [("ours", "exponent", COLOURS[0], "o-")]
        if points["peer"]:
            lines.append(("peer", "baseline_exponent", COLOURS[1], "s--"))
        for who, slope, colour, style in lines:
            label = f"{who if who == 'ours' else row['baseline']}: {row[slope]:.2f}"
            ax.loglog(points["sizes"], points[who], style, color=colour, label=label)
        ax.set(title=str(row["name"]).removeprefix("growth-"), xlabel=grows, ylabel="s")
        ax.legend(frameon=False, fontsize="x-small")
    return figure


def growth_page(rows: Sequence[Mapping[str, Any]], page: str, figure: str, commit: str) -> str:
    """The rows of `benchmarks.speed.growth` as a page of the documentation, with the load of the last quarter of an hour."""
    table = []
    for row in rows:
        grows, _, sizes = str(row["size"]).partition(" ")
        numbers = {key: float(f"{row[key]:.3g}") for key in SHOWN if isinstance(row.get(key), float)}
        verb = str(row["name"]).removeprefix("growth-")
        table.append({**row, **numbers, "verb": verb, "grows": grows, "sizes": sizes})
    return PAGE.format(
        table=to_markdown(table, SHOWN), figure=figure, page=page, commit=f" at commit `{commit}`" if commit else "",
        cores=os.cpu_count(), load=os.getloadavg()[2],
    )  # fmt: skip
