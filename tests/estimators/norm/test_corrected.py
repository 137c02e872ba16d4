"""Bias-corrected estimators: bias, rho and coverage in Monte Carlo, with what they must beat as the control."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from estimators.montecarlo.engine import counter_start
from estimators.norm.gains import gain
from estimators.norm.local_models import local_peak
from estimators.norm.peak_estimates import NARROW, corrected, fixed_point, theorem_12, width_left_open
from estimators.rules.inputs import multisine
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import run
from oed.errors import InputError, Status
from oed.experiments import simulated
from oed.plants.named import NAMES, named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant


def iterations(plant, N, M, replicate):
    single = plant.n_inputs * plant.n_outputs == 1
    start = counter_start(plant, N, replicate=replicate)
    count = M * (1 if single else 1 + plant.n_inputs * plant.n_outputs)
    return run(
        partial(power_iterations if single else procedure_2, start=start),
        simulated(plant, replicate=replicate, expected=count),
        samples=N,
        experiments=count,
        rng=np.random.default_rng(replicate),
    )


def study(plant, N, M, replicates, estimators):
    """(R, E) errors, and the estimates of the first estimator."""
    gamma, rows, first = peak(plant).value, [], []
    for r in range(replicates):
        trace = iterations(plant, N, M, r)
        found = [estimate(trace) for estimate in estimators]
        first.append(found[0])
        rows.append([e.value - gamma for e in found] + [gain(trace).last - gamma])
    return np.array(rows), first, np.sqrt(trace.usage.energy / plant.noise_variance)


def coverage(errors, estimates):
    return np.mean([abs(e) < 1.959964 * f.standard_error for e, f in zip(errors, estimates, strict=True)])


@pytest.mark.slow
def test_bias_and_rho_at_variance_1():
    """N = 1000, 50 iterations, 40 runs: rho of beta_2 is 52 (theory.md section 4); every bias is cut 20 times.

    Larger studies gave bias -0.0004, 0.0003, -0.003 and rho 1.4, 1.6, 1.7 (corrected, fixed point, Theorem 12);
    the bounds are 4 Monte-Carlo standard errors away, so a false alarm has probability below 1e-4.
    """
    errors, estimates, scale = study(
        named_plant("reference"), 1000, 50, 40, (corrected, fixed_point, theorem_12)
    )
    bias, rho = errors.mean(axis=0), scale * np.sqrt(np.mean(errors**2, axis=0))
    assert rho[3] == pytest.approx(52, abs=2)
    assert abs(bias[3]) > 0.2
    assert (np.abs(bias[:3]) < abs(bias[3]) / 20).all()
    assert (rho[:3] < [2, 2.4, 2.5]).all()
    assert coverage(errors[:, 0], estimates) > 0.8
    assert np.mean([e.noise_variance for e in estimates]) == pytest.approx(1, abs=0.02)


COVERAGE = [
    *(("reference", v, 50) for v in (1.0, 4.0, 9.0)),
    *((name, 1.0, 50) for name in NAMES if name not in ("reference", "three-by-two", "avis")),
    *((name, 1.0, 20) for name in ("three-by-two", "avis")),
]
"""Plant, noise variance and iterations. On two-peaks the result often says that the peaks compete."""


@pytest.mark.validate
@pytest.mark.parametrize("name, variance, iterations", COVERAGE)
def test_coverage_of_the_interval(name, variance, iterations, record_figure):
    """2000 runs: 93 to 97 % of the 95 % intervals that are trusted hold the norm; shrunk to 0.7 they do not.

    Where the result often says that peaks compete, those that are left hold it more often than 95 %: it is the low
    estimates of the higher peak that let the other compete. There only the lower end is asked for.
    """
    errors, estimates, scale = study(named_plant(name, variance), 1000, iterations, 2000, (corrected,))
    ok = np.array([e.status.ok for e in estimates])
    trusted = [e for e in estimates if e.status.ok]
    share = coverage(errors[ok, 0], trusted)
    record_figure("coverage", share, plant=name, variance=variance, trusted=ok.mean())
    rho = scale * np.sqrt(np.nanmean(errors**2, axis=0))
    record_figure("bias and rho", [errors[:, 0].mean(), rho[0]], plant=name, variance=variance)
    record_figure("bias and rho of (7)", [np.nanmean(errors[:, 1]), rho[1]], plant=name, variance=variance)
    assert 0.93 < share < (0.97 if ok.mean() > 0.95 else 1)
    narrow = np.mean([abs(e) < 1.37 * f.standard_error for e, f in zip(errors[ok, 0], trusted, strict=True)])
    assert narrow < 0.93


SINGLE = [name for name in NAMES if name not in ("three-by-two", "avis", "two-peaks")]


@pytest.mark.validate
@pytest.mark.parametrize("name", SINGLE)
def test_bias_and_rho_of_the_limit_spectrum_estimators(name, record_figure):
    """400 runs at variance 1: every bias is cut 20 times within its Monte-Carlo error, rho is about 2 at most."""
    estimators = (corrected, fixed_point, theorem_12)
    errors, estimates, scale = study(named_plant(name), 1000, 50, 400, estimators)
    errors = errors[np.array([e.status.ok for e in estimates])]
    bias, rho = errors.mean(axis=0), scale * np.sqrt(np.mean(errors**2, axis=0))
    record_figure("bias", bias.tolist(), plant=name)
    record_figure("rho", rho.tolist(), plant=name)
    spread = errors.std(axis=0) / np.sqrt(len(errors))
    assert (np.abs(bias[:3]) < abs(bias[3]) / 20 + 3 * spread[:3]).all()
    assert (rho[:3] < 2.3).all()


@pytest.mark.parametrize("name", ["order-20", "bandit-fir"])
def test_more_than_one_resonance_is_taken_from_the_records(name):
    """One run at variance 1: taken for one resonance, as it was once, order-20 gave 0.11 too much; spread 0.009."""
    plant = named_plant(name)
    trace = iterations(plant, 1000, 50, 0)
    for estimate in (fixed_point, theorem_12):
        found = estimate(trace)
        assert found.status.ok
        assert abs(found.value - peak(plant).value) < 0.04


@pytest.mark.slow
def test_the_wrong_peak_is_never_followed_in_silence():
    """avis, 20 runs of 20 iterations: the highest line is that of the lower peak in several; none is trusted."""
    plant, alone, silent = named_plant("avis"), 0, 0
    top = peak(plant)
    for r in range(14, 34):
        trace = iterations(plant, 1000, 20, r)
        one, found = local_peak(trace), corrected(trace)
        alone += one.status.ok and abs(one.frequency - top.frequency) > 0.5
        silent += found.status.ok and abs(found.frequency - top.frequency) > 0.5
    assert alone >= 2  # negative control: the local model by itself
    assert silent == 0


def test_equal_peaks_compete_and_a_single_one_does_not():
    low, high = [1, -2 * 0.95 * np.cos(0.8), 0.95**2], [1, -2 * 0.95 * np.cos(2.0), 0.95**2]
    num = np.array([0.0, 1, 0, -1]) * (1 - 0.95**2)
    den = np.convolve(low, high)
    plant = Plant(np.convolve(num, low) + np.convolve(num, high), den, noise_covariance=1.0, name="equal")
    found = [corrected(iterations(plant, 1000, 20, r)).status for r in range(5)]
    assert found.count(Status.COMPETING) >= 4
    one = corrected(iterations(named_plant("reference"), 1000, 20, 0))
    assert one.status is Status.OK
    assert "two standard errors" in Status.COMPETING.value


def test_what_is_not_one_resonance_is_not_trusted():
    trace = iterations(named_plant("two-peaks"), 1000, 20, 0)
    assert fixed_point(trace).status is not Status.OK
    assert theorem_12(trace).status is not Status.OK
    longer = iterations(
        named_plant("two-peaks"), 1000, 50, 60
    )  # here the higher peak is sure, its rival not settled
    assert corrected(longer).status is Status.OK
    assert fixed_point(longer).status is theorem_12(longer).status is Status.INACCURATE
    noisy = iterations(named_plant("reference", 9.0), 1000, 20, 0)
    assert theorem_12(noisy).status is Status.INACCURATE


@pytest.mark.parametrize("name", ["peak-at-zero", "peak-at-pi", "delay"])
def test_estimators_by_the_limit_spectrum_on_other_plants(name):
    """One run at variance 0.1: within a fifth of the bias of (7) there, lambda_e / (2 gamma)."""
    plant = named_plant(name, 0.1)
    trace, gamma = iterations(plant, 1000, 40, 0), peak(named_plant(name)).value
    for estimate in (fixed_point, theorem_12):
        found = estimate(trace)
        assert found.status.ok
        assert abs(found.value - gamma) < 0.2 * 0.1 / (2 * gamma) + 4 * np.sqrt(0.1 / 40000) * 2


@pytest.mark.parametrize("name", ["peak-at-zero", "peak-at-pi", "order-20", "delay", "three-by-two"])
def test_named_plants_without_noise_give_their_norm(name):
    """Deterministic: what is left is the local model's own error, far below any noise used here."""
    plant = named_plant(name, 1e-10)
    estimate = corrected(iterations(plant, 800, 12, 0))
    assert estimate.value == pytest.approx(peak(plant).value, rel=2e-3)
    assert estimate.frequency == pytest.approx(peak(plant).frequency, abs=0.01)


