"""Checks of information additivity that a user's own pytest calls on their plant and their method.

Lemma 13 of [S]: the information of several experiments is the sum of their informations, also where the input
of each depends on the noise of those before. With s_k the score of experiment k and J_k the information of the input that
was applied in it, t_k = J_k^-1/2 s_k are then independent standard normal vectors: given the past, the score is a fixed
linear map of fresh Gaussian noise. That joint law is what is tested; E s s' = sum E J_k is its second moment alone.

    result = additivity_by_monte_carlo(plant, method, samples=200, experiments=5, resolution=0.1)
    assert result, result

With the pytest plugin that the package registers, the fixture `information_adds_up` does the same."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.rules.trace import Rule, Trace, run
from oed.errors import InputError
from oed.experiments import decoloured, simulated
from oed.information import covariance, information_of_signal, signal_gradient
from oed.plants.plant import Plant
from oed.plants.systems import as_plant

Information = Callable[[Plant, NDArray[np.float64]], NDArray[np.float64]]

POWER = 0.9
"""Probability with which an error of the size of the resolution is found."""
FEWEST = 100
"""Replicates below which the laws of the statistics are not those of large samples."""
EMPTY = 1e-10
"""Eigenvalue of an information, relative to the mean one, that counts as none; what a score has there is relative to 1."""


@dataclass(frozen=True, eq=False)
class Additivity:
    """Outcome of a check; true where the information is additive. `holds` whether no statistic is beyond its
    threshold; `discrepancy` the smallest p-value; `threshold` what it is held against; `measured, summed` (n,
    n) the two sides of the equation; `standard_error` (n, n) of their difference; `message` the sentence a
    user reads; `resolution` relative error of the information in a single direction that would have been
    found with a probability of 90 %; `p_values` what was tested of the joint law, and how likely a
    discrepancy at least as large is where it holds."""

    holds: bool
    discrepancy: float
    threshold: float
    measured: NDArray[np.float64]
    summed: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    message: str
    resolution: float = 0.0
    p_values: dict[str, float] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return self.holds

    def __repr__(self) -> str:
        rows = [f"  {name}: p = {p:.2g}{' <-' * (p < self.threshold)}" for name, p in self.p_values.items()]
        return "\n".join([f"{'additive' if self.holds else 'NOT additive'}: {self.message}", *rows])


def additivity_by_monte_carlo(
    plant: Plant,
    method: Rule | Callable[..., Trace],
    *,
    samples: int = 200,
    experiments: int = 5,
    resolution: float = 0.1,
    replicates: int | None = None,
    seed: int = 0,
    false_alarm_rate: float = 1e-3,
    information: Information | None = None,
) -> Additivity:
    """Whether the scores of adaptive experiments have the law under which their informations add up.

    The scores, each whitened by the information of its own experiment, must be independent standard normal vectors:
    their means, their covariance within an experiment (a wrong information), between experiments (an input that knows
    the noise), the correlation of their squares (noise that experiments share), and the distribution of all.

    Parameters
    ----------
    plant : Plant
        The plant, simulated with its noise.
    method : callable
        A rule (generator function, as for `run`) or `method(experiment, *, samples, iterations, rng) -> Trace`.
    samples, experiments : int
        Length and number of the experiments of one replicate.
    resolution : float
        The relative error of the information in one direction that is to be found with a probability of 90 %; the number
        of replicates follows from it, at least 100.
    replicates : int, optional
        Instead of the resolution, at least 100.
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
        `measured` is the mean outer product of the summed scores, `summed` the mean of the summed information.

    Raises
    ------
    InputError
        If there are too few replicates, or the resolution is not between 0 and 1.
    NotIdentifiable
        If the experiments together tell nothing about a combination of the parameters, which is named.

    Notes
    -----
    [S] Lemma 13, with the reason it holds in adaptive experiments: scores are martingale differences.
    """
    plant = as_plant(plant)
    n, M = len(plant.free), experiments
    found_at = _found_at(n, false_alarm_rate / 5)
    if replicates is None:
        if not 0 < resolution < 1:
            raise InputError(f"the resolution is {resolution}; it is a relative error, between 0 and 1.")
        replicates = max(int(np.ceil(2 * found_at / (M * resolution**2))), FEWEST)
    if replicates < FEWEST:
        raise InputError(
            f"replicates is {replicates}; a standard error that can be trusted needs at least {FEWEST}."
        )
    one = information or information_of_signal
    scores, each = np.zeros((replicates, M, n)), np.zeros((replicates, M, n, n))
    for r, records in enumerate(_replicates(plant, method, samples, M, replicates, seed)):
        for k, record in enumerate(records):
            scores[r, k], each[r, k] = score_of(plant, record.u, record.y), one(plant, record.u)
    total, expected = scores.sum(axis=1), each.sum(axis=1)
    outer, mean = total[:, :, None] * total[:, None, :], expected.mean(axis=0)
    covariance(mean, plant.free)  # raises NotIdentifiable, naming the null directions, where mean is singular
    t, outside = _whitened_scores(scores, each, mean / M, np.random.default_rng([seed, replicates]))
    p_values = _p_values(t)
    if outside > EMPTY**0.5:
        p_values["a score where the information is zero"] = 0.0
    threshold, worst = false_alarm_rate / 5, min(p_values.values())
    smallest = float(np.sqrt(2 * found_at / (M * replicates)))
    message = (
        f"scores of {replicates} runs of {M} experiments against their joint law, false-alarm rate {false_alarm_rate:g}; an "
        f"information wrong by {smallest:.1%} in one direction would have been found with probability {POWER:g}"
    )
    spread = (outer - expected).std(axis=0, ddof=1) / np.sqrt(replicates)
    return Additivity(
        bool(worst >= threshold), worst, threshold, outer.mean(axis=0), mean, spread, message, smallest, p_values,
    )  # fmt: skip


def _replicates(
    plant: Plant, method: Rule | Callable[..., Trace], samples: int, experiments: int, replicates: int, seed: int,
) -> Iterator[Any]:  # fmt: skip
    from inspect import isgeneratorfunction

    rule = isgeneratorfunction(getattr(method, "func", method))  # also a functools.partial of a rule
    for r in range(replicates):
        experiment, rng = simulated(plant, seed=seed, replicate=r), np.random.default_rng([seed, r])
        if rule:
            yield run(method, experiment, samples=samples, experiments=experiments, rng=rng).records  # type: ignore[arg-type]
        else:
            yield method(experiment, samples=samples, iterations=experiments, rng=rng).records  # type: ignore[call-arg,union-attr]


def _found_at(n: int, level: float) -> float:
    """Noncentrality of chi-squared with n (n + 1) / 2 degrees of freedom that a test of the level finds with POWER."""
    from scipy.stats import chi2, ncx2

    df = n * (n + 1) / 2
    limit, low, high = chi2.isf(level, df), 0.0, 1e4
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if ncx2.sf(limit, df, middle) > POWER else (middle, high)
    return high


def _whitened_scores(
    scores: NDArray, each: NDArray, unit: NDArray, rng: np.random.Generator
) -> tuple[NDArray[np.float64], float]:
    """(R, M, n) J_k^-1/2 s_k, and the largest part of a score that lies where its information is none.
    Directions without information get standard normal numbers: nothing is claimed of them."""
    scale = np.linalg.inv(np.linalg.cholesky(unit))
    s, J = scores @ scale.T, scale @ each @ scale.T
    values, vectors = np.linalg.eigh((J + J.swapaxes(-1, -2)) / 2)
    turned = np.einsum("rkij,rki->rkj", vectors, s)
    known = values > EMPTY
    t = np.where(known, turned / np.sqrt(np.where(known, values, 1.0)), rng.standard_normal(turned.shape))
    return np.einsum("rkij,rkj->rki", vectors, t), float(np.max(np.abs(turned), where=~known, initial=0.0))


def _p_values(t: NDArray[np.float64]) -> dict[str, float]:
    """Of five statistics of (R, M, n) numbers that are independent and standard normal if information adds up."""
    from scipy.stats import chi2, kstest

    R, M, n = t.shape
    within = np.einsum("rki,rkj->ij", t, t) / (R * M) - np.eye(n)
    flat = t.reshape(R, M * n)
    between = np.triu(((flat.T @ flat / R) ** 2).reshape(M, n, M, n).sum(axis=(1, 3)), 1).sum()
    size = (np.sum(t**2, axis=2) - n) / np.sqrt(2 * n)
    together = np.triu((size.T @ size / R) ** 2, 1).sum()
    pairs = M * (M - 1) / 2
    found = {
        "mean of the scores": chi2.sf(R * np.sum(t.mean(axis=0) ** 2), M * n),
        "information of an experiment against its scores": chi2.sf(
            R * M / 2 * np.sum(within**2), n * (n + 1) / 2
        ),
        "normal distribution of the scores": kstest(t.ravel(), "norm").pvalue,
    }
    if M > 1:
        others = 2 * (n * (M - 1) - 1)
        found |= {
            "scores of different experiments": _uncorrelated(R * between, R, pairs * n * n, others, 3.0),
            "sizes of the scores of different experiments": _uncorrelated(
                R * together, R, pairs, 2 * (M - 2), 3 + 12 / n
            ),
        }
    return {name: float(p) for name, p in found.items()}


def _uncorrelated(value: float, R: int, pairs: float, sharing: float, fourth: float) -> float:
    """P-value of R times the sum of the squared correlations of pairs of independent variables of R values.
    Each pair shares a variable with `sharing` others; the variables have the fourth moment `fourth`. Their
    exact mean and variance are those of a scaled chi-squared; a plain one rejects 3 % at a level of .1 % of
    20 experiments in 100 runs."""
    from scipy.stats import chi2

    variance = pairs * (2 + (fourth**2 - 3) / R + sharing * (fourth - 1) / R)
    return float(chi2.sf(value * 2 * pairs / variance, 2 * pairs**2 / variance))


def score_of(plant: Plant, u: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Score of one experiment from rest: gradient of its log-likelihood at the plant's parameters; u, y (N,
    nu) -> (n,)."""
    e = decoloured(plant, y - plant.simulate(u))
    weighted = np.linalg.solve(plant.noise_covariance, e.T).T
    return np.einsum("tnp,tp->n", signal_gradient(plant, u), weighted)
