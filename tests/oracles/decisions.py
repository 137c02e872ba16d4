"""How many samples an input needs to decide between two models, by Monte Carlo with standard errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.model.fitting import Fit, levenberg_marquardt
from estimators.diagnosis.model.simulation import simulate

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Decision:
    """Right decisions by the length of the experiment.

    `lengths` (K,) samples of the experiment; `rates` (K,) share of right decisions; `standard_errors` (K,) of
    the shares, binomial; `samples` length at which the share first reaches the wanted one, interpolated;
    infinite where it does not; `samples_error` its standard error, by a bootstrap over the replicates; NaN
    where that is infinite.
    """

    lengths: Array
    rates: Array
    standard_errors: Array
    samples: float
    samples_error: float


def _crossing(lengths: Array, rates: Array, wanted: float) -> float:
    """Length at which the running maximum of the rates passes `wanted`, from half right at length 0."""
    x = np.concatenate(([0.0], lengths))
    y = np.maximum.accumulate(np.concatenate(([0.5], rates)))
    above = np.flatnonzero(y >= wanted)
    if not len(above):
        return float("inf")
    k = int(above[0])
    return float(x[k - 1] + (x[k] - x[k - 1]) * (wanted - y[k - 1]) / max(y[k] - y[k - 1], 1e-12))


def decision_samples(
    a: Fit,
    b: Fit,
    u: Array,
    *,
    lengths: tuple[int, ...],
    noise: float,
    replicates: int,
    rng: np.random.Generator,
    wanted: float = 0.9,
) -> Decision:
    """Samples of an input that decide between two models with a wanted probability.

    Shapes: u (N,).

    Both models are fitted again to the old record and the new experiment together (Gauss-Newton steps on the
    new errors, the old record's information as a prior): the one with the smaller cost is decided for.
    """
    right = np.zeros((len(lengths), replicates), dtype=bool)
    for r in range(replicates):
        truth = (a, b)[r % 2]
        clock = Clock(np.arange(float(len(u))), len(u))
        clean = simulate(truth.structure, truth.p, u[:, None], clock, rest=True)
        y = clean + noise * rng.standard_normal(len(u))
        for i, n in enumerate(lengths):
            costs = [_cost(f, u[:n], y[:n], noise) for f in (a, b)]
            right[i, r] = (costs[0] < costs[1]) == (r % 2 == 0)
    rates = right.mean(axis=1)
    x = np.array(lengths, dtype=float)
    draws = rng.integers(0, replicates, (200, replicates))
    again = np.array([_crossing(x, right[:, rows].mean(axis=1), wanted) for rows in draws])
    value = _crossing(x, rates, wanted)
    error = float(np.std(again[np.isfinite(again)])) if np.isfinite(value) else float("nan")
    return Decision(x, rates, np.sqrt(rates * (1 - rates) / replicates), value, error)


def _cost(f: Fit, u: Array, y: Array, noise: float) -> float:
    """Smallest |new errors|^2/noise^2 + |J_old (p - p_old)|^2/s_old^2 over the parameters, by Gauss-Newton."""
    n = len(u)
    clock = Clock(np.arange(float(n)), n)
    prior = f.jacobian / np.sqrt(f.variance)
    steps = 1e-5 * f.scales

    def errors(p: Array) -> Array | None:
        out = simulate(f.structure, p, u[:, None], clock, rest=True)
        return (
            None if not np.all(np.isfinite(out)) else np.concatenate(((out - y) / noise, prior @ (p - f.p)))
        )

    _, cost, _ = levenberg_marquardt(errors, f.p, f.scales, iterations=4, steps=steps)
    return cost
