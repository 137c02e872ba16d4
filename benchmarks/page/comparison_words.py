"""What the page of a comparison says: the answer in a sentence, what to do, captions, and what columns mean."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.campaign.plants import family_of
from benchmarks.campaign.registry import Told
from benchmarks.campaign.settings import Settings
from benchmarks.tables.answer import OPTIMAL
from benchmarks.tables.columns import BUDGET, is_number
from benchmarks.tables.formats import format_value
from benchmarks.tables.profiles import TOLERANCE

Row = dict[str, Any]
HEADLINE = {
    "plant": "plant", "noise_variance": "noise", "method": "input", "known": "is told", **BUDGET,
    "c_efficiency": "efficiency, peak gain",
    "d_efficiency": "efficiency, D", "best_estimator": "best estimator", "rho": "its rho", "rho_predicted": "rho predicted",
}  # fmt: skip
PAIRS = {
    "plant": "plant", "noise_variance": "noise", "question": "which", "method": "input", "estimator": "estimator",
    "against_method": "against input", "against_estimator": "against estimator", "rho2_difference": "difference of rho²",
    "closer": "closer in", "n": "pairs", "known": "is told", "against_known": "against one told", "p_holm": "p (Holm)", "differs": "differs", "samples": "samples",
    "experiments": "experiments", "energy": "energy", "peak_amplitude": "peak |u|", "against_samples": "samples against",
    "against_experiments": "experiments against", "against_energy": "energy against",
    "against_peak_amplitude": "peak |u| against",
}  # fmt: skip
_SOLVER = {
    "method": "input", "estimator": "estimator", "known": "is told", "channels": "channels", "samples": "samples", "experiments": "experiments",
    "energy": "energy", "peak_amplitude": "peak |u|",
}  # fmt: skip
PERFORMANCE = {
    **_SOLVER,
    "within_1": "best",
    "within_2": "within 2x",
    "within_10": "within 10x",
    "n": "problems",
}
DATA = {**_SOLVER, "share": "solved", "low": "95 % from", "high": "to", "n": "problems"}
CAPTIONS = {
    "oracle": "The input oracle-hinf is the optimum for the gain at a peak whose frequency is known: one sinusoid there. With PEM "
    "its rho is nevertheless large, because the records say nothing about where the peak is: the fitted gain at the true peak "
    "frequency meets the bound, but the norm of the fitted model is its largest gain over all frequencies, which lies above.",
    "budget": "Every input had {s.experiments} experiments of {s.samples} samples at unit power, the same plants and the same noise, "
    "{replicates} times{fewer}. rho is the root mean square error of the estimated H-infinity norm times the root of the input "
    "energy over the noise variance: no unbiased method gets below 1 (a bound that holds locally and for large samples). The "
    "column predicted is what the Fisher information of the same inputs promises to an efficient estimator.",
    "answer": "Where the iterations are optimal design for the peak gain at this budget (at least 90 % of the certified optimum; over "
    "half; better than white: 1.5 times) and in the limit of experiments without end; and the best way to the norm for whoever knows "
    "the structure (orders and delay), for whoever knows nothing, and with the iterations' own estimators, which know nothing either. "
    "Chosen on one half of the problems and judged on the other: replicates of a plant, plants of a family. What ties with it is "
    "within two standard errors there. Data wasted: mean square error over that of PEM on the same records. Energy over all "
    "experiments and channels, the 1 + pq of Procedure 2 counted one by one.",
    "not_run": "What has no number, and why. An estimator that is made for other records (the iterations' own) is not listed.",
    "below": "rho is at least 1 for unbiased estimators, locally and for large samples. A rho below 1 is chance (see its error), or a "
    "biased estimator whose bias happens to help here; the column remark says which.",
    "shared": "All inputs of a plant meet the same noise, and its noise levels share their draws, only scaled: differences between "
    "inputs, and between levels, are less uncertain than the intervals of either alone suggest.",
    "growth": "The verdict is one of this budget. Of several channels an iteration costs 1 + pq experiments, so that 20 of them are few "
    "iterations. Predicted for long experiments; measured ones are of finite length. Samples and energy beside.",
    "advice": "Which input to apply, by budget: the one that carries most for the peak gain without knowing the plant.",
    "headline": "What every input carries, in shares of the certified optimum, and the estimator that made most of it.",
    "efficiency": "Efficiency is the certified optimal loss over the loss of the information that the inputs carried, both at the "
    "same energy: for the variance of the peak gain, and for D, A and E of all parameters. The information of the first n "
    "experiments is the sum of their informations (Lemma 13).",
    "information": "Efficiencies of the first n experiments together, against certified optima; jackknife standard errors.",
    "pairs": "Inputs against the iterations with the same estimator, estimators against PEM on the same records: mean difference of "
    "rho squared over the same replicates (negative: the first is better), the share of replicates in which the first is closer, "
    "and p-values corrected by Holm over the whole table.",
    "performance": "Performance profiles: share of all problems (plant, noise level, replicate) in which the error is at most so "
    "many times the smallest; failed runs solve nothing. Standard errors are binomial. Budgets are those of a run, the energy in "
    "the mean over the problems.",
    "data": f"Data profiles: share of problems solved to a relative error of {100 * TOLERANCE:g} % by budget, for plants with one "
    "channel and with several apart (those from a whole iteration of Procedure 2 on).",
    "map": "Efficiency for the peak gain of the sinusoid at the peak, of the limit spectrum of the iterations and of white noise, "
    "against a certified optimum, as the problem is varied.",
    "claim_map": "Every case with the gap of its certificate, per sample at unit power.",
    "protocol": "Random FIR plants of length 10 (decay 0.75), 200 experiments of 50 samples, input norm 1, noise of standard "
    "deviation 0.1. The second stage of the printed two-experiment scheme is not normalised, so its energy is its own and stated. "
    "Printed: medians of a re-run of the published protocol on other plants.",
    "head_to_head": "Median relative errors with intervals from order statistics.",
}  # fmt: skip


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
