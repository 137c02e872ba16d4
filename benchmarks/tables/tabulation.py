"""From a store to all tables, one combination in memory at a time."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.campaign.one_part import profile_replicates
from benchmarks.campaign.plants import family_of
from benchmarks.campaign.registry import Told, of_the_iterations, told
from benchmarks.campaign.run_columns import Estimates, Runs
from benchmarks.campaign.settings import Settings
from benchmarks.tables.pairs import Errors, chosen_and_judged, errors_of, holm, paired_rows, ratio_of_means
from benchmarks.tables.profiles import Profiles
from benchmarks.tables.statistics import Target, comparison_rows, information_rows, targets

Row = dict[str, Any]
LEAST = 30
"""Replicates below which a solver is left out of the performance profiles, where others have more."""


@dataclass(frozen=True, eq=False)
class Tables:
    """All tables of a comparison. `rows` the comparison: one row per plant, noise variance, input and
    estimator; `information` what the inputs carry, by number of experiments; `pairs` paired differences, with
    p-values corrected over the whole table; `performance, data` profiles; `known` (plant, noise variance) to
    Target; `judged` (case, noise variance) to the best ways of each kind, where a case is a plant or a family
    of random ones."""

    rows: list[Row]
    information: list[Row] = field(repr=False)
    pairs: list[Row] = field(repr=False)
    performance: list[Row] = field(repr=False)
    data: list[Row] = field(repr=False)
    known: dict[tuple[str, float], Target] = field(repr=False)
    judged: dict[tuple[str, float], Row] = field(default_factory=dict, repr=False)


def tabulate(runs: Iterable[Runs], settings: Settings, jobs: int = 1) -> Tables:
    """Tables of a campaign."""
    known = targets([(p, v) for p in settings.plants for v in settings.noise_variances], jobs)
    rows: list[Row] = []
    information: list[Row] = []
    pairs: list[Row] = []
    profiles = Profiles()
    solvers: dict[tuple[str, str], Estimates] = {}
    scale = {}
    current: tuple[str, float] | None = None
    errors: dict[tuple[str, float], dict[tuple[str, str], dict[int, float]]] = {}

    def close() -> None:
        if current is None or not solvers:
            return
        gamma, variance = known[current].gamma, known[current].plant.noise_variance
        family = family_of(current[0])
        ways = errors.setdefault((family or current[0], current[1]), {})
        for way, found in solvers.items():
            mine = errors_of(found, gamma, variance)
            if family:
                finite = [v for v in mine.values() if np.isfinite(v)]
                mean = float(np.sqrt(np.mean(np.square(finite)))) if finite else np.inf
                mine = {int(current[0].rpartition("-")[2]): mean}
            ways.setdefault(way, {}).update(mine)
        head = {"plant": current[0], "noise_variance": current[1]}
        pairs.extend(head | row for row in paired_rows(solvers, gamma, scale[current]))
        most = max(len(found) for found in solvers.values())
        profiles.least = min(LEAST, most)
        profiles.add(solvers, gamma, known[current].channels)
        solvers.clear()

    for combination in runs:
        key = combination.plant, combination.noise_variance
        if key != current:
            close()
            current = key
        target = known[key]
        carried = information_rows(combination, target)
        mine = comparison_rows(combination, carried, target)
        information += carried
        rows += mine
        energies = [row["energy"] for row in mine if np.isfinite(row["energy"])]
        if energies:
            scale.setdefault(key, max(energies) / target.plant.noise_variance)
        scale.setdefault(key, float("nan"))
        for estimator, found in combination.final.items():
            solvers[combination.method, estimator] = found
        profiled = profile_replicates(settings, target.plant)
        whole = [((e, found.spent["experiments"]), found) for e, found in combination.final.items()]
        for (estimator, experiments), found in [*combination.earlier.items(), *whole]:
            if profiled and experiments:
                key = (combination.method, estimator, target.channels, experiments)
                profiles.add_budget(key, found, target.gamma, profiled)
    close()
    for row, corrected in zip(pairs, holm([row["p_value"] for row in pairs]), strict=True):
        row["p_holm"] = float(corrected)
        row["differs"] = bool(corrected <= 0.05)
    judged = {case: judged_ways(ways) for case, ways in errors.items()}
    return Tables(rows, information, pairs, profiles.performance_rows(), profiles.data_rows(), known, judged)


KINDS = {
    "structure": lambda method, estimator: told(method, estimator) is not Told.PLANT,
    "nothing": lambda method, estimator: told(method, estimator) is Told.NOTHING,
    "own": of_the_iterations,
}
"""What is compared in the answer: whoever knows the structure, whoever knows nothing, the iterations with their own estimator."""
PRINTED = "gain"
"""The iterations' estimator as it is printed, [S] (7)."""


def judged_ways(ways: Mapping[tuple[str, str], Errors]) -> Row:
    """The best way of every kind, chosen on one half and judged on the other, and the data that the iterations' estimators
    waste: their mean square error over that of PEM on the same records."""
    row: Row = {}
    for kind, belongs in KINDS.items():
        found = chosen_and_judged({way: mine for way, mine in ways.items() if belongs(*way)})
        row |= {f"{kind}_{key}": found[key] for key in ("input", "estimator", "ties", "n")}
        row |= {f"rho_{kind}": found["rho"], f"rho_{kind}_se": found["rho_se"]}
    method = row["own_input"]
    for name, estimator in (("waste", PRINTED), ("waste_own", row["own_estimator"])):
        row[name], row[f"{name}_se"] = ratio_of_means(
            ways.get((method, estimator), {}), ways.get((method, "pem"), {})
        )
    return row
