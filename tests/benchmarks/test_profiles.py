"""Paired comparisons, Holm's correction and profiles against hand-made cases and plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from benchmarks.campaign.run_columns import Estimates
from benchmarks.tables.head_to_head import median_interval
from benchmarks.tables.pairs import holm, paired_rows
from benchmarks.tables.profiles import RATIOS, TOLERANCE, Profiles, wilson


def estimates(values, good=None) -> Estimates:
    values = np.asarray(values, dtype=float)
    zero = np.zeros(len(values))
    return Estimates(
        np.arange(len(values), dtype=float), zero + 2, zero + 100, zero + 100, zero, values, zero + np.nan,
        np.isfinite(values) if good is None else np.asarray(good), {}, (),
    )  # fmt: skip


def test_holm_by_hand():
    """Five p-values, the third unknown: 0.01*4, max(.., 0.02*3), max(.., 0.03*2), then 0.5*1."""
    assert np.allclose(holm([0.03, 0.01, np.nan, 0.5, 0.02]), [0.06, 0.04, np.nan, 0.5, 0.06], equal_nan=True)
    assert np.all(holm([0.9, 0.8]) <= 1)


def test_holm_keeps_the_familywise_error_and_a_single_test_does_not(rng):
    """2000 families of 20 true nulls: at most 5 % have any rejection (bound 4 standard errors), uncorrected about 64 %."""
    p = rng.random((2000, 20))
    corrected = np.mean([np.any(holm(row) <= 0.05) for row in p])
    assert corrected <= 0.05 + 4 * np.sqrt(0.05 * 0.95 / 2000)
    assert np.mean(np.any(p <= 0.05, axis=1)) > 0.5


def test_pairs_are_those_of_a_paired_t_test(rng):
    a = 2.0 + 0.3 * rng.standard_normal(40)
    b = a + 0.1 * rng.standard_normal(40)
    b[3] = np.nan
    solvers = {("power", "pem"): estimates(b), ("white", "pem"): estimates(a)}
    (row,) = paired_rows(solvers, 2.0, 10.0)
    kept = np.delete(np.arange(40), 3)
    twin = stats.ttest_rel((a[kept] - 2) ** 2, (b[kept] - 2) ** 2)
    assert (row["question"], row["method"], row["against_method"], row["n"]) == (
        "input",
        "white",
        "power",
        39,
    )
    assert np.isclose(row["p_value"], twin.pvalue, rtol=1e-10)
    # As wide as forty normal errors need, and no narrower than the test's own.
    assert 1 < row["rho2_difference_se"] / (row["rho2_difference"] / twin.statistic) < 1.3
    assert np.isclose(row["closer"], np.mean(np.abs(a[kept] - 2) < np.abs(b[kept] - 2)))


def test_performance_profile_against_a_plain_loop(rng):
    gamma = 3.0
    values = {("a", "x"): gamma + rng.standard_normal(30), ("b", "x"): gamma + 2 * rng.standard_normal(30)}
    values["b", "x"][:4] = np.nan
    profiles = Profiles()
    profiles.add({k: estimates(v) for k, v in values.items()}, gamma, "1 x 1")
    rows = profiles.performance_rows()
    for solver, mine in values.items():
        for tau in RATIOS[[0, 5, 12]]:
            count = 0
            for r in range(30):
                errors = [abs(v[r] / gamma - 1) for v in values.values() if np.isfinite(v[r])]
                count += bool(np.isfinite(mine[r])) and abs(mine[r] / gamma - 1) <= tau * min(errors)
            row = next(x for x in rows if (x["method"], x["estimator"], x["ratio"]) == (*solver, tau))
            assert np.isclose(row["share"], count / 30)
            assert row["low"] <= row["share"] <= row["high"]
            assert row["n"] == 30
    last = [r["share"] for r in rows if r["method"] == "b"][-1]
    assert last <= 26 / 30  # failed runs solve nothing


def test_data_profile_counts_failures_as_unsolved():
    profiles = Profiles()
    found = estimates([1.0, 1.0 + 0.9 * TOLERANCE, 1.2, np.nan, 1.0])
    profiles.add_budget(("a", "x", "1 x 1", 2), found, 1.0, 4)
    profiles.add_budget(("a", "x", "1 x 1", 2), found, 1.0, 2)
    profiles.add_budget(("a", "x", "3 x 2", 2), found, 1.0, 2)
    row, several = profiles.data_rows()
    assert (row["share"], row["n"], row["samples"], row["experiments"]) == (4 / 6, 6, 100, 2)
    assert (row["energy"], row["peak_amplitude"]) == (100.0, 0.0)
    assert (several["channels"], several["n"], several["share"]) == ("3 x 2", 2, 1.0)


def test_a_solver_with_few_replicates_is_left_out():
    profiles = Profiles(least=5)
    profiles.add({("a", "x"): estimates([1.0] * 9), ("b", "x"): estimates([1.0] * 3)}, 2.0, "1 x 1")
    profiles.add({("a", "x"): estimates([1.0] * 6)}, 2.0, "3 x 2")
    row = profiles.performance_rows()[0]
    assert (row["channels"], row["energy"], row["samples"], row["n"]) == ("1 x 1, 3 x 2", 100.0, 100, 15)
    assert set(profiles.solved) == {("a", "x")}
    assert profiles.problems["a", "x"] == 15


@pytest.mark.parametrize("n, solved", [(10, 0), (10, 10), (50, 13)])
def test_wilson_solves_its_own_equation(n, solved):
    """The ends p solve |solved/n - p| = z sqrt(p (1 - p) / n)."""
    for end in wilson(solved, n):
        assert np.isclose(abs(solved / n - end), 1.96 * np.sqrt(end * (1 - end) / n), atol=1e-12)


def test_median_interval_covers(rng):
    """At least 95 % of 2000 samples of 25 (allowing 4 standard errors); the interval of half the level does not."""
    samples = rng.standard_normal((2000, 25))
    cover = lambda level: np.mean([(lambda e: e[0] <= 0 <= e[1])(median_interval(x, level)) for x in samples])
    assert cover(0.95) >= 0.95 - 4 * np.sqrt(0.05 * 0.95 / 2000)
    assert cover(0.5) < 0.9
