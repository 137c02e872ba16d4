"""The iterative algorithms by name, run with all the estimates that go with them."""

from collections.abc import Callable
from functools import partial

import numpy as np

from estimators.norm.gains import Gains, gain, mu, rayleigh
from estimators.rules.limits import Limits
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import Rule, Trace, run
from oed.errors import InputError, check_names
from oed.experiments import Experiment

ALGORITHMS = ("siso", "procedure-1", "two-experiment", "mimo")


def algorithm_rule(
    algorithm: str, n_inputs: int, n_outputs: int, *, scaling: str = "none", limits: Limits | None = None
) -> tuple[Rule, int]:
    """The rule of an algorithm and its number of experiments per iteration."""
    check_names([algorithm], ALGORITHMS, "algorithm")
    if algorithm in ("siso", "procedure-1"):
        return partial(power_iterations, limits=limits), 1
    if algorithm == "two-experiment" and (n_inputs, n_outputs) != (1, 1):
        raise InputError(
            f"the two-experiment scheme needs one input and one output, and the system has {n_inputs} and "
            f"{n_outputs}; use the algorithm mimo."
        )
    return partial(procedure_2, scaling=scaling, limits=limits), 1 + n_inputs * n_outputs


def iterate(
    experiment: Experiment, *, algorithm: str = "siso", samples: int, iterations: int, scaling: str = "none",
    limits: Limits | None = None, rng: np.random.Generator, stop: Callable[[Trace], bool] | None = None,
) -> tuple[Trace, dict[str, Gains]]:  # fmt: skip
    """Run an algorithm and evaluate its estimators."""
    rule, each = algorithm_rule(
        algorithm, experiment.n_inputs, experiment.n_outputs, scaling=scaling, limits=limits
    )
    trace = run(rule, experiment, samples=samples, experiments=iterations * each, rng=rng, stop=stop)
    estimators = (rayleigh, gain, mu) if each == 1 else (gain, mu)
    return trace, {g.name: g for g in (estimator(trace) for estimator in estimators)}