def test_curvature_and_frequency():
    plant = named_plant("reference", 0.01)
    top, estimate = peak(plant), corrected(iterations(plant, 1000, 30, 1))
    assert estimate.curvature == pytest.approx(top.curvature, rel=0.05)
    assert abs(estimate.frequency - top.frequency) < 4 * estimate.frequency_error
    low, high = estimate.interval()
    assert high - low == pytest.approx(2 * 1.96 * estimate.standard_error, rel=1e-4)
    assert "peak gain" in repr(estimate)


@pytest.mark.parametrize("seed", [0, 5])
def test_all_that_a_narrower_band_differs_is_in_the_errors(seed):
    """What it should differ were the model right was taken off: beside nine other peaks .92 of 1500 frequencies were held, now .93."""
    trace = iterations(named_plant("order-20", 1.0), 1000, 20, seed)
    best = local_peak(trace)
    found = width_left_open(best, trace)
    centre = round(best.frequency * 1000 / (2 * np.pi))
    narrow = local_peak(trace, lines=NARROW, centre=centre)
    for value, error in (("value", "standard_error"), ("frequency", "frequency_error")):
        differs = abs(getattr(narrow, value) - getattr(best, value))
        assert differs > 0
        assert getattr(found, error) == pytest.approx(np.hypot(getattr(best, error), differs))


