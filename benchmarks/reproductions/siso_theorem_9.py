"""[S] Theorems 9 and 12: mu^2 and E beta_2^2 at little noise, as slopes of the error against the variance."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.tables.reproduced import row
from oed.plants.named import named_plant
from oed.plants.norms import peak
from oed.theory.limit import limit_spectrum

__all__ = ["rows"]

VARIANCES = np.geomspace(1e-5, 1e-2, 7)


def _slope(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def rows() -> list[dict[str, Any]]:
    """Orders and constants, with the factor for a peak at 0 or pi that the paper does not treat.

    Returns
    -------
    list of dict
        Rows of `benchmarks.tables.reproduced`.
    """
    found = []
    for name, factor, source in (
        ("reference", 2.0, "[S] Theorem 9"),
        ("peak-at-zero", 0.5, "[S] Theorem 9, corrected for a peak at 0"),
        ("peak-at-pi", 0.5, "[S] Theorem 9, corrected for a peak at pi"),
    ):
        plant = named_plant(name)
        H = peak(plant).curvature
        limits = [limit_spectrum(plant.replace(noise_variance=v)) for v in VARIANCES]
        delta = np.array([limit.mu2_excess for limit in limits])
        found.append(
            row(
                f"order of mu^2 - gamma^2 in the noise variance, {name}",
                source,
                2.0,
                _slope(VARIANCES, delta),
                0.02,
                "slope of a line through variances 1e-5 to 1e-2; the next term is 3 % at the upper end.",
            )
        )
        ratio = delta[0] * H / VARIANCES[0] ** 2
        found.append(
            row(
                f"its constant times H, {name}",
                source,
                factor,
                float(ratio),
                1e-3 * factor,
                "at variance 1e-5; the relative error falls in proportion to the variance.",
            )
        )
    plant = named_plant("reference")
    gamma = peak(plant).value
    limits = [limit_spectrum(plant.replace(noise_variance=v)) for v in VARIANCES]
    bias = np.array([gamma**2 - limit.beta2_mean for limit in limits])
    delta = np.array([limit.mu2_excess for limit in limits])
    found.append(
        row(
            "bias of beta_2^2 in units of -lambda_e",
            "[S] Theorem 12",
            1.0,
            float(bias[0] / VARIANCES[0]),
            1e-6,
            "at variance 1e-5, where the next term is 2e-8 of it.",
        )
    )
    found.append(
        row(
            "order of what is left after -lambda_e",
            "[S] Theorem 12",
            2.0,
            _slope(VARIANCES, np.abs(VARIANCES - bias) + 0 * delta),
            0.02,
            "gamma^2 - lambda_e - E beta_2^2 falls as the square of the variance.",
        )
    )
    bias_gain = gamma - np.sqrt(limits[0].beta2_mean)
    found.append(
        row(
            "bias of beta_2 in units of -lambda_e / (2 gamma)",
            "[S] after Theorem 12",
            1.0,
            float(bias_gain * 2 * gamma / VARIANCES[0]),
            1e-5,
            "at variance 1e-5; second order in the variance over gamma^2.",
        )
    )
    return found
