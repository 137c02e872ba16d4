"""What is compared: methods, which choose the inputs, and estimators, which turn the records into a norm.

The two are kept apart because the question is which of them earns the gain. A method is a function
`method(experiment, *, samples, iterations, rng) -> Trace`. What either is told beforehand is part of its entry here, and it
is handed no more than that: nothing, the structure (orders, delay, length), or the plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import partial
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

import numpy as np

import estimators.rules
from estimators.norm.gains import gain, mu, rayleigh
from estimators.rules.krylov import ritz
from estimators.rules.trace import OFFERS, Rule, Trace, run
from oed.errors import InputError, OedError, Status, check_names
from oed.experiments import Experiment
from oed.plants.plant import Plant

Method = Callable[..., Trace]


@dataclass(frozen=True)
class Estimate:
    """An estimate of the H-infinity norm. `value` NaN where the estimator failed; `standard_error` as the
    estimator states it; NaN where it states none; `status` how it ended; `message` why, where it failed."""

    value: float
    standard_error: float = float("nan")
    status: Status = Status.OK
    message: str = ""

    @classmethod
    def of(cls, value: float, status: Status, standard_error: float = float("nan")) -> Estimate:
        """An estimate whose message is its status in words."""
        return cls(value, standard_error, status, "" if status.ok else status.value)


class Told(Enum):
    """What an input or an estimator is told beforehand; the values are the words of the tables, least first."""

    NOTHING = "nothing"
    STRUCTURE = "structure"
    PLANT = "plant"


@dataclass(frozen=True)
class Structure:
    """What is known of a plant where only its structure is: no value of a parameter. `orders` numerator and
    denominator, `delay`, entry by entry as `identify` takes them; `taps` so many hold 99.99 % of the impulse
    response's energy."""

    orders: tuple[Any, Any]
    delay: Any
    taps: int


def tell(plant: Plant, what: Told) -> tuple[Any, ...]:
    """The arguments that carry what is told: none, the structure, or the plant itself."""
    if what is Told.NOTHING:
        return ()
    if what is Told.PLANT:
        return (plant,)
    nb, nf, nk = model_orders(plant)
    energy = np.cumsum(np.sum(plant.impulse_response(400) ** 2, axis=(1, 2)))
    return (Structure((nb, nf), nk, int(np.searchsorted(energy, 0.9999 * energy[-1])) + 1),)


@dataclass(frozen=True)
class Input:
    """A method of the comparison: how it is built of what it is told, and what that is."""

    build: Callable[..., Method]
    words: str
    told: Told = Told.NOTHING
    details: str = ""
    one_channel: bool = False
    iterations: bool = False

    def __call__(self, plant: Plant) -> Method:
        """The method for a plant, which itself is handed over only where the entry says so."""
        return self.build(*tell(plant, self.told))


@dataclass(frozen=True)
class Estimator:
    """An estimator of the comparison: a function of the trace and of what it is told, and what that is.
    `inputs` on whose records it means something, all where empty; `own` whether it belongs to the iterations."""

    estimate: Callable[..., Estimate]
    words: str
    told: Told = Told.NOTHING
    details: str = ""
    inputs: tuple[str, ...] = ()
    own: bool = False

    def __call__(self, trace: Trace, plant: Plant) -> Estimate:
        """The estimate; the plant is handed over only where the entry says so."""
        return self.estimate(trace, *tell(plant, self.told))


def run_rule(rule: Rule, experiment: Experiment, *, samples: int, iterations: int, rng: Any) -> Trace:
    """A rule as a method of the comparison."""
    return run(rule, experiment, samples=samples, experiments=iterations, rng=rng)


def _running(rule: Rule) -> Callable[[], Method]:
    return lambda: partial(run_rule, rule)


def _oracle(criterion: str, plant: Plant) -> Method:
    """The signal of the optimal spectrum of the true plant, with new phases in every experiment."""
    from oed.design import solve_design

    spectrum = solve_design(plant, criterion).spectrum

    def rule(samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator) -> Any:
        from oed.signals.synthesis import realise

        while True:
            yield realise(spectrum, samples, rng=rng)

    return partial(run_rule, rule)


