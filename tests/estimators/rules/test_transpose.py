"""The transpose by experiments, learning control, smallest gain, passivity and the small-gain check."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.norm.peak_estimates import corrected
from estimators.norm.properties import passivity_index, small_gain, smallest_gain
from estimators.rules.by_name import iterate
from estimators.rules.transpose import adjoint_learning, apply_transpose, lipschitz_constant, model_error
from oed.errors import InputError
from oed.experiments import simulated
from oed.plants.named import named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.theory.finite import finite_norm, singular_values


def dense(plant, N):
    G = np.zeros((N * plant.n_outputs, N * plant.n_inputs))
    for k in range(N * plant.n_inputs):
        pulse = np.zeros(N * plant.n_inputs)
        pulse[k] = 1
        G[:, k] = plant.simulate(pulse.reshape(N, -1)).ravel()
    return G


@pytest.mark.parametrize("name", ["reference", "avis", "three-by-two"])
@pytest.mark.parametrize("power", [None, 1.0])
def test_transpose_is_the_matrix_transpose(name, power, rng):
    plant, N = named_plant(name, 0.0), 50
    x = rng.standard_normal((N, plant.n_outputs))
    found = apply_transpose(simulated(plant), x, power=power)
    np.testing.assert_allclose(found.ravel(), dense(plant, N).T @ x.ravel(), atol=1e-11)
    with pytest.raises(InputError, match="signal on the outputs"):
        apply_transpose(simulated(plant), np.ones((N, 7)))


@pytest.mark.parametrize("name", ["reference", "three-by-two"])
def test_learning_is_the_gradient_iteration(name, rng):
    """e_(k+1) = (I - a G G') e_k with the dense matrix; the error never grows."""
    plant, N = named_plant(name, 0.0), 40
    G = dense(plant, N)
    r = (G @ rng.standard_normal(N * plant.n_inputs)).reshape(N, -1)
    found = adjoint_learning(simulated(plant), r, trials=30, gain=finite_norm(plant, N))
    e = r.ravel()
    for measured in found.errors:
        assert measured == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-8)
        e = e - found.step * (G @ (G.T @ e))
    assert (np.diff(found.errors) <= 0).all()
    assert found.errors[-1] < 0.3 * found.errors[0]


def test_learning_with_noise_averages_it_when_the_gain_falls():
    """True error after 60 trials: the falling gain ends lower (medians of 5 noises), both far below the start."""
    plant, N, ends = named_plant("reference", 0.01), 60, {}
    r = named_plant("reference").simulate(np.sin(0.9 * np.arange(N))[:, None])
    for decreasing in (False, True):
        found = [
            adjoint_learning(simulated(plant, replicate=k), r, trials=60, gain=2.42, decreasing=decreasing)
            for k in range(5)
        ]
        ends[decreasing] = np.median([np.sqrt(np.mean((r - plant.simulate(f.u)) ** 2)) for f in found])
    assert ends[True] < 0.2 * np.sqrt(np.mean(r**2))
    assert ends[False] < 0.2 * np.sqrt(np.mean(r**2))


def test_learning_contracts_where_power_iterations_expand(rng):
    """[M] (14)-(15): the power map has a Lipschitz constant above 1 although its values are bounded."""
    plant, N = named_plant("reference", 0.0), 40
    G = dense(plant, N)
    a = 1 / finite_norm(plant, N) ** 2
    contraction = lambda e: e - a * (G @ (G.T @ e))
    power = lambda w: G @ (w[::-1] / np.linalg.norm(w))
    points = rng.standard_normal((6, N))
    assert lipschitz_constant(contraction, points) <= 1
    assert lipschitz_constant(power, points / np.linalg.norm(points, axis=1)[:, None]) > 1


def test_bad_learning_gain():
    with pytest.raises(InputError, match="contract only"):
        adjoint_learning(simulated(named_plant("reference")), np.ones(10), trials=3, gain=1.0, relaxation=2.5)


def test_smallest_gain_and_passivity(rng):
    plant = Plant([1.0, 0.4], [1.0, -0.3], noise_covariance=0.0)
    N, gain = 30, 2.1
    G = dense(plant, N)
    least = smallest_gain(simulated(plant), samples=N, iterations=400, gain=gain, rng=rng)
    assert np.sqrt(least.last) == pytest.approx(singular_values(plant, N)[-1], rel=2e-2)  # slow: 1 / n
    assert (np.diff(least.values) < 1e-9).all()
    passive = passivity_index(simulated(plant), samples=N, iterations=400, gain=gain, rng=rng)
    assert passive.last == pytest.approx(np.linalg.eigvalsh((G + G.T) / 2)[0], rel=2e-2)
    assert passive.last > 0
    delayed = Plant([0.0, 1.0, 0.4], [1.0, -0.3], noise_covariance=0.0)
    assert passivity_index(simulated(delayed), samples=N, iterations=200, gain=gain, rng=rng).last < 0
    assert passive.experiments == 800
    with pytest.raises(InputError, match="as many of each"):
        passivity_index(simulated(named_plant("three-by-two")), samples=N, iterations=2, gain=4, rng=rng)


def test_model_error_on_the_rig_and_the_controller_check():
    """[M] Sec. II: gamma of P_model - P_true by experiments on P_true, then the small-gain check with its interval."""
    true = named_plant("reference", 0.01)
    model = true.replace(num=[0, 0.25, 0.15], den=[1, -0.98, 0.80])
    gamma = peak(Plant(*_difference(model, true))).value
    trace, gains = iterate(
        model_error(model, simulated(true)), samples=1000, iterations=20, rng=np.random.default_rng(0)
    )
    estimate = corrected(trace)
    assert estimate.value == pytest.approx(gamma, abs=4 * estimate.standard_error + 0.01 * gamma)
    assert gains["gain"].last == pytest.approx(gamma, rel=0.1)
    soft, hard = Plant([0.05], [1.0]), Plant([0.3], [1.0])
    assert small_gain(model, soft, estimate.value, estimate.interval()).stable is True
    assert small_gain(model, hard, 20.0, (10.0, 30.0)).stable is False
    assert small_gain(model, soft, 20.0, (0.1, 1e3)).stable is None
    assert "undecided" in repr(small_gain(model, soft, 20.0, (0.1, 1e3)))
    with pytest.raises(InputError, match="nominal loop"):
        small_gain(model, Plant([5.0], [1.0]), 1.0, (1.0, 1.0))
    with pytest.raises(InputError, match="needs the same of both"):
        model_error(named_plant("avis"), simulated(true))


def _difference(a, b):
    A, B = a.den[0][0], b.den[0][0]
    num = np.convolve(a.num[0][0], B) - np.convolve(b.num[0][0], A)
    return num, np.convolve(A, B)
