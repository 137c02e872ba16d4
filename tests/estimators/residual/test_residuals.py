"""Residual tests hold their level where nothing is missing and see what is missing, coloured noise included."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from estimators.pem import identify
from estimators.residual.algebra import (
    FEWEST,
    INDEPENDENT,
    mean_error,
    noise_filter,
    powers_of_two,
    sum_error,
    unit,
)
from estimators.residual.tests import (
    autocorrelation,
    cross_correlation,
    feedback,
    input_correlation,
    residual_tests,
    whiteness,
)
from oed.covariances import of_few
from oed.data import Record
from oed.errors import InputError
from tests.oracles import residuals as oracle

B, A = [0.0, 0.2155, 0.2012], [1.0, -0.9854, 0.8187]
RUNS, LEVEL = 200, 0.05
# 200 tests at level 0.05 reject between these numbers of times with probability 0.999.
LOW, HIGH = binom.ppf([0.0005, 0.9995], RUNS, LEVEL)


def fitted(seed, colour=(), order="oe", orders=(2, 2), length=500):
    rng = np.random.default_rng(seed)
    u = lfilter([1], [1, -0.8], rng.normal(size=length))
    e = lfilter([1], [1, *colour], rng.normal(size=length))
    record = Record(u, lfilter(B, A, u) + e)
    return identify(record, order, orders, start=[0.2155, 0.2012, -0.9854, 0.8187], offset=False), record


def test_level_of_the_input_test_in_coloured_noise() -> None:
    """p < 0.05 in 5 % of the runs although the noise is coloured and the input too; false alarms: 0.001."""
    p, alone, unfitted, ahead = [], [], [], []
    for seed in range(RUNS):
        fit, record = fitted(seed, colour=(-0.9,))
        p.append(input_correlation(fit, record, lags=20).p_value)
        ahead.append(feedback(fit, record).p_value)
        white = fit.residuals[0][:, 0]
        unfitted.append(cross_correlation(white, record.u, lags=20).p_value)
        alone.append(
            np.abs(oracle.cross_correlations(white, record.u[:, 0], range(21))).max()
            > 3.1 / np.sqrt(len(white))
        )
    assert LOW <= np.sum(np.array(p) < LEVEL) <= HIGH
    assert np.sum(np.array(ahead) < LEVEL) <= HIGH
    # The negative controls: the textbook bound for white residuals (3.1 sigma for 21 lags) fails here, and so does the
    # test for noise that no fit has touched.
    assert np.sum(alone) > HIGH
    assert np.sum(np.array(unfitted) < LEVEL) > HIGH


def test_level_of_the_whiteness_test() -> None:
    p = []
    for seed in range(RUNS):
        fit, record = fitted(1000 + seed)
        p.append(residual_tests(fit, record, lags=20)["whiteness"].p_value)
    assert LOW <= np.sum(np.array(p) < LEVEL) <= HIGH


def test_level_on_fresh_data() -> None:
    p = []
    for seed in range(RUNS):
        fit, _ = fitted(2000 + seed, colour=(-0.7,), length=300)
        p.append(residual_tests(fit, fitted(9000 + seed, (-0.7,))[1], lags=15, fresh=True)["input"].p_value)
    # The covariance of the parameters assumes white noise, so that the level is only near its value.
    assert np.sum(np.array(p) < LEVEL) <= HIGH + 10


def test_power_against_a_missing_delay_and_coloured_noise() -> None:
    """The planted errors are seen: p < 0.001 in every one of ten runs."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=600)
        y = lfilter([0, *B], A, u) + 0.2 * lfilter([1], [1, -0.6], rng.normal(size=600))
        record = Record(u, y)
        tests = residual_tests(identify(record, "oe", (2, 2), 1, offset=False), record)
        assert tests["whiteness"].p_value < 1e-3
        assert tests["input"].p_value < 1e-3
        good = residual_tests(identify(record, "oe", (2, 2), 2, offset=False), record)
        assert good["input"].p_value > 1e-4
        assert good["whiteness"].p_value < 1e-3


def test_feedback_is_seen_and_not_invented(rng) -> None:
    e = rng.normal(size=(2, 1000))
    y, u = np.zeros(1000), np.zeros(1000)
    for t in range(1, 1000):
        y[t] = 0.5 * y[t - 1] + 0.4 * u[t - 1] + e[0, t]
        u[t] = -0.4 * y[t] + e[1, t]
    ahead = range(-10, 0)
    assert cross_correlation(e[0], lfilter([1], [1, -0.5], e[1]), lags=ahead).p_value > 1e-3
    assert cross_correlation(e[0], np.r_[0, u[:-1]], lags=ahead).p_value < 1e-6
    closed = Record(np.r_[0, u[:-1]], y)
    assert feedback(identify(closed, "arx", (1, 1), 0), closed).p_value < 1e-6


def test_of_noise_untouched_by_a_fit_it_is_the_permutation_test(rng) -> None:
    """White noise: the chi-squared p-value is that of 2000 permutations within their error (0.011 at p = 0.5)."""
    e, u = rng.normal(size=400), rng.normal(size=400)
    theirs = oracle.independence_p_value(e, u - u.mean(), range(11), rng)
    assert cross_correlation(e, u, lags=10).p_value == pytest.approx(theirs, abs=0.05)
    assert autocorrelation(e, lags=10).p_value == pytest.approx(
        oracle.whiteness_p_value(e, 10, rng), abs=0.05
    )


