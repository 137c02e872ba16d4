"""Counter-based noise: published known answers, moments, tails, independence across counters."""

import numpy as np
import pytest
from scipy import stats

from oed.signals.noise import noise_key, noise_series, philox, standard_noise


@pytest.mark.parametrize(
    "counter, key, answer",
    [  # known-answer test vectors of Random123 (Salmon et al., SC 2011), philox4x32 with 10 rounds
        ([0] * 4, (0, 0), [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
        ([0xFFFFFFFF] * 4, (0xFFFFFFFF, 0xFFFFFFFF), [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
        (
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
            (0xA4093822, 0x299F31D0),
            [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
        ),
    ],
)
def test_known_answers(counter, key, answer):
    words = philox(tuple(np.array([c], dtype=np.uint64) for c in counter), key, rounds=10)
    assert [int(w[0]) for w in words] == answer


def test_normal_by_kolmogorov_smirnov_moments_and_tails():
    """400000 samples; the seed is fixed, each test alone would alarm on 1 of 1000 seeds."""
    x = standard_noise(noise_key(0, "quality"), 0, 0, 400_000)[:, 0]
    assert stats.kstest(x, "norm").pvalue > 1e-3
    assert abs(x.mean()) < 3.3 / np.sqrt(len(x))
    assert abs(x.var() - 1) < 3.3 * np.sqrt(2 / len(x))
    assert abs(np.mean(x**4) - 3) < 3.3 * np.sqrt(96 / len(x))
    for level in (2.0, 3.0, 4.0):
        expected = 2 * stats.norm.sf(level) * len(x)
        assert abs(np.sum(np.abs(x) > level) - expected) < 3.3 * np.sqrt(expected) + 1


def test_a_wrong_generator_would_be_caught():
    """Negative control: uniform numbers of the same variance, and a sum of 12 uniforms, both fail."""
    rng = np.random.default_rng(0)
    assert stats.kstest(rng.uniform(-np.sqrt(3), np.sqrt(3), 400_000), "norm").pvalue < 1e-10
    x = rng.random((400_000, 12)).sum(axis=1) - 6
    expected = 2 * stats.norm.sf(4.0) * len(x)
    assert abs(np.sum(np.abs(x) > 4) - expected) > 3.3 * np.sqrt(expected)


@pytest.mark.parametrize("lag", [1, 2, 3, 4, 5])
def test_uncorrelated_in_time(lag):
    x = standard_noise(noise_key(1, "lags"), 0, 0, 200_000)[:, 0]
    assert abs(np.mean(x[lag:] * x[:-lag])) < 3.3 / np.sqrt(len(x))
    assert abs(np.mean(x[lag:] ** 2 * x[:-lag] ** 2) - 1) < 3.3 * np.sqrt(8 / len(x))


def test_independent_across_every_coordinate():
    key = noise_key(0, "a")
    base = standard_noise(key, 0, 0, 50_000, 2)
    others = [
        base[:, 1],
        standard_noise(key, 1, 0, 50_000)[:, 0],
        standard_noise(key, 0, 1, 50_000)[:, 0],
        standard_noise(noise_key(0, "b"), 0, 0, 50_000)[:, 0],
        standard_noise(noise_key(1, "a"), 0, 0, 50_000)[:, 0],
    ]
    for other in others:
        assert abs(np.mean(base[:, 0] * other)) < 3.3 / np.sqrt(50_000)
        assert not np.array_equal(base[:, 0], other)


def test_a_pure_function_of_its_coordinates():
    key = noise_key(5, "plant")
    long = standard_noise(key, 3, 7, 1000, 3)
    assert np.array_equal(
        standard_noise(key, 3, 7, 333, 3), long[:333]
    )  # shorter experiments see the same start
    assert np.array_equal(
        standard_noise(key, 3, 7, 1000, 1), long[:, :1]
    )  # more outputs do not change the first


def test_experiments_at_once_are_those_one_by_one():
    """Bit by bit, also where the lengths change from experiment to experiment and ahead was computed in vain."""
    from oed.experiments import simulated
    from oed.plants.named import named_plant

    key = noise_key(2, "several")
    for samples, outputs in ((500, 1), (7, 3), (1, 2)):
        series = noise_series(key, 5, range(3, 9), samples, outputs)
        for k, one in enumerate(series):
            assert np.array_equal(one, standard_noise(key, 5, 3 + k, samples, outputs))
    plant = named_plant("reference", 2.0)
    experiment = simulated(plant, seed=4, replicate=6, first=2, expected=7)
    for k, samples in enumerate((40, 40, 40, 9, 9, 3000, 40, 40)):
        noise = standard_noise(noise_key(4, plant.name), 6, 2 + k, samples)
        u = np.sin(np.arange(samples))[:, None]
        assert np.array_equal(experiment(u), plant.simulate(u) + np.sqrt(2.0) * noise)
