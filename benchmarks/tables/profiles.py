"""Performance profiles (Dolan and More) and data profiles (More and Wild) over all plants, noise levels and replicates.

A problem is one plant at one noise level in one replicate; a solver is an input with an estimator. A run that failed has
solved nothing."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.campaign.registry import told
from benchmarks.campaign.run_columns import Estimates

Row = dict[str, Any]
Solver = tuple[str, str]

RATIOS = np.unique(np.concatenate([np.round(np.geomspace(1, 1000, 31), 6), [2.0, 5.0]]))
"""How many times the smallest error of a problem counts as solved."""
TOLERANCE = 0.05
"""Relative error that a data profile counts as solved."""


def wilson(solved: float, n: float, z: float = 1.96) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    if n <= 0:
        return float("nan"), float("nan")
    p = solved / n
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    return float(max(0.0, middle - half)), float(min(1.0, middle + half))


def _errors(found: Estimates, gamma: float, replicates: int) -> NDArray[np.float64]:
    """Relative errors of the first replicates, infinite where there is no number."""
    errors = np.full(replicates, np.inf)
    at = found.replicate.astype(int)
    kept = found.good & (at < replicates)
    errors[at[kept]] = np.abs(found.estimate[kept] / gamma - 1)
    return errors


@dataclass
class Profiles:
    """Counts that grow by one plant and noise level at a time, so that memory does not grow with the
    problems. `solved` solver to the (33,) numbers of problems solved within each of RATIOS of the best;
    `problems` solver to the number of problems it met; `spent` solver to what it spent: sums of energy over
    the problems, largest of all else, and the channels met; `by_budget` (input, estimator, channels,
    experiments) to [samples, sum of energies, peak amplitude, solved, problems]; `least` solvers with fewer
    replicates of a plant are left out there, and all others count up to the fewest of theirs."""

    solved: dict[Solver, NDArray[np.float64]] = field(default_factory=dict)
    problems: dict[Solver, int] = field(default_factory=dict)
    spent: dict[Solver, Row] = field(default_factory=dict)
    by_budget: dict[tuple[str, str, str, int], list[float]] = field(default_factory=dict)
    least: int = 1

    def add(self, solvers: Mapping[Solver, Estimates], gamma: float, channels: str) -> None:
        """Add the problems of one plant at one noise level: solvers (input, estimator)."""
        solvers = {solver: found for solver, found in solvers.items() if len(found) >= self.least}
        if not solvers:
            return
        replicates = int(min(len(found) for found in solvers.values()))
        errors = {solver: _errors(found, gamma, replicates) for solver, found in solvers.items()}
        best = np.maximum(np.min(list(errors.values()), axis=0), 1e-12)  # the last digits decide nothing
        solvable = np.isfinite(best)
        for solver, mine in errors.items():
            ratio = np.maximum(mine, 1e-12)[solvable] / best[solvable]
            counts = np.array([np.sum(ratio <= tau) for tau in RATIOS], dtype=float)
            self.solved[solver] = self.solved.get(solver, np.zeros(len(RATIOS))) + counts
            self.problems[solver] = self.problems.get(solver, 0) + replicates
            self._add_spent(solver, solvers[solver].spent, channels, replicates)

    def _add_spent(self, solver: Solver, spent: Row, channels: str, replicates: int) -> None:
        row = self.spent.setdefault(
            solver, {"channels": [], "samples": 0, "experiments": 0, "energy": 0.0, "peak_amplitude": 0.0}
        )
        if channels not in row["channels"]:
            row["channels"].append(channels)
        row["energy"] += replicates * spent["energy"]
        for name in ("samples", "experiments", "peak_amplitude"):
            row[name] = max(row[name], spent[name])

    def add_budget(
        self, key: tuple[str, str, str, int], found: Estimates, gamma: float, replicates: int
    ) -> None:
        """Add the estimates of one solver after a part of the budget."""
        replicates, spent = min(replicates, len(found)), found.spent
        row = self.by_budget.setdefault(key, [0.0] * 5)
        row[0] = max(row[0], spent["samples"])
        row[1] += replicates * spent["energy"]
        row[2] = max(row[2], spent["peak_amplitude"])
        row[3] += float(np.sum(_errors(found, gamma, replicates) <= TOLERANCE))
        row[4] += replicates

    def performance_rows(self) -> list[Row]:
        """The performance profiles."""
        rows = []
        for (method, estimator), counts in self.solved.items():
            n = self.problems[method, estimator]
            spent = self.spent[method, estimator]
            spent = spent | {"channels": ", ".join(spent["channels"]), "energy": spent["energy"] / n}
            for ratio, solved in zip(RATIOS, counts, strict=True):
                low, high = wilson(solved, n)
                rows.append(
                    {"method": method, "estimator": estimator, "known": told(method, estimator).value, **spent, "ratio": float(ratio),
                     "share": solved / n, "low": low, "high": high, "n": n}
                )  # fmt: skip
        return rows

    def data_rows(self) -> list[Row]:
        """The data profiles."""
        rows = []
        for (method, estimator, channels, experiments), counted in sorted(self.by_budget.items()):
            samples, energy, amplitude, solved, n = counted
            low, high = wilson(solved, n)
            rows.append(
                {"method": method, "estimator": estimator, "known": told(method, estimator).value, "channels": channels, "experiments": experiments,
                 "samples": int(samples), "energy": energy / n if n else float("nan"), "peak_amplitude": amplitude,
                 "share": solved / n if n else float("nan"), "low": low, "high": high, "n": int(n)}
            )  # fmt: skip
        return rows
