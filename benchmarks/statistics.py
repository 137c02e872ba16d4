"""From the rows of a campaign to the comparison table: every figure with its Monte-Carlo standard error.

rho = RMSE(gamma^) sqrt(input energy / lambda_e), the yardstick of theory.md section 4: at least 1 for unbiased
estimators (a local, large-sample bound), whatever the method.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.plants import load_plant
from benchmarks.predictions import CRITERIA, optimal_losses
from oed.errors import Status
from oed.norms import gain_gradient, peak
from oed.plants import Plant
from oed.theory.efficiency import Losses, losses

__all__ = ["comparison_rows", "information_rows", "mean_with_error"]

Row = dict[str, Any]


def mean_with_error(values: NDArray[np.float64]) -> tuple[float, float]:
    """Mean and its standard error.

    Parameters
    ----------
    values : ndarray
        (R,) independent values.

    Returns
    -------
    tuple of float
        NaN where there are too few.
    """
    if len(values) < 2:
        return (float(values[0]) if len(values) else float("nan")), float("nan")
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


class Target:
    """What the estimates of one plant at one noise level are compared with."""

    def __init__(self, spec: str, noise_variance: float) -> None:
        self.plant: Plant = load_plant(spec, noise_variance)
        self.peak = peak(self.plant)
        self.gamma = self.peak.value
        self.c = gain_gradient(self.plant, self.peak) if self.peak.unique else None
        self.optimum = _optimum(spec, noise_variance)

    def efficiencies(self, information: NDArray[np.float64], energy: float) -> dict[str, float]:
        """Efficiencies of a total information at a total input energy against the certified optima."""
        share = losses(information / energy, self.c).efficiency(self.optimum)
        return {f"{k.lower()}_efficiency": float(getattr(share, k)) for k in CRITERIA}

    def predicted_rho(self, information: NDArray[np.float64], energy: float) -> float:
        """Rho of an efficient estimator on these inputs: sqrt(c' I^-1 c energy / lambda_e)."""
        return float(np.sqrt(losses(information, self.c).c * energy / self.plant.noise_variance))


@lru_cache(maxsize=32)
def _optimum_at_unit_noise(spec: str) -> tuple[Losses, float]:
    plant = load_plant(spec)
    return optimal_losses(plant), plant.noise_variance


def _optimum(spec: str, noise_variance: float) -> Losses:
    """Optimal losses at a noise level; they are proportional to the noise variance."""
    losses_then, variance_then = _optimum_at_unit_noise(spec)
    ratio = load_plant(spec, noise_variance).noise_variance / variance_then
    return Losses(*(getattr(losses_then, k) * ratio for k in CRITERIA))


def _groups(rows: Sequence[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    grouped: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        grouped.setdefault(tuple(row[key] for key in keys), []).append(row)
    return grouped


def targets(rows: Sequence[Row]) -> dict[tuple[str, float], Target]:
    """Targets of all plants and noise levels in a campaign.

    Parameters
    ----------
    rows : sequence of dict
        Of `run_campaign`.

    Returns
    -------
    dict
        (plant, noise variance) to Target.
    """
    return {key: Target(*key) for key in _groups(rows, "plant", "noise_variance")}


def information_rows(rows: Sequence[Row], known: dict[tuple[str, float], Target]) -> list[Row]:
    """What each input carries: efficiencies after every checkpoint, with jackknife standard errors.

    Parameters
    ----------
    rows : sequence of dict
        Of `run_campaign`.
    known : dict
        Targets.

    Returns
    -------
    list of dict
        plant, noise_variance, method, experiments, samples, energy, the four efficiencies each with _se, and
        rho_predicted, the rho of an efficient estimator.
    """
    table = []
    kept = [row for row in rows if row["estimator"] == ""]
    for (plant, variance, method, experiments), group in _groups(
        kept, "plant", "noise_variance", "method", "experiments"
    ).items():
        target = known[plant, variance]
        n = len(target.plant.free)
        information = np.array([row["information"] for row in group]).reshape(len(group), n, n)
        energy = float(np.mean([row["energy"] for row in group]))
        values = target.efficiencies(information.mean(axis=0), energy)
        blocks = np.array_split(np.arange(len(group)), min(10, len(group)))
        left_out = [
            target.efficiencies(np.delete(information, block, axis=0).mean(axis=0), energy)
            for block in blocks
            if len(blocks) > 1
        ]
        row: Row = {
            "plant": plant,
            "noise_variance": variance,
            "method": method,
            "experiments": experiments,
            "samples": group[0]["samples"],
            "energy": energy,
            "peak_amplitude": max(r["peak_amplitude"] for r in group),
        }
        for key, value in values.items():
            row[key] = value
            row[f"{key}_se"] = _jackknife(np.array([other[key] for other in left_out]))
        row["rho_predicted"] = target.predicted_rho(information.mean(axis=0), energy)
        table.append(row)
    return table


def _jackknife(values: NDArray[np.float64]) -> float:
    m = len(values)
    if m < 2 or not np.isfinite(values).all():
        return float("nan")
    return float(np.sqrt((m - 1) / m * np.sum((values - values.mean()) ** 2)))


def comparison_rows(
    rows: Sequence[Row], information: Sequence[Row], known: dict[tuple[str, float], Target]
) -> list[Row]:
    """The comparison table: bias, RMSE and rho of every method with every estimator.

    Parameters
    ----------
    rows : sequence of dict
        Of `run_campaign`.
    information : sequence of dict
        Of `information_rows`.
    known : dict
        Targets.

    Returns
    -------
    list of dict
        One row per plant, noise variance, method and estimator. Failed runs are counted in `n_failed` and left
        out of the averages, which are then averages over the runs that gave a number.
    """
    carried = {(r["plant"], r["noise_variance"], r["method"], r["experiments"]): r for r in information}
    table = []
    kept = [row for row in rows if row["estimator"] != ""]
    for (plant, variance, method, estimator), group in _groups(
        kept, "plant", "noise_variance", "method", "estimator"
    ).items():
        target = known[plant, variance]
        good = [
            row
            for row in group
            if np.isfinite(row["estimate"]) and Status[row["status"]] is not Status.FAILED
        ]
        errors = np.array([row["estimate"] for row in good]) - target.gamma
        energies = [row["energy"] for row in group if np.isfinite(row["energy"])]
        energy = float(np.mean(energies)) if energies else float("nan")
        bias, bias_se = mean_with_error(errors)
        mse, mse_se = mean_with_error(errors**2)
        rmse = float(np.sqrt(mse))
        rmse_se = mse_se / (2 * rmse) if rmse > 0 else float("nan")
        scale = float(np.sqrt(energy / target.plant.noise_variance))
        experiments = max((row["experiments"] for row in group), default=0)
        row: Row = {
            "plant": plant,
            "noise_variance": variance,
            "method": method,
            "estimator": estimator,
            "samples": max(row["samples"] for row in group),
            "experiments": experiments,
            "energy": energy,
            "rho": rmse * scale,
            "rho_se": rmse_se * scale,
            "rho_predicted": float("nan"),
            "bias": bias,
            "bias_se": bias_se,
            "rmse": rmse,
            "rmse_se": rmse_se,
        }
        source = carried.get((plant, variance, method, experiments), {})
        for name in ("c_efficiency", "d_efficiency", "a_efficiency", "e_efficiency"):
            row[name] = source.get(name, float("nan"))
            row[f"{name}_se"] = source.get(f"{name}_se", float("nan"))
        if estimator == "pem":
            row["rho_predicted"] = source.get("rho_predicted", float("nan"))
        if estimator in ("gain", "mu") and method == "power":
            row["bias_predicted"] = _predicted_bias(target, estimator)
        row |= _coverage(good, target.gamma)
        row |= {"hinf_norm": target.gamma, "n": len(group), "n_failed": len(group) - len(good)}
        table.append(row)
    return table


def _predicted_bias(target: Target, estimator: str) -> float:
    """Limit bias of beta_2 or mu ([S] Theorems 9 and 12, exact rather than to second order)."""
    from oed.theory.limit import limit_spectrum

    limit = limit_spectrum(target.plant)
    square = limit.beta2_mean if estimator == "gain" else limit.mu2
    return float(np.sqrt(square) - target.gamma) if square > 0 else float("nan")


def _coverage(good: Sequence[Row], gamma: float) -> Row:
    """Share of 95 % intervals that contain the norm, where the estimator states standard errors."""
    stated = [row for row in good if np.isfinite(row["standard_error"])]
    if not stated:
        return {"coverage": float("nan"), "coverage_se": float("nan")}
    hit = np.array(
        [abs(row["estimate"] - gamma) <= 1.96 * row["standard_error"] for row in stated], dtype=float
    )
    share = float(hit.mean())
    # The add-two rule keeps the error positive at shares of 0 and 1.
    shrunk = (hit.sum() + 2) / (len(hit) + 4)
    return {"coverage": share, "coverage_se": float(np.sqrt(shrunk * (1 - shrunk) / (len(hit) + 4)))}
