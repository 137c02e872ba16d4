"""How lags and p-values are printed."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.residual.measures import in_ranges, p_stated


@pytest.mark.parametrize(
    "lags, words",
    [([], ""), ([3], "3"), ([1, 2, 3, 7, 9, 10], "1 to 3, 7, 9 to 10"), ([-2, -1, 0], "-2 to 0")],
)
def test_lags_in_ranges(lags, words):
    assert in_ranges(np.array(lags, dtype=int)) == words


def test_no_p_value_is_zero():
    assert (p_stated(0.0), p_stated(0.0312), p_stated(5e-324)) == ("p < 1e-300", "p = 0.031", "p = 4.9e-324")
