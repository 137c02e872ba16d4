"""What a comparison leaves behind: tables, figures, the page, and the sentences at its top."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.campaign.processes import at_once
from benchmarks.campaign.settings import Settings
from benchmarks.page import figures
from benchmarks.page.comparison_sections import (
    Save,
    answer_section,
    claim_section,
    head_to_head_section,
    profile_section,
)
from benchmarks.page.report import save_figure, save_report, save_table
from benchmarks.tables.answer import answer_rows, answer_sentences
from benchmarks.tables.claim_map import claim_tasks
from benchmarks.tables.columns import BUDGET, COLUMNS, INFORMATION_COLUMNS, is_number, made, save_summary
from benchmarks.tables.formats import format_value, to_markdown
from benchmarks.tables.hair_dryer import hair_dryer_story
from benchmarks.tables.head_to_head import head_to_head_tasks
from benchmarks.tables.statistics import Target
from benchmarks.tables.tabulation import Tables
from oed.theory.efficiency import peak_gain_efficiency_by_experiments

__all__ = ["write_comparison"]

Row = dict[str, Any]
Targets = Mapping[tuple[str, float], Target]
ORACLE = (
    "The input oracle-hinf is the optimum for the gain at a peak whose frequency is known: one sinusoid there. With PEM its rho "
    "is nevertheless large, because the records say nothing about where the peak is: the fitted gain at the true peak "
    "frequency meets the bound, but the norm of the fitted model is its largest gain over all frequencies, which lies above."
)
FIG3_ITERATIONS = 50
FIG3_REPLICATES = 1000
HEAD_TO_HEAD_PLANTS = 40


def write_comparison(
    folder: Path, settings: Settings, replicates: int, tables: Tables, jobs: int = 1
) -> tuple[list[str], Path]:
    """Write tables, figures and the page of a comparison."""
    rows, information, known = tables.rows, tables.information, tables.known
    made_with = made(settings, replicates, folder)
    save = partial(save_table, folder, metadata=made_with)
    answer = answer_rows(tables)
    sentences = answer_sentences(answer, settings)
    details = answers(rows, information, settings)
    siso = [p for p in settings.plants if known[p, settings.noise_variances[0]].plant.n_inputs == 1]
    siso = [p for p in siso if known[p, settings.noise_variances[0]].plant.n_outputs == 1]
    best = headline_rows(rows)
    inputs = {
        "title": "What each input carries, and the estimator that made most of it",
        "text": details,
        "tables": [
            save(
                "headline",
                best,
                HEADLINE,
                f"What {settings.experiments} experiments of {settings.samples} samples carry, in shares of the certified optimum, "
                "and the estimator that made most of them.",
            )
        ],
    }
    tasks: dict[str, Callable[[], Any]] = {
        "comparison": partial(_comparison_section, folder, save, rows, settings, replicates),
        "profiles": partial(profile_section, folder, save, tables),
        "information": partial(_information_section, folder, save, information, known, settings, siso),
    }
    if answer:
        tasks["answer"] = partial(answer_section, folder, save, tables, answer, settings)
    if "hair-dryer" in settings.plants:
        tasks["hair dryer"] = partial(_hair_dryer_section, folder, save)
    tasks |= {
        f"theory of {plant}": partial(_theory_figures, folder, settings, known, plant) for plant in siso
    }
    # The map of the claim is about all plants, so not for a look at one.
    claims = claim_tasks() if len(settings.plants) > 1 and answer else []
    duels = head_to_head_tasks(HEAD_TO_HEAD_PLANTS) if answer else []
    done = iter(at_once([*claims, *tasks.values(), *duels], jobs))
    mapped = [row for rows in islice(done, len(claims)) for row in rows]
    found = dict(zip(tasks, islice(done, len(tasks)), strict=True))
    sections = [inputs, found["comparison"], found["profiles"], found["information"]]
    if answer:
        section, sentence = head_to_head_section(folder, save, list(done))
        sections = [found["answer"], *sections, section]
        sentences.append(sentence)
    if claims:
        sections.append(claim_section(folder, save, mapped))
    theory = [figure for plant in siso for figure in found[f"theory of {plant}"]]
    sections.append({"title": "The theory beside it", "text": [], "tables": [], "figures": theory})
    if "hair dryer" in found:
        sections.append(found["hair dryer"])
    headline = to_markdown(best, HEADLINE)
    sentences = sentences or details
    save_summary(folder, [*sentences, *details], headline)
    content = {
        "title": "Which input is worth applying for the H-infinity norm?",
        "lead": sentences,
        "sections": sections,
        "made": made_with,
    }
    return sentences, save_report(folder, content)


def _comparison_section(
    folder: Path, save: Save, rows: Sequence[Row], settings: Settings, replicates: int
) -> dict[str, Any]:
    """Every input with every estimator."""
    fewer = " or as often as the column runs says" if settings.limits else ""
    return {
        "title": "The comparison",
        "text": [
            f"Every input had {settings.experiments} experiments of {settings.samples} samples at unit power, the same plants and "
            f"the same noise, {replicates} times{fewer}. rho is the root mean square error of the estimated H-infinity norm times the root of "
            "the input energy over the noise variance: no unbiased method gets below 1 (a bound that holds locally and for "
            "large samples). The column predicted is what the Fisher information of the same inputs promises to an efficient estimator.",
            ORACLE,
        ],
        "tables": [
            save(
                "comparison",
                rows,
                COLUMNS,
                "Bias, RMSE and rho, each with its Monte-Carlo standard error.",
            )
        ],
        "figures": [
            save_figure(
                folder,
                "rho",
                figures.rho_figure(rows, settings.plants),
                "rho of every input and estimator (error bars: two standard errors) beside the prediction of the information.",
            )
        ],
    }


def _information_section(
    folder: Path,
    save: Save,
    information: Sequence[Row],
    known: Targets,
    settings: Settings,
    siso: Sequence[str],
) -> dict[str, Any]:
    """Efficiencies against the number of experiments."""
    return {
        "title": "What each input carries",
        "text": [
            "Efficiency is the certified optimal loss over the loss of the information that the inputs carried, both at the same "
            "energy: for the variance of the peak gain, and for D, A and E of all parameters. The information of the first n "
            "experiments is the sum of their informations (Lemma 13).",
        ],
        "tables": [
            save(
                "information",
                information,
                INFORMATION_COLUMNS,
                "Efficiencies of the first n experiments together, against certified optima; jackknife standard errors.",
            )
        ]
        if information  # no run ended: there are no inputs to speak of
        else [],
        "figures": [
            save_figure(
                folder,
                f"efficiency-{plant}",
                figures.efficiency_figure(information, plant, _theory(known, settings, plant)),
                f"{plant}: efficiency against the number of experiments, measured (markers) and predicted (line).",
            )
            for plant in siso
            if any(row["plant"] == plant for row in information)
        ],
    }


HEADLINE = {
    "plant": "plant",
    "noise_variance": "noise",
    "method": "input",
    **BUDGET,
    "c_efficiency": "efficiency, peak gain",
    "d_efficiency": "efficiency, D",
    "best_estimator": "best estimator",
    "rho": "its rho",
    "rho_predicted": "rho predicted",
}


def headline_rows(rows: Sequence[Row]) -> list[Row]:
    """One row per plant, noise and input: what it carries, and its best estimator."""
    table: list[Row] = []
    keys = list(dict.fromkeys((r["plant"], r["noise_variance"], r["method"]) for r in rows))
    for key in keys:
        mine = [r for r in rows if (r["plant"], r["noise_variance"], r["method"]) == key]
        best = min(mine, key=lambda r: r["rho"] if is_number(r["rho"]) else np.inf)
        predicted = next((r["rho_predicted"] for r in mine if is_number(r["rho_predicted"])), float("nan"))
        table.append(best | {"best_estimator": best["estimator"], "rho_predicted": predicted})
    return table


def answers(rows: Sequence[Row], information: Sequence[Row], settings: Settings) -> list[str]:
    """What the numbers say about the claim that the iterations are experiment design."""
    sentences = []
    at = {
        (r["plant"], r["noise_variance"], r["method"]): r
        for r in information
        if r["experiments"] == settings.experiments
    }
    for plant in settings.plants:
        found = []
        for variance in settings.noise_variances:
            power, white = at.get((plant, variance, "power")), at.get((plant, variance, "white"))
            if power and white:
                found.append(
                    (
                        variance,
                        power["c_efficiency"],
                        white["c_efficiency"],
                        power["d_efficiency"],
                        white["d_efficiency"],
                    )
                )
        if found:
            listed = "; ".join(
                f"at noise {v:g}, {100 * c:.1f} % of the optimum for the peak gain (white noise {100 * cw:.1f} %) and "
                f"{100 * d:.1f} % for D (white {100 * dw:.1f} %)"
                for v, c, cw, d, dw in found
            )
            sentences.append(f"{plant}: {settings.experiments} power iterations carry, {listed}.")
    for plant in settings.plants:
        own = [
            r
            for r in rows
            if r["plant"] == plant
            and r["method"] == "power"
            and r["estimator"] == "gain"
            and is_number(r["rho"])
        ]
        pem = {
            r["noise_variance"]: r
            for r in rows
            if r["plant"] == plant and r["method"] == "power" and r["estimator"] == "pem"
        }
        listed = "; ".join(
            f"at noise {r['noise_variance']:g} rho is {format_value(r['rho'], r['rho_se'])} with beta_2 and "
            f"{format_value(pem[r['noise_variance']]['rho'], pem[r['noise_variance']]['rho_se'])} with PEM"
            for r in own
            if r["noise_variance"] in pem and is_number(pem[r["noise_variance"]]["rho"])
        )
        if listed:
            sentences.append(f"{plant}: on the same records of the iterations, {listed}.")
    return sentences


def _theory(known: Targets, settings: Settings, plant: str) -> dict[float, Any]:
    return {
        variance: peak_gain_efficiency_by_experiments(known[plant, variance].plant, settings.experiments)
        for variance in settings.noise_variances
    }


def _theory_figures(folder: Path, settings: Settings, known: Targets, plant: str) -> list[dict[str, Any]]:
    """[S] Fig. 2 and 3 for a plant, and the limit spectra beside the optimal ones."""
    from oed.design import solve_design

    variances = settings.noise_variances
    absolute = [known[plant, v].plant.noise_variance for v in variances]
    base = known[plant, variances[0]].plant
    optima = {
        name: solve_design(base, key).spectrum
        for name, key in (("peak gain", "hinf"), ("D", "D"))
        if key != "hinf" or known[plant, variances[0]].peak.unique
    }
    return [
        save_figure(
            folder,
            f"limit-spectra-{plant}",
            figures.limit_spectrum_figure(base, absolute),
            f"{plant}: magnitude of the plant and limit spectra of the power iterations ([S] Fig. 2).",
        ),
        save_figure(
            folder,
            f"spectra-{plant}",
            figures.spectra_against_optima_figure(base, absolute, optima),
            f"{plant}: where the power lies, iterations against optimal inputs (cumulative, since lines have no density).",
        ),
        _estimated_gain(folder, settings, known, plant),
    ]


def _estimated_gain(folder: Path, settings: Settings, known: Targets, plant: str) -> dict[str, Any]:
    """[S] Fig. 3 for a plant."""
    from estimators.montecarlo.engine import monte_carlo
    from estimators.norm.gains import gain
    from estimators.rules.power import power_iterations
    from estimators.rules.trace import run
    from oed.experiments import simulated
    from oed.theory.finite import finite_norm

    plants = {v: known[plant, v].plant for v in settings.noise_variances}
    size: dict[str, Any] = {
        "samples": settings.samples,
        "iterations": FIG3_ITERATIONS,
        "replicates": FIG3_REPLICATES,
        "seed": settings.seed,
    }
    means = {v: monte_carlo(p, **size).mean["gain"] for v, p in plants.items()}
    loudest = max(plants)
    trace = run(
        power_iterations,
        simulated(plants[loudest], seed=settings.seed),
        samples=settings.samples,
        experiments=FIG3_ITERATIONS,
        rng=np.random.default_rng(settings.seed),
    )
    figure = figures.estimated_gain_figure(
        means, gain(trace).values, loudest, finite_norm(plants[loudest], settings.samples), FIG3_REPLICATES
    )
    return save_figure(
        folder,
        f"estimated-gain-{plant}",
        figure,
        f"{plant}: estimated gain beta_2 during the iterations ([S] Fig. 3), {FIG3_REPLICATES} runs of {settings.samples} "
        "samples; runs whose square is negative are left out of that iteration's mean.",
    )


def _hair_dryer_section(folder: Path, save: Any) -> dict[str, Any]:
    story = hair_dryer_story()
    return {
        "title": "The loop closed on a real record: the hair dryer",
        "text": story.sentences,
        "tables": [
            save(
                "hair_dryer",
                story.rows,
                {
                    "model": "model",
                    "delay": "nk",
                    "simulation_rmse": "simulation error (V)",
                    "one_step_rmse": "one-step error (V)",
                    "fit_percent": "fit of the simulation (%)",
                    "smallest_p_value": "p, input-residual lags 1-10",
                },
                "Errors on the second half of the record, which no model has seen.",
            )
        ],
        "figures": [
            save_figure(
                folder,
                "hair-dryer",
                figures.hair_dryer_figure(story),
                "Left: correlation of input and residual before and after the delay was added. Right: simulation on the second half.",
            )
        ],
    }
