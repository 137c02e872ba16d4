"""How sure an effect of a joint model is, by what the record itself asks for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from estimators.diagnosis.baseline.linear_model import rest_means
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.model.fitting import Fit
from estimators.diagnosis.model.forces import effective_samples
from estimators.diagnosis.model.structure import Part


def part_significance(rest: Fit, f: Fit, part: Part, family: int, u: NDArray[Any]) -> float:
    """Corrected p-value of a part in the joint fit to inputs (N, nu): the better of two likelihood ratios, at twice its value.

    One takes each side under the noise model that it asks for. Such a model predicts a smooth error from its own past,
    whatever causes it, so that the other takes the simulation errors for as many samples as are independent among them.
    """
    costs = [g.deviance + len(g.noise) * float(np.log(g.n)) for g in (rest, f)]
    ratio = max(costs[0] - costs[1], 0.0)
    if np.isfinite(costs).all():
        left = [max(float(np.mean(g.residual**2)), 1e-300) for g in (rest, f)]
        ratio = max(
            ratio, min(effective_samples(g.residual) for g in (rest, f)) * float(np.log(left[0] / left[1]))
        )
    degrees = max(1, len(f.p) - len(rest.p))
    p = float(min(1.0, 2 * family * part.effect.tries(f.n) * chi2.sf(ratio, degrees)))
    return max(p, _as_subtracted(u, f, part)) if part.effect is OFFSET else p


def _as_subtracted(u: NDArray[Any], f: Fit, part: Part) -> float:
    """p-value of a constant beside the error of what deviations are from, the mean of the samples before the inputs (N, nu) moved:
    of so many samples, means of the noise scatter by that."""
    scatter = float(np.sqrt(np.mean(rest_means(u, f.residual) ** 2)))
    constant = abs(float(f.p[f.structure.slices()[f.structure.parts.index(part)]][0]))
    return float(2.0 * norm.sf(constant / max(scatter, 1e-300)))