def test_a_bend_that_is_hardly_known_widens_the_error_of_the_frequency():
    """Twice the noise is more than twice the error of where the slope is zero, and a bend within two of its errors of none says nothing."""
    plant = named_plant("reference", 1.0)
    errors, rng = [], np.random.default_rng(1)
    trace = iterations(replace(plant, noise_covariance=np.eye(1) * 1e-8), 400, 6, 0)
    noises = [rng.normal(size=r.y.shape) for r in trace.records]
    for size in (0.01, 0.4, 4.0):
        records = tuple(r.replace(y=r.y + size * e) for r, e in zip(trace.records, noises, strict=True))
        found = local_peak(replace(trace, records=records), orders=(2, 1, 2))
        errors.append(found.frequency_error / size)
    assert errors[1] > errors[0]
    assert np.isinf(errors[2]) or errors[2] > 1.05 * errors[1]


def test_other_inputs_and_short_records():
    plant, rng = named_plant("reference"), np.random.default_rng(0)
    trace = run(multisine, simulated(plant), samples=1000, experiments=5, rng=rng)
    with pytest.raises(InputError, match="records of power iterations"):
        corrected(trace)
    with pytest.raises(InputError, match="at least 4 experiments"):
        theorem_12(trace)
    assert local_peak(trace, centre=157).value == pytest.approx(2.41, abs=0.5)
    with pytest.raises(InputError, match="too few DFT lines"):
        corrected(iterations(plant, 20, 5, 0))


def test_an_interval_that_cannot_be_trusted_says_so():
    estimate = corrected(iterations(named_plant("reference", 2000.0), 200, 4, 0))
    assert estimate.status is not Status.OK
