"""The page of a comparison: the answer plant by noise, what to do, and every table and figure behind it."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.campaign.one_part import parts
from benchmarks.campaign.plants import family_of
from benchmarks.campaign.processes import at_once
from benchmarks.campaign.registry import words_of
from benchmarks.campaign.settings import Settings
from benchmarks.page import comparison_figures as figures
from benchmarks.page.comparison_words import advice_sentences, short_answer
from benchmarks.page.content import Figure, Page, Section, Table
from benchmarks.page.skeleton import save_page
from benchmarks.tables.answer import advice_rows, answer_rows, answer_sentences
from benchmarks.tables.columns import SAID, TEXTS, headings, is_number, made, not_run_rows, save_summary
from benchmarks.tables.formats import to_markdown
from benchmarks.tables.growth import growth_rows
from benchmarks.tables.hair_dryer import hair_dryer_story
from benchmarks.tables.head_to_head import head_to_head_rows, head_to_head_sentence, head_to_head_tasks
from benchmarks.tables.predictions import claim_tasks
from benchmarks.tables.profiles import TOLERANCE
from benchmarks.tables.statistics import Target
from benchmarks.tables.tabulation import Tables
from oed.theory.efficiency import peak_gain_efficiency_by_experiments

Row = dict[str, Any]
Targets = Mapping[tuple[str, float], Target]
FIG3_ITERATIONS = 50
FIG3_REPLICATES = 1000
HEAD_TO_HEAD_PLANTS = 40
CLAIM = "Are power iterations optimal experiment design for the H-infinity norm?"
FILTERS = {"plant": "plant", "noise_variance": "noise", "method": "input", "known": "what is known"}


def write_comparison(
    folder: Path, settings: Settings, replicates: int, tables: Tables, jobs: int = 1,
    tell: Callable[[list[str]], None] = lambda words: None,
) -> tuple[list[str], Path]:  # fmt: skip
    """Write tables, figures and the page of a comparison; `tell` hears what the runs say before anything is drawn."""
    known = tables.known
    answer = answer_rows(tables)
    # Of a family's plants the page shows what they give together, where iterations give it; tables/ has every one of them.
    information, rows, pairs = (
        [r for r in table if not answer or not family_of(r["plant"])]
        for table in (tables.information, tables.rows, tables.pairs)
    )
    best, sentences = headline_rows(rows), answer_sentences(answer, settings)
    short = short_answer(answer, best, settings)
    tell(list(sentences or [short]))
    siso = [
        p
        for p in settings.plants
        if not family_of(p) and known[p, settings.noise_variances[0]].channels == "1 x 1"
    ]
    tasks: dict[str, Callable[[], Any]] = {
        f"theory of {p}": partial(_theory, settings, known, p) for p in siso
    }
    if "hair-dryer" in settings.plants:
        tasks["hair dryer"] = hair_dryer_story
    # The map of the claim is about all plants, so not for a look at one.
    claims = claim_tasks() if len(settings.plants) > 1 and answer else []
    duels = head_to_head_tasks(HEAD_TO_HEAD_PLANTS) if answer else []
    done = iter(at_once([*claims, *tasks.values(), *duels], jobs))
    mapped = [row for found in islice(done, len(claims)) for row in found]
    found = dict(zip(tasks, islice(done, len(tasks)), strict=True))
    sections = [*_answer(tables, answer, jobs), *_inputs(best), *_comparison(rows, settings, replicates),
                *_profiles(tables, pairs), *_information(information, known, settings, siso)]  # fmt: skip
    if answer:
        head = head_to_head_rows(list(done))
        sentences.append(head_to_head_sentence(head))
        sections.append(Section("The public head-to-head, settled", [sentences[-1], TEXTS["protocol"]],
                                shown("head_to_head", head), [figures.head_to_head_figure(head)]))  # fmt: skip
    if claims:
        sections.append(Section("In theory: the map of the claim", [TEXTS["map"]], shown("claim_map", mapped),
                                [figures.claim_figure(mapped)]))  # fmt: skip
    theory = [figure for p in siso for figure in found[f"theory of {p}"]]
    sections += [Section("The theory beside it", figures=theory)] if theory else []
    sections += [_hair_dryer(found["hair dryer"])] if "hair dryer" in found else []
    words = sentences or [short]
    sections.append(Section("In words", words))
    save_summary(folder, words, to_markdown(best, headings("headline")))
    families = [row for row in answer if row["plant"] != row["case"]]
    used = [*settings.methods, *settings.estimators]
    page = Page(
        "comparison", CLAIM if answer else "Which input is worth applying for the H-infinity norm?", short,
        [f"At most {replicates} runs (every row says how many) of {settings.experiments} experiments of {settings.samples} samples each, everything on the same "
         "plants and the same noise; every value has its Monte-Carlo standard error, every optimum its certificate.",
         *([f"Of the {len(answer)} cases {len(families)} are families of random plants: in the table of the answer, not in the matrix."]
           if families else []),
         "Differences are tested in pairs and corrected for how many there are (Holm): see 'Who is better, and is it chance?'."],
        advice_sentences(answer, best), sections=sections, made=made(settings, replicates, folder), filters=FILTERS,
        matrix="headline" if information else "", repeat=_repeat(settings, replicates), runs=_runs(settings, replicates),
        names={name: text for name in used if (text := words_of(name))},
    )  # fmt: skip
    return words, save_page(folder, page, static=True, jobs=jobs)


def _repeat(settings: Settings, replicates: int) -> dict[str, str]:
    rest = ["--samples", settings.samples, "--experiments", settings.experiments, "--replicates", replicates,
            "--profile-replicates", settings.profile_replicates, "--seed", settings.seed, "--out", "results/again"]  # fmt: skip
    return {
        "estimators": shlex.join(["--estimators", *settings.estimators]),
        "rest": shlex.join(map(str, rest)),
    }


def _runs(settings: Settings, replicates: int) -> dict[str, str]:
    """By plant, noise and input, the file of the first part, with a star for the others."""
    found: dict[str, str] = {}
    for part in parts(settings, replicates):
        if family_of(part.plant):  # no row of the page is one of its plants
            continue
        name = part.key.rsplit("-", 2)[0]
        found[f"{part.plant}|{part.noise_variance:g}|{part.method}"] = f"parts/{name}-*.parquet"
    return found


def shown(name: str, rows: Sequence[Row]) -> list[Table]:
    """A table of `columns.toml`, where it has rows."""
    own = SAID["tables"][name]
    caption = own["caption"].format(tolerance=100 * TOLERANCE)
    return (
        [Table(name, caption, headings(name), rows, own.get("shade", ()), own.get("repeat", False))]
        if rows
        else []
    )


def _answer(tables: Tables, rows: list[Row], jobs: int) -> list[Section]:
    if not rows:
        return []
    growth = growth_rows(tables, rows, jobs)
    by_budget = [Section("By budget, up to the limit", [TEXTS["growth"]], shown("growth", growth),
                         [figures.growth_figure(growth)])] if growth else []  # fmt: skip
    return [
        Section(
            "The answer to [S] Sec. 4.2: are the iterations optimal experiment design?",
            [TEXTS["below"], TEXTS["shared"]],
            [*shown("answer", rows), *shown("advice", advice_rows(tables))],
            [figures.where_figure(rows), figures.advice_figure(rows)],
        ),
        *by_budget,
    ]


def _inputs(best: list[Row]) -> list[Section]:
    title = "What each input carries, and the estimator that made most of it"
    return [Section(title, [], shown("headline", best))]


def _comparison(rows: list[Row], settings: Settings, replicates: int) -> list[Section]:
    fewer = " or as often as the column runs says" if settings.limits else ""
    text = [TEXTS["budget"].format(s=settings, replicates=replicates, fewer=fewer), TEXTS["oracle"]]
    saved = [*shown("comparison", rows), *shown("not_run", not_run_rows(settings, replicates))]
    return [Section("The comparison", text, saved, [figures.rho_figure(rows)])]


def _profiles(tables: Tables, pairs: list[Row]) -> list[Section]:
    saved = [
        *shown("pairs", pairs),
        *shown("performance", _summary(tables.performance)),
        *shown("data_profiles", tables.data),
    ]
    drawn = figures.profile_figures(tables.performance, tables.data) if tables.performance else []
    return [Section("Who is better, and is it chance?", [], saved, [f for f in drawn if f.rows])]


def _summary(performance: Sequence[Row]) -> list[Row]:
    """The performance profiles at a few ratios, one row per solver."""
    wanted = {1.0: "within_1", 2.0: "within_2", 10.0: "within_10"}
    rows: dict[tuple[str, str], Row] = {}
    for r in performance:
        name = wanted.get(r["ratio"])
        if name:
            row = rows.setdefault(
                (r["method"], r["estimator"]), {key: r[key] for key in headings("performance") if key in r}
            )
            row |= {name: r["share"], f"{name}_se": (r["high"] - r["low"]) / (2 * 1.96), "n": r["n"]}
    return sorted(rows.values(), key=lambda row: -row["within_2"])


def _information(
    information: list[Row], known: Targets, settings: Settings, siso: Sequence[str]
) -> list[Section]:
    """Efficiencies against the number of experiments."""
    if not information:  # no run ended: there are no inputs to speak of
        return []
    predicted = lambda plant: {
        v: peak_gain_efficiency_by_experiments(
            known[plant, v].plant, settings.experiments, known[plant, v].optimum.c) for v in settings.noise_variances
    } if "power" in settings.methods else {}  # fmt: skip
    drawn = [figures.efficiency_figure(information, plant, predicted(plant))
             for plant in siso if any(row["plant"] == plant for row in information)]  # fmt: skip
    carried = shown("information", information)
    return [Section("What each input carries, by budget", [TEXTS["efficiency"]], carried, drawn)]


def headline_rows(rows: Sequence[Row]) -> list[Row]:
    """One row per plant, noise and input: what it carries, and its best estimator."""
    table: list[Row] = []
    keys = list(dict.fromkeys((r["plant"], r["noise_variance"], r["method"]) for r in rows))
    for key in keys:
        mine = [r for r in rows if (r["plant"], r["noise_variance"], r["method"]) == key]
        best = min(mine, key=lambda r: r["rho"] if is_number(r["rho"]) else np.inf)
        predicted = next((r["rho_predicted"] for r in mine if is_number(r["rho_predicted"])), float("nan"))
        more = {"best_estimator": best["estimator"], "rho_predicted": predicted}
        table.append({k: v for k, v in best.items() if k != "estimator"} | more)
    return table


def _theory(settings: Settings, known: Targets, plant: str) -> list[Figure]:
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
    return [*figures.limit_spectrum_figures(base, plant, absolute), figures.spectra_figure(base, plant, absolute, optima),
            _estimated_gain(settings, known, plant)]  # fmt: skip


def _estimated_gain(settings: Settings, known: Targets, plant: str) -> Figure:
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
    rng, noisy = np.random.default_rng(settings.seed), simulated(plants[loudest], seed=settings.seed)
    trace = run(power_iterations, noisy, samples=settings.samples, experiments=FIG3_ITERATIONS, rng=rng)
    norm = finite_norm(plants[loudest], settings.samples)
    return figures.estimated_gain_figure(plant, means, gain(trace).values, loudest, norm,
                                         f"{FIG3_REPLICATES} runs of {settings.samples} samples")  # fmt: skip


def _hair_dryer(story: Any) -> Section:
    title = "The loop closed on a real record: the hair dryer"
    return Section(title, story.sentences, shown("hair_dryer", story.rows), figures.hair_dryer_figures(story))
