"""What is printed beside the parameters of an identified model, in Monte Carlo: bands, poles, peaks, tests, blocks left out.

500 runs of each are `make validate`; a few cheap ones, in fewer runs, stand among the tests.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from estimators.pem import identify
from estimators.pem.choice import held_out_error
from estimators.pem.fit import Fit
from estimators.pem.uncertainty import bode_band, pole_covariances, profile_interval, step_band
from estimators.residual.tests import residual_tests
from oed.data import Record
from oed.errors import NotIdentifiable
from oed.experiments import simulated
from oed.plants.named import named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant
from tests.benchmarks.test_printed_errors import Row, checked, coverage

B, F, C, D = [0.0, 0.5, 0.3], [1.0, -1.2, 0.6], [1.0, 0.4], [1.0, -0.7]
CASES = {
    "oe": (([1.0], [1.0]), (2, 2)),
    "arx": (([1.0], F), (2, 2)),
    "armax": ((C, F), (2, 2, 1)),
    "bj": ((C, D), (2, 1, 1, 2)),
    "ss": ((C, F), (2,)),
}
"""Filter of the noise, and the orders, of the structure that describes it."""
OMEGA = np.array([0.0, 0.1, 0.7, 1.5, np.pi])
SAMPLES, DEVIATION = 1000, 0.7
THETA = [0.5, 0.3, -1.2, 0.6]


def record(
    seed: int, noise: tuple[list[float], list[float]] = ([1.0], [1.0]), samples: int = SAMPLES
) -> Record:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=samples)
    return Record(u, lfilter(B, F, u) + lfilter(*noise, DEVIATION * rng.normal(size=samples)))


def of_parameters(fit: Fit) -> Row:
    return {name: told for name, *told in zip(fit.names, fit.theta, fit.standard_errors, THETA, strict=True)}  # type: ignore[misc]


def of_peak(fit: Fit, plant: Plant) -> Row:
    (value, error, frequency), true = fit.hinf_norm, peak(plant)
    return {
        "peak": (value, error, true.value),
        "its frequency": (frequency, fit.hinf_frequency_error, true.frequency),
    }


def of_bands(kind: str, seed: int) -> Row:
    noise, orders = CASES[kind]
    data = record(seed, noise)
    fit = identify(data, kind, orders)
    (gain, phase), step = bode_band(fit, OMEGA), step_band(fit, 40)
    z = np.exp(-1j * OMEGA)
    true = np.polyval(B[::-1], z) / np.polyval(F[::-1], z)
    rows = of_peak(fit, Plant(B, F))
    for k, omega in enumerate(OMEGA):
        rows[f"gain at {omega:.1f}"] = gain.value[k, 0, 0], gain.standard_error[k, 0, 0], abs(true[k])
        if 0 < k < len(OMEGA) - 1:
            off = np.angle(np.exp(1j * phase.value[k, 0, 0]) / true[k])
            rows[f"phase at {omega:.1f}"] = float(off), phase.standard_error[k, 0, 0], 0.0
    for k, at in enumerate(lfilter(B, F, np.ones(40))):
        if k in (1, 4, 10, 39):
            rows[f"step at {k}"] = step.value[k, 0, 0], step.standard_error[k, 0, 0], at
    pole = np.roots(F)[0]
    for found, covariance in pole_covariances(fit):
        if found.imag * pole.imag > 0:
            rows["pole, real"] = found.real, np.sqrt(covariance[0, 0]), pole.real
            rows["pole, imaginary"] = found.imag, np.sqrt(covariance[1, 1]), pole.imag
    # A test at 5 % is one more interval: it holds where it does not reject.
    truth = dict(
        zip(("b1", "b2", "f1", "f2", "a1", "a2", "c1", "d1"), (*THETA, *THETA[2:], 0.4, -0.7), strict=True)
    )
    if kind != "ss":  # whose parameters test_pem_coverage knows
        rows |= {
            n: (v, se, truth[n]) for n, v, se in zip(fit.names, fit.theta, fit.standard_errors, strict=True)
        }
    # No level was added: what is found is the gain at rest times the mean of the input.
    rest = sum(B) / sum(F) * float(data.u.mean())
    rows["level"] = float(fit.output_level[0]), float(fit.output_level_errors[0]), rest
    return rows | {
        f"p of {name}": (float(test.p_value < 0.05), 0.5, 0.0)
        for name, test in residual_tests(fit, data).items()
    }


def of_profile(seed: int) -> Row:
    data = record(seed, samples=300)
    fit = identify(data, "oe", (2, 2))
    ends = {name: profile_interval(fit, data, name) for name in fit.names}
    return {
        name: ((low + high) / 2, (high - low) / 2 / 1.959964, true)
        for (name, (low, high)), true in zip(ends.items(), THETA, strict=True)
    }


def of_outliers(loss: str, seed: int) -> Row:
    """One sample in twenty is ten times as noisy."""
    data, rng = record(seed, samples=500), np.random.default_rng([seed, 2])
    wild = np.where(rng.uniform(size=500) < 0.05, 10 * DEVIATION * rng.normal(size=500), 0.0)
    return of_parameters(identify(data.replace(y=data.y + wild[:, None]), "oe", (2, 2), robust=loss))


def of_missing(seed: int) -> Row:
    data = record(seed)
    lost = np.random.default_rng([seed, 1]).uniform(size=data.y.shape) < 0.2
    return of_parameters(identify(data.replace(y=np.where(lost, np.nan, data.y)), "oe", (2, 2), missing=True))


def of_several(seed: int) -> Row:
    plant, u = named_plant("three-by-two", 1.0), np.random.default_rng(seed).normal(size=(1500, 2))
    try:
        return of_peak(
            identify(Record(u, simulated(plant, seed=seed)(u)), "oe", (2, 2), search="quick"), plant
        )
    except (
        NotIdentifiable
    ):  # entries of first order have a pole too many: at 1 it takes the level's place, and no error is given
        return {}


PRINTED: dict[str, Callable[[int], Row]] = {
    **{f"bands of {kind}": lambda seed, kind=kind: of_bands(kind, seed) for kind in CASES},
    "orders and delay chosen": lambda seed: of_peak(
        identify(record(seed), "oe", "auto", "auto"), Plant(B, F)
    ),
    "profiles": of_profile,
    "missing samples": of_missing,
    **{f"outliers, {loss}": lambda seed, loss=loss: of_outliers(loss, seed) for loss in ("huber", "student")},
    "four records": lambda seed: of_parameters(
        identify([record(4 * seed + k, samples=250) for k in range(4)], "oe", (2, 2))
    ),
    "several channels": of_several,
}
RUNS = {"bands of bj": 200, "orders and delay chosen": 200}
"""Where a fit takes half a second."""


@pytest.mark.validate
@pytest.mark.parametrize("name", PRINTED)
def test_coverage(name: str, record_figure) -> None:
    checked(name, PRINTED[name], RUNS.get(name, 500), record_figure)


@pytest.mark.validate
@pytest.mark.parametrize("rings", [False, True])
def test_the_peak_of_a_regularised_response(rings: bool, record_figure) -> None:
    """Errors hold for a response like the prior's; of one that rings the peak is shrunk by more than is seen of it, and the fit says
    so: the posterior alone held 77 to 83 %."""
    b, f = (B, F) if rings else ([0.0, 0.1], [1.0, -0.9])
    held, plant = 0, Plant(b, f)
    for seed in range(200):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=400)
        y = lfilter(b, f, u)
        fit = identify(Record(u, y + 0.5 * y.std() * rng.normal(size=400)), "fir", (49,), regularisation="tc")
        value, error, true = of_peak(fit, plant)["peak"]
        held += abs(value - true) < 1.959964 * error
    record_figure("coverage of the peak of a regularised response", held / 200, runs=200, rings=rings)
    assert held >= binom.ppf(1e-3, 200, 0.87 if rings else 0.93)
    assert "too small" in repr(fit)


@pytest.mark.parametrize("name", ["bands of oe", "bands of arx"])
def test_coverage_of_few_runs(name: str) -> None:
    for key, (held, total) in coverage(PRINTED[name], 60).items():
        assert binom.ppf(1e-4, total, 0.93) <= held, (key, held, total)


@pytest.mark.parametrize(
    "folds, runs",
    [
        (4, 60),
        pytest.param(4, 500, marks=pytest.mark.validate),
        pytest.param(8, 500, marks=pytest.mark.validate),
    ],
)
def test_the_error_on_blocks_left_out(folds: int, runs: int, record_figure) -> None:
    """Its truth is the mean over all runs; four blocks have three degrees of freedom."""
    found = np.array([held_out_error(record(k), "oe", (2, 2), folds=folds) for k in range(runs)])
    truth = np.sqrt(np.mean(found[:, 0] ** 2))
    held = int(np.sum(np.abs(found[:, 0] - truth) < 1.959964 * found[:, 1]))
    record_figure(f"coverage of the error on {folds} blocks left out", held / runs, runs=runs)
    assert binom.ppf(1e-3, runs, 0.93) <= held <= binom.isf(1e-3, runs, 0.97)
