"""Procedure 2 at finite N: the moments against campaigns, one effect after the other, and against one channel."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.montecarlo.engine import batches
from oed.errors import InputError
from oed.plants.named import named_plant
from oed.theory.finite import EFFECTS, singular_values
from oed.theory.finite_mimo import finite_mimo_moments, finite_mimo_prediction

CASES = [
    ("three-by-two", 4.0, "each", 100, 3000),
    ("three-by-two", 1.0, "none", 300, 1500),
    ("avis", 0.5, "each", 400, 2000),
    ("reference", 4.0, "each", 300, 4000),
    ("reference", 1.0, "none", 100, 2000),
    ("avis", 1.0, "common", 200, 6000),
]


def prediction_errors(name, variance, scaling, samples, runs, seed=11):
    """Predictions less the mean of gamma_2^2 over iterations 21 to 30, and its standard error."""
    plant = named_plant(name, variance)
    parts = batches(
        plant, algorithm="mimo", samples=samples, iterations=30, replicates=runs, seed=seed, scaling=scaling
    )
    values = np.concatenate([batch.gain_squares[:, 20:].mean(axis=1) for batch in parts])
    moments = [finite_mimo_moments(plant, samples, 30, effect=e, scaling=scaling) for e in EFFECTS]
    off = [float(m.beta2[20:].mean() - values.mean()) for m in moments]
    return np.array(off), float(values.std(ddof=1) / np.sqrt(runs)), moments[-1].holds


@pytest.mark.parametrize("name, variance, scaling, samples, runs", CASES[:1])
def test_each_effect_brings_the_prediction_closer(name, variance, scaling, samples, runs):
    """Edges first, then the fluctuation of mu where its expansion holds."""
    off, error, holds = prediction_errors(name, variance, scaling, samples, runs)
    assert holds
    assert abs(off[0]) > 20 * error
    assert abs(off[0]) > abs(off[1])
    assert abs(off[2]) < 0.67 * abs(off[1]) + 3 * error


@pytest.mark.validate
@pytest.mark.parametrize("name, variance, scaling, samples, runs", CASES[1:])
def test_each_effect_on_the_other_plants(name, variance, scaling, samples, runs, record_figure):
    """Three plants, one 3 x 2, and all scalings. What is left where the expansion holds is at most two thirds of the second."""
    off, error, holds = prediction_errors(name, variance, scaling, samples, runs)
    record_figure(
        "prediction less measurement", [*off.tolist(), error], plant=name, variance=variance, N=samples
    )
    assert abs(off[0]) > abs(off[1])
    assert abs(off[2]) < (0.67 if holds else 1.0) * abs(off[1]) + 3 * error


@pytest.mark.parametrize("scaling", ["none", "each", "common"])
def test_longer_experiments_tend_to_the_theory_without_edges(scaling):
    plant = named_plant("three-by-two", 2.0)
    far = [
        abs(finite_mimo_moments(plant, N, 2, effect="edge", scaling=scaling).limit_beta2
            - finite_mimo_moments(plant, N, 2, effect="infinite", scaling=scaling).limit_beta2)
        for N in (100, 400)
    ]  # fmt: skip
    assert far[1] < 0.35 * far[0]


@pytest.mark.parametrize("scaling", ["none", "each", "common"])
def test_the_limit_is_that_of_the_recursion(scaling):
    plant = named_plant("three-by-two", 5.0)
    moments = finite_mimo_moments(plant, 60, 400, effect="edge", scaling=scaling)
    assert moments.beta2[-1] == pytest.approx(moments.limit_beta2, rel=1e-8)
    assert moments.mu2[-1] == pytest.approx(moments.limit_mu2, rel=1e-8)


def test_recursion_of_the_full_covariance():
    """Twin: matrices of second moments over all samples, as the experiments are made, for the mean of Q."""
    plant, N, variance = named_plant("three-by-two", 0.7), 20, 0.7
    p, q = plant.n_outputs, plant.n_inputs
    g = plant.impulse_response(N)
    G = np.zeros((N * p, N * q))
    for t in range(N):
        for s in range(t + 1):
            G[t * p : (t + 1) * p, s * q : (s + 1) * q] = g[t - s]
    S, found = np.eye(N * q) / q, []
    for _ in range(12):
        Y = G @ S @ G.T
        found.append(np.trace(Y) / N)
        power = (np.trace(Y) + variance * N * p) / N
        W = G.T @ (Y + variance * np.eye(N * p)) @ G + variance * power * np.eye(
            N * q
        )  # each scaled by itself
        S = W / (np.trace(W) / N)
    moments = finite_mimo_moments(plant, N, 12, effect="edge", scaling="each")
    np.testing.assert_allclose(moments.beta2, found, rtol=1e-10)


def test_without_noise_the_shares_are_those_of_the_powers():
    """No noise: the mean is sum d^2 d^4m / sum d^4m with the edges alone, and less with the random start."""
    plant, N = named_plant("avis", 0.0), 60
    d2 = singular_values(plant, N) ** 2
    weights = d2 ** (2 * np.arange(6)[:, None])
    edge = finite_mimo_moments(plant, N, 6, effect="edge")
    np.testing.assert_allclose(edge.beta2, (weights @ d2) / weights.sum(axis=1), rtol=1e-12)
    assert edge.limit_beta2 == d2.max()
    assert (finite_mimo_moments(plant, N, 6, effect="random-mu").beta2[1:] < edge.beta2[1:]).all()


def test_prediction_keys():
    plant = named_plant("avis", 20.0)
    short, long = finite_mimo_prediction(plant, 100, "each"), finite_mimo_prediction(plant, 2000)
    assert "finite_beta2_mean_random_mu" not in finite_mimo_prediction(named_plant("avis", 1.0), 100, "each")
    assert short["finite_beta2_mean"] < short["finite_norm"] ** 2
    assert short["finite_beta2_mean_random_mu"] < short["finite_beta2_mean"]
    assert set(long) == {"samples", "finite_norm"}


def test_what_it_is_not_for():
    with pytest.raises(InputError, match="one variance on every output"):
        finite_mimo_moments(named_plant("avis").replace(noise_covariance=[[1, 0], [0, 2.0]]), 50)
    with pytest.raises(InputError, match="no description named"):
        finite_mimo_moments(named_plant("avis"), 50, effect="none")
