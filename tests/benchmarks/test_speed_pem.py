"""The rows of the identification benchmarks are complete, on sizes small enough for every day."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.speed.pem import _case, against_scipy, against_sippy, memory, monte_carlo
from benchmarks.speed.searches import _record, searched
from estimators.pem import identify
from estimators.pem.predictors.plain import plain_output_error

KEYS = {
    *("name", "size", "seconds", "baseline", "baseline_seconds", "ratio", "target", "holds", "peak_mb"),
}


def test_rows_have_their_keys_and_the_same_optimum() -> None:
    row = against_scipy(2, 1000, repeats=1)
    assert set(row) >= KEYS
    assert (
        row["holds"] is True
    )  # no target at this size: true says that the optimum is not worse than scipy's
    assert row["ratio"] == pytest.approx(row["baseline_seconds"] / row["seconds"])
    assert set(against_sippy(1000)) >= KEYS
    row = monte_carlo(3, 500, jobs=1)
    assert row["seconds"] > 0
    assert float(row["note"].rsplit(" ", 1)[1]) == pytest.approx(1, abs=0.2)  # the noise variance


def test_searches_have_a_row_with_their_limit_and_how_they_ended() -> None:
    row = searched("one order too many", lambda rng: _record(rng, 1), "oe", (3, 3), 1e9)
    assert set(row) >= KEYS
    assert row["holds"] is True
    assert row["baseline_seconds"] == 1e9
    assert "CONVERGED" in row["note"]


def test_memory_is_bounded() -> None:
    assert memory(2, 100_000)["peak_mb"] < 150


def test_plain_casadi_finds_the_same_optimum_and_takes_constraints() -> None:
    record, start, _ = _case(2, 400)
    theta, loss = plain_output_error(record, 2)(start)
    ours = identify(record, "oe", (2, 2), start=start, offset=False)
    assert np.allclose(ours.theta, theta, atol=1e-5)
    assert ours.loss == pytest.approx(loss, rel=1e-9)
    held, worse = plain_output_error(record, 2, constraints=lambda p: [(p[0] + p[1], 0.0, 0.0)])(start)
    assert held[0] + held[1] == pytest.approx(0, abs=1e-6)
    assert worse > loss
