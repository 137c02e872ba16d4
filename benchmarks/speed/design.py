"""Speed of optimal design on a frequency grid: column generation with Newton against CVXPY with Clarabel, in turn.

Both start from the same scaled columns, both must reach a certified relative gap of 1e-6. CVXPY builds, compiles
and solves its problem in every call, as a user's script would; its tolerances are Clarabel's defaults (1e-8)."""

from typing import Any

import numpy as np

from benchmarks.tables.timings import in_turn, speed_row

GAP = 1e-6


def _problem(parameters: int, frequencies: int, criterion: str) -> Any:
    from oed.criteria import Criterion
    from oed.design import information_map
    from oed.design.problem.budgets import power_budgets
    from oed.design.problem.criteria_by_name import criterion_of
    from oed.design.problem.lines import Problem
    from oed.plants.named import named_plant

    plant = named_plant("reference" if parameters == 4 else "order-20")
    if parameters != 4:
        plant = plant.replace(free=plant.all_names[-parameters:])
    information = information_map(plant)
    wanted: Criterion = criterion_of(criterion, plant, information)
    omega = (np.arange(frequencies) + 0.5) * np.pi / frequencies
    return Problem(information, wanted, power_budgets(information, 1.0), omega)


def _all_columns(problem: Any) -> Any:
    return problem.columns(problem.omega, np.ones((len(problem.omega), 1), dtype=complex))


def against_cvxpy(criterion: str, parameters: int, frequencies: int, target: float, repeats: int = 5) -> dict:
    """One criterion on one grid: ours against CVXPY with Clarabel."""
    from oed.design.solvers.column_generation import evaluated_bound, exchange
    from oed.design.solvers.whole_grid import cvxpy_weights

    problem = _problem(parameters, frequencies, criterion)
    columns = _all_columns(problem)
    (seconds, found), (other, weights) = in_turn(
        lambda: exchange(problem, refine=False, tolerance=GAP),
        lambda: cvxpy_weights(columns, problem.criterion, problem.constant, 1e-8),
        rounds=repeats,
    )
    w = weights.w / (columns.q.T @ weights.w).max()
    bound = evaluated_bound(problem, weights.X, weights.nu, refine=False)[0]
    gap = problem.loss(columns, w) / bound - 1
    return speed_row(
        f"{criterion} design", f"{parameters} parameters, {frequencies} frequencies", seconds, "CVXPY, Clarabel", other,
        target, same=found.gap <= GAP, note=f"gap {found.gap:.1e}, baseline's {gap:.1e}",
    )  # fmt: skip


def elfving_dual(repeats: int = 5) -> dict:
    """The peak-gain design's dual on 1000 frequencies: at most 0.6 of CVXPY's D design (15 ms where that
    takes 25)."""
    from oed.design.solvers.column_generation import exchange
    from oed.design.solvers.weights_clarabel import elfving
    from oed.design.solvers.whole_grid import cvxpy_weights

    peak, D = _problem(4, 1000, "hinf"), _problem(4, 1000, "D")
    columns = _all_columns(D)

    dual = lambda p, columns, start, accuracy: elfving(columns, p.criterion, p.constant, tolerance=1e-9)
    (seconds, found), (other, _) = in_turn(
        lambda: exchange(peak, master=dual, refine=False, tolerance=GAP),
        lambda: cvxpy_weights(columns, D.criterion, D.constant, 1e-8), rounds=repeats,
    )  # fmt: skip
    return speed_row(
        "hinf design by the dual cone", "4 parameters, 1000 frequencies", seconds, "CVXPY, Clarabel, D design", other,
        25 / 15, same=found.gap <= GAP, note=f"gap {found.gap:.1e}",
    )  # fmt: skip


def rows(repeats: int = 5) -> list[dict]:
    """All rows of the design benchmarks."""
    few = max(1, repeats // 2)
    return [
        against_cvxpy("D", 4, 10_000, 30, repeats),
        against_cvxpy("A", 4, 10_000, 30, repeats),
        against_cvxpy("D", 40, 100, 20, repeats),
        against_cvxpy("D", 40, 1000, 5, few),
        elfving_dual(repeats),
    ]
