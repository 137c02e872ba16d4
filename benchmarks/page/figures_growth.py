"""Figure of how cost grows with the work: log-log, one panel for each thing that grows, ours and the peer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from benchmarks.page.charts import COLOURS
from benchmarks.page.figures_static import panels


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
