"""The head-to-head of Tu, Boczar and Recht (2018) as the report shows it: medians with intervals, at stated budgets."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks.reproductions.head_to_head import CASES, plants, traces
from oed.plants.norms import peak
from oed.plants.plant import Plant


def median_interval(values: Sequence[float], level: float = 0.95) -> tuple[float, float]:
    """Interval of a median from order statistics, whatever the distribution."""
    from scipy import stats

    ordered = np.sort(np.asarray(values, dtype=float))
    n = len(ordered)
    # P(fewer than `rank` below the median) <= (1 - level) / 2
    rank = int(stats.binom.ppf((1 - level) / 2, n, 0.5))
    return float(ordered[max(rank - 1, 0)]), float(ordered[min(n - rank, n - 1)])


def head_to_head_tasks(count: int) -> list[Callable[[], Any]]:
    """The runs of the protocol on random FIR plants of length 10: 200 experiments of 50 samples, noise 0.1."""
    return [partial(_errors_on, plant) for plant in plants(count)]


def head_to_head_rows(found: Sequence[Any]) -> list[dict[str, Any]]:
    """Every way of the protocol."""
    table = []
    for k, case in enumerate(CASES):
        values = np.array([errors[k] for errors, _ in found])
        # A run without a number has an infinite error: it counts in the median, and is counted beside it.
        values = np.where(np.isfinite(values), values, np.inf)
        low, high = median_interval(list(values))
        spent = found[-1][1][case.method]
        table.append(
            {"name": case.name, "samples": spent.samples, "experiments": spent.experiments, "energy": spent.energy,
             "peak_amplitude": spent.peak, "median": float(np.median(values)), "low": low, "high": high,
             "published": case.published, "in_print": case.in_print, "n": len(values),
             "n_failed": int(np.sum(~np.isfinite(values)))}
        )  # fmt: skip
    return sorted(table, key=lambda row: row["median"])


def _errors_on(plant: Plant) -> tuple[list[float], dict[str, Any]]:
    """The relative error of every case on one plant, and what each method used."""
    gamma, found = peak(plant).value, traces(plant)
    errors = [abs(case.estimate(found[case.method]) / gamma - 1) for case in CASES]
    return errors, {method: trace.usage for method, trace in found.items()}


def head_to_head_sentence(rows: Sequence[dict[str, Any]]) -> str:
    """What the head-to-head says."""
    by_name = {row["name"]: row for row in rows}
    say = lambda name: (
        f"{100 * by_name[name]['median']:.2g} % ({100 * by_name[name]['low']:.2g} to {100 * by_name[name]['high']:.2g})"
    )
    return (
        f"Head-to-head on {rows[0]['n']} random FIR plants: the power iterations' own estimate misses by "
        f"{say('power iterations, their own estimate')} in the median, plug-in by {say('plug-in, impulses, 10 taps')}; not in "
        f"print: the same records of the iterations by least squares miss by {say('records of the power iterations, 10 taps')} "
        f"with the length known, {say('records of the power iterations, taps selected')} with it selected from the records and "
        f"{say('records of the power iterations, 49 taps')} with 49 taps."
    )
