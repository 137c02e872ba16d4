"""Sections of the comparison's page: the answer to [S] Sec. 4.2, the profiles, the head-to-head."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.campaign.settings import Settings
from benchmarks.page import figures_answer
from benchmarks.page.report import save_figure
from benchmarks.tables.answer import ADVICE, ANSWER, advice_rows
from benchmarks.tables.head_to_head import HEAD_TO_HEAD, head_to_head_rows, head_to_head_sentence
from benchmarks.tables.profiles import TOLERANCE
from benchmarks.tables.statistics import Target
from benchmarks.tables.tabulation import Tables
from oed.theory.efficiency import losses, peak_gain_efficiency_by_experiments

__all__ = ["answer_section", "claim_section", "head_to_head_section", "profile_section"]

Row = dict[str, Any]
Save = Callable[..., dict[str, Any]]

PAIRS = {
    "plant": "plant",
    "noise_variance": "noise",
    "question": "which",
    "method": "input",
    "estimator": "estimator",
    "against_method": "against input",
    "against_estimator": "against estimator",
    "rho2_difference": "difference of rho²",
    "closer": "closer in",
    "n": "pairs",
    "p_holm": "p (Holm)",
    "differs": "differs",
    "samples": "samples",
    "experiments": "experiments",
    "energy": "energy",
    "peak_amplitude": "peak |u|",
    "against_samples": "samples against",
    "against_experiments": "experiments against",
    "against_energy": "energy against",
    "against_peak_amplitude": "peak |u| against",
}
PERFORMANCE = {
    "method": "input",
    "estimator": "estimator",
    "channels": "channels",
    "samples": "samples",
    "experiments": "experiments",
    "energy": "energy",
    "peak_amplitude": "peak |u|",
    "within_1": "best",
    "within_2": "within 2x",
    "within_10": "within 10x",
    "n": "problems",
}
DATA = {
    "method": "input",
    "estimator": "estimator",
    "channels": "channels",
    "samples": "samples",
    "experiments": "experiments",
    "energy": "energy",
    "peak_amplitude": "peak |u|",
    "share": "solved",
    "low": "95 % from",
    "high": "to",
    "n": "problems",
}


def _predicted(target: Target, row: Row) -> float:
    """Efficiency that theory predicts for the iterations with the same budget; NaN where it has no number."""
    if row["iterations"] == "power":
        return float(peak_gain_efficiency_by_experiments(target.plant, row["experiments"])[-1])
    from oed.information import information_of_spectrum
    from oed.theory.mimo import mimo_limit_spectrum

    limit = mimo_limit_spectrum(target.plant, scaling="each")
    together = losses(information_of_spectrum(target.plant, limit.spectrum), target.c)
    return float(together.efficiency(target.optimum).c)


def answer_section(
    folder: Path, save: Save, tables: Tables, rows: list[Row], settings: Settings
) -> dict[str, Any]:
    """The answer: a table and two figures, and the advice by budget."""
    white = {
        (r["plant"], r["noise_variance"]): r["c_efficiency"]
        for r in tables.information
        if r["method"] == "white" and r["experiments"] == settings.experiments
    }
    theory = {
        (r["plant"], r["noise_variance"]): _predicted(tables.known[r["plant"], r["noise_variance"]], r)
        for r in rows
    }
    return {
        "title": "The answer to [S] Sec. 4.2: are the iterations optimal experiment design?",
        "text": [],
        "figures_first": True,
        "tables": [
            save(
                "answer",
                rows,
                ANSWER,
                "Where the iterations are optimal design for the peak gain (at least 90 % of the certified optimum; over half; "
                "better than white: 1.5 times), what their own estimators waste, and the best input and estimator that need not "
                "know the plant, with its order known and unknown. Energy over all experiments and channels, the 1 + pq of "
                "Procedure 2 counted one by one.",
            ),
            save(
                "advice",
                advice_rows(tables),
                ADVICE,
                "Which input to apply, by budget: the one that carries most for the peak gain without knowing the plant.",
            ),
        ],
        "figures": [
            save_figure(
                folder,
                "answer-where",
                figures_answer.where_figure(rows, white, theory),
                "Where the iterations are optimal design: what their experiments carry together, in shares of the certified "
                "optimum (error bars: two standard errors; green: at least 90 %). Predicted: for one channel with the same "
                "budget, for several the limit.",
            ),
            save_figure(
                folder,
                "answer-advice",
                figures_answer.advice_figure(rows, tables.rows),
                "What the estimators waste and what to do: rho against noise (error bars: two standard errors).",
            ),
        ],
    }


def profile_section(folder: Path, save: Save, tables: Tables) -> dict[str, Any]:
    """Paired differences, performance and data profiles."""
    saved = []
    if tables.pairs:
        saved.append(
            save(
                "pairs",
                tables.pairs,
                PAIRS,
                "Inputs against the iterations with the same estimator, estimators against PEM on the same records: mean "
                "difference of rho squared over the same replicates (negative: the first is better), the share of replicates "
                "in which the first is closer, and p-values corrected by Holm over the whole table.",
            )
        )
    drawn = []
    if tables.performance:
        saved.append(
            save(
                "performance",
                _summary(tables.performance),
                PERFORMANCE,
                "Performance profiles: share of all problems (plant, noise level, replicate) in which the error is at most so "
                "many times the smallest; failed runs solve nothing. Standard errors are binomial. Budgets are those of a run, the energy in "
                "the mean over the problems.",
            )
        )
        drawn.append(
            save_figure(
                folder,
                "profiles",
                figures_answer.profile_figure(tables.performance, tables.data, TOLERANCE),
                "Performance profiles over all problems and data profiles over the budget, with pointwise 95 % bands (Wilson).",
            )
        )
    if tables.data:
        saved.append(
            save(
                "data_profiles",
                tables.data,
                DATA,
                f"Data profiles: share of problems solved to a relative error of {100 * TOLERANCE:g} % by budget, for plants with one "
                "channel and with several apart (those from a whole iteration of Procedure 2 on).",
            )
        )
    return {
        "title": "Who is better, and is it chance?",
        "text": [],
        "tables": saved,
        "figures": drawn,
    }


def _summary(performance: Sequence[Row]) -> list[Row]:
    """The performance profiles at a few ratios, one row per solver."""
    wanted = {1.0: "within_1", 2.0: "within_2", 10.0: "within_10"}
    rows: dict[tuple[str, str], Row] = {}
    for r in performance:
        name = wanted.get(r["ratio"])
        if name:
            row = rows.setdefault(
                (r["method"], r["estimator"]), {key: r[key] for key in PERFORMANCE if key in r}
            )
            row[name] = r["share"]
            row[f"{name}_se"] = (r["high"] - r["low"]) / (2 * 1.96)
            row["n"] = r["n"]
    return sorted(rows.values(), key=lambda row: -row["within_2"])


def claim_section(folder: Path, save: Save, rows: Sequence[Row]) -> dict[str, Any]:
    """The map of the claim: in which cases the sinusoid at the peak, and the limit of the iterations, are
    optimal.
    """
    from benchmarks.page.figures_claim import claim_figure
    from benchmarks.tables.claim_map import COLUMNS as CLAIM

    return {
        "title": "In theory: the map of the claim",
        "text": [
            "Efficiency for the peak gain of the sinusoid at the peak, of the limit spectrum of the iterations and of white noise, "
            "against a certified optimum, as the problem is varied.",
        ],
        "tables": [
            save(
                "claim_map",
                rows,
                CLAIM,
                "Every case with the gap of its certificate, per sample at unit power.",
            )
        ],
        "figures": [
            save_figure(folder, "claim-map", claim_figure(rows), "The map of the claim, case by case.")
        ],
    }


def head_to_head_section(folder: Path, save: Save, found: Sequence[Any]) -> tuple[dict[str, Any], str]:
    """The public head-to-head with intervals, and the line that is not in print."""
    rows = head_to_head_rows(found)
    sentence = head_to_head_sentence(rows)
    section = {
        "title": "The public head-to-head, settled",
        "text": [
            sentence,
            "Random FIR plants of length 10 (decay 0.75), 200 experiments of 50 samples, input norm 1, noise of standard deviation "
            "0.1. The second stage of the printed two-experiment scheme is not normalised, so its energy is its own and stated. "
            "Printed: medians of a re-run of the published protocol on other plants.",
        ],
        "tables": [
            save(
                "head_to_head",
                rows,
                HEAD_TO_HEAD,
                "Median relative errors with intervals from order statistics.",
            )
        ],
        "figures": [
            save_figure(
                folder,
                "head-to-head",
                figures_answer.head_to_head_figure(rows),
                "Median relative error of every way, with its 95 % interval, and the printed one.",
            )
        ],
    }
    return section, sentence
