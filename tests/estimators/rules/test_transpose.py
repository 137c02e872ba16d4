"""The transpose by experiments, and experiments on a model error."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.norm.peak_estimates import corrected
from estimators.rules.by_name import iterate
from estimators.rules.transpose import apply_transpose, model_error
from oed.errors import InputError
from oed.experiments import simulated
from oed.plants.named import named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.theory.finite import finite_norm


def dense(plant, N):
    G = np.zeros((N * plant.n_outputs, N * plant.n_inputs))
    for k in range(N * plant.n_inputs):
        pulse = np.zeros(N * plant.n_inputs)
        pulse[k] = 1
        G[:, k] = plant.simulate(pulse.reshape(N, -1)).ravel()
    return G


def lipschitz_constant(mapping, points, size=1e-4):
    """Largest measured ratio ||f(x + d) - f(x)|| / ||d||, d towards the other points and along f itself."""
    worst = 0.0
    for x in points:
        base = mapping(x)
        for d in (*(other - x for other in points if (other != x).any()), base):
            d = d / np.linalg.norm(d) * size * np.linalg.norm(x)
            worst = max(worst, float(np.linalg.norm(mapping(x + d) - base) / np.linalg.norm(d)))
    return worst


@pytest.mark.parametrize("name", ["reference", "avis", "three-by-two"])
@pytest.mark.parametrize("power", [None, 1.0])
def test_transpose_is_the_matrix_transpose(name, power, rng):
    plant, N = named_plant(name, 0.0), 50
    x = rng.standard_normal((N, plant.n_outputs))
    found = apply_transpose(simulated(plant), x, power=power)
    np.testing.assert_allclose(found.ravel(), dense(plant, N).T @ x.ravel(), atol=1e-11)
    with pytest.raises(InputError, match="signal on the outputs"):
        apply_transpose(simulated(plant), np.ones((N, 7)))


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


def test_model_error_on_the_rig():
    """[M] Sec. II: gamma of P_model - P_true by experiments on P_true."""
    true = named_plant("reference", 0.01)
    model = true.replace(num=[0, 0.25, 0.15], den=[1, -0.98, 0.80])
    gamma = peak(Plant(*_difference(model, true))).value
    trace, gains = iterate(
        model_error(model, simulated(true)), samples=1000, iterations=20, rng=np.random.default_rng(0)
    )
    estimate = corrected(trace)
    assert estimate.value == pytest.approx(gamma, abs=4 * estimate.standard_error + 0.01 * gamma)
    assert gains["gain"].last == pytest.approx(gamma, rel=0.1)
    with pytest.raises(InputError, match="needs the same of both"):
        model_error(named_plant("avis"), simulated(true))


def _difference(a, b):
    A, B = a.den[0][0], b.den[0][0]
    num = np.convolve(a.num[0][0], B) - np.convolve(b.num[0][0], A)
    return num, np.convolve(A, B)
