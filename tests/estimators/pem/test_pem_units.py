"""Units change no conclusion: powers of ten within the stated range, a line beyond it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators import diagnose
from estimators.pem import identify
from estimators.residual.tests import residual_tests
from oed.data import Record
from oed.errors import InputError


def record(u_size: float = 1.0, y_size: float = 1.0, dt: float = 1.0) -> Record:
    """A plant of order one in noise that is not white, so that a test of whiteness must fail."""
    rng = np.random.default_rng(0)
    u, e = rng.standard_normal((2, 400))
    y = lfilter([0, 1, 0.5], [1, -0.8], u) + 0.3 * lfilter([1], [1, -0.9], e)
    return Record(u_size * u[:, None], y_size * y[:, None], dt=dt)


def conclusions(data: Record) -> dict[str, float]:
    fit = identify(data, "oe", (2, 1), 1)
    return {name: test.p_value for name, test in residual_tests(fit, data).items()} | {
        "pole": fit.model.theta[-1]
    }


@pytest.mark.parametrize(
    "sizes", [(1, 1e-75), (1, 5e73), (1e-74, 1), (1e74, 1), (1e-40, 1e40), (1, 1, 1e-9), (1, 1, 1e9)]
)
def test_powers_of_ten_change_no_conclusion(sizes):
    usual, found = conclusions(record()), conclusions(record(*sizes))
    assert usual["whiteness"] < 1e-6
    assert found["whiteness"] < 1e-6
    for name in ("input", "feedback", "pole"):
        assert np.isclose(found[name], usual[name], rtol=1e-6)  # the search stops at another last bit


@pytest.mark.parametrize("sizes", [(1, 1e-100), (1, 1e150), (1e-160, 1), (1e200, 1), (1, 1e-300)])
def test_beyond_the_range_of_squares_is_a_line(sizes):
    """Before, a failed test of whiteness became p = 1 at 1e-100, and larger sizes ended in tracebacks."""
    with pytest.raises(InputError, match="of the size .* choose units"):
        conclusions(record(*sizes))
    with pytest.raises(InputError, match="of the training record are of the size .* choose units"):
        diagnose(record(*sizes))
