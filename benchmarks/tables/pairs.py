"""Paired comparisons of ways to the same number on the same plants and noise, and the best way without optimism.

The smallest of many noisy errors is too small. So the best way is chosen on the problems of even number (replicates of a
plant, or plants of a family), and its error is that on the problems of odd number, where nothing was chosen; ways whose error
there is not larger by two standard errors of the paired difference tie with it. Against an earlier comparison nothing is
paired: what is better or worse is said under Holm's rule."""

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.campaign.registry import told
from benchmarks.campaign.run_columns import Estimates
from benchmarks.campaign.settings import Settings
from benchmarks.tables.statistics import error_of_squares, rms_with_error
from oed.errors import InputError

Row = dict[str, Any]
Solver = tuple[str, str]
Errors = Mapping[int, float]
"""By number of the problem the error times sqrt(energy / noise variance), whose root mean square is rho; infinite where a run
failed."""
HALF = 3
"""Problems that either half must have: fewer have no standard error worth the name."""
FAILED = 0.05
"""Share of failed runs from which on a way is none that one would recommend."""
MOST_TIES = 3
"""Ways that a cell names as ties, those of least error; it counts the others."""
TIED = 2.0
"""Standard errors of the paired difference up to which two ways tie."""


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
    replicate: solvers (input, estimator)."""
    rows = []
    for question, first, second in _questions(list(solvers)):
        a, b = solvers[first], solvers[second]
        rows.append(
            {
                "question": question, "method": first[0], "estimator": first[1], "against_method": second[0],
                "against_estimator": second[1], "known": told(*first).value, "against_known": told(*second).value,
                **a.spent, **{f"against_{name}": value for name, value in b.spent.items()},
                **_difference(a, b, gamma, scale),
            }
        )  # fmt: skip
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
    both = np.stack([(x.estimate[x.good][k] - gamma) * np.sqrt(scale) for x, k in ((a, i), (b, j))])
    difference = both[0] ** 2 - both[1] ** 2
    n = len(difference)
    closer = float(np.mean(difference < 0)) if n else float("nan")
    row: Row = {"rho2_difference": float("nan"), "rho2_difference_se": float("nan"), "closer": closer, "n": n}
    row |= {"closer_se": float("nan"), "p_value": float("nan")}
    if n < 2:
        return row
    se = float(difference.std(ddof=1) / np.sqrt(n))
    shrunk = (closer * n + 2) / (n + 4)
    row |= {
        "rho2_difference": float(difference.mean()),
        "rho2_difference_se": error_of_squares(both, np.array([1.0, -1.0])),
    }
    row["closer_se"] = float(np.sqrt(shrunk * (1 - shrunk) / (n + 4)))
    row["p_value"] = float(2 * stats.t.sf(abs(difference.mean()) / se, n - 1)) if se > 0 else 1.0
    return row


def errors_of(found: Estimates, gamma: float, noise_variance: float) -> dict[int, float]:
    """Of every replicate, infinite where it has no number."""
    errors = (found.estimate - gamma) * np.sqrt(found.energy / noise_variance)
    return dict(
        zip(found.replicate.astype(int).tolist(), np.where(found.good, errors, np.inf).tolist(), strict=True)
    )


def _half(errors: Errors, odd: bool) -> dict[int, float]:
    return {k: v for k, v in errors.items() if k % 2 == odd and np.isfinite(v)}


def _usable(errors: Errors) -> bool:
    failed = np.mean(~np.isfinite(list(errors.values()))) if errors else 1.0
    return bool(failed <= FAILED) and all(len(_half(errors, odd)) >= HALF for odd in (False, True))


def chosen_and_judged(ways: Mapping[Solver, Errors]) -> Row:
    """The way of least error on even problems, its rho on the odd ones, and the ways that tie with it there."""
    ways = {way: errors for way, errors in ways.items() if _usable(errors)}
    if not ways:
        return {"input": "", "estimator": "", "rho": float("nan"), "rho_se": float("nan"), "n": 0, "ties": ""}
    best = min(ways, key=lambda way: _square(ways[way], odd=False))
    mine = _half(ways[best], True)
    tied = [way for way, errors in ways.items() if way != best and _ties(_half(errors, True), mine)]
    tied.sort(key=lambda way: _square(ways[way], odd=True))
    ties = [f"{method} / {estimator}" for method, estimator in tied[:MOST_TIES]]
    ties += [f"{len(tied) - MOST_TIES} more"] if len(tied) > MOST_TIES else []
    rho, error = rms_with_error(np.array(list(mine.values())))
    return {
        "input": best[0], "estimator": best[1], "rho": rho, "rho_se": error, "n": len(mine),
        "ties": ", ".join(ties),
    }  # fmt: skip


def _square(errors: Errors, odd: bool) -> float:
    return float(np.mean(np.square(list(_half(errors, odd).values()))))


def _paired(a: Errors, b: Errors) -> NDArray[np.float64] | None:
    """The errors of two ways on the problems that both have, (2, R); None of too few."""
    both = sorted(set(a) & set(b))
    return np.array([[side[k] for k in both] for side in (a, b)]) if len(both) >= HALF else None


def _ties(theirs: Errors, mine: Errors) -> bool:
    errors, weights = _paired(theirs, mine), np.array([1.0, -1.0])
    if errors is None:
        return False
    return bool(weights @ np.mean(errors**2, axis=1) <= TIED * error_of_squares(errors, weights))


def ratio_of_means(a: Errors, b: Errors) -> tuple[float, float]:
    """Mean error of one way over that of another on the problems of odd number that both have, with its
    standard error. To first order: var(a/b) = (a/b)^2 var(a_k / a - b_k / b), the pairs kept together."""
    errors = _paired(_half(a, True), _half(b, True))
    if errors is None:
        return float("nan"), float("nan")
    x, y = np.mean(errors**2, axis=1)
    return float(x / y), float(x / y) * error_of_squares(errors, np.array([1 / x, -1 / y]))


KEY = ("plant", "method", "estimator")
BUDGET = ("noise_variance", "samples", "experiments")
SURE = 0.05
"""Chance of any wrong "better" or "worse" in the whole table where nothing has changed, by Holm's rule."""
AGAINST = {
    "plant": "plant", "noise_variance": "noise", "method": "input", "estimator": "estimator", "rho": "rho here",
    "rho_there": "rho there", "difference": "difference", "p_holm": "p (Holm)", "verdict": "so it is",
}  # fmt: skip