def _adaptive(name: str, structure: Structure | None = None) -> Method:
    """Two-stage or sequential optimal design; without a structure its model's orders and delay are chosen as it goes."""

    def method(experiment: Experiment, *, samples: int, iterations: int, rng: Any) -> Trace:
        from estimators.rules import adaptive

        orders, delay = (structure.orders, structure.delay) if structure else (None, None)
        rule = getattr(adaptive, name)(orders, delay, experiments=iterations)
        return run_rule(rule, experiment, samples=samples, iterations=iterations, rng=rng)

    return method


_ORDERS = "orders and delay"
for _module in iter_modules(estimators.rules.__path__, "estimators.rules."):
    import_module(_module.name)  # which offers the rules in it
METHODS: dict[str, Input] = {
    name: Input(_running(offer.rule), offer.words, one_channel=offer.one_channel, iterations=offer.iterations)
    for name, offer in sorted(OFFERS.items())
} | {
    "two-stage": Input(partial(_adaptive, "two_stage"), "white noise first, then the optimal input of the model",
                       Told.STRUCTURE, _ORDERS),
    "sequential": Input(partial(_adaptive, "sequential"), "the optimal input of the model so far, again and again",
                        Told.STRUCTURE, _ORDERS),
    "sequential-selected": Input(partial(_adaptive, "sequential"), "the same with orders and delay chosen from the records"),
    "oracle-D": Input(partial(_oracle, "D"), "the D-optimal input of the true plant: nobody has it, a yardstick",
                      Told.PLANT, "the plant"),
    "oracle-hinf": Input(partial(_oracle, "hinf"), "the optimal input for the peak gain of the true plant: nobody has it, a "
                         "yardstick", Told.PLANT, "the plant, so the peak's frequency"),
}  # fmt: skip


def complete(trace: Trace) -> Trace:
    """The trace without a last iteration that the budget cut short."""
    iterations = trace.iterations
    if len(iterations) < 2:
        return trace
    sizes = [part.stop - part.start for part in iterations]
    return trace if sizes[-1] == sizes[0] else trace.first(iterations[-1].start)


def _from_gains(compute: Callable[[Trace], Any]) -> Callable[[Trace], Estimate]:
    def estimate(trace: Trace) -> Estimate:
        gains = compute(complete(trace))
        return Estimate.of(gains.last, gains.status)

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


def prediction_error(trace: Trace, structure: Structure) -> Estimate:
    """Output-error identification on all records together, orders and delay known, then the norm."""
    from estimators.pem import identify

    search = "quick" if trace.usage.samples >= ENOUGH else "auto"
    fit = lambda: identify(
        list(trace.records), "oe", structure.orders, delay=structure.delay, search=search, offset=False
    )
    return _norm_of(fit)


def prediction_error_selected(trace: Trace) -> Estimate:
    """Output-error identification with orders and delay chosen from the records alone."""
    from estimators.pem.choice import from_records

    return _norm_of(lambda: from_records(list(trace.records)))


def _norm_of(fitted: Callable[[], Any]) -> Estimate:
    try:
        fit = fitted()
        value, error, *_ = fit.hinf_norm
    except OedError as failure:
        return Estimate(float("nan"), status=Status.FAILED, message=str(failure))
    if not np.isfinite(value):
        return Estimate(float("nan"), status=fit.status if not fit.status.ok else Status.NOT_FINITE)
    return Estimate.of(float(value), fit.status, float(error))


def _peak_estimator(module: str, function: str) -> Callable[[Trace], Estimate]:
    """An estimator of `estimators` that returns a PeakEstimate."""

    def estimate(trace: Trace) -> Estimate:
        return _from_peak(getattr(import_module(f"estimators.{module}"), function)(trace))

    return estimate


def _from_peak(found: Any) -> Estimate:
    return Estimate.of(found.value, found.status, found.standard_error)


REGULARISED = 60
"""Taps of the regularised impulse response: the prior decides how many of them count."""


def _fir(trace: Trace, taps: int | None = None, kernel: str = "none") -> Estimate:
    from estimators.norm.fir import peak_of_fir, plug_in

    most = len(trace.records[0]) // 4
    return _from_peak(peak_of_fir(plug_in(trace, taps and min(taps, most), kernel=kernel)))


def frequency_response_peak(trace: Trace) -> Estimate:
    """Averaged frequency response on the DFT lines, and its largest gain."""
    from estimators.norm.frf import frequency_response, peak_of_response

    return _from_peak(peak_of_response(frequency_response(trace)))


