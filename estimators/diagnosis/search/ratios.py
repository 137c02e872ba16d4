"""How sure an effect of a joint model is, by what the record itself asks for, and whether it leaves anything."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from estimators.diagnosis.baseline.linear_model import rest_means
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.profiled import gained
from estimators.diagnosis.model.fitting import Channel, Fit
from estimators.diagnosis.model.forces import effective_samples
from estimators.diagnosis.model.structure import Part
from estimators.diagnosis.share.signals import late
from estimators.residual.algebra import least_squares

PLAIN = 2
"""Parameters of an effect that, if it leaves nothing, is no fit of many."""
SLIGHT = 0.05
"""Of what an effect gains, that whatever is left could add at most, where nothing else is tried: it then leaves hardly more than the noise,
of a record with ten times as much before a tenth more. Named effects that stand in for another leave half as much again and more."""
LATER, CHANCE = (0, 1, 2, 3, 5, 8, 13), 1e-3
"""Lags in samples at which its signals are asked what it left, and the level from which on they tell something."""


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


def explained(channel: Channel, base: Fit, fits: Iterable[Fit]) -> bool:
    """Whether an effect of few parameters leaves white noise of which its signals and the time tell nothing: what has a search of its own,
    and more parameters or more shapes, could do no better. Or whether it leaves hardly more than that, and no other cause comes near."""
    f, *others = sorted(fits, key=lambda f: f.criterion)
    if channel.step > 0:
        return False
    degrees, told = _told(channel, f)
    if not len(f.noise) and len(f.p) - len(base.p) <= PLAIN and chi2.sf(told, degrees) > CHANCE:
        return True
    before, cause = _squares(base), lambda f: f.structure.parts[-1].effect.cause
    gain = gained(f.n, before, _squares(f))
    left = max(told - degrees, 0.0) + gained(f.n, _squares(f) / f.n, f.variance)
    rest = max((gained(g.n, before, _squares(g)) for g in others if cause(g) != cause(f)), default=gain)
    return left < SLIGHT * gain and rest < gain - left


def _squares(f: Fit) -> float:
    return float(f.residual @ f.residual)


def _told(channel: Channel, f: Fit) -> tuple[int, float]:
    """How many signals and bends of them are asked what a fit left, and the likelihood ratio that they tell of it."""
    n, t = len(channel), np.linspace(-1.0, 1.0, len(channel))
    columns = [np.ones(n), t, t**2, t**3]
    for x in (*channel.u[:, list(f.structure.inputs)].T, channel.y - f.residual):
        x = np.nan_to_num(x - x.mean()) / (x.std() + 1e-300)
        columns += [bend for v in (late(x, k) for k in LATER) for bend in (v, v**2, v**3, np.abs(v), t * v)]
    X, e = np.stack(columns, axis=1)[channel.keep], f.residual[channel.keep]
    left = e - X @ least_squares(X, e, 1e-10)
    return X.shape[1], gained(f.n, float(e @ e), float(left @ left))
