"""Checks of information additivity that a user's own pytest calls on their plant and their method.

Lemma 13 of [S]: the information of several experiments is the sum of their informations, also where the input
of each depends on the noise of those before. A check returns a result that is true where it holds and prints
the numbers:

    result = additivity_by_monte_carlo(plant, method, samples=200, experiments=5, replicates=1000)
    assert result, result
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.rules.trace import Rule, Trace, run
from oed.data import Spectrum, join
from oed.errors import InputError
from oed.experiments import decoloured, simulated
from oed.information import (
    covariance,
    information_of_records,
    information_of_signal,
    information_of_spectrum,
    signal_gradient,
)
from oed.plants.plant import Plant

__all__ = ["Additivity", "additivity_by_monte_carlo", "additivity_of_records", "additivity_of_spectra"]

Information = Callable[[Plant, NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Additivity:
    """Outcome of a check; true where the information is additive.

    Attributes
    ----------
    holds : bool
        Whether the discrepancy is within the threshold.
    discrepancy : float
        Largest entry of the difference: relative to the information for the exact checks, in standard errors
        for the Monte-Carlo check.
    threshold : float
        What it is held against.
    measured, summed : ndarray
        (n, n) the two sides of the equation.
    standard_error : ndarray
        (n, n) of `measured - summed`; zero for the exact checks.
    message : str
        The sentence a user reads.
    """

    holds: bool
    discrepancy: float
    threshold: float
    measured: NDArray[np.float64]
    summed: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    message: str

    def __bool__(self) -> bool:
        return self.holds

    def __repr__(self) -> str:
        return f"{'additive' if self.holds else 'NOT additive'}: {self.message}"


def _exact(together: NDArray, summed: NDArray, tolerance: float, what: str) -> Additivity:
    scale = np.sqrt(np.outer(np.diag(summed), np.diag(summed)))
    discrepancy = float(np.max(np.abs(together - summed) / np.where(scale > 0, scale, 1.0)))
    holds = bool(discrepancy <= tolerance)
    message = f"{what} differ by at most {discrepancy:.2g} relative (tolerance {tolerance:.2g})"
    return Additivity(holds, discrepancy, tolerance, together, summed, np.zeros_like(summed), message)


def additivity_of_spectra(
    plant: Plant, spectra: Sequence[Spectrum], *, tolerance: float = 1e-12
) -> Additivity:
    """Whether the information of the sum of spectra is the sum of their informations ([S] (19)-(21)).

    Parameters
    ----------
    plant : Plant
        The plant.
    spectra : sequence of Spectrum
        At least two.
    tolerance : float
        Relative; rounding of sums over lines is far below the default.

    Returns
    -------
    Additivity
        True where it holds.
    """
    if len(spectra) < 2:
        raise InputError(f"{len(spectra)} spectra were given; additivity is a statement about at least two.")
    together = information_of_spectrum(plant, join(spectra))
    summed = np.sum([information_of_spectrum(plant, s) for s in spectra], axis=0)
    return _exact(together, summed, tolerance, "information of the joint spectrum and the sum")


def additivity_of_records(plant: Plant, inputs: Sequence[Any], *, tolerance: float = 1e-5) -> Additivity:
    """Whether the curvature of the joint likelihood of several finite experiments is the sum of informations.

    The joint side is computed apart from the summed one: the outputs of all experiments are simulated at
    shifted parameters and the expected squared shift of the whitened predictions is the information.

    Parameters
    ----------
    plant : Plant
        The plant.
    inputs : sequence of array_like
        (N_k, nu) each; the lengths may differ.
    tolerance : float
        Relative; central differences with a step of 1e-6 of each parameter's standard deviation scale leave
        about 1e-8.

    Returns
    -------
    Additivity
        True where it holds.
    """
    if len(inputs) < 2:
        raise InputError(f"{len(inputs)} inputs were given; additivity is a statement about at least two.")
    signals = [np.asarray(u, dtype=float).reshape(len(u), -1) for u in inputs]
    theta = plant.theta
    columns = []
    for i in range(len(theta)):
        step = 1e-6 * max(abs(theta[i]), 1e-2)
        shift = step * np.eye(len(theta))[i]
        up, down = plant.with_theta(theta + shift), plant.with_theta(theta - shift)
        parts = [
            (_whitened(plant, up.simulate(u)) - _whitened(plant, down.simulate(u))).ravel() for u in signals
        ]
        columns.append(np.concatenate(parts) / (2 * step))
    psi = np.array(columns)
    summed = information_of_records(plant, signals)
    return _exact(psi @ psi.T, summed, tolerance, "information of all records together and the sum")


def _whitened(plant: Plant, v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lambda^-1/2 H^-1 v, from rest."""
    return np.linalg.solve(np.linalg.cholesky(plant.noise_covariance), decoloured(plant, v).T).T