_GAINED = ("power", "two-experiment", "procedure-2")
_CORRECTED = ("power", "averaged", "two-experiment", "procedure-2")
_ritz_or_gain = lambda trace: ritz(trace) if trace.kinds[0] == "krylov" else gain(trace)
_of_peaks = partial(_peak_estimator, "norm.peak_estimates")
ESTIMATORS: dict[str, Estimator] = {
    "rayleigh": Estimator(_from_gains(rayleigh), "the Rayleigh quotient of input and output ([S] (4))", inputs=("power",), own=True),
    "gain": Estimator(_from_gains(_ritz_or_gain), "the root of the quotient of the last energies ([S] (7))",
                      inputs=(*_GAINED, "krylov"), own=True),
    "mu": Estimator(_from_gains(mu), "the norm ratio of the last output and input", inputs=_GAINED, own=True),
    "corrected": Estimator(_of_peaks("corrected"), "the peak of a local model of the iterations' records: their gain without "
                           "its noise bias", inputs=_CORRECTED, own=True),
    "fixed-point": Estimator(_of_peaks("fixed_point"), "the gain at which the theory meets the measured one", inputs=("power",),
                             own=True),
    "theorem-12": Estimator(_of_peaks("theorem_12"), "the bias removed by [S] Theorem 12", inputs=("power",), own=True),
    "fir-known": Estimator(lambda trace, structure: _fir(trace, structure.taps), "least squares for the impulse response, its "
                           "length known", Told.STRUCTURE, "length"),
    "fir-selected": Estimator(_fir, "least squares for the impulse response, its length chosen from the data"),
    "fir-regularised": Estimator(partial(_fir, taps=REGULARISED, kernel="tc"), "a long impulse response that a prior expects to "
                                 "decay, as fast as the data say"),
    "frf": Estimator(frequency_response_peak, "the averaged frequency response's largest value"),
    "lpm": Estimator(_peak_estimator("norm.frf", "lpm"), "local polynomial fits of the frequency response"),
    "bandit": Estimator(_peak_estimator("rules.bandit", "best_arm"), "the best arm's mean", inputs=("bandit",)),
    "pem": Estimator(prediction_error, "prediction-error identification, orders and delay known, then the model's norm",
                     Told.STRUCTURE, _ORDERS),
    "pem-selected": Estimator(prediction_error_selected, "prediction-error identification, orders and delay chosen from the records"),
}  # fmt: skip


def told(method: str, estimator: str = "") -> Told:
    """What an input and an estimator together are told. A method of the user's own is handed an experiment
    and no plant; an estimator of the user's own is handed the plant."""
    mine = METHODS[method].told if method in METHODS else Told.NOTHING
    theirs = ESTIMATORS[estimator].told if estimator in ESTIMATORS else Told.PLANT
    return max(mine, theirs if estimator else Told.NOTHING, key=list(Told).index)


def of_the_iterations(method: str, estimator: str = "") -> bool:
    """Whether an input is one of the iterations and the estimator, where one is given, is their own."""
    mine = method in METHODS and METHODS[method].iterations
    return mine and (not estimator or (estimator in ESTIMATORS and ESTIMATORS[estimator].own))


def words_of(name: str) -> str:
    """What a name means, and what it is told; empty where it is not ours."""
    entry = METHODS.get(name) or ESTIMATORS.get(name)
    if entry is None:
        return ""
    return f"{entry.words} (is told {entry.details or 'nothing'})"


def compatible(method: str, estimator: str) -> bool:
    """Whether an estimator can be applied to the records of a method."""
    wanted = ESTIMATORS[estimator].inputs if estimator in ESTIMATORS else ()
    return not wanted or method in wanted


def fits(method: str, plant: Plant) -> bool:
    """Whether an input is made for the channels of a plant."""
    return plant.n_inputs * plant.n_outputs == 1 or method not in METHODS or not METHODS[method].one_channel


def method_for(name: str, plant: Plant) -> Method:
    """A method by name, told of a plant what its entry says."""
    check_names([name], tuple(METHODS), "method")
    if not fits(name, plant):
        raise InputError(
            f"the method {name} is for one input and one output and {plant.name} has {plant.n_inputs} and "
            f"{plant.n_outputs}; use procedure-2."
        )
    return METHODS[name](plant)
