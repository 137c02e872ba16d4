"""The other ways to the norm: impulse response, frequency response, Krylov, bandit."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from estimators.norm.fir import peak_of_fir, plug_in, select_taps
from estimators.norm.frf import frequency_response, lpm, peak_of_response
from estimators.norm.gains import gain
from estimators.rules.bandit import best_arm, thompson_sampling
from estimators.rules.inputs import multisine, white
from estimators.rules.krylov import lanczos, ritz
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import run
from oed.errors import InputError, Status
from oed.experiments import simulated
from oed.plants.named import NAMES, named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.theory.finite import finite_norm


def records(rule, plant, N, M, seed=0):
    return run(rule, simulated(plant, seed=seed), samples=N, experiments=M, rng=np.random.default_rng(seed))


@pytest.mark.parametrize("name", ["bandit-fir", "three-by-two"])
def test_fir_is_exact_without_noise(name):
    plant = named_plant(name, 0.0)
    if name == "three-by-two":
        num = [[[0.5, 0.2], [-0.3]], [[0.1, 0.25], [0.0, 0.4]], [[0.0, -0.2, 0.1], [0.35]]]
        plant = Plant(num, [[[1.0]] * 2] * 3, noise_covariance=0.0)
    model = plug_in(records(white, plant, 60, 3), 12)
    np.testing.assert_allclose(model.taps, plant.impulse_response(12), atol=1e-10)
    assert peak_of_fir(model).value == pytest.approx(peak(plant).value, rel=1e-8)


def test_fir_is_least_squares_over_all_records(rng):
    """Against numpy's solver on the stacked regressors, written sample by sample."""
    trace = records(multisine, named_plant("bandit-fir"), 40, 3)
    rows, outputs = [], []
    for record in trace.records:
        for t in range(40):
            rows.append([record.u[t - k, 0] if t >= k else 0.0 for k in range(6)])
            outputs.append(record.y[t, 0])
    expected, rest = np.linalg.lstsq(np.array(rows), np.array(outputs), rcond=None)[:2]
    model = plug_in(trace, 6)
    np.testing.assert_allclose(model.taps[:, 0, 0], expected, rtol=1e-9)
    assert model.noise[0] == pytest.approx(rest[0] / (120 - 6))


