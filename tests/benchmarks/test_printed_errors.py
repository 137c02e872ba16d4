"""Every printed +- that belongs to a known truth, in Monte Carlo: 93 to 97 % of 95 % intervals hold it.

Bands, poles and tests of a model stand in test_printed_bands, parameters in test_pem_coverage, tables in test_errors_of_few. 500 runs are `make validate`; of 100 runs of the cheapest cases here a true 95 % is missed by the bounds below with
probability 1e-3 each (binomial). What is not sure says so with its status and does not count, but a quarter at least must.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import binom

from estimators.norm.peak_estimates import corrected
from estimators.norm.worst_inputs import worst_case
from estimators.pem import identify, identify_response
from estimators.rules.by_name import iterate
from estimators.sessions import Session, Settings
from oed.data import Record
from oed.experiments import simulated
from oed.plants.named import named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant

Row = dict[str, tuple[float, float, float]]
"""What is printed, its standard error, and the truth."""


def broad(radius: float, name: str) -> Plant:
    """A peak near 0.4 rad/sample so broad that the local model's band reaches over frequency 0."""
    den = np.poly(radius * np.exp([0.45j, -0.45j])).real
    return Plant([0, 0.3, 0.1], den, noise_covariance=0.25, name=name)


def of_iterate(plant: Plant, algorithm: str, samples: int, iterations: int, seed: int) -> Row:
    trace, _ = iterate(
        simulated(plant, seed=seed), algorithm=algorithm, samples=samples, iterations=iterations,
        rng=np.random.default_rng([seed, 0]),
    )  # fmt: skip
    found, true = corrected(trace), peak(plant)
    if not found.located:
        return {}
    return {
        "value": (found.value, found.standard_error, true.value),
        "frequency": (found.frequency, found.frequency_error, true.frequency),
    }


def of_session(plant: Plant, method: str, samples: int, experiments: int, seed: int) -> Row:
    names = {
        side: tuple(f"{side[0]}{k}" for k in range(count))
        for side, count in (("inputs", plant.n_inputs), ("outputs", plant.n_outputs))
    }
    session = Session(Settings(method, samples=samples, experiments=experiments, seed=seed, **names))
    found, true = session.run(simulated(plant, seed=seed)), peak(plant)
    if not np.isfinite(found.frequency_error):
        return {}
    return {
        "value": (found.value, found.standard_error, true.value),
        "frequency": (found.frequency, found.frequency_error, true.frequency),
    }


def of_response(seed: int) -> Row:
    """`oed identify response.csv`: a measured frequency response with the variance of every line."""
    plant, rng = named_plant("reference", 1.0), np.random.default_rng(seed)
    omega = np.linspace(0.05, 3.0, 60)
    variance = 10 ** rng.uniform(-4, -2, 60)
    noise = rng.normal(size=(60, 2)) @ [1, 1j] * np.sqrt(variance / 2)
    fit = identify_response(
        plant.response(omega)[0][:, 0, 0] + noise, (2, 2), omega=omega, variance=variance, dt=1.0
    )
    return {
        name: (value, error, truth)
        for name, value, error, truth in zip(
            fit.model.names,
            fit.model.theta,
            fit.standard_errors,
            [0.2155, 0.2012, -0.9854, 0.8187],
            strict=True,
        )
    }


def of_identify(seed: int) -> Row:
    """`oed identify record.csv --structure oe --orders 2 2` of a record with a level, begun in motion."""
    plant, level = named_plant("reference", 1.0), 3.0
    u = np.random.default_rng(seed).normal(size=(1600, 1))
    y = simulated(plant, seed=seed)(u) + level
    fit, true = identify(Record(u[100:], y[100:]), "oe", (2, 2)), peak(plant)
    mean = float(plant.response([0.0])[0][0, 0, 0].real * u[100:].mean())
    rows = {
        name: (value, error, truth)
        for name, value, error, truth in zip(
            fit.names, fit.theta, fit.standard_errors, [0.2155, 0.2012, -0.9854, 0.8187], strict=True
        )
    }
    value, error, frequency = fit.hinf_norm
    return rows | {
        "level": (float(fit.output_level[0]), float(fit.output_level_errors[0]), level + mean),
        "value": (value, error, true.value),
        "frequency": (frequency, fit.hinf_frequency_error, true.frequency),
    }


