"""What can be added to the squared loss: known and bounded parameters, priors, robust weights, filters, gaps."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.pem.predictors.of_structure import kernel_for
from estimators.pem.search.levenberg_marquardt import Optimum, Point
from estimators.pem.search.problem import Problem
from estimators.pem.search.starts import filtered
from oed.data import Record
from oed.errors import InputError

HUBER = 1.345
"""Threshold in standard deviations: 95 % efficiency for Gaussian noise (Huber 1964)."""
STUDENT = 4.0
"""Degrees of freedom of the t distribution (Lange, Little, Taylor 1989)."""


@dataclass(frozen=True)
class Settings:
    """How a fit is made, beside the data and the structure. `offset, unknown, missing` whether levels are
    estimated, initial states unknown, outputs missing; `search` auto, quick or thorough; `max_iterations`
    most steps from each start; `tolerance` relative decrease of the loss below which to stop."""

    offset: bool
    unknown: bool
    missing: bool
    search: str
    max_iterations: int
    tolerance: float


def _index(problem: Problem, name: str) -> int:
    names = problem.structure.names
    if name not in names:
        raise InputError(f"there is no parameter {name!r}; {problem.structure!r} has {', '.join(names)}.")
    return names.index(name)


def with_limits(
    problem: Problem, fixed: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> Problem:
    """A problem whose parameters are known or bounded."""
    if not fixed and not bounds:
        return problem
    lower, upper = np.full(problem.n_parameters, -np.inf), np.full(problem.n_parameters, np.inf)
    for name, (low, high) in {**bounds, **{k: (v, v) for k, v in fixed.items()}}.items():
        k = _index(problem, name)
        if not low <= high or np.isnan(low) or np.isnan(high):
            raise InputError(f"the bounds of {name} are {low}, {high}; the lower must not exceed the upper.")
        lower[k], upper[k] = low / problem.scale[k], high / problem.scale[k]
    return problem.replace(lower=lower, upper=upper)


def with_prior(
    problem: Problem, optimum: Optimum, prior: Mapping[str, tuple[float, float]], how: Settings
) -> tuple[Problem, Optimum]:
    """The posterior mode under independent Gaussian priors, the noise variance found along the way."""
    mean, information = np.zeros(problem.n_parameters), np.zeros(problem.n_parameters)
    for name, (center, deviation) in prior.items():
        k = _index(problem, name)
        if not deviation > 0:
            raise InputError(
                f"the prior of {name} has the standard deviation {deviation}; it must be positive."
            )
        mean[k], information[k] = center / problem.scale[k], (problem.scale[k] / deviation) ** 2
    for _ in range(20):
        variance = float(optimum.point.extra[1][0, 0]) if problem.structure.n_outputs == 1 else 1.0
        posed = problem.replace(prior_mean=mean, prior_precision=np.diag(information * variance))
        point = posed.evaluate(optimum.point.z, optimum.point.extra[0])
        if point is None:
            break
        optimum = posed.descend(point, max_iterations=how.max_iterations, tolerance=how.tolerance)
        problem = posed
        if abs(float(optimum.point.extra[1][0, 0]) / variance - 1) < 1e-10 or problem.structure.n_outputs > 1:
            break
    return problem, optimum


def unweighted(problem: Problem) -> Problem:
    """The problem without weights for single samples."""
    if problem.variant != "weighted":
        return problem
    levels = problem.n_parameters > problem.structure.n
    return problem.replace(
        kernel=kernel_for(problem.structure, levels, problem.n_initial > 0),
        data=np.ascontiguousarray(problem.data[:, : -problem.structure.n_outputs]),
        variant="",
    )


def _scatter(e: NDArray, weights: NDArray, robust: str) -> NDArray:
    if robust == "huber":
        return np.diag((np.median(np.abs(e), axis=0) / 0.6745) ** 2)
    return (weights * e).T @ e / len(e)


def _distances(e: NDArray, scatter: NDArray) -> tuple[NDArray, NDArray]:
    inverse = np.linalg.inv(scatter)
    return inverse, np.sqrt(np.einsum("ti,ij,tj->t", e, inverse, e))


def _weights(distance: NDArray, robust: str, ny: int) -> NDArray:
    if robust == "huber":
        return np.minimum(1.0, HUBER / np.maximum(distance, 1e-300))
    return (STUDENT + ny) / (STUDENT + distance**2)


def robustly(problem: Problem, optimum: Optimum, robust: str, how: Settings) -> tuple[Problem, Optimum]:
    """The M-estimate by iteratively reweighted least squares."""
    plain, ny = problem, problem.structure.n_outputs
    point, iterations, weights = optimum.point, optimum.iterations, np.ones((problem.n_samples, 1))
    for _ in range(200):
        e = np.concatenate(plain.residuals(point)) / plain.output_scale
        scatter = _scatter(e, weights, robust)
        inverse, distance = _distances(e, scatter)
        weights = _weights(distance, robust, ny)[:, None]
        posed = plain.with_weights(np.repeat(weights, ny, axis=1))
        posed = posed.replace(weight=inverse if ny > 1 else plain.weight)
        before = posed.evaluate(point.z, point.extra[0])
        if before is None:
            break
        optimum = posed.descend(before, max_iterations=3, tolerance=how.tolerance)
        iterations += optimum.iterations
        moved = optimum.point.z - point.z
        problem, point = posed, optimum.point
        if float(moved @ point.hessian @ moved) < 1e-14 * max(point.loss, 1e-300):
            break
    return problem, Optimum(point, optimum.status, iterations, optimum.decrement)


def robust_factor(problem: Problem, point: Point, robust: str) -> float:
    """sigma^2 times N E[psi^2] / E[psi']^2 over the weights' sum: from (sum w J'J)^-1 to the M-estimate's
    covariance."""
    plain, ny = unweighted(problem), problem.structure.n_outputs
    e = np.concatenate(plain.residuals(point)) / plain.output_scale
    weights = problem.data[:, -1] ** 2
    scatter = _scatter(e, weights[:, None], robust)
    distance = _distances(e, scatter)[1]
    if robust == "huber":
        slope = (distance < HUBER).astype(float)
    else:
        slope = (STUDENT + ny) * (STUDENT - distance**2) / (STUDENT + distance**2) ** 2
    spread = float(np.mean((weights * distance) ** 2)) / ny
    factor = spread * float(np.mean(weights)) / max(float(np.mean(slope)), 1e-3) ** 2
    return factor * (float(scatter[0, 0]) if ny == 1 else 1.0)


def robust_scale(problem: Problem, optimum: Optimum) -> float:
    """Median absolute residual, the product over outputs: which of two robust optima is the better one."""
    e = np.concatenate(unweighted(problem).residuals(optimum.point)) / problem.output_scale
    return float(np.prod(np.median(np.abs(e), axis=0)))


def without_outliers(records: list[Record], residuals: list[NDArray]) -> list[Record]:
    """Records whose outputs are interpolated where they jump off their neighbours or off a model: residuals
    (N, ny)."""
    e = np.concatenate(residuals)
    limit = 4 * np.median(np.abs(e), axis=0) / 0.6745
    return [
        bridged(r.replace(y=np.where(np.abs(x) > limit, np.nan, r.y)))
        for r, x in zip(records, residuals, strict=True)
    ]


def filtered_record(record: Record, num: ArrayLike, den: ArrayLike) -> Record:
    """A record whose inputs and outputs have both passed a filter, from rest."""
    through = lambda x: filtered(num, den, x.T).T
    roots = np.roots(np.atleast_1d(den))
    if roots.size and np.abs(roots).max() >= 1:
        raise InputError(
            f"the prefilter has a pole of modulus {np.abs(roots).max():.4g}; it must be stable (all below 1)."
        )
    return record.replace(u=through(record.u), y=through(record.y))


def bridged(record: Record) -> Record:
    """A record whose missing outputs are interpolated, to begin a search from."""
    y, t = np.array(record.y), np.arange(len(record))
    for column in y.T:
        seen = np.isfinite(column)
        if not seen.any():
            raise InputError("an output has no sample that is not missing; leave it out.")
        column[~seen] = np.interp(t[~seen], t[seen], column[seen])
    return record.replace(y=y)