def test_noise_filter_finds_an_autoregression(rng) -> None:
    a = noise_filter([lfilter([1], [1, -1.5, 0.8], rng.normal(size=4000))])
    assert a[:3] == pytest.approx([1, -1.5, 0.8], abs=0.06)
    assert np.abs(np.roots(a)).max() < 1
    assert len(noise_filter([np.zeros(100)])) == 1


def test_several_records_and_channels(rng) -> None:
    records = []
    for _ in range(3):
        u = rng.normal(size=(300, 2))
        y = np.column_stack([lfilter(B, A, u[:, 0]), lfilter([0, 0, 1], [1, -0.5], u[:, 1])])
        records.append(Record(u, y + 0.1 * rng.normal(size=(300, 2))))
    fit = identify(records, "oe", (2, 1), initial="estimate", offset=True, diagonal=True)
    tests = residual_tests(fit, records)
    assert set(tests) == {
        *("whiteness_1", "whiteness_2"),
        *(f"{k}_{i}{j}" for k in ("input", "feedback") for i in (1, 2) for j in (1, 2)),
    }
    assert tests["input_11"].p_value < 1e-6  # F of degree 1 cannot resonate
    assert tests["input_22"].p_value > 1e-4
    assert tests["input_22"].p_value == input_correlation(fit, records, output=1, input=1).p_value
    assert tests["whiteness_2"].p_value == whiteness(fit, records, output=1).p_value
    assert tests["input_11"].significant().size > 0


def test_bad_input_is_told(rng) -> None:
    with pytest.raises(InputError, match="equal, record by record"):
        cross_correlation(rng.normal(size=50), rng.normal(size=49))
    with pytest.raises(InputError, match="one channel at a time"):
        autocorrelation(rng.normal(size=(50, 2)))
    with pytest.raises(InputError, match="lags"):
        autocorrelation(rng.normal(size=3))


@pytest.mark.parametrize("pole", [0.0, 0.8, -0.5])
def test_the_error_of_a_mean_knows_the_memory_of_its_series(pole) -> None:
    """Of a long AR(1) series: its deviation times 1 / (1 - pole), over the root of its length; a negative pole is not believed."""
    e = np.asarray(lfilter([1.0], [1.0, -pole], np.random.default_rng(4).normal(size=40_000)))
    told = max(1 / (1 - pole), 1 / np.sqrt(1 - pole**2)) / 200
    assert mean_error(3.0 + e) == pytest.approx(told, rel=0.03)
    assert mean_error(1e200 * e) == pytest.approx(1e200 * mean_error(e), rel=1e-12)


def test_the_error_of_a_mean_is_as_wide_as_few_values_make_it() -> None:
    few = np.random.default_rng(0).normal(size=39)
    few_error = float(np.sqrt(np.sum((few - few.mean()) ** 2))) / 39
    assert list(noise_filter([few - few.mean()])) == [1.0]
    assert mean_error(few) == pytest.approx(of_few(few_error, 39 / INDEPENDENT), rel=1e-12)
    fewer = few[:5]
    fewer_error = float(np.sqrt(np.sum((fewer - fewer.mean()) ** 2))) / 5
    assert mean_error(fewer) == pytest.approx(of_few(fewer_error, FEWEST), rel=1e-12)
    assert mean_error(np.full(7, 2.5)) == 0.0


def test_the_error_of_a_sum_weighs_neighbours_by_bartlett() -> None:
    drawn = np.random.default_rng(5).normal(size=12)
    apart = np.abs(np.subtract.outer(np.arange(12), np.arange(12)))
    weights = np.clip(1 - apart / 4.0, 0.0, None)
    for off in (np.cumsum(drawn), drawn, drawn * (-1.0) ** np.arange(12)):
        together = max(float(off @ off), float(off @ weights @ off))
        assert sum_error(off) == pytest.approx(np.sqrt(together * 12 / 11), rel=1e-12)
    assert sum_error(np.array([3.0])) == 3.0
    assert sum_error(np.array([3.0, 2.0])) == pytest.approx(np.sqrt(2 * (13 + 2 * 0.75 * 6)), rel=1e-12)


def test_units_are_powers_of_two_that_change_no_digit() -> None:
    x = np.array([[0.3, 0.0, np.inf, -5.0], [-0.1, 0.0, 1.0, 4.0]])
    np.testing.assert_array_equal(powers_of_two(x, axis=(0,)), [0.25, 1.0, 1.0, 4.0])
    assert powers_of_two(np.zeros(0)) == powers_of_two(np.zeros(3)) == 1.0
    np.testing.assert_array_equal(unit(np.array([0.3, -0.1])), [1.2, -0.4])


def test_a_noise_filter_is_no_longer_than_it_may_be() -> None:
    e = np.asarray(lfilter([1.0], [1.0, *np.zeros(59), -0.9], np.random.default_rng(6).normal(size=4000)))
    assert len(noise_filter([e], most=60)) == 61
    assert len(noise_filter([e])) <= 41
    assert list(noise_filter([e], most=0)) == [1.0]
