"""What the page of a comparison says: the answer in a sentence, what to do, and what the numbers say plant by plant."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.campaign.plants import family_of
from benchmarks.campaign.registry import Told
from benchmarks.campaign.settings import Settings
from benchmarks.tables.answer import OPTIMAL, between
from benchmarks.tables.columns import is_number
from benchmarks.tables.formats import format_value

Row = dict[str, Any]


def short_answer(answer: Sequence[Row], best: Sequence[Row], settings: Settings) -> str:
    """The answer in one sentence."""
    if not answer:
        inputs = [r for r in best if is_number(r["c_efficiency"]) and not r["method"].startswith("oracle")]
        if not inputs:
            return "No run gave a number: the same command with --dry-run says why."
        top = max(inputs, key=lambda r: r["c_efficiency"])
        return (f"Of the inputs compared, {top['method']} carries most for the peak gain: {100 * top['c_efficiency']:.0f} % of the "
                f"optimum on {top['plant']} at noise {top['noise_variance']:g}.")  # fmt: skip
    good, most = [r for r in answer if r["c_efficiency"] >= OPTIMAL], len(answer)
    budget = sorted({r["experiments"] for r in answer})
    limit = sum(r["limit"] >= OPTIMAL for r in answer)
    if most == 1:
        share, without_end = (f"{100 * answer[0][key]:.0f} %" for key in ("c_efficiency", "limit"))
        return (f"{'Yes' if good else 'No'}: with {budget[0]} experiments of {settings.samples} samples the iterations carry {share} of "
                f"the certified optimum for the peak gain of {answer[0]['plant']} ({100 * OPTIMAL:.0f} % are asked for); with experiments "
                f"without end, {without_end}.")  # fmt: skip
    return (f"{'Yes' if len(good) == most else 'Not in general' if good else 'No'}: with {budget[0]} experiments of {settings.samples} "
            f"samples the iterations reach {100 * OPTIMAL:.0f} % of the certified optimum for the peak gain in {len(good)} of {most} "
            f"cases (a plant or family at a noise level); with experiments without end, in {limit}.")  # fmt: skip


def _counted(rows: Sequence[Row], key: str) -> str:
    """The two most common names with how often."""
    found = Counter(r[key] for r in rows).most_common(2)
    return " or ".join(f"{name} ({count})" if len(rows) > 1 else name for name, count in found)


def _over_blind(row: Row) -> Row:
    """Rho of the iterations' own estimator over that of the best blind way, with an error as if the two had no run in common."""
    ratio = row["rho_own"] / row["rho_nothing"]
    relative = np.hypot(*(row[f"rho_{k}_se"] / row[f"rho_{k}"] for k in ("own", "nothing")))
    same = row["best_own"] == row["best_nothing"]
    return row | {"ratio": ratio, "ratio_se": 0.0 if same else ratio * float(relative)}


def advice_sentences(answer: Sequence[Row], best: Sequence[Row]) -> list[str]:
    """What to apply and what to estimate with, knowing the structure and knowing nothing; and what not to do."""
    lines = []
    for kind, knows in (("structure", "Knowing orders and delay"), ("nothing", "Knowing nothing")):
        here = [r for r in answer if r[f"best_{kind}"]]
        if here:
            inputs, fits = (_counted(here, f"{kind}_{part}") for part in ("input", "estimator"))
            ties = sum(bool(r[f"{kind}_ties"]) for r in here)
            how = (f"in brackets: in how many of {len(here)} cases it was best; in {ties} others tie with it" if len(here) > 1
                   else "others tie with it" if ties else "")  # fmt: skip
            lines.append(f"{knows}, apply {inputs} and estimate with {fits}{f' ({how})' if how else ''}.")
    ratios = sorted((_over_blind(r) for r in answer if is_number(r["rho_own"]) and is_number(r["rho_nothing"])),
                    key=lambda r: r["ratio"])  # fmt: skip
    if ratios and all(r["best_own"] == r["best_nothing"] for r in ratios):
        lines.append("The iterations with their own estimator are the best way that is told nothing.")
    elif ratios:
        lines.append("The error of the iterations' own estimators is " + between(ratios[0], ratios[-1], "ratio")
                     + " that of the best way which is told as little: nothing.")  # fmt: skip
    free = [r for r in best if is_number(r["rho"]) and r["known"] != Told.PLANT.value]
    if not lines and free:
        top = min(free, key=lambda r: r["rho"])
        lines = [f"Apply {top['method']} and estimate with {top['best_estimator']}: rho {format_value(top['rho'], top['rho_se'])} on "
                 f"{top['plant']} (the error over its bound: 1 is the best an unbiased estimate can do)."]  # fmt: skip
    return lines


def details(rows: Sequence[Row], information: Sequence[Row], settings: Settings) -> list[str]:
    """What the numbers say about the claim that the iterations are experiment design, plant by plant."""
    at = {
        (r["plant"], r["noise_variance"], r["method"]): r
        for r in information
        if r["experiments"] == settings.experiments
    }
    sentences = [
        words
        for plant in settings.plants
        if not family_of(plant) and (words := _carried(at, plant, settings))
    ]
    return sentences + [
        words for plant in settings.plants if not family_of(plant) and (words := _estimated(rows, plant))
    ]


def _carried(at: Mapping[Any, Row], plant: str, settings: Settings) -> str:
    share = lambda row, key: f"{format_value(100 * row[key], 100 * row[f'{key}_se'])} %"
    listed = "; ".join(
        f"at noise {v:g}, {share(power, 'c_efficiency')} of the optimum for the peak gain (white noise "
        f"{share(white, 'c_efficiency')}) and {share(power, 'd_efficiency')} for D (white {share(white, 'd_efficiency')})"
        for v in settings.noise_variances
        if (power := at.get((plant, v, "power"))) and (white := at.get((plant, v, "white")))
    )
    return f"{plant}: {settings.experiments} power iterations carry, {listed}." if listed else ""


def _estimated(rows: Sequence[Row], plant: str) -> str:
    mine = {(r["noise_variance"], r["estimator"]): r for r in rows
            if (r["plant"], r["method"]) == (plant, "power") and is_number(r["rho"])}  # fmt: skip
    rho = lambda row: format_value(row["rho"], row["rho_se"])
    listed = "; ".join(
        f"at noise {v:g} rho is {rho(row)} with beta_2 and {rho(mine[v, 'pem'])} with PEM"
        for (v, estimator), row in mine.items()
        if estimator == "gain" and (v, "pem") in mine
    )
    return f"{plant}: on the same records of the iterations, {listed}." if listed else ""
