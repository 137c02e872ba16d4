"""What the page of a comparison says: the answer in a sentence, what to do, and what the numbers say plant by plant."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.campaign.plants import family_of
from benchmarks.campaign.registry import Told
from benchmarks.campaign.settings import Settings
from benchmarks.tables.answer import OPTIMAL
from benchmarks.tables.columns import is_number
from benchmarks.tables.formats import format_value

Row = dict[str, Any]


def short_answer(answer: Sequence[Row], best: Sequence[Row], settings: Settings) -> str:
    """The answer in one sentence."""
    if not answer:
        inputs = [r for r in best if is_number(r["c_efficiency"]) and not r["method"].startswith("oracle")]
        if not inputs:
            return "No run gave a number: see what failed and how in the tables."
        top = max(inputs, key=lambda r: r["c_efficiency"])
        return (f"Of the inputs compared, {top['method']} carries most for the peak gain: {100 * top['c_efficiency']:.0f} % of the "
                f"optimum on {top['plant']} at noise {top['noise_variance']:g}.")  # fmt: skip
    good, most = [r for r in answer if r["c_efficiency"] >= OPTIMAL], len(answer)
    budget = sorted({r["experiments"] for r in answer})
    sentence = (f"With {budget[0]} experiments the iterations are an optimal input for the peak gain in {len(good)} of {most} cases "
                "(plant or family, and noise level)")  # fmt: skip
    ratios = sorted(
        r["rho_own"] / r["rho_nothing"]
        for r in answer
        if is_number(r["rho_own"]) and is_number(r["rho_nothing"])
    )
    if not ratios:
        return f"{sentence}."
    least, most_ = (format(v, ".2g") for v in (ratios[0], ratios[-1]))
    return (f"{sentence}; their own estimators have {least} to {most_} times the error of the best way that knows as little, "
            "which is nothing.")  # fmt: skip


def advice_sentences(answer: Sequence[Row], best: Sequence[Row]) -> list[str]:
    """What to do, most common first: knowing the structure, and knowing nothing."""
    lines = []
    for kind, knows in (("structure", "With the structure known"), ("nothing", "With nothing known")):
        ways = Counter(r[f"best_{kind}"] for r in answer if r[f"best_{kind}"])
        for way, count in ways.most_common(3):
            where = ", ".join(dict.fromkeys(r["plant"] for r in answer if r[f"best_{kind}"] == way))
            lines.append(f"{knows}: {way} is chosen in {count} of {len(answer)} cases ({where}).")
    free = [r for r in best if is_number(r["rho"]) and r["known"] != Told.PLANT.value]
    if not lines and free:
        top = min(free, key=lambda r: r["rho"])
        lines = [f"Apply {top['method']} and estimate with {top['best_estimator']}: rho {format_value(top['rho'], top['rho_se'])} on "
                 f"{top['plant']}."]  # fmt: skip
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
    share = lambda row, key: f"{100 * row[key]:.1f} %"
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
