"""Experiments of finite length: norms against dense matrices, moments against campaigns."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.montecarlo.engine import batches
from oed.errors import InputError
from oed.plants.named import NAMES, named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.theory.finite import EFFECTS, finite_moments, finite_norm, finite_prediction, singular_values


@pytest.mark.parametrize("name", NAMES)
def test_norm_is_the_dense_singular_value(name):
    plant = named_plant(name)
    assert finite_norm(plant, 400) == pytest.approx(singular_values(plant, 400)[0], rel=1e-10)
    assert finite_norm(plant, 400) < peak(plant).value


@pytest.mark.parametrize(
    "N, norm",
    [(50, 2.13096642), (100, 2.32001887), (200, 2.38542592), (500, 2.40705505), (1000, 2.41040246), (2000, 2.41126309)],
)  # fmt: skip
def test_published_norms_of_the_reference_plant(N, norm):
    """theory.md section 6, to its eight decimals."""
    assert finite_norm(named_plant("reference"), N) == pytest.approx(norm, abs=6e-9)


def test_second_singular_value_is_nearly_equal():
    """theory.md section 1: 2.38542592 and 2.38497898 at N = 200."""
    np.testing.assert_allclose(
        singular_values(named_plant("reference"), 200)[:2], [2.38542592, 2.38497898], atol=6e-9
    )


def test_norm_tends_to_the_hinf_norm_as_one_over_n_squared():
    plant = named_plant("reference")
    top = peak(plant)
    slope = [N**2 * (1 - finite_norm(plant, N) / top.value) for N in (200, 2000, 20000)]
    assert slope[0] == pytest.approx(433.4, abs=0.5)
    assert slope[1] == pytest.approx(482.6, abs=0.5)
    assert slope[2] == pytest.approx(np.pi**2 * top.curvature / (4 * top.value**2), rel=2e-3)


def campaign(plant, N, replicates, seed):
    """Root of the mean of beta_2^2 over iterations 30-60, with its standard error over runs."""
    runs = [
        batch.gain_squares[:, 29:].mean(axis=1)
        for batch in batches(plant, samples=N, iterations=60, replicates=replicates, seed=seed)
    ]
    values = np.concatenate(runs)
    mean = np.sqrt(values.mean())
    return mean, values.std(ddof=1) / np.sqrt(len(values)) / (2 * mean)


def fir(variance):
    return Plant([[[0, 1, 0.5, -0.3]]], [[[1.0]]], noise_covariance=variance, name="fir")


def at_pi(variance):
    return Plant([[[0, 1.0]]], [[[1, 0.9]]], noise_covariance=variance, name="pi")


def reference(variance):
    return named_plant("reference", variance)


def test_each_effect_brings_the_prediction_closer():
    """A finite impulse response, N = 60, variance 0.3, 8000 runs.

    The last prediction lies within 4 standard errors (false alarm 6e-5 for one seed); the two before, which
    are the negative controls, do not.
    """
    plant = fir(0.3)
    measured, error = campaign(plant, 60, 8000, seed=1)
    moments = [finite_moments(plant, 60, effect=e) for e in EFFECTS]
    off = np.abs(np.array([one.average(30, 60) for one in moments]) - measured) / error
    assert moments[-1].holds
    assert off[0] > off[1] > 4 > off[2]


@pytest.mark.parametrize(
    ("make", "N", "variance"),
    [
        (reference, 200, 1.0),
        (reference, 150, 1.0),
        (reference, 150, 0.5),
        (reference, 200, 0.1),
        (at_pi, 120, 20.0),
    ],
)
def test_where_the_expansion_ends_it_says_so_and_does_no_harm(make, N, variance, monkeypatch):
    """Beside the points of the table: nothing is printed, and the error is no larger than with the edges alone.

    2000 runs, 4 standard errors. The control: without its own end the expansion is worse than the edges by more than 2.
    """
    plant = make(variance)
    measured, error = campaign(plant, N, 2000, seed=6)
    edge, both = (finite_moments(plant, N, effect=e) for e in ("edge", "random-mu"))
    assert edge.holds
    assert not both.holds
    assert np.isnan(both.limit_beta2)
    assert "finite_beta2_mean_random_mu" not in finite_prediction(plant, N)
    off = [abs(one.average(30, 60) - measured) for one in (edge, both)]
    assert off[1] <= off[0] + 4 * error
    monkeypatch.setattr("oed.theory.finite.ASTRAY", np.inf)
    endless = finite_moments(plant, N, effect="random-mu")
    assert abs(endless.average(30, 60) - measured) > off[0] + 2 * error


def test_the_limit_over_the_iterations_is_converged():
    """With edges alone the limit solves its own equation: 20000 iterations at little noise reach it, 60 do not."""
    plant = named_plant("reference", 0.01)
    found = finite_moments(plant, 60, 20_000)
    assert found.beta2[-1] == pytest.approx(found.limit_beta2, rel=1e-9)
    assert abs(found.beta2[59] / found.limit_beta2 - 1) > 1e-6


def test_edges_of_the_first_published_row():
    """theory.md section 6: N = 100, variance 1, 2.1821 without edges and 2.0981 with them."""
    found = [finite_moments(reference(1.0), 100, effect=e).average(30, 60) for e in EFFECTS[:2]]
    np.testing.assert_allclose(found, [2.1821, 2.0981], atol=1e-4)


def test_edge_effect_of_the_other_published_rows():
    """theory.md section 6, to its four decimals."""
    for N, variance, value in ((100, 4.0, 1.3245), (500, 4.0, 1.4124), (1000, 4.0, 1.4188)):
        moments = finite_moments(named_plant("reference", variance), N, effect="edge")
        assert moments.average(30, 60) == pytest.approx(value, abs=2e-4)


@pytest.mark.slow
def test_prediction_keys_and_extrapolation():
    plant = named_plant("reference", 4.0)
    exact = finite_prediction(plant, 2500)
    assert exact["finite_beta2_mean"] == pytest.approx(exact["finite_mu2"] - 4.0)
    near = finite_prediction(plant, 3001)
    slope = 6.034597847881 - exact["finite_mu2"]
    assert 6.034597847881 - near["finite_mu2"] == pytest.approx(slope * 2500 / 3001, rel=1e-2)
    with pytest.raises(InputError, match="one of each"):
        finite_prediction(named_plant("avis"), 100)
    with pytest.raises(InputError, match="samples is 1"):
        finite_norm(plant, 1)
    with pytest.raises(InputError, match="dense matrix"):
        singular_values(plant, 5000)


@pytest.mark.slow
def test_the_third_order_falls_as_one_over_n_squared():
    """Variance 4: what both effects leave at N = 100 (-0.021) is at most a tenth of that at N = 500."""
    from benchmarks.reproductions.finite_experiments import prediction_errors

    (_, _, short, _), (_, error, long, _) = (prediction_errors(N, 4.0) for N in (100, 500))
    assert abs(short["random-mu"]) > 0.01
    assert abs(long["random-mu"]) < abs(short["random-mu"]) / 10 + 4 * error
    assert abs(long["edge"]) > 4 * error  # negative control: one effect less
