"""From the rows of a campaign to the comparison table: every figure with its Monte-Carlo standard error.

rho = RMSE(gamma^) sqrt(input energy / lambda_e), the yardstick of docs/theory/design.md: at least 1 for unbiased
estimators (a local, large-sample bound), whatever the method."""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.campaign.plants import content_of, family_of, load_plant
from benchmarks.campaign.processes import spread
from benchmarks.campaign.registry import told
from benchmarks.campaign.run_columns import Estimates, Runs
from benchmarks.tables.predictions import CRITERIA, optimal_loss
from oed.covariances import of_few
from oed.errors import Status
from oed.plants.norms import gain_gradient, peak
from oed.plants.plant import Plant
from oed.theory.efficiency import Losses, losses

Row = dict[str, Any]


def mean_with_error(values: NDArray[np.float64]) -> tuple[float, float]:
    """Mean and its standard error: values (R,)."""
    if len(values) < 2:
        return (float(values[0]) if len(values) else float("nan")), float("nan")
    return float(values.mean()), of_few(float(values.std(ddof=1) / np.sqrt(len(values))), len(values) - 1)


def error_of_squares(errors: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Standard error of a weighted sum of mean squares: errors (m, R) of the same R problems, weights (m,). The spread of few
    squares is too small more often than not, as the large ones are rare: never less than that of normal errors."""
    count = errors.shape[1]
    if count < 2:
        return float("nan")
    mean = errors.mean(axis=1)
    S = (errors - mean[:, None]) @ errors.T / (count - 1)
    normal = weights @ (4 * np.outer(mean, mean) * S + 2 * S**2) @ weights
    return of_few(float(np.sqrt(max(np.var(weights @ errors**2, ddof=1), normal) / count)), count - 1)


def rms_with_error(errors: NDArray[np.float64]) -> tuple[float, float]:
    """Root mean square and its standard error: errors (R,)."""
    rms = float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")
    return rms, error_of_squares(errors[None], np.ones(1)) / (2 * rms) if rms > 0 else float("nan")


class Target:
    """What the estimates of one plant at one noise level are compared with."""

    def __init__(self, spec: str, noise_variance: float, at_unit_noise: Losses) -> None:
        self.plant: Plant = load_plant(spec, noise_variance)
        self.peak = peak(self.plant)
        self.gamma = self.peak.value
        self.c = gain_gradient(self.plant, self.peak) if self.peak.unique else None
        # The losses are proportional to the noise variance.
        ratio = self.plant.noise_variance / load_plant(spec).noise_variance
        self.optimum = Losses(*(getattr(at_unit_noise, k) * ratio for k in CRITERIA))

    @property
    def channels(self) -> str:
        """Outputs x inputs, as tables state them."""
        return f"{self.plant.n_outputs} x {self.plant.n_inputs}"

    def efficiencies(self, information: NDArray[np.float64], energy: float) -> dict[str, float]:
        """Efficiencies of a total information against the certified optima at the same energy: information
        (n, n)."""
        share = losses(information / energy, self.c).efficiency(self.optimum)
        return {f"{k.lower()}_efficiency": float(getattr(share, k)) for k in CRITERIA}

    def predicted_rho(self, information: NDArray[np.float64], energy: float) -> float:
        """Rho of an efficient estimator on these inputs: sqrt(c' I^-1 c energy / lambda_e)."""
        return float(np.sqrt(losses(information, self.c).c * energy / self.plant.noise_variance))


@lru_cache(maxsize=128)
def _optimum(asked: tuple[str, str, str]) -> float:
    spec, _, criterion = asked  # the content is there for the cache
    return optimal_loss(load_plant(spec), criterion)


Targets = Mapping[tuple[str, float], Target]


def targets(keys: Iterable[tuple[str, float]], jobs: int = 1) -> dict[tuple[str, float], Target]:
    """Targets of plants at noise levels: returns (plant, noise variance)."""
    keys = list(dict.fromkeys(keys))
    specs = list(dict.fromkeys(spec for spec, _ in keys))
    # Of the plants of a family only the peak gain is asked for: the other optima of 200 plants would take an hour.
    asked = [(s, content_of(s), k) for s in specs for k in (CRITERIA if not family_of(s) else CRITERIA[:1])]
    found = dict(zip([(spec, k) for spec, _, k in asked], spread(_optimum, asked, jobs), strict=True))
    blank = float("nan")
    at_unit_noise = {spec: Losses(**{k: found.get((spec, k), blank) for k in CRITERIA}) for spec in specs}
    return {(spec, variance): Target(spec, variance, at_unit_noise[spec]) for spec, variance in keys}


def _budget(target: Target, samples: float, experiments: float, energy: float, amplitude: float) -> Row:
    """What was spent, as every table states it."""
    plant = target.plant
    return {
        "channels": target.channels,
        "samples": int(samples),
        "experiments": int(experiments),
        "energy": float(energy),
        "energy_per_input": float(energy) / plant.n_inputs,
        "peak_amplitude": float(amplitude),
    }


def information_rows(runs: Runs, target: Target) -> list[Row]:
    """What an input carries: efficiencies after every checkpoint, with jackknife standard errors."""
    n = len(target.plant.free)
    marks: dict[int, list[Row]] = {}
    for row in runs.information:
        marks.setdefault(row["experiments"], []).append(row)
    table = []
    for experiments, group in sorted(marks.items()):
        sums = np.array([row["information"] for row in group]).reshape(len(group), n, n)
        counts = np.array([row["count"] for row in group], dtype=float)
        energy = sum(row["energy"] for row in group) / counts.sum()
        mean = sums.sum(axis=0) / counts.sum()
        values = target.efficiencies(mean, energy)
        blocks = np.array_split(np.arange(len(group)), min(10, len(group)))
        left_out = [
            target.efficiencies(
                np.delete(sums, block, axis=0).sum(axis=0) / np.delete(counts, block).sum(), energy
            )
            for block in blocks
            if len(blocks) > 1
        ]
        row: Row = {"plant": runs.plant, "noise_variance": runs.noise_variance, "method": runs.method}
        row["known"] = told(runs.method).value
        amplitude = max(r["peak_amplitude"] for r in group)
        row |= _budget(target, group[0]["samples"], experiments, energy, amplitude)
        for key, value in values.items():
            row[key] = value
            row[f"{key}_se"] = _jackknife(np.array([other[key] for other in left_out]))
        row["rho_predicted"] = target.predicted_rho(mean, energy)
        row["n"] = int(counts.sum())
        table.append(row)
    return table


def _jackknife(values: NDArray[np.float64]) -> float:
    m = len(values)
    if m < 2 or not np.isfinite(values).all():
        return float("nan")
    return of_few(float(np.sqrt((m - 1) / m * np.sum((values - values.mean()) ** 2))), m - 1)


def comparison_rows(runs: Runs, information: Sequence[Row], target: Target) -> list[Row]:
    """Rows of the comparison table: bias, RMSE and rho of an input with every estimator."""
    carried = {row["experiments"]: row for row in information}
    table = []
    for estimator, found in runs.final.items():
        errors = found.estimate[found.good] - target.gamma
        spent = found.spent
        bias, bias_se = mean_with_error(errors)
        rmse, rmse_se = rms_with_error(errors)
        scale = float(np.sqrt(spent["energy"] / target.plant.noise_variance))
        row: Row = {
            "plant": runs.plant, "noise_variance": runs.noise_variance, "method": runs.method,
            "estimator": estimator, "known": told(runs.method, estimator).value, **_budget(target, *spent.values()),
            "rho": rmse * scale, "rho_se": rmse_se * scale, "rho_predicted": float("nan"), "bias": bias,
            "bias_se": bias_se, "bias_predicted": float("nan"), "rmse": rmse, "rmse_se": rmse_se,
        }  # fmt: skip
        source = carried.get(row["experiments"], {})
        for name in ("c_efficiency", "d_efficiency", "a_efficiency", "e_efficiency"):
            row[name] = source.get(name, float("nan"))
            row[f"{name}_se"] = source.get(f"{name}_se", float("nan"))
        if estimator.startswith("pem"):
            row["rho_predicted"] = source.get("rho_predicted", float("nan"))
        if estimator in ("gain", "mu") and runs.method == "power":
            row["bias_predicted"] = _predicted_bias(target, estimator)
        row |= _coverage(found, target.gamma)
        failed = {k: n for k, n in found.statuses.items() if not Status[k].ok}
        row |= {"hinf_norm": target.gamma, "n": len(found), "n_failed": int(np.sum(~found.good))}
        row |= {
            "remark": "; ".join(filter(None, (below_one(row | {"n": len(errors)}), _coarse(row)))),
            "failures": ", ".join(f"{n} {k.lower().replace('_', ' ')}" for k, n in failed.items()),
        }
        table.append(row)
    return table


COARSE = 0.05
"""Share of rho from which on its standard error is said to be large."""


def _coarse(row: Row) -> str:
    return f"standard error over {100 * COARSE:g} % of rho" if row["rho_se"] > COARSE * row["rho"] else ""


def below_one(row: Row) -> str:
    """Why a rho is below 1, the bound; empty where it is not. n rho^2 of an estimator that attains the bound is
    chi-squared with n degrees of freedom, n the problems of the mean: how often it is as small as this."""
    if not row["rho"] < 1:
        return ""
    from scipy.stats import chi2

    promised = row.get("rho_predicted", 1.0)
    promised = 1.0 if promised != promised else promised
    chance = chi2.cdf(row["n"] * (row["rho"] / max(promised, 1.0)) ** 2, row["n"])
    most = "under 0.001" if chance < 0.001 else f"{chance:.2g}"
    where = (
        "1, at which"
        if promised <= 1
        else f"1; at the {promised:.3g} that the information of these inputs promises,"
    )
    words = f"below the bound {where} {row['n']} problems give as little with probability {most}"
    biased = abs(row.get("bias", 0.0)) > 2 * row.get("bias_se", 0.0)
    return words + (
        "; and this estimator is biased here, for which the bound does not hold" if biased else ""
    )


def _predicted_bias(target: Target, estimator: str) -> float:
    """Limit bias of beta_2 or mu ([S] Theorems 9 and 12, exact rather than to second order)."""
    from oed.theory.limit import limit_spectrum

    limit = limit_spectrum(target.plant)
    square = limit.beta2_mean if estimator == "gain" else limit.mu2
    return float(np.sqrt(square) - target.gamma) if square > 0 else float("nan")


def _coverage(found: Estimates, gamma: float) -> Row:
    """Share of 95 % intervals that contain the norm, where the estimator states standard errors."""
    stated = found.good & np.isfinite(found.standard_error)
    if not stated.any():
        return {"coverage": float("nan"), "coverage_se": float("nan")}
    hit = np.abs(found.estimate[stated] - gamma) <= 1.96 * found.standard_error[stated]
    # The add-two rule keeps the error positive at shares of 0 and 1.
    shrunk = (hit.sum() + 2) / (len(hit) + 4)
    return {
        "coverage": float(hit.mean()),
        "coverage_se": float(np.sqrt(shrunk * (1 - shrunk) / (len(hit) + 4))),
    }
