"""What the page of a comparison says: the answer in a sentence, what to do, and what the numbers say plant by plant."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.campaign.registry import Told
from benchmarks.campaign.settings import Settings
from benchmarks.tables.answer import GOOD, OPTIMAL, between
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
    return row | {"ratio": ratio, "ratio_se": ratio * float(relative)}


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
    behind = [r for r in ratios if r["best_own"] != r["best_nothing"]]
    if ratios and not behind:
        lines.append("The iterations with their own estimator are the best way that is told nothing.")
    elif ratios:
        first = len(ratios) - len(behind)
        lines.append("The error of the iterations' own estimators is " + between(behind[0], behind[-1], "ratio")
                     + " that of the best way which is told as little: nothing"
                     + (f"; in {first} of {len(ratios)} cases they are that way." if first else "."))  # fmt: skip
    free = [r for r in best if is_number(r["rho"]) and r["known"] != Told.PLANT.value]
    if not lines and free:
        top = min(free, key=lambda r: r["rho"])
        lines = [f"Apply {top['method']} and estimate with {top['best_estimator']}: rho {format_value(top['rho'], top['rho_se'])} on "
                 f"{top['plant']} (the error over its bound: 1 is the best an unbiased estimate can do)."]  # fmt: skip
    return lines


def _listed(rows: Sequence[Row]) -> str:
    """Plants and families, each with the noise levels at which it is among the rows."""
    levels: dict[str, list[str]] = {}
    for row in rows:
        levels.setdefault(row["case"], []).append(f"{row['noise_variance']:g}")
    return "; ".join(f"{case} ({', '.join(at)})" for case, at in levels.items())


def _spread(values: Sequence[float]) -> str:
    """Median and range of shares."""
    low, middle, high = (f"{np.nanquantile(values, q):.2g}" for q in (0, 0.5, 1))
    return middle if low == high else f"{middle} ({low} to {high})"


def by_noise(answer: Sequence[Row]) -> list[Row]:
    """What the iterations carry as an input, over the cases of each noise level."""
    shown = {"of the optimum": "c_efficiency", "times white noise": "over_white", "in the limit": "limit", "for D": "d_efficiency"}  # fmt: skip
    table = []
    for variance in dict.fromkeys(row["noise_variance"] for row in answer):
        here = [row for row in answer if row["noise_variance"] == variance]
        cells = {head: _spread([row[key] for row in here]) for head, key in shown.items()}
        table.append({"noise": f"{variance:g}", "cases": len(here)} | cells)
    return table


def by_budget(growth: Sequence[Row], experiments: int) -> list[Row]:
    """Per plant and noise level, the share of the optimum after one experiment, the budget, many, and without end."""
    cases: dict[tuple[str, float], dict[int, Row]] = {}
    for row in growth:
        cases.setdefault((row["plant"], row["noise_variance"]), {})[row["experiments"]] = row
    table = []
    for (plant, variance), spent in cases.items():
        few, many = spent[min(spent)], spent[max(spent)]
        share = lambda row: format_value(row.get("c_efficiency"), row.get("c_efficiency_se"))
        table.append({
            "plant": plant, "noise": f"{variance:g}", "1 experiment": share(few),
            f"{experiments} experiments": share(spent.get(experiments, {})), "white noise": format_value(many["white"]),
            "many, predicted": f"{format_value(many['predicted'])} ({many['experiments']})",
            "in the limit": format_value(many["limit"]), "experiments to 90 % of it": many["needed"],
        })  # fmt: skip
    return table


def where_it_holds(answer: Sequence[Row]) -> list[str]:
    """Where the claim holds, how nearly, and what it fails of: the noise, or the budget."""
    within = lambda low, high: [row for row in answer if low <= row["limit"] < high]
    parts = [
        (within(OPTIMAL, np.inf), f"**It holds in the limit** of experiments without end (over {100 * OPTIMAL:.0f} % of the certified optimum)"),
        (within(GOOD, OPTIMAL), f"**It nearly holds** (over {100 * GOOD:.0f} % in the limit)"),
        (within(0, GOOD), f"**It fails, however many experiments** (under {100 * GOOD:.0f} % in the limit)"),
        ([row for row in answer if row["c_efficiency"] < GOOD * row["limit"]],
         f"**It fails for the budget** ({answer[0]['experiments']} experiments carry less than half of what the limit promises)"),
    ]  # fmt: skip
    return [
        f"{words} in {len(rows)} of {len(answer)} cases (at noise): {_listed(rows)}."
        for rows, words in parts
        if rows
    ]
