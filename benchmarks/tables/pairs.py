"""Paired comparisons: two ways to the same number on the same plants and noise, corrected for how many there are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.campaign.part import Estimates
from benchmarks.campaign.registry import told

__all__ = ["holm", "paired_rows"]

Row = dict[str, Any]
Solver = tuple[str, str]


def holm(p_values: Sequence[float]) -> NDArray[np.float64]:
    """P-values corrected for multiplicity by Holm's step-down rule."""
    p = np.asarray(p_values, dtype=float)
    corrected = np.full(p.shape, np.nan)
    known = np.flatnonzero(np.isfinite(p))
    order = known[np.argsort(p[known], kind="stable")]
    weights = len(order) - np.arange(len(order))
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(p[order] * weights))
    return corrected


def paired_rows(solvers: Mapping[Solver, Estimates], gamma: float, scale: float) -> list[Row]:
    """Differences of squared errors between ways to the norm of one plant at one noise level, replicate by
    replicate.

    Shapes: solvers (input, estimator).
    """
    rows = []
    for question, first, second in _questions(list(solvers)):
        a, b = solvers[first], solvers[second]
        rows.append(
            {
                "question": question,
                "method": first[0],
                "estimator": first[1],
                "against_method": second[0],
                "against_estimator": second[1],
                "known": told(*first).value,
                "against_known": told(*second).value,
                **a.spent,
                **{f"against_{name}": value for name, value in b.spent.items()},
                **_difference(a, b, gamma, scale),
            }
        )
    return rows


def _questions(solvers: Sequence[Solver]) -> list[tuple[str, Solver, Solver]]:
    """Every input against the iterations at the same estimator; every estimator against PEM on the same input."""
    methods = list(dict.fromkeys(m for m, _ in solvers))
    estimators = list(dict.fromkeys(e for _, e in solvers))
    base = next((m for m in ("power", "procedure-2", "two-experiment") if m in methods), methods[0])
    best = "pem" if "pem" in estimators else estimators[0]
    found = [("input", s, (base, s[1])) for s in solvers if s[0] != base and (base, s[1]) in solvers]
    found += [("estimator", s, (s[0], best)) for s in solvers if s[1] != best and (s[0], best) in solvers]
    return found


def _difference(a: Estimates, b: Estimates, gamma: float, scale: float) -> Row:
    from scipy import stats

    _, i, j = np.intersect1d(a.replicate[a.good], b.replicate[b.good], return_indices=True)
    one, two = ((x.estimate[x.good][k] - gamma) ** 2 * scale for x, k in ((a, i), (b, j)))
    difference = one - two
    n = len(difference)
    closer = float(np.mean(one < two)) if n else float("nan")
    row: Row = {"rho2_difference": float("nan"), "rho2_difference_se": float("nan"), "closer": closer, "n": n}
    row |= {"closer_se": float("nan"), "p_value": float("nan")}
    if n < 2:
        return row
    se = float(difference.std(ddof=1) / np.sqrt(n))
    shrunk = (closer * n + 2) / (n + 4)
    row |= {"rho2_difference": float(difference.mean()), "rho2_difference_se": se}
    row["closer_se"] = float(np.sqrt(shrunk * (1 - shrunk) / (n + 4)))
    row["p_value"] = float(2 * stats.t.sf(abs(difference.mean()) / se, n - 1)) if se > 0 else 1.0
    return row
