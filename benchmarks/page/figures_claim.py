"""Figure of the map of [S] Sec. 4.2's claim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from benchmarks.page.figures import COLOURS, MARKERS, panels

__all__ = ["claim_figure"]

Row = Mapping[str, Any]


def claim_figure(rows: Sequence[Row]) -> Figure:
    """c-efficiency of sinusoid, limit spectrum and white noise, case by case."""
    figure, (ax,) = panels(width=9.0, height=1.2 + 0.24 * len(rows))
    names = {"sinusoid": "sinusoid at the peak", "limit": "limit of the iterations", "white": "white noise"}
    for (key, name), colour, marker in zip(names.items(), COLOURS, MARKERS, strict=False):
        places = [(float(row[key]), k) for k, row in enumerate(rows) if row[key] == row[key]]
        ax.plot(
            [x for x, _ in places],
            [k for _, k in places],
            linestyle="none",
            marker=marker,
            color=colour,
            label=name,
            markersize=5,
        )
    for k in range(1, len(rows)):
        if rows[k]["group"] != rows[k - 1]["group"]:
            ax.axhline(k - 0.5, color="#c3c8cc", linewidth=0.8)
    ax.axvline(1.0, color="black", linewidth=0.8)
    ax.set_yticks(range(len(rows)), [f"{row['group']}: {row['plant']}" for row in rows], fontsize=7)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(-0.02, 1.05)
    ax.set_xlabel("efficiency for the peak gain, certified optimum = 1")
    ax.legend(loc="upper center", bbox_to_anchor=(0.4, 1.06), ncols=3, frameon=False, fontsize=8)
    return figure
