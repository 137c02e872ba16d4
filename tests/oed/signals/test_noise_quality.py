"""The noise against its formula in double precision, its moments, tails and independence on a million values.

Each statistical check compares with 5 standard errors (false alarms below 1e-6 each; the noise is a fixed
function, so each outcome is fixed too), and has a negative control that it must catch.
"""

from __future__ import annotations

from math import erfc

import numpy as np
import pytest

from oed.signals.noise import START, noise_key, philox, standard_noise

KEY = noise_key(7, "reference")


@pytest.fixture(scope="module")
def sample():
    """1 million normals over samples, outputs, experiments and replicates."""
    parts = [standard_noise(KEY, r, k, 1000, 2) for r in range(50) for k in range(10)]
    return np.stack(parts).reshape(50, 10, 1000, 2)


def test_known_answer_of_seven_rounds():
    """The known-answer vector published with Random123."""
    found = philox((np.zeros(1, np.uint64),) * 4, (0, 0))
    assert [int(word[0]) for word in found] == [0x5F6FB709, 0x0D893F64, 0x4F121F81, 0x4F730A48]


def test_normals_are_those_of_box_muller_in_double_precision():
    blocks = 5000
    zero = np.zeros(blocks, np.uint64)
    x = philox((np.arange(blocks, dtype=np.uint64), zero, zero, zero), KEY)
    expected, bound = np.empty((blocks, 4)), np.empty((blocks, 4))
    for pair in (0, 1):
        first, second = (x[2 * pair + k].astype(np.int64) for k in (0, 1))
        uniform = (first % 2**31 + 0.5) * 2.0**-31
        radius = np.sqrt(-2 * np.log(uniform)) * np.where(first >= 2**31, -1, 1)
        angle = np.where(second >= 2**31, second - 2.0**32, second) * (np.pi / 2 / 2**31)
        expected[:, 2 * pair], expected[:, 2 * pair + 1] = radius * np.cos(angle), radius * np.sin(angle)
        bound[:, 2 * pair : 2 * pair + 2] = (1e-6 + 1e-7 / np.abs(radius))[:, None]
    found = standard_noise(KEY, 0, 0, 4 * blocks)[:, 0]
    assert (np.abs(found - expected.ravel()) < bound.ravel()).all()


def moments_off(e):
    """Largest deviation of the first six moments from the normal ones, in standard errors."""
    e, n = e.ravel(), e.size
    normal = {1: 0, 2: 1, 3: 0, 4: 3, 5: 0, 6: 15}
    spread = {1: 1, 2: 2, 3: 15, 4: 96, 5: 945, 6: 10170}  # variances of e^k
    return max(abs(np.mean(e**k) - normal[k]) / np.sqrt(spread[k] / n) for k in normal)


def tails_off(e):
    """Largest deviation of the numbers beyond 1, 2, ..., 4.5 from the normal ones, in standard errors."""
    e, n, worst = e.ravel(), e.size, 0.0
    for c in (1, 2, 3, 4, 4.5):
        p = erfc(c / np.sqrt(2)) / 2
        for beyond in (e > c, e < -c):
            worst = max(worst, abs(beyond.sum() - n * p) / np.sqrt(n * p))
    return worst


def correlation_off(a, b):
    """Correlation of two samples and of their squares, in standard errors."""
    n = a.size
    plain = abs(np.mean(a * b)) * np.sqrt(n)
    return max(plain, abs(np.mean((a**2 - 1) * (b**2 - 1))) / 2 * np.sqrt(n))


def neighbours_off(e):
    pairs = [(e[:, :, :-lag], e[:, :, lag:]) for lag in (1, 2, 3, 4, 5, 8)]
    pairs += [(e[:, :, :, 0], e[:, :, :, 1]), (e[:, :-1], e[:, 1:]), (e[:-1], e[1:])]
    return max(correlation_off(a, b) for a, b in pairs)


def test_moments(sample):
    assert moments_off(sample) < 5
    assert moments_off(1.006 * sample) > 5
    assert moments_off(sample + 0.01 * sample**2) > 5


def test_tails(sample):
    assert tails_off(sample) < 5
    assert tails_off(np.clip(sample, -4, 4)) > 5


def test_independence_across_samples_outputs_experiments_and_replicates(sample):
    assert neighbours_off(sample) < 5
    mixed = sample.copy()
    mixed[:, :, 1:] += 0.01 * sample[:, :, :-1]
    assert neighbours_off(mixed) > 5
    shared = sample.copy()
    shared[1::2, :, :100] = sample[0::2, :, :100]
    assert neighbours_off(shared) > 5


def test_quantiles_by_kolmogorov(sample):
    from scipy.stats import kstest

    some = sample[:, :2].ravel()
    assert kstest(some, "norm").pvalue > 1e-6
    assert kstest(1.02 * some, "norm").pvalue < 1e-6


def test_a_sample_depends_on_its_coordinates_only():
    whole = standard_noise(KEY, 3, 5, 1001, 3)
    np.testing.assert_array_equal(standard_noise(KEY, 3, 5, 40, 2), whole[:40, :2])
    for other in (
        standard_noise(KEY, 4, 5, 1001, 3),
        standard_noise(KEY, 3, START, 1001, 3),
        standard_noise(noise_key(8, "reference"), 3, 5, 1001, 3),
        standard_noise(noise_key(7, "delay"), 3, 5, 1001, 3),
    ):
        assert np.abs(np.corrcoef(other.ravel(), whole.ravel())[0, 1]) < 5 / np.sqrt(whole.size)