def additivity_by_monte_carlo(
    plant: Plant,
    method: Rule | Callable[..., Trace],
    *,
    samples: int = 200,
    experiments: int = 5,
    replicates: int = 1000,
    seed: int = 0,
    false_alarm_rate: float = 1e-3,
    information: Information | None = None,
) -> Additivity:
    """Whether the mean outer product of the scores of adaptive experiments is the sum of their informations.

    With s_r the score of run r, all experiments together, and J_r the sum of the informations of the inputs
    that were applied in it, E s s' = E J. The difference is tested entry by entry against its own Monte-Carlo
    standard error, after scaling by the mean information, with a Bonferroni correction.

    Parameters
    ----------
    plant : Plant
        The plant, simulated with its noise.
    method : callable
        A rule (generator function, as for `run`) or `method(experiment, *, samples, iterations, rng) -> Trace`.
    samples, experiments, replicates : int
        Size of the simulation; `replicates` of at least 100.
    seed : int
        Seed of noise and method.
    false_alarm_rate : float
        Probability that a true lemma fails the check.
    information : callable, optional
        `information(plant, u) -> (n, n)` of one experiment, instead of the exact one (to test a formula of
        your own, or to see that the check can fail).

    Returns
    -------
    Additivity
        `measured` is the mean outer product of scores, `summed` the mean of the summed information.

    Notes
    -----
    [S] Lemma 13, with the reason it holds in adaptive experiments: scores are martingale differences.
    """
    from inspect import isgeneratorfunction
    from statistics import NormalDist

    if replicates < 100:
        raise InputError(
            f"replicates is {replicates}; a standard error that can be trusted needs at least 100."
        )
    one = information or information_of_signal
    n = len(plant.free)
    outer, expected = np.zeros((replicates, n, n)), np.zeros((replicates, n, n))
    target = getattr(method, "func", method)  # a functools.partial of a rule
    for r in range(replicates):
        experiment, rng = simulated(plant, seed=seed, replicate=r), np.random.default_rng([seed, r])
        if isgeneratorfunction(target):
            trace = run(method, experiment, samples=samples, experiments=experiments, rng=rng)  # type: ignore[arg-type]
        else:
            trace = method(experiment, samples=samples, iterations=experiments, rng=rng)  # type: ignore[call-arg]
        score = np.zeros(n)
        for record in trace.records:  # type: ignore[union-attr]
            score += score_of(plant, record.u, record.y)
            expected[r] += one(plant, record.u)
        outer[r] = np.outer(score, score)
    mean = expected.mean(axis=0)
    covariance(mean, plant.free)  # raises NotIdentifiable, naming the null directions, where mean is singular
    scale = np.linalg.inv(np.linalg.cholesky(mean))
    difference = np.einsum("ij,rjk,lk->ril", scale, outer - expected, scale)
    se = difference.std(axis=0, ddof=1) / np.sqrt(replicates)
    z = np.abs(difference.mean(axis=0)) / np.where(se > 0, se, np.inf)
    threshold = NormalDist().inv_cdf(1 - false_alarm_rate / (n * (n + 1)))
    worst = float(z.max())
    raw_se = (outer - expected).std(axis=0, ddof=1) / np.sqrt(replicates)
    message = (
        f"mean outer product of scores and summed information differ by at most {worst:.2f} standard errors over "
        f"{replicates} runs of {experiments} experiments (threshold {threshold:.2f}, false-alarm rate {false_alarm_rate:g})"
    )
    return Additivity(bool(worst <= threshold), worst, threshold, outer.mean(axis=0), mean, raw_se, message)


def score_of(plant: Plant, u: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Score of one experiment from rest: gradient of its log-likelihood at the plant's parameters.

    Parameters
    ----------
    plant : Plant
        The plant.
    u, y : ndarray
        (N, nu) and (N, ny).

    Returns
    -------
    ndarray
        (n,), sum over samples of psi_t Lambda^-1 e_t.
    """
    e = decoloured(plant, y - plant.simulate(u))
    weighted = np.linalg.solve(plant.noise_covariance, e.T).T
    return np.einsum("tnp,tp->n", signal_gradient(plant, u), weighted)