APART = "has no plant, noise level, input and estimator in common with this comparison at its budget; compare with "
APART += "--samples, --experiments and --plant as there."


def check_budget(
    folder: str | Path, samples: int = Settings.samples, experiments: int = Settings.experiments
) -> None:
    """InputError unless an earlier comparison has this budget somewhere: experiments of so many samples each."""
    asked = float(samples * experiments), float(experiments)
    if asked not in {
        (float(row["samples"]), float(row["experiments"])) for row in published_rows(Path(folder))
    }:
        raise InputError(f"{folder} {APART}")


def against_rows(rows: Sequence[Row], folder: str | Path) -> list[Row]:
    """Rho of every way that both have at the same budget, its difference, and whether that is more than chance."""
    there = {_key(row): row for row in published_rows(Path(folder))}
    both = [(row, there[_key(row)]) for row in rows if _key(row) in there]
    if not both:
        raise InputError(f"{folder} {APART}")
    table = []
    for mine, theirs in both:
        row = {key: mine[key] for key in (*KEY, "noise_variance", "rho", "rho_se")}
        row |= {"rho_there": float(theirs["rho"]), "rho_there_se": float(theirs["rho_se"] or "nan")}
        row["difference"] = row["rho"] - row["rho_there"]
        row["difference_se"] = float(np.hypot(row["rho_se"], row["rho_there_se"]))
        table.append(row)
    from scipy.stats import norm

    off, se = (np.array([abs(row[key]) for row in table]) for key in ("difference", "difference_se"))
    z = np.divide(off, se, out=np.full(len(table), np.nan), where=se > 0)
    for row, p in zip(table, holm((2 * norm.sf(z)).tolist()), strict=True):
        row["p_holm"] = float(p)
        changed = "better" if row["difference"] < 0 else "worse"
        row["verdict"] = changed if p <= SURE else "within the error"
    return table


def against_sentence(table: Sequence[Row], folder: str | Path) -> str:
    """How many are better, worse and within the error."""
    count = Counter(row["verdict"] for row in table)
    return (
        f"Against {folder}: {count['better']} better, {count['worse']} worse, {count['within the error']} within the error, of "
        f"{len(table)} ways that both have (5 % chance of any wrong word, noise taken as independent)."
    )


def _key(row: Row) -> tuple[Any, ...]:
    return (*(row[key] for key in KEY), *(float(row[key]) for key in BUDGET))


def published_rows(folder: Path) -> list[Row]:
    """comparison.csv of a published folder, or of the tables of a results folder."""
    for file in (folder / "comparison.csv", folder / "tables" / "comparison.csv"):
        if file.is_file():
            try:
                with file.open(encoding="utf-8", newline="") as stream:
                    rows = [dict(row) for row in csv.DictReader(stream)]
                _ = [(_key(row), float(row["rho"])) for row in rows]
                return rows
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise InputError(
                    f"{file} is no table of a comparison ({type(error).__name__}: {error})."
                ) from None
    raise InputError(f"{folder} holds no comparison.csv; give a folder of results, or docs/results.")
