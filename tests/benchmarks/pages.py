"""A page of made-up numbers as large as the default comparison's, for what a browser shows of it: no campaign is run."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.campaign.registry import told, words_of
from benchmarks.page import comparison_figures as figures
from benchmarks.page.comparison import FILTERS, headline_rows
from benchmarks.page.content import Figure, Page, Section, Table, thinned
from benchmarks.tables.columns import headings

PLANTS = ("reference", "hair-dryer", "random-fir-1", "three-by-two")
NOISES = (1.0, 4.0, 9.0)
METHODS = ("white", "multisine", "power", "sequential", "oracle-D", "oracle-hinf")
ESTIMATORS = ("rayleigh", "gain", "mu", "corrected", "fir-selected", "pem")


def comparison_rows(
    plants=PLANTS, noises=NOISES, methods=METHODS, estimators=ESTIMATORS
) -> list[dict[str, Any]]:
    rng = np.random.default_rng(5)
    rows = []
    for plant in plants:
        for noise in noises:
            for method in methods:
                share = float(rng.uniform(0.02, 0.99))
                for estimator in estimators:
                    rho = float(rng.uniform(1, 30))
                    row = dict.fromkeys(headings("comparison"), 0.0) | {
                        "plant": plant, "noise_variance": noise, "method": method, "estimator": estimator, "channels": "1 x 1",
                        "samples": 20000, "experiments": 20, "energy": 20000.0, "peak_amplitude": 4.2, "rho": rho,
                        "rho_se": 0.05 * rho, "rho_predicted": 0.9 * rho, "bias": 0.01, "bias_se": 0.003, "rmse": 0.1,
                        "rmse_se": 0.01, "c_efficiency": share, "c_efficiency_se": 0.01, "d_efficiency": share / 2,
                        "d_efficiency_se": 0.01, "coverage": 0.95, "n": 100, "n_failed": 0, "failures": "",
                    }  # fmt: skip
                    rows.append(row | {"known": told(method, estimator).value})
    return rows


def small_page(rows: list[dict[str, Any]] | None = None) -> Page:
    """The comparison's page as a reader has it, with made-up numbers."""
    rows = comparison_rows() if rows is None else rows
    best = headline_rows(rows)
    t = np.arange(9000) / 100
    signals = thinned(t, {"measured": np.sin(t), "model": 0.9 * np.sin(t)})
    curve = [
        {"x": float(x), "y": x * x, "low": x * x - 0.1, "high": x * x + 0.1, "series": "found"}
        for x in np.linspace(0, 1, 21)
    ]
    sections = [
        Section("What each input carries", ["One sentence & <b>another</b>."],
                [Table("headline", "What every input carries.", headings("headline"), best, ["c_efficiency"], repeat=True)]),
        Section("The comparison", [], [Table("comparison", "Bias, RMSE and rho.", headings("comparison"), rows, ["c_efficiency"], repeat=True)],
                [figures.rho_figure(rows)]),
        Section("Signals", figures=[Figure("signals", "Measured and simulated.", "Two sinusoids over time.", signals, "time (s)",
                                           "y", zoom=True),
                                    Figure("curve", "A curve with its band.", "A parabola.", curve, "x", "y")]),
    ]  # fmt: skip
    return Page(
        "comparison", "A page & its <tests>", "The iterations are an optimal input in 5 of 12 cases.",
        ["100 runs each."], ["Apply power and estimate with pem."], sections=sections, made={"command": "oed compare " * 20},
        filters=FILTERS, matrix="headline", repeat={"estimators": "--estimators gain pem", "rest": "--samples 100 --seed 0"},
        runs={"reference|1|power": "parts/reference-power-*.parquet"}, names={k: words_of(k) for k in (*METHODS, *ESTIMATORS)},
        downloads={"next_input.csv": "u\n1\n"},
    )  # fmt: skip
