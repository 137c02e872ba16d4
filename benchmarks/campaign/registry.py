"""What is compared: methods, which choose the inputs, and estimators, which turn the records into a norm.

The two are kept apart because the question is which of them earns the gain. A method is a function
`method(experiment, *, samples, iterations, rng) -> Trace`; an estimator a function
`estimator(trace, plant) -> Estimate` that may use the plant's structure (orders, delay) but not its values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from estimators.norm.gains import gain, mu, rayleigh
from estimators.rules import inputs
from estimators.rules.averaging import averaged_iterations
from estimators.rules.bandit import thompson_sampling
from estimators.rules.krylov import lanczos, ritz
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import Rule, Trace, run
from oed.errors import InputError, OedError, Status, check_names
from oed.experiments import Experiment
from oed.plants.plant import Plant

__all__ = ["ESTIMATORS", "METHODS", "Estimate", "Estimator", "Method", "compatible", "fits", "method_for"]

Method = Callable[..., Trace]


@dataclass(frozen=True)
class Estimate:
    """An estimate of the H-infinity norm.

    `value` naN where the estimator failed; `standard_error` as the estimator states it; NaN where it states
    none; `status` how it ended; `message` why, where it failed.
    """

    value: float
    standard_error: float = float("nan")
    status: Status = Status.OK
    message: str = ""


Estimator = Callable[[Trace, Plant], Estimate]


def _run_rule(rule: Rule, experiment: Experiment, *, samples: int, iterations: int, rng: Any) -> Trace:
    return run(rule, experiment, samples=samples, experiments=iterations, rng=rng)


def _rule(rule: Rule) -> Callable[[Plant], Method]:
    return lambda plant: partial(_run_rule, rule)


def _oracle(criterion: str) -> Callable[[Plant], Method]:
    """The signal of the optimal spectrum of the true plant, with new phases in every experiment."""

    def build(plant: Plant) -> Method:
        from oed.design import solve_design

        spectrum = solve_design(plant, criterion).spectrum

        def rule(samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator) -> Any:
            from oed.signals.synthesis import realise

            while True:
                yield realise(spectrum, samples, rng=rng)

        return partial(_run_rule, rule)

    return build


def _adaptive(name: str) -> Callable[[Plant], Method]:
    """Two-stage or sequential optimal design: the structure of the plant is known, its values are not."""

    def build(plant: Plant) -> Method:
        from estimators.rules import adaptive

        nb, nf, nk = model_orders(plant)

        def method(experiment: Experiment, *, samples: int, iterations: int, rng: Any) -> Trace:
            rule = getattr(adaptive, name)((nb, nf), nk, experiments=iterations)
            return _run_rule(rule, experiment, samples=samples, iterations=iterations, rng=rng)

        return method

    return build


METHODS: dict[str, Callable[[Plant], Method]] = {
    "white": _rule(inputs.white),
    "multisine": _rule(inputs.multisine),
    "prbs": _rule(inputs.prbs),
    "sweep": _rule(inputs.sweep),
    "power": _rule(power_iterations),
    "averaged": _rule(averaged_iterations),
    "two-experiment": _rule(partial(procedure_2, scaling="each")),
    "procedure-2": _rule(partial(procedure_2, scaling="each")),
    "krylov": _rule(lanczos),
    "bandit": _rule(thompson_sampling),
    "two-stage": _adaptive("two_stage"),
    "sequential": _adaptive("sequential"),
    "oracle-D": _oracle("D"),
    "oracle-hinf": _oracle("hinf"),
}


def complete(trace: Trace) -> Trace:
    """The trace without a last iteration that the budget cut short."""
    iterations = trace.iterations
    if len(iterations) < 2:
        return trace
    sizes = [part.stop - part.start for part in iterations]
    return trace if sizes[-1] == sizes[0] else trace.first(iterations[-1].start)


def _from_gains(name: str, compute: Callable[[Trace], Any]) -> Estimator:
    def estimate(trace: Trace, plant: Plant) -> Estimate:
        gains = compute(complete(trace))
        return Estimate(
            gains.last, status=gains.status, message="" if gains.status.ok else gains.status.value
        )

    estimate.__name__ = name
    return estimate


def model_orders(plant: Plant) -> tuple[Any, Any, Any]:
    """Numerator and denominator orders and delays of a plant, entry by entry, as `identify` takes them."""
    nk = [[int(np.flatnonzero(B)[0]) if np.any(B) else 0 for B in row] for row in plant.num]
    nb = [
        [len(B) - k if np.any(B) else 0 for B, k in zip(*rows, strict=True)]
        for rows in zip(plant.num, nk, strict=True)
    ]
    nf = [[len(A) - 1 for A in row] for row in plant.den]
    if plant.n_inputs * plant.n_outputs == 1:
        return nb[0][0], nf[0][0], nk[0][0]
    return nb, nf, nk


ENOUGH = 5000
"""Samples from which on a fit tries only the starts by linear algebra: in 19 runs on three plants of order 4 to 20 the
wider search, which takes four times as long, ended at the same optimum to the last bit."""


def prediction_error(trace: Trace, plant: Plant) -> Estimate:
    """Output-error identification on all records together, orders and delay known, then the norm."""
    from estimators.pem import identify

    nb, nf, nk = model_orders(plant)
    try:
        search = "quick" if trace.usage.samples >= ENOUGH else "auto"
        fit = identify(list(trace.records), "oe", (nb, nf), delay=nk, search=search, offset=False)
        value, error, *_ = fit.hinf_norm
    except OedError as failure:
        return Estimate(float("nan"), status=Status.FAILED, message=str(failure))
    if not np.isfinite(value):
        return Estimate(float("nan"), status=fit.status if not fit.status.ok else Status.NOT_FINITE)
    return Estimate(float(value), float(error), fit.status, "" if fit.status.ok else fit.status.value)


def prediction_error_selected(trace: Trace, plant: Plant) -> Estimate:
    """Output-error identification with orders 1 to 4 and delays 0 to 3 chosen by the Bayesian criterion."""
    from estimators.pem.choice import select_orders

    if plant.n_inputs * plant.n_outputs != 1:
        return Estimate(
            float("nan"), status=Status.FAILED, message="order selection is for one input and one output"
        )
    try:
        choice = select_orders(
            list(trace.records), "oe", [(n, n) for n in (1, 2, 3, 4)], delays=range(4), offset=False
        )
        value, error, *_ = choice.fit.hinf_norm
    except OedError as failure:
        return Estimate(float("nan"), status=Status.FAILED, message=str(failure))
    return Estimate(float(value), float(error), choice.fit.status)


def _peak_estimator(module: str, function: str) -> Estimator:
    """An estimator of `estimators` that returns a PeakEstimate."""

    def estimate(trace: Trace, plant: Plant) -> Estimate:
        from importlib import import_module

        found = getattr(import_module(f"estimators.{module}"), function)(trace)
        return _from_peak(found)

    return estimate


def _from_peak(found: Any) -> Estimate:
    return Estimate(
        found.value, found.standard_error, found.status, "" if found.status.ok else found.status.value
    )


def fir_known(trace: Trace, plant: Plant) -> Estimate:
    """Impulse response by least squares with as many taps as hold 99.99 % of the plant's energy."""
    from estimators.norm.fir import peak_of_fir, plug_in

    energy = np.cumsum(np.sum(plant.impulse_response(400) ** 2, axis=(1, 2)))
    taps = int(np.searchsorted(energy, 0.9999 * energy[-1])) + 1
    return _from_peak(peak_of_fir(plug_in(trace, min(taps, len(trace.records[0]) // 4))))


def fir_selected(trace: Trace, plant: Plant) -> Estimate:
    """Impulse response by least squares with the number of taps chosen by the Bayesian criterion."""
    from estimators.norm.fir import peak_of_fir, plug_in

    return _from_peak(peak_of_fir(plug_in(trace)))


def frequency_response_peak(trace: Trace, plant: Plant) -> Estimate:
    """Averaged frequency response on the DFT lines, and its largest gain."""
    from estimators.norm.frf import frequency_response, peak_of_response

    return _from_peak(peak_of_response(frequency_response(trace)))


ESTIMATORS: dict[str, Estimator] = {
    "rayleigh": _from_gains("rayleigh", rayleigh),
    "gain": _from_gains("gain", lambda trace: ritz(trace) if trace.kinds[0] == "krylov" else gain(trace)),
    "mu": _from_gains("mu", mu),
    "corrected": _peak_estimator("norm.peak_estimates", "corrected"),
    "fixed-point": _peak_estimator("norm.peak_estimates", "fixed_point"),
    "theorem-12": _peak_estimator("norm.peak_estimates", "theorem_12"),
    "fir-known": fir_known,
    "fir-selected": fir_selected,
    "frf": frequency_response_peak,
    "lpm": _peak_estimator("norm.frf", "lpm"),
    "bandit": _peak_estimator("rules.bandit", "best_arm"),
    "pem": prediction_error,
    "pem-selected": prediction_error_selected,
}

APPLIES = {
    "rayleigh": ("power",),
    "gain": ("power", "two-experiment", "procedure-2", "krylov"),
    "mu": ("power", "two-experiment", "procedure-2"),
    "corrected": ("power", "averaged", "two-experiment", "procedure-2"),
    "fixed-point": ("power",),
    "theorem-12": ("power",),
    "bandit": ("bandit",),
}
"""Inputs on which the iterations' own estimators mean something; the others apply everywhere."""


def compatible(method: str, estimator: str) -> bool:
    """Whether an estimator can be applied to the records of a method."""
    return method in APPLIES.get(estimator, (method,))


SINGLE_CHANNEL = ("power", "averaged", "two-experiment", "krylov", "bandit")
"""Inputs that are made for one input and one output."""


def fits(method: str, plant: Plant) -> bool:
    """Whether an input is made for the channels of a plant."""
    return plant.n_inputs * plant.n_outputs == 1 or method not in SINGLE_CHANNEL


def method_for(name: str, plant: Plant) -> Method:
    """A method by name, ready for a plant (oracle methods compute their input from it)."""
    check_names([name], tuple(METHODS), "method")
    if not fits(name, plant):
        raise InputError(
            f"the method {name} is for one input and one output and {plant.name} has {plant.n_inputs} and "
            f"{plant.n_outputs}; use procedure-2."
        )
    return METHODS[name](plant)
