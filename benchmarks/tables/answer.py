"""The answer to [S] Sec. 4.2: where the iterations are optimal experiment design, what their estimators waste, what to do.

Inputs and estimators are judged apart. An input by the information it carries for the peak gain, in shares of the
certified optimum at the same energy; an estimator by rho on the same records.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.campaign.registry import Told
from benchmarks.campaign.settings import Settings
from benchmarks.tables.formats import format_value
from benchmarks.tables.tabulation import Tables

__all__ = ["ADVICE", "ANSWER", "advice_rows", "answer_rows", "answer_sentences"]

Row = dict[str, Any]
ITERATIONS = ("power", "procedure-2", "two-experiment")
OWN = ("gain", "mu", "rayleigh")
OPTIMAL, GOOD, BETTER = 0.9, 0.5, 1.5
"""Shares of the optimum that count as optimal and as over half of it, and the factor over white noise that counts as better."""

BUDGET = {
    "samples": "samples",
    "experiments": "experiments",
    "energy": "energy",
    "energy_per_input": "per input",
    "peak_amplitude": "peak |u|",
}
MOST_LISTED = 16
"""Plants and noise levels that a sentence lists one by one."""
ANSWER = {
    "plant": "plant",
    "channels": "channels",
    "parameters": "parameters",
    "noise_variance": "noise",
    "c_efficiency": "of the optimum",
    "over_white": "times white",
    "verdict": "so the iterations are",
    "rho_own": "rho, own estimator",
    "rho_pem": "rho, PEM",
    "waste": "data wasted by own",
    "advice_input": "best input",
    "advice_estimator": "best estimator",
    "rho_advice": "their rho",
    "blind_input": "order unknown: input",
    "blind_estimator": "and estimator",
    "rho_blind": "and rho",
    "d_efficiency": "of D",
    "iterations": "iterations",
    "own_estimator": "own estimator",
    **BUDGET,
}
"""The columns of the answer, the most important ones first."""

ADVICE = {
    "plant": "plant",
    "channels": "channels",
    "parameters": "parameters",
    "noise_variance": "noise",
    "experiments": "experiments",
    "input": "best input",
    "c_efficiency": "of the optimum",
    "iterations_efficiency": "iterations",
    "white_efficiency": "white",
    "oracle_efficiency": "oracle",
    **{key: name for key, name in BUDGET.items() if key != "experiments"},
}


def _oracle(method: str) -> bool:
    return method.startswith("oracle")


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and bool(np.isfinite(value))


def _lowest(rows: Sequence[Row]) -> Row | None:
    """The row with the smallest rho among those with few failures."""
    usable = [r for r in rows if _finite(r["rho"]) and r["n_failed"] <= 0.05 * r["n"]]
    return min(usable, key=lambda r: r["rho"]) if usable else None


def _verdict(efficiency: float, over_white: float) -> str:
    """What an input is, in words, from its share of the optimum and how many times white noise that is."""
    if efficiency >= OPTIMAL:
        return "optimal design"
    if efficiency >= GOOD:
        return "over half the optimum"
    return "better than white noise" if over_white >= BETTER else "hardly better than white noise"


def answer_rows(tables: Tables) -> list[Row]:
    """One row per plant and noise level on which the iterations ran."""
    table = []
    for (plant, variance), target in tables.known.items():
        here = [r for r in tables.rows if (r["plant"], r["noise_variance"]) == (plant, variance)]
        carried = _last_checkpoints(tables.information, plant, variance)
        name = next((m for m in ITERATIONS if m in carried), None)
        if name is None:
            continue
        mine, white = carried[name], carried.get("white", {})
        own = _lowest([r for r in here if r["method"] == name and r["estimator"] in OWN])
        pem = next((r for r in here if r["method"] == name and r["estimator"] == "pem"), {})
        free = [r for r in here if not _oracle(r["method"])]
        best = _lowest(free)
        blind = _lowest([r for r in free if r["known"] == Told.NOTHING.value])
        over_white = mine["c_efficiency"] / white["c_efficiency"] if white else float("nan")
        row: Row = {
            "plant": plant,
            "noise_variance": variance,
            "parameters": len(target.plant.free),
            "iterations": name,
            **{k: mine[k] for k in ("channels", *BUDGET)},
            **{k: mine[k] for k in ("c_efficiency", "c_efficiency_se", "d_efficiency", "d_efficiency_se")},
            "over_white": over_white,
            "verdict": _verdict(mine["c_efficiency"], over_white),
            "own_estimator": own["estimator"] if own else "",
        }
        for key, source in (("own", own), ("pem", pem), ("advice", best), ("blind", blind)):
            row[f"rho_{key}"] = source["rho"] if source else float("nan")
            row[f"rho_{key}_se"] = source["rho_se"] if source else float("nan")
        row["waste"] = (row["rho_own"] / row["rho_pem"]) ** 2
        for key, source in (("advice", best), ("blind", blind)):
            row[f"{key}_input"] = source["method"] if source else ""
            row[f"{key}_estimator"] = source["estimator"] if source else ""
        table.append(row)
    return table


def _last_checkpoints(information: Sequence[Row], plant: str, variance: float) -> dict[str, Row]:
    """By input, what it carried with the whole budget."""
    found: dict[str, Row] = {}
    for row in information:
        if (row["plant"], row["noise_variance"]) == (plant, variance):
            last = found.get(row["method"])
            if last is None or row["experiments"] > last["experiments"]:
                found[row["method"]] = row
    return found


def advice_rows(tables: Tables) -> list[Row]:
    """Which input to apply, by budget: the one that carries most for the peak gain without knowing the plant."""
    grouped: dict[tuple[str, float, int], dict[str, Row]] = {}
    for row in tables.information:
        if _finite(row["c_efficiency"]):
            key = row["plant"], row["noise_variance"], row["experiments"]
            grouped.setdefault(key, {})[row["method"]] = row
    table = []
    for (plant, variance, _), found in grouped.items():
        free = [r for m, r in found.items() if not _oracle(m)]
        if not free:
            continue
        best = max(free, key=lambda r: r["c_efficiency"])
        name = next((m for m in ITERATIONS if m in found), None)
        blank = {"c_efficiency": float("nan"), "c_efficiency_se": float("nan")}
        row = {
            "parameters": len(tables.known[plant, variance].plant.free),
            **{k: v for k, v in best.items() if k not in ("method", "rho_predicted")},
            "input": best["method"],
        }
        for key, source in (
            ("iterations", found.get(name or "", blank)),
            ("white", found.get("white", blank)),
            ("oracle", found.get("oracle-hinf", blank)),
        ):
            row[f"{key}_efficiency"] = source["c_efficiency"]
            row[f"{key}_efficiency_se"] = source["c_efficiency_se"]
        table.append(row)
    return table


def _where(group: Sequence[Row], total: int, key: str) -> str:
    """Plants with their noise levels and a value each; of many only how many and on which plants."""
    by_plant: dict[str, list[Row]] = {}
    for row in group:
        by_plant.setdefault(row["plant"], []).append(row)
    if total > MOST_LISTED:
        return f"{len(group)} of {total} plants and noise levels ({', '.join(by_plant)})"
    show = lambda r: (
        f"{100 * r[key]:.0f} %"
        if key.endswith("efficiency")
        else "rho " + format_value(r[key], r[f"{key}_se"])
    )
    return ", ".join(
        f"{plant} at noise {', '.join(format(r['noise_variance'], 'g') for r in mine)} ({', '.join(map(show, mine))})"
        for plant, mine in by_plant.items()
    )


def answer_sentences(rows: Sequence[Row], settings: Settings) -> list[str]:
    """The answer in a few sentences, with its numbers."""
    if not rows:
        return []
    by_verdict: dict[str, list[Row]] = {}
    for row in rows:
        by_verdict.setdefault(row["verdict"], []).append(row)
    order = (
        "optimal design",
        "over half the optimum",
        "better than white noise",
        "hardly better than white noise",
    )
    listed = "; ".join(
        f"{name}: {_where(by_verdict[name], len(rows), 'c_efficiency')}"
        for name in order
        if name in by_verdict
    )
    sentences = [
        f"Are the iterations optimal experiment design ([S] Sec. 4.2)? Measured over {settings.experiments} experiments of "
        f"{settings.samples} samples, as an input for the peak gain they are: {listed}."
    ]
    wasted = [r for r in rows if _finite(r["waste"])]
    if wasted:
        least, most = min(wasted, key=lambda r: r["waste"]), max(wasted, key=lambda r: r["waste"])
        sentences.append(
            f"Their own estimators waste what the input gains: on the same records PEM needs between {_times(least['waste'])} "
            f"({least['plant']}, noise {least['noise_variance']:g}) and {_times(most['waste'])} times ({most['plant']}, noise "
            f"{most['noise_variance']:g}) less data for the same error."
        )
    advice = [r for r in rows if _finite(r["rho_advice"])]
    if advice:
        pairs: dict[tuple[str, str], list[Row]] = {}
        for row in advice:
            pairs.setdefault((row["advice_input"], row["advice_estimator"]), []).append(row)
        words = "; ".join(
            f"{method} with {estimator} on {_where(group, len(rows), 'rho_advice')}"
            for (method, estimator), group in pairs.items()
        )
        sentences.append(f"What to do, knowing the order but not the plant: {words}.")
    return sentences


def _times(ratio: float) -> str:
    return f"{ratio:.1f}" if ratio < 100 else f"{ratio:.0f}"
