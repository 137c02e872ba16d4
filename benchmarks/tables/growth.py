"""Efficiency against budget, up to the limit: what the iterations carry after 1, 2, 5, .. experiments, and after all that one could do."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks.campaign.one_part import checkpoints
from benchmarks.campaign.plants import family_of
from benchmarks.campaign.processes import at_once
from benchmarks.tables.tabulation import Tables
from oed.plants.plant import Plant

Row = dict[str, Any]
FARTHEST = 1000
"""Experiments up to which the theory is followed: four of the five rows of theory.md's table are within 4 % of the limit by then."""
NEAR_LIMIT = 0.9
"""Share of the limit that counts as having reached it."""


def growth_of(
    plant: Plant, iterations: str, most: int, optimum: float | None = None
) -> tuple[dict[int, float], float]:
    """By number of experiments, the efficiency that theory predicts for the first so many together; and that
    of the limit. `optimum` is the certified least variance of the peak gain; where it is not given, that of
    white noise."""
    from oed.information import information_of_spectrum
    from oed.plants.norms import gain_gradient, peak
    from oed.theory.efficiency import losses, peak_gain_efficiency_by_experiments
    from oed.theory.limit import limit_spectrum
    from oed.theory.mimo import procedure_2_efficiency

    if iterations != "power":
        each = 1 + plant.n_inputs * plant.n_outputs
        marks = sorted({max(round(k / each), 1) for k in checkpoints(most)})
        values, limit = procedure_2_efficiency(plant, marks, optimum)
        return {each * m: float(v) for m, v in zip(marks, values, strict=True)}, limit
    top = peak(plant)
    values = peak_gain_efficiency_by_experiments(plant, most, optimum)
    if not top.unique:
        return dict(enumerate(values.tolist(), 1)), float("nan")
    together = information_of_spectrum(plant, limit_spectrum(plant).spectrum)
    least = plant.noise_variance if optimum is None else optimum
    limit = least / losses(together, gain_gradient(plant, top)).c
    return dict(enumerate(values.tolist(), 1)), float(limit)


def growth_rows(tables: Tables, answer: Sequence[Row], jobs: int = 1) -> list[Row]:
    """The iterations on every plant, by budget: as measured where the campaign went, as predicted up to the limit."""
    table: list[Row] = []
    place = lambda said: (said["plant"], said["noise_variance"])
    answer = [said for said in answer if place(said) in tables.known and not family_of(said["plant"])]
    targets = [tables.known[place(said)] for said in answer]
    tasks = [partial(growth_of, target.plant, said["iterations"], FARTHEST, target.optimum.c)
             for said, target in zip(answer, targets, strict=True)]  # fmt: skip
    for said, (predicted, limit) in zip(answer, at_once(tasks, jobs), strict=True):
        plant, variance, name = *place(said), said["iterations"]
        here = [r for r in tables.information if (r["plant"], r["noise_variance"]) == (plant, variance)]
        measured = {r["experiments"]: r for r in here if r["method"] == name}
        white = {r["experiments"]: r["c_efficiency"] for r in here if r["method"] == "white"}
        each = min(predicted)
        reached = [k for k, v in predicted.items() if v >= NEAR_LIMIT * limit]
        size = {k: said[k] / said["experiments"] for k in ("samples", "energy")}
        marks = {round(k / each) * each for k in checkpoints(FARTHEST) if k >= each} | set(measured)
        for k in sorted(marks):
            table.append(
                {
                    "plant": plant, "case": said["case"], "channels": said["channels"], "noise_variance": variance,
                    "iterations": name, "experiments": k, "samples": round(k * size["samples"]), "energy": k * size["energy"],
                    **{key: measured.get(k, {}).get(key, float("nan")) for key in ("c_efficiency", "c_efficiency_se")},
                    "predicted": predicted.get(k, float("nan")), "limit": limit,
                    "white": white.get(k, float(np.mean(list(white.values()))) if white else float("nan")),
                    "needed": str(min(reached)) if reached else f"over {FARTHEST}",
                }
            )  # fmt: skip
    return table
