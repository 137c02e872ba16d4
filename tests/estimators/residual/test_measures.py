"""How lags and p-values are printed."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.residual.measures import in_ranges, p_stated, stated


@pytest.mark.parametrize(
    "lags, words",
    [([], ""), ([3], "3"), ([1, 2, 3, 7, 9, 10], "1 to 3, 7, 9 to 10"), ([-2, -1, 0], "-2 to 0")],
)
def test_lags_in_ranges(lags, words):
    assert in_ranges(np.array(lags, dtype=int)) == words


def test_no_p_value_is_zero():
    assert (p_stated(0.0), p_stated(0.0312), p_stated(5e-324)) == ("p < 1e-300", "p = 0.031", "p = 4.9e-324")


@pytest.mark.parametrize(
    "value, error, words",
    [(3.5811, 0.0573, "3.581 +- 0.057"), (13.2, 29.0, "13 +- 29"), (4e-14, 0.017, "0.000 +- 0.017"), (2.0, np.nan, "2 +- unknown"),
     (1234.5, 160.0, "1234 +- 160"), (1e-9, 2e-10, "1e-09 +- 2e-10"), (5.0, 0.0, "5 +- 0")],
)  # fmt: skip
def test_a_value_has_the_digits_that_its_error_leaves(value, error, words):
    assert stated(value, error) == words