def test_fir_of_several_channels_and_lengths_is_least_squares(rng):
    """Against numpy's solver on regressors written sample by sample; one record is shorter than the taps."""
    plant, taps = named_plant("three-by-two"), 9
    short = records(white, plant, 7, 1, 1).records
    data = [*records(white, plant, 40, 3).records, *short, *records(white, plant, 55, 1, 2).records]
    rows = [
        np.concatenate([r.u[t - k] if t >= k else np.zeros(2) for k in range(taps)])
        for r in data
        for t in range(len(r))
    ]
    y = np.concatenate([r.y for r in data])
    expected, rest = np.linalg.lstsq(np.array(rows), y, rcond=None)[:2]
    model = plug_in(data, taps)
    np.testing.assert_allclose(model.taps.transpose(0, 2, 1).reshape(-1, 3), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(model.noise, rest / (len(y) - 2 * taps), rtol=1e-9)
    np.testing.assert_allclose(
        model.covariance, np.linalg.inv(np.array(rows).T @ np.array(rows)), rtol=1e-8, atol=1e-12
    )


def test_wins_of_the_lines_are_those_of_plain_draws():
    """200 x 300 draws of the chance to be the peak against complex normal numbers: 5 standard errors, 6 lines."""
    from estimators.rules.bandit import DRAWS, _Posterior

    rng = np.random.default_rng(8)
    mean = rng.standard_normal(6) + 1j * rng.standard_normal(6)
    deviation = np.array([0.3, 1.0, 0.7, 1.4, 0.1, 0.5])
    posterior = _Posterior(mean, 2 * deviation**2, 1.0)
    wins = np.mean([posterior.wins(rng) for _ in range(300)], axis=0)
    z = rng.standard_normal((2, 300 * DRAWS, 6)) * deviation
    plain = np.bincount(np.argmax(np.abs(mean + z[0] + 1j * z[1]), axis=1), minlength=6) / len(z[0])
    error = np.sqrt(2 * plain * (1 - plain) / len(z[0])) + 1e-5
    assert (np.abs(wins - plain) < 5 * error).all()
    wrong = _Posterior(mean, deviation**2, 1.0)  # the control: half the variance would show
    assert (np.abs(np.mean([wrong.wins(rng) for _ in range(300)], axis=0) - plain) > 5 * error).any()
    sure = _Posterior(np.array([1.0, 3.0 + 0j]), np.array([1e-4, 1e-4]), 1.0)
    assert sure.wins(rng).tolist() == [0.0, 1.0]


def test_the_number_of_taps_has_the_smallest_criterion():
    """Against the criterion by numpy's solver for every number of taps."""
    trace = records(white, named_plant("bandit-fir", 1.0), 60, 3)
    y = np.concatenate([r.y[:, 0] for r in trace.records])
    scores = {}
    for n in (2, 3, 5, 8, 12, 18):
        rows = [
            [r.u[t - k, 0] if t >= k else 0.0 for k in range(n)] for r in trace.records for t in range(60)
        ]
        rest = np.linalg.lstsq(np.array(rows), y, rcond=None)[1][0]
        scores[n] = len(y) * np.log(rest / len(y)) + n * np.log(len(y))
    assert select_taps(trace, tuple(scores)[::-1]) == min(scores, key=lambda n: scores[n])
    best, chosen = plug_in(trace, select_taps(trace)), plug_in(trace)
    np.testing.assert_allclose(chosen.taps, best.taps, atol=1e-10)
    np.testing.assert_allclose(chosen.covariance, best.covariance, atol=1e-10)


def test_standard_error_of_the_plug_in():
    """300 runs with known order: the mean squared standardised error is 1 within 5 standard errors (0.41)."""
    plant = named_plant("bandit-fir", 0.01)
    gamma = peak(plant).value
    found = [peak_of_fir(plug_in(records(white, plant, 200, 2, seed), 11)) for seed in range(300)]
    z = np.array([(f.value - gamma) / f.standard_error for f in found])
    assert np.mean(z**2) == pytest.approx(1, abs=0.41)
    assert np.mean((2 * z) ** 2) > 1.41  # the control: an error half as large would show


def test_order_selection_and_kernel():
    plant = named_plant("bandit-fir", 0.01)
    trace = records(white, plant, 300, 4)
    assert select_taps(trace, [3, 7, 11, 15, 30]) == 11
    gamma = peak(plant).value
    many = records(white, plant, 100, 1)
    errors = {
        k: np.linalg.norm(plug_in(many, 40, kernel=k).taps - plant.impulse_response(40))
        for k in ("none", "tc")
    }
    assert errors["tc"] < 0.7 * errors["none"]
    assert peak_of_fir(plug_in(many, 40, kernel="tc")).value == pytest.approx(gamma, rel=0.1)


def test_fir_refuses_what_it_cannot_do():
    trace = records(white, named_plant("bandit-fir"), 30, 1)
    with pytest.raises(InputError, match="taps is 30"):
        plug_in(trace, 30)
    with pytest.raises(InputError, match="no kernel named"):
        plug_in(trace, 3, kernel="dc")

    def impulse_free(samples, n_inputs, n_outputs, rng):
        while True:
            yield np.zeros((samples, n_inputs))

    with pytest.raises(InputError, match="does not excite"):
        plug_in(records(impulse_free, named_plant("bandit-fir"), 30, 2), 3)


@pytest.mark.parametrize("name", ["reference", "three-by-two"])
def test_frequency_responses(name):
    plant = named_plant(name, 1e-4)
    trace = records(multisine, plant, 1000, 6)
    plain = frequency_response(trace)
    exact = plant.response(plain.omega)[0]
    assert np.abs(plain.response - exact).max() < 0.8  # transients of experiments from rest
    gamma = peak(plant).value
    assert peak_of_response(plain).value == pytest.approx(gamma, rel=0.1)
    local = lpm(trace)
    assert local.value == pytest.approx(gamma, rel=2e-3)
    assert abs(local.value - gamma) < abs(peak_of_response(plain).value - gamma)
    assert local.frequency == pytest.approx(peak(plant).frequency, abs=0.02)
    with pytest.raises(InputError, match="needs at least 2"):
        frequency_response(records(multisine, named_plant("three-by-two"), 50, 1))


@pytest.mark.parametrize("name", NAMES)
def test_krylov_is_never_worse_and_saves_experiments(name, record_figure):
    plant, N = named_plant(name, 0.0), 200
    start = np.random.default_rng(3).standard_normal((N, plant.n_inputs))
    single = plant.n_inputs * plant.n_outputs == 1
    each = 1 if single else 1 + plant.n_inputs * plant.n_outputs
    norm, M = finite_norm(plant, N), 24
    power = records(partial(power_iterations if single else procedure_2, start=start), plant, N, M * each)
    lanczos_trace = records(partial(lanczos, start=start), plant, N, M * each)
    slow, same, fast = gain(power).values, ritz(power).values, ritz(lanczos_trace).values
    assert (fast <= norm * (1 + 1e-9)).all()
    assert (fast[2:] >= slow[2:] - 1e-9).all()
    assert fast[-1] >= same[-1] - 1e-6
    reached = int(np.argmax(fast >= slow[-1])) + 1
    assert reached <= M
    record_figure(
        "krylov", {"plant": name, "power": M, "krylov": reached, "norm": norm, "left": norm - fast[-1]}
    )


def test_krylov_stops_at_an_invariant_span():
    plant = Plant([1.0, 0.5], [1.0], noise_covariance=0.0)
    trace = records(lanczos, plant, 4, 50)
    assert trace.status is Status.OK
    assert len(trace) <= 4
    assert ritz(trace).last == pytest.approx(finite_norm(plant, 4), rel=1e-9)
    with pytest.raises(InputError, match="Ritz values need"):
        ritz(records(white, plant, 10, 2))


def test_bandit_concentrates_and_stops():
    plant = named_plant("bandit-fir", 0.02)
    trace = records(thompson_sampling, plant, 100, 30)
    power = np.abs(np.fft.rfft(trace.records[-1].u[:, 0])) ** 2
    top = peak(plant)
    assert abs(2 * np.pi * np.argmax(power) / 100 - top.frequency) < 0.13
    assert power.max() > 10 * power[1:-1].mean()
    assert np.mean(trace.records[-1].u ** 2) == pytest.approx(1)
    estimate = best_arm(trace)
    assert estimate.value == pytest.approx(top.value, rel=0.1)  # 11 of 100 samples are the transient
    flat = best_arm(records(multisine, plant.replace(noise_variance=50.0), 100, 3))
    assert flat.status is not Status.CONVERGED
    with pytest.raises(InputError, match="one input and one output"):
        records(thompson_sampling, named_plant("avis"), 50, 2)
