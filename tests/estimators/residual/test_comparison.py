"""Models side by side on fresh data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.residual import compare_models
from oed.data import Record
from oed.errors import InputError


def test_models_are_compared_on_fresh_data(rng):
    u = rng.normal(size=(600, 1))
    y = lfilter([0, 0.2, 0.2], [1, -1, 0.8], u, axis=0) + 0.05 * rng.normal(size=(600, 1))
    record = Record(u, y)
    first, second = record[:400], record[400:]
    fits = {
        name: identify(first, *how) for name, how in {"poor": ("fir", (2,)), "right": ("oe", (2, 2))}.items()
    }
    compared = compare_models(fits, second, skip=20)
    assert [row["model"] for row in compared.rows] == ["right", "poor"]
    e = (second.y - fits["right"].simulate_record(second, window=20))[20:]
    assert compared.rows[0]["simulation_rmse"] == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-12)
    assert compared.rows[0]["simulation_fit_percent"] > compared.rows[1]["simulation_fit_percent"] + 5
    lines = repr(compared).splitlines()
    assert len(lines) == 3
    assert lines[1].startswith("right")
    assert len({len(line) for line in lines}) == 1
    with pytest.raises(InputError, match="leave some to judge by"):
        compare_models(fits, second, skip=200)
    with pytest.raises(InputError, match="no model to compare"):
        compare_models({}, second)


def test_the_figure_says_what_the_table_says_of_models_with_and_without_a_start(rng):
    """A model that starts at rest does so in the figure too; samples that are missing are left out of both."""
    u = rng.normal(size=(600, 1))
    y = lfilter([0, 0.2, 0.2], [1, -1, 0.95], u, axis=0) + 0.05 * rng.normal(size=(600, 1))
    first, second = Record(u, y)[:300], Record(u, np.where(np.arange(600)[:, None] % 40, y, np.nan))[300:]
    compared = compare_models({k: identify(first, "oe", (2, 2), initial=k) for k in ("zero", "estimate")}, second, skip=20)  # fmt: skip
    legend = [text.get_text() for text in compared.plot().axes[0].get_legend().get_texts()]
    assert legend[1:] == [f"{row['model']}: {row['simulation_fit_percent']:.1f} %" for row in compared.rows]  # fmt: skip
    assert len({row["simulation_fit_percent"] for row in compared.rows}) == 2
