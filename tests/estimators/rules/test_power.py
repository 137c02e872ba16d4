"""Power iterations against dense matrices, and the estimators against the noise."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from estimators.norm.gains import gain, mu, rayleigh, transposed_output
from estimators.norm.worst_inputs import worst_case
from estimators.rules.by_name import iterate
from estimators.rules.inputs import white
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import run
from oed.errors import InputError, Status
from oed.experiments import simulated
from oed.plants.named import NAMES, named_plant
from oed.plants.plant import Plant


def dense(plant, N):
    """Lower-triangular block Toeplitz matrix of the plant, (N ny, N nu), time-major, built entry by entry."""
    g = plant.impulse_response(N)
    ny, nu = g.shape[1:]
    G = np.zeros((N * ny, N * nu))
    for t in range(N):
        for s in range(t + 1):
            G[t * ny : (t + 1) * ny, s * nu : (s + 1) * nu] = g[t - s]
    return G


@pytest.mark.parametrize("name", NAMES)
def test_every_gain_is_that_of_the_matrix_power_iteration(name, rng):
    """Without noise, N = 200: the same start, G'G applied by experiments and by a matrix."""
    plant, N, M = named_plant(name, 0.0), 200, 12
    start = rng.standard_normal((N, plant.n_inputs))
    G = dense(plant, N)
    siso = plant.n_inputs * plant.n_outputs == 1
    rule = partial(power_iterations if siso else procedure_2, start=start)
    each = 1 if siso else 1 + plant.n_inputs * plant.n_outputs
    trace = run(rule, simulated(plant), samples=N, experiments=M * each, rng=rng)
    u, expected = start.ravel(), []
    for _ in range(M):
        w = G.T @ (G @ u)
        expected.append(np.sqrt(u @ w / (u @ u)))
        u = G[::-1] @ u if siso else w
    values = gain(trace).values
    if siso:
        assert np.isnan(values[0])
        np.testing.assert_allclose(values[1:], expected[:-1], rtol=1e-9)
    else:
        np.testing.assert_allclose(values, expected, rtol=1e-9)
    assert values[-1] <= np.linalg.norm(G, 2) * (1 + 1e-9)


@pytest.mark.parametrize("name", ["three-by-two", "avis", "reference"])
@pytest.mark.parametrize("scaling", ["none", "each", "common"])
def test_procedure_2_applies_the_transpose_under_every_scaling(name, scaling, rng):
    plant, N = named_plant(name, 0.0), 60
    G = dense(plant, N)
    each = 1 + plant.n_inputs * plant.n_outputs
    rule = partial(procedure_2, scaling=scaling)
    trace = run(rule, simulated(plant), samples=N, experiments=2 * each, rng=rng)
    for part in trace.iterations:
        w = transposed_output(trace, part)
        np.testing.assert_allclose(w.ravel(), G.T @ (G @ trace.records[part][0].u.ravel()), atol=1e-10)
    np.testing.assert_allclose(trace.records[each].u, w * 0 + trace.records[each].u)
    if scaling != "none":
        for record in trace.records:
            assert np.mean(np.sum(record.u**2, axis=1)) <= 1 + 1e-9
    assert sum(k == "forward" for k in trace.kinds) == 2


def test_rayleigh_settles_anywhere(rng):
    """[S] Remark 5, understated: 40 starts, noise-free, iteration 60: (4) spreads, (7) does not."""
    plant, ends, twos = named_plant("reference", 0.0), [], []
    for _ in range(40):
        trace = run(power_iterations, simulated(plant), samples=200, experiments=60, rng=rng)
        ends.append(rayleigh(trace).last)
        twos.append(gain(trace).last)
    assert np.std(ends) > 0.6  # theory.md section 1: 0.94 at N = 1000
    assert np.min(np.abs(ends)) < 1.2
    assert np.min(twos) > 2.3


def test_without_reversal_the_first_markov_parameter_is_found(rng):
    """[S] Remark 3: the eigenvalues of G are all g_0, here 1.5, below the norm 3.29."""
    plant = Plant([1.5, 0.4], [1, -0.3], noise_covariance=0.0)
    rule = partial(power_iterations, reversal=False)
    trace = run(rule, simulated(plant), samples=20, experiments=3000, rng=rng)
    assert abs(rayleigh(trace).last - 1.5) < 0.02
    with pytest.raises(InputError, match="gain is defined on power iterations"):
        gain(trace)


def test_negative_square_is_a_status(rng):
    plant = named_plant("reference", 400.0)
    trace = run(power_iterations, simulated(plant, seed=3), samples=50, experiments=60, rng=rng)
    g = gain(trace)
    negative = [k for k, s in enumerate(g.statuses) if s is Status.NEGATIVE_SQUARE]
    assert negative
    assert np.isnan(g.values[negative]).all()
    assert (g.squares[negative] < 0).all()
    assert "Negative" not in repr(g)
    assert "without a value" in repr(g)
    assert all(s is Status.OK for s in mu(trace).statuses)


def test_gain_needs_iterations(rng):
    trace = run(white, simulated(named_plant("reference")), samples=50, experiments=3, rng=rng)
    with pytest.raises(InputError, match="gain is defined on power iterations"):
        gain(trace)
    assert len(mu(trace)) == 3


@pytest.mark.parametrize("algorithm", ["siso", "procedure-1", "two-experiment", "mimo"])
def test_iterate_finds_the_peak_of_the_reference_plant(algorithm):
    plant = named_plant("reference", 0.01)
    trace, gains = iterate(
        simulated(plant), algorithm=algorithm, samples=500, iterations=40, rng=np.random.default_rng(1)
    )
    assert gains["gain"].last == pytest.approx(2.4, abs=0.03)
    assert worst_case(trace).frequency == pytest.approx(0.989, abs=2 * np.pi / 500)
    assert len(gains["mu"]) == 40


def test_named_plants_have_the_features_of_their_names():
    omega = np.linspace(0, np.pi, 4001)
    gains = {n: np.linalg.norm(named_plant(n).response(omega)[0], 2, axis=(1, 2)) for n in NAMES}
    peak = {n: omega[np.argmax(g)] for n, g in gains.items()}
    assert gains["reference"].max() == pytest.approx(2.411554068769, rel=1e-5)
    assert peak["peak-at-zero"] == 0
    assert peak["peak-at-pi"] == np.pi
    left, right = gains["two-peaks"][:1500].max(), gains["two-peaks"][1500:].max()
    assert 0.95 < right / left < 1.05
    assert left != right
    assert named_plant("three-by-two").n_outputs == 3
    assert len(named_plant("order-20").den[0][0]) == 21
    assert np.abs(np.roots(named_plant("nonminimum-phase").num[0][0][1:])).max() > 1
    hertz = np.arange(0, 500, 18.5)
    coarse = np.linalg.norm(named_plant("avis").response(2 * np.pi * hertz / 1000)[0], 2, axis=(1, 2))
    assert hertz[np.argmax(coarse)] == 296
    assert coarse.max() == pytest.approx(1.95, abs=1e-3)
    at = lambda f: np.linalg.norm(named_plant("avis").response([2 * np.pi * f / 1000])[0][0], 2)
    assert at(121.0) == pytest.approx(1.997, abs=1e-3)
    assert peak["avis"] * 1000 / (2 * np.pi) == pytest.approx(121, abs=0.2)
    with pytest.raises(InputError, match="did you mean reference"):
        named_plant("referense")