REFERENCE, SEVERAL = named_plant("reference", 1.0), named_plant("three-by-two", 1.0)
CASES: dict[str, Callable[[int], Row]] = {
    "iterate": lambda seed: of_iterate(REFERENCE, "siso", 1000, 50, seed),
    "iterate, variance 9": lambda seed: of_iterate(named_plant("reference", 9.0), "siso", 1000, 50, seed),
    "iterate, several channels": lambda seed: of_iterate(SEVERAL, "mimo", 300, 20, seed),
    "iterate, two experiments": lambda seed: of_iterate(REFERENCE, "two-experiment", 1000, 20, seed),
    "iterate, procedure 1": lambda seed: of_iterate(REFERENCE, "procedure-1", 1000, 20, seed),
    "iterate, short": lambda seed: of_iterate(REFERENCE, "siso", 200, 20, seed),
    "iterate, order 20": lambda seed: of_iterate(named_plant("order-20", 1.0), "siso", 1000, 20, seed),
    "iterate, peak at 0": lambda seed: of_iterate(named_plant("peak-at-zero", 1.0), "siso", 1000, 20, seed),
    "iterate, two peaks": lambda seed: of_iterate(named_plant("two-peaks", 1.0), "siso", 1000, 20, seed),
    "session sequential": lambda seed: of_session(REFERENCE, "sequential", 500, 6, seed),
    "session procedure-2": lambda seed: of_session(SEVERAL, "procedure-2", 300, 42, seed),
    "session power": lambda seed: of_session(REFERENCE, "power", 500, 10, seed),
    "session power, broad peak": lambda seed: of_session(broad(0.8, "p45"), "power", 200, 10, seed),
    "session two-stage": lambda seed: of_session(REFERENCE, "two-stage", 500, 4, seed),
    "identify": of_identify,
    "identify, a frequency response": of_response,
    "session bandit": lambda seed: of_session(REFERENCE, "bandit", 500, 10, seed),
}


CAUTIOUS = ("session power, broad peak", "iterate, peak at 0")
"""Where the band of the local model is as wide as the peak: what the width leaves open is added, and is too much. And a peak at
0, which no estimate passes."""


def coverage(case: Callable[[int], Row], runs: int) -> dict[str, tuple[int, int]]:
    """How many 95 % intervals hold the truth, of how many that were printed."""
    rows = [row for row in map(case, range(runs)) if row]
    assert len(rows) > runs / 4, "the status refuses too much"
    held = lambda name: sum(abs(r[name][0] - r[name][2]) < 1.959964 * r[name][1] for r in rows)
    return {name: (held(name), len(rows)) for name in rows[0]}


def checked(name: str, case: Callable[[int], Row], runs: int, record_figure) -> None:
    """Every figure in 93 to 97 %, up to what so many runs leave open (one in a thousand of a true 93 and of a true 97 %)."""
    found = coverage(case, runs)
    shares = {key: held / total for key, (held, total) in found.items()}
    record_figure(f"coverage of what is printed: {name}", shares, runs=runs)
    for held, total in found.values():
        most = total if name in CAUTIOUS else binom.isf(1e-3, total, 0.97)
        assert binom.ppf(1e-3, total, 0.93) <= held <= most, shares


@pytest.mark.validate
@pytest.mark.parametrize("name", CASES)
def test_coverage(name: str, record_figure) -> None:
    checked(name, CASES[name], 500, record_figure)


@pytest.mark.parametrize(
    "name", ["session power, broad peak", "session power", "identify", "identify, a frequency response"]
)
def test_coverage_of_few_runs(name: str) -> None:
    for key, (held, total) in coverage(CASES[name], 100).items():
        assert binom.ppf(5e-4, total, 0.93) <= held, (key, held, total)


def test_negative_control_the_spread_of_the_inputs_of_one_run_is_no_error() -> None:
    """What was printed once: the last ten inputs of a run depend on each other, and their spread covers a fifth."""
    from estimators.norm.worst_inputs import dominant_frequency

    true, held = peak(REFERENCE).frequency, 0
    for seed in range(40):
        trace, _ = iterate(
            simulated(REFERENCE, seed=seed), algorithm="siso", samples=300, iterations=20,
            rng=np.random.default_rng([seed, 0]),
        )  # fmt: skip
        near = np.array([dominant_frequency(r.u) for r in trace.records[-10:]])
        held += abs(worst_case(trace).frequency - true) < 1.959964 * near.std(ddof=1)
    assert held < binom.ppf(5e-4, 40, 0.93)


def test_a_session_names_no_frequency_0_where_the_peak_is_elsewhere() -> None:
    """The band reaches over 0, where the model is symmetric: of its two equal peaks either may be the higher by rounding."""
    plant = broad(0.8, "p45")
    for seed in (14, 18):  # these were 0 with status OK
        found = Session(Settings("power", samples=100, experiments=10, seed=seed)).run(
            simulated(plant, seed=seed)
        )
        assert abs(found.frequency - peak(plant).frequency) < 4 * found.frequency_error < 0.2


def test_a_frequency_that_is_not_known_is_not_given() -> None:
    session = Session(Settings("power", samples=24, experiments=2))
    rig = simulated(named_plant("reference", 0.01), seed=2)
    session.tell(rig(session.ask()))
    assert np.isinf(session.estimate().frequency_error)
    assert "at no sure frequency" in str(session.estimate())
    first_order = Record(*_step_record())
    assert identify(first_order, "oe", (1, 1)).hinf_frequency_error == 0.0  # a low-pass peaks at 0, surely


def _step_record() -> tuple[np.ndarray, np.ndarray]:
    plant = named_plant("peak-at-zero", 0.01)
    u = np.random.default_rng(0).normal(size=(400, 1))
    return u, simulated(plant, seed=0)(u)
