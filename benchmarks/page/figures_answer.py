"""Figures of the answer to [S] Sec. 4.2, of the profiles, and of the head-to-head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.page.figures import COLOURS, DASHES, GREY, MARKERS, panels

__all__ = ["advice_figure", "head_to_head_figure", "profile_figure", "where_figure"]

Row = Mapping[str, Any]
ROW = 4
"""Plants in a row of panels."""


def _levels(rows: Sequence[Row], plant: str) -> list[Row]:
    return sorted((r for r in rows if r["plant"] == plant), key=lambda r: r["noise_variance"])


def _errors(rows: Sequence[Row], key: str) -> NDArray[np.float64]:
    return 2 * np.nan_to_num(np.array([r.get(f"{key}_se", 0.0) for r in rows], dtype=float))


def _plant_panels(count: int) -> tuple[Figure, list[Any]]:
    """One panel per plant, four in a row."""
    width = max(7.5, 2.6 * min(count, ROW) + 0.8)
    return panels(count, width=width, height=0.6 + 3.1 * -(-count // ROW), columns=ROW)


def where_figure(
    rows: Sequence[Row], white: Mapping[tuple[str, float], float], theory: Mapping[tuple[str, float], float]
) -> Figure:
    """Where the iterations are optimal experiment design: efficiency against noise, plant by plant.

    Shapes: white (plant, noise variance), theory (plant, noise variance).
    """
    plants = list(dict.fromkeys(r["plant"] for r in rows))
    figure, axes = _plant_panels(len(plants))
    for ax, plant in zip(axes, plants, strict=True):
        mine = _levels(rows, plant)
        x = [r["noise_variance"] for r in mine]
        ax.axhspan(0.9, 1.0, color="#e8f1e8", linewidth=0)
        for k, (key, label) in enumerate((("c_efficiency", "for the peak gain"), ("d_efficiency", "for D"))):
            values, bars = np.array([r[key] for r in mine]), _errors(mine, key)
            lower = np.minimum(bars, 0.9 * values)
            ax.errorbar(
                x,
                values,
                yerr=[lower, bars],
                fmt=f"{MARKERS[k]}{DASHES[k]}",
                color=COLOURS[k],
                markersize=5,
                capsize=2,
                linewidth=1,
                label=f"iterations, {label}",
            )
        known = [v for v in x if (plant, v) in theory]
        ax.plot(
            known, [theory[plant, v] for v in known], "_", color="black", markersize=14, label="predicted"
        )
        ax.plot(x, [white.get((plant, v), np.nan) for v in x], ":", color=GREY, label="white, peak gain")
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_ylim(0.02, 1.3)
        ax.set_xticks(x, [f"{v:g}" for v in x])
        ax.minorticks_off()
        ax.set_yticks([0.02, 0.05, 0.1, 0.2, 0.5, 1], ["2 %", "5 %", "10 %", "20 %", "50 %", "100 %"])
        ax.set_xlabel("noise variance")
        ax.set_title(f"{plant} ({mine[0]['channels']})", fontsize=10, loc="left")
    for ax in axes[::ROW]:
        ax.set_ylabel("share of the certified optimum")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def advice_figure(rows: Sequence[Row], comparison: Sequence[Row]) -> Figure:
    """What the estimators waste and what to do: rho against noise, plant by plant."""
    plants = list(dict.fromkeys(r["plant"] for r in rows))
    figure, axes = _plant_panels(len(plants))
    white = {
        (r["plant"], r["noise_variance"]): r
        for r in comparison
        if (r["method"], r["estimator"]) == ("white", "pem")
    }
    for ax, plant in zip(axes, plants, strict=True):
        mine = _levels(rows, plant)
        x = np.array([r["noise_variance"] for r in mine])
        lines = [
            ("iterations, own estimator", [(r["rho_own"], r["rho_own_se"]) for r in mine]),
            ("iterations, PEM", [(r["rho_pem"], r["rho_pem_se"]) for r in mine]),
            (
                "white, PEM",
                [
                    (white[plant, v]["rho"], white[plant, v]["rho_se"])
                    if (plant, v) in white
                    else (np.nan,) * 2
                    for v in x
                ],
            ),
            ("best without the order", [(r["rho_blind"], r["rho_blind_se"]) for r in mine]),
        ]
        for k, (label, pairs) in enumerate(lines):
            values, bars = np.array(pairs, dtype=float).T
            bars = 2 * np.nan_to_num(bars)
            ax.errorbar(
                x * (1 + 0.03 * (k - 1.5)),
                values,
                yerr=[np.minimum(bars, 0.8 * np.nan_to_num(values)), bars],
                fmt=f"{MARKERS[k]}{DASHES[k % 4]}",
                color=COLOURS[k],
                markersize=4,
                capsize=2,
                linewidth=1,
                label=label,
            )
        ax.axhline(1, color=GREY, linewidth=1)
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xticks(x, [f"{v:g}" for v in x])
        ax.minorticks_off()
        ax.set_xlabel("noise variance")
        ax.set_title(f"{plant} ({mine[0]['channels']})", fontsize=10, loc="left")
    for ax in axes[::ROW]:
        ax.set_ylabel("ρ (1 is the bound)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def profile_figure(performance: Sequence[Row], data: Sequence[Row], tolerance: float) -> Figure:
    """Performance profiles (left) and data profiles (right) with pointwise 95 % bands."""
    channels = list(dict.fromkeys(r["channels"] for r in data))
    figure, (left, *others) = panels(1 + max(len(channels), 1), width=9.5, height=4.6)
    solvers = list(dict.fromkeys((r["method"], r["estimator"]) for r in performance))
    area = {s: sum(r["share"] for r in performance if (r["method"], r["estimator"]) == s) for s in solvers}
    shown = sorted(solvers, key=lambda s: -area[s])[:12]
    for k, solver in enumerate(shown):
        by_budget = [
            (ax, [r for r in data if r["channels"] == name], "experiments")
            for ax, name in zip(others, channels, strict=False)
        ]
        for ax, rows, key in ((left, performance, "ratio"), *by_budget):
            mine = [r for r in rows if (r["method"], r["estimator"]) == solver]
            x = [r[key] for r in mine]
            ax.plot(
                x,
                [r["share"] for r in mine],
                DASHES[(k // 6) % 4],
                color=COLOURS[k % 6],
                linewidth=1.2,
                label=" / ".join(solver),
            )
            if mine:
                ax.fill_between(
                    x,
                    [r["low"] for r in mine],
                    [r["high"] for r in mine],
                    color=COLOURS[k % 6],
                    alpha=0.12,
                    linewidth=0,
                )
            ax.set_xscale("log")
            ax.set_ylim(0, 1.02)
    left.set_xlabel("error over the problem's smallest")
    left.set_ylabel("share of the problems")
    left.set_title("Performance profiles (Dolan, Moré)", fontsize=10, loc="left")
    for ax, name in zip(others, channels, strict=False):
        ax.set_xlabel("experiments")
        spent = sorted({r["experiments"] for r in data if r["channels"] == name})
        ax.set_xticks(spent, [str(k) for k in spent])
        ax.set_xticks([], minor=True)
        ax.set_title(f"Data, {name}: error ≤ {100 * tolerance:g} %", fontsize=10, loc="left")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def head_to_head_figure(rows: Sequence[Row]) -> Figure:
    """Median relative errors of the head-to-head with their intervals, beside the printed ones."""
    figure, (ax,) = panels(1, width=8.0, height=0.9 + 0.32 * len(rows))
    for k, row in enumerate(rows):
        own = row["published"] is None
        ax.plot([100 * row["low"], 100 * row["high"]], [-k, -k], color=COLOURS[0], linewidth=2)
        ax.plot(100 * row["median"], -k, "o", color=COLOURS[0], markersize=5, label="" if k else "here")
        if not own:
            ax.plot(
                100 * row["published"], -k, "x", color=COLOURS[1], markersize=6, label="" if k else "printed"
            )
    ax.set_yticks([-k for k in range(len(rows))], [r["name"] for r in rows], fontsize=8)
    ax.set_xscale("log")
    ax.set_xlabel("median relative error (%), with 95 % interval")
    ax.legend(frameon=False, fontsize=8, loc="upper right")
    return figure
