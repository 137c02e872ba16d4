"""The answer to [S] Sec. 4.2: where the iterations are optimal experiment design, what their estimators waste, what to do.

Inputs and estimators are judged apart. An input by the information it carries for the peak gain, in shares of the
certified optimum at the same energy; an estimator by rho on the same records."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.campaign.plants import family_of
from benchmarks.campaign.settings import Settings
from benchmarks.tables.columns import is_number
from benchmarks.tables.formats import format_value
from benchmarks.tables.growth import growth_of
from benchmarks.tables.statistics import below_one, mean_with_error
from benchmarks.tables.tabulation import Tables, judged_ways
from oed.covariances import of_few

Row = dict[str, Any]
ITERATIONS = ("power", "procedure-2", "two-experiment")
OPTIMAL, GOOD, BETTER = 0.9, 0.5, 1.5
"""Shares of the optimum that count as optimal and as over half of it, and the factor over white noise that counts as better."""

VERDICTS = (
    "optimal design",
    "over half the optimum",
    "better than white noise",
    "hardly better than white noise",
)
BUDGET = ("samples", "experiments", "energy", "energy_per_input", "peak_amplitude")
MOST_LISTED = 16
"""Plants and noise levels that a sentence lists one by one."""
KINDS = {
    "structure": "knows the structure",
    "nothing": "knows nothing",
    "own": "the iterations with their own estimator",
}
"""The three columns of the answer."""


def _verdict(efficiency: float, over_white: float) -> str:
    """What an input is, in words, from its share of the optimum and how many times white noise that is."""
    reached = efficiency >= OPTIMAL, efficiency >= GOOD, over_white >= BETTER, True
    return VERDICTS[reached.index(True)]


def answer_rows(tables: Tables) -> list[Row]:
    """One row per plant, or family of random plants, and noise level on which the iterations ran."""
    last: dict[tuple[str, float], dict[str, list[Row]]] = {}
    for row in _whole_budget(tables.information):
        case = family_of(row["plant"]) or row["plant"], row["noise_variance"]
        last.setdefault(case, {}).setdefault(row["method"], []).append(row)
    table = []
    for (case, variance), carried in last.items():
        name = next((m for m in ITERATIONS if m in carried), None)
        if name is None:
            continue
        mine, white = _mean(carried[name], "c_efficiency"), _mean(carried.get("white", []), "c_efficiency")
        ratio = mine[0] / white[0] if white[0] > 0 else float("nan")
        plants = list(dict.fromkeys(row["plant"] for row in carried[name]))
        targets = [tables.known[plant, variance] for plant in plants]
        limits = [growth_of(target.plant, name, 1, target.optimum.c)[1] for target in targets]
        first, d = carried[name][0], _mean(carried[name], "d_efficiency")
        row: Row = {
            "plant": plants[0] if len(plants) == 1 else case,
            "case": plants[0] if len(plants) == 1 else f"{case}, {len(plants)} plants",
            "noise_variance": variance,
            "parameters": str(_range([len(target.plant.free) for target in targets])),
            "iterations": name,
            **{k: first[k] for k in BUDGET},
            "channels": _range([target.channels for target in targets]),
            "c_efficiency": mine[0],
            "c_efficiency_se": mine[1],
            "d_efficiency": d[0],
            "d_efficiency_se": d[1],
            "limit": _mean([{"limit": v, "limit_se": 0.0} for v in limits], "limit")[0],
            "over_white": ratio,
            "over_white_se": ratio * float(np.hypot(mine[1] / mine[0], white[1] / white[0])) if ratio > 0 else float("nan"),
            "verdict": _verdict(mine[0], ratio),
            **tables.judged.get((case, variance), judged_ways({})),
        }  # fmt: skip
        for kind in KINDS:
            way = row[f"{kind}_input"], row[f"{kind}_estimator"]
            row[f"best_{kind}"] = " / ".join(way) if way[0] else None
        row["remark"] = _remark(row, tables.rows)
        table.append(row)
    return table


def _whole_budget(information: Sequence[Row]) -> list[Row]:
    """What every input carried with its whole budget."""
    found: dict[tuple[str, float, str], Row] = {}
    for row in information:
        key = row["plant"], row["noise_variance"], row["method"]
        if key not in found or row["experiments"] > found[key]["experiments"]:
            found[key] = row
    return list(found.values())


def _mean(rows: Sequence[Row], key: str) -> tuple[float, float]:
    """Of one plant its value and error; of many their mean, with the error of plants drawn at random."""
    values = np.array([row[key] for row in rows if is_number(row[key])])
    if len(values) < 2:
        only = next((row for row in rows if is_number(row[key])), {})
        return float(only.get(key, np.nan)), float(only.get(f"{key}_se", np.nan))
    return mean_with_error(values)


def _range(values: Sequence[Any]) -> Any:
    ends = min(values), max(values)
    return ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"


def carried_by(rho: float, error: float, n: int) -> float:
    """How many of n equal squares would have the mean and the error of the given ones (Kish): n rho^4 over the
    mean fourth power. Normal errors have n/3; of a heavy tail a few make up the whole rho."""
    return n / ((n - 1) * (2 * error / of_few(rho, n - 1)) ** 2 + 1) if rho > 0 and n > 1 else float("nan")


FEW = 1 / 6
"""Share of the problems, half of that of normal errors, from which downwards a rho is said to be made by so few."""


def _remark(row: Row, compared: Sequence[Row]) -> str:
    """Why a rho of the row is below 1, where one is, and which rho a few problems make; a way in two columns once."""
    said: dict[str, None] = {}
    for kind in KINDS:
        judged = {"rho": row[f"rho_{kind}"], "rho_se": row[f"rho_{kind}_se"], "n": row[f"{kind}_n"]}
        name = f"rho {format_value(judged['rho'], judged['rho_se'])}"
        few = carried_by(judged["rho"], judged["rho_se"], judged["n"])
        if few < FEW * judged["n"]:
            said[f"{name} is made by about {few:.0f} of {judged['n']} problems"] = None
        if judged["rho"] < 1:
            way = row["plant"], row["noise_variance"], row[f"{kind}_input"], row[f"{kind}_estimator"]
            keys = ("plant", "noise_variance", "method", "estimator")
            whole = next((r for r in compared if tuple(r[k] for k in keys) == way), row)
            said[f"{name} is {below_one(whole | judged)}"] = None
    return "; ".join(said)


def advice_rows(tables: Tables) -> list[Row]:
    """Which input to apply, by budget: the one that carries most for the peak gain without knowing the plant."""
    grouped: dict[tuple[str, float, int], dict[str, Row]] = {}
    for row in tables.information:
        if is_number(row["c_efficiency"]) and not family_of(row["plant"]):
            key = row["plant"], row["noise_variance"], row["experiments"]
            grouped.setdefault(key, {})[row["method"]] = row
    table = []
    for (plant, variance, _), found in grouped.items():
        free = [r for m, r in found.items() if not m.startswith("oracle")]
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
        for key, method in (("iterations", name or ""), ("white", "white"), ("oracle", "oracle-hinf")):
            source = found.get(method, blank)
            row |= {f"{key}_efficiency{end}": source[f"c_efficiency{end}"] for end in ("", "_se")}
        table.append(row)
    return table


def _where(group: Sequence[Row], total: int, key: str) -> str:
    """Plants with their noise levels and a value each; of many only how many and on which plants."""
    by_plant: dict[str, list[Row]] = {}
    for row in group:
        by_plant.setdefault(row["case"], []).append(row)
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
    listed = "; ".join(
        f"{name}: {_where(by_verdict[name], len(rows), 'c_efficiency')}"
        for name in VERDICTS
        if name in by_verdict
    )
    sentences = [
        f"Are the iterations optimal experiment design ([S] Sec. 4.2)? Measured over {settings.experiments} experiments of "
        f"{settings.samples} samples, as an input for the peak gain they are: {listed}. In the limit of experiments without end "
        f"they reach {100 * OPTIMAL:.0f} % of the optimum in {sum(r['limit'] >= OPTIMAL for r in rows)} of {len(rows)}."
    ]
    sentences += waste_sentence(rows)
    for kind, who in KINDS.items():
        ways: dict[str, list[Row]] = {}
        for row in rows:
            if row[f"best_{kind}"]:
                ways.setdefault(row[f"best_{kind}"], []).append(row)
        if ways:
            most = sorted(ways.items(), key=lambda item: -len(item[1]))
            listed = "; ".join(
                f"{way} on {len(group) if len(rows) > MOST_LISTED else _where(group, len(rows), f'rho_{kind}')}"
                for way, group in most
            )
            tied = sum(bool(row[f"{kind}_ties"]) for row in rows)
            sentences.append(
                f"Best, {who}, of {len(rows)} plants and noise levels: {listed}. Chosen on one half of the problems and judged on the other; in {tied} of {len(rows)} "
                "cases others tie with it within the error."
            )
    return sentences


def waste_sentence(rows: Sequence[Row]) -> list[str]:
    """How much data the iterations' estimators waste, where it was measured."""
    wasted = [r for r in rows if is_number(r["waste"])]
    if not wasted:
        return []
    least, most = min(wasted, key=lambda r: r["waste"]), max(wasted, key=lambda r: r["waste"])
    own = sorted((r for r in wasted if is_number(r["waste_own"])), key=lambda r: r["waste_own"])
    rest = f" The best of their estimators wastes {between(own[0], own[-1], 'waste_own')}." if own else ""
    return [
        "Their printed estimator (7) wastes what the input gains: PEM, which is told orders and delay as (7) is not, needs "
        f"{between(least, most, 'waste')} less data of the same records for the same error.{rest}"
    ]


def between(least: Row, most: Row, key: str) -> str:
    """The least and the largest of a factor, each with its error and where it was found."""
    at = [
        f"{format_value(r[key], r[f'{key}_se'])} times ({r['case']}, noise {r['noise_variance']:g})"
        for r in (least, most)
    ]
    return f"between {at[0]} and {at[1]}" if least is not most else at[0]


def tied(row: Row, kind: str) -> str:
    """The best way of a kind with the number of those that tie with it."""
    named = [name for name in str(row[f"{kind}_ties"] or "").split(", ") if name]
    count = sum(int(name.split()[0]) if name.endswith(" more") else 1 for name in named)
    return f"{row[f'best_{kind}']} ({count} tie)" if count else row[f"best_{kind}"]
