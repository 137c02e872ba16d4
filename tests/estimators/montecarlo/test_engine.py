"""The compiled campaigns (`engine_kernels`) against the plain loop, run by run."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.montecarlo.engine import batches, counter_start, monte_carlo, plain_batch
from estimators.montecarlo.noise_ahead import noise_of_replicates
from oed.errors import InputError
from oed.experiments import Experiment, simulated
from oed.plants.named import NAMES, named_plant
from oed.signals.noise import noise_key, noise_series, standard_noise


def coloured(name):
    plant = named_plant(name, 0.5)
    return plant.replace(noise_num=[1, 0.4], noise_den=[1, -0.7, 0.2], name="coloured")


def correlated():
    return named_plant("three-by-two").replace(noise_covariance=[[1, 0.3, 0], [0.3, 2, 0.1], [0, 0.1, 0.5]])


def twin_batch(plant, algorithm, samples, iterations, seed, replicate, scaling="none"):
    """The run of the compiled engine, by the plain loop."""
    start = counter_start(plant, samples, seed=seed, replicate=replicate)
    experiment = simulated(plant, seed=seed, replicate=replicate)
    return plain_batch(experiment, algorithm, samples, iterations, seed, replicate, scaling, start)


def compare(plant, algorithm, scaling="none", samples=201, iterations=6, replicate=66):
    """Largest difference relative to the largest value, over everything a batch holds."""
    found = list(
        batches(plant, algorithm=algorithm, scaling=scaling, samples=samples, iterations=iterations,
                replicates=replicate + 1, seed=3)
    )[-1]  # fmt: skip
    twin = twin_batch(plant, algorithm, samples, iterations, 3, replicate, scaling)
    worst = 0.0
    for field in ("gain_squares", "mu_squares", "rayleigh", "energy"):
        ours, theirs = getattr(found, field)[replicate - found.first], getattr(twin, field)[0]
        np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))
        if np.isfinite(theirs).any():
            worst = max(worst, np.nanmax(np.abs(ours - theirs)) / np.nanmax(np.abs(theirs)))
    return worst


SINGLE = [name for name in NAMES if named_plant(name).n_inputs == 1]


@pytest.mark.parametrize("name", SINGLE)
def test_algorithm_1_agrees_with_the_plain_loop(name):
    assert compare(named_plant(name), "siso") < 1e-10


@pytest.mark.parametrize("samples", [200, 201, 202, 203])
def test_lengths_that_are_no_multiple_of_four(samples):
    assert compare(named_plant("reference"), "siso", samples=samples) < 1e-10


@pytest.mark.parametrize("scaling", ["none", "each", "common"])
@pytest.mark.parametrize("name, algorithm", [("reference", "two-experiment"), ("three-by-two", "mimo")])
def test_procedure_2_agrees_with_the_plain_loop(name, algorithm, scaling):
    assert compare(named_plant(name), algorithm, scaling, samples=101, iterations=4) < 1e-10


def test_coloured_and_correlated_noise():
    assert compare(coloured("reference"), "siso") < 1e-10
    assert compare(coloured("three-by-two"), "mimo", iterations=3) < 1e-10
    assert compare(correlated(), "mimo", iterations=3) < 1e-10


def test_another_noise_would_show():
    """Negative control: the twin of another replicate differs in the first digits."""
    plant = named_plant("reference")
    found = next(batches(plant, samples=200, iterations=4, replicates=2, seed=3))
    twin = twin_batch(plant, "siso", 200, 4, 3, 1)
    assert np.abs(found.gain_squares[0] - twin.gain_squares[0])[1:].max() > 1e-3


def test_compiled_normals_are_the_same_bits():
    from estimators.montecarlo.noise_kernels import B, normal_block

    key = noise_key(5, "plant")
    x = np.empty(1001 * B)
    normal_block(*(np.uint64(k) for k in key), 1001, 2, 7, 11, x)
    for r in (0, B - 1):
        np.testing.assert_array_equal(x.reshape(-1, B)[:, r], standard_noise(key, 11 + r, 7, 1001, 3)[:, 2])


def test_noise_of_replicates_is_that_of_each_run():
    key = noise_key(5, "plant")
    found = noise_of_replicates(key, 11, 3, 101, 2)
    for r in (0, 5):
        np.testing.assert_array_equal(found[r], noise_series(key, 11 + r, range(3), 101, 2))


def test_result_does_not_depend_on_threads_or_on_splitting():
    plant, size = named_plant("reference"), {"samples": 60, "iterations": 5}
    one = monte_carlo(plant, 60, 5, 200)
    two = monte_carlo(plant, 60, 5, 200, threads=2)
    for name, values in one.mean.items():
        np.testing.assert_array_equal(values, two.mean[name])
        np.testing.assert_array_equal(one.deviation[name], two.deviation[name])
    whole = np.concatenate([b.gain_squares for b in batches(plant, replicates=200, **size)])
    part = np.concatenate([b.gain_squares for b in batches(plant, replicates=77, first=100, **size)])
    np.testing.assert_array_equal(part, whole[100:177])


def test_campaign_statistics_are_those_of_the_runs():
    plant = named_plant("reference", 9.0)
    campaign = monte_carlo(plant, 100, 8, 150, seed=2)
    squares = np.concatenate(
        [b.gain_squares for b in batches(plant, samples=100, iterations=8, replicates=150, seed=2)]
    )
    roots = np.sqrt(np.where(squares >= 0, squares, np.nan))
    np.testing.assert_allclose(campaign.mean["gain"][1:], np.nanmean(roots[:, 1:], axis=0), rtol=1e-12)
    np.testing.assert_allclose(
        campaign.deviation["gain"][1:], np.nanstd(roots[:, 1:], axis=0, ddof=1), rtol=1e-12
    )
    np.testing.assert_array_equal(campaign.negative, (squares < 0).sum(axis=0))
    assert campaign.negative.sum() > 0
    np.testing.assert_allclose(campaign.energy, 100)
    assert "150 runs" in repr(campaign)
    np.testing.assert_array_equal(campaign.gain_first, roots[0])
    assert campaign.finite_norm == pytest.approx(2.32001887, abs=1e-8)


def test_a_python_callable_takes_the_slow_path_to_the_same_place():
    plant = named_plant("reference")
    slow = monte_carlo(lambda r: simulated(plant, replicate=r), 100, 12, 60)
    fast = monte_carlo(plant, 100, 12, 60)
    off = (
        np.abs(slow.mean["gain"] - fast.mean["gain"])[6:]
        / np.hypot(slow.error("gain"), fast.error("gain"))[6:]
    )
    assert off.max() < 5  # the starts differ, the noise does not
    saturated = monte_carlo(
        lambda r: Experiment(lambda u: np.clip(u, -1, 1) + 0.1 * standard_noise((r, 0), 0, 0, len(u))),
        50,
        4,
        3,
    )
    assert np.isfinite(saturated.mean["gain"][1:]).all()


def test_start_has_exact_power():
    u = counter_start(named_plant("three-by-two"), 50, seed=1, replicate=2)
    assert np.mean(np.sum(u**2, axis=1)) == pytest.approx(1, rel=1e-14)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"algorithm": "mimi"}, "did you mean mimo"),
        ({"scaling": "all"}, "no scaling named"),
        ({"replicates": 0}, "replicates is 0"),
        ({"iterations": 1.5}, "iterations is 1.5"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(InputError, match=message):
        list(
            batches(
                named_plant("reference"), **({"samples": 10, "iterations": 2, "replicates": 1} | arguments)
            )
        )
    with pytest.raises(InputError, match="one input and one output"):
        list(batches(named_plant("avis"), samples=10, iterations=2, replicates=1))
