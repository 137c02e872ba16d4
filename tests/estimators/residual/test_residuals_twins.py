"""estimators.residual.tests against permutation: p-values of the same statistics without any distribution theory."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.residual.algebra import definite, least_squares
from estimators.residual.tests import autocorrelation, cross_correlation
from tests.oracles import lti, residuals


@pytest.mark.parametrize("case", range(4))
def test_whiteness(case, rng) -> None:
    """A permutation p-value of 999 has the standard error sqrt(p (1 - p) / 999) < .016; the chi-squared is a large-sample law and the
    statistics weigh the lags by N - k against 1: 0.08 apart at N = 300 allows five errors of the first. Control: case 3 is coloured.
    """
    e = rng.standard_normal(300)
    if case == 3:
        e = lti.difference_equation([1.0], [1.0, -0.5], e)
    oracle = residuals.whiteness_p_value(e, 10, rng, permutations=999)
    assert autocorrelation(e, lags=10).p_value == pytest.approx(oracle, abs=0.08)
    assert autocorrelation(e, lags=10).correlation == pytest.approx(
        residuals.autocorrelations(e, 10), abs=1e-12
    )
    assert (oracle < 0.01) == (case == 3)


@pytest.mark.parametrize("case", range(4))
def test_input_correlation(case, rng) -> None:
    """As above; the residual is white, so that permutation is a fair reference, and the input is not. Control: case 3 leaks."""
    e, u = rng.standard_normal(300), lti.difference_equation([1.0], [1.0, -0.8], rng.standard_normal(300))
    u = u - u.mean()
    if case == 3:
        e = e + 0.3 * np.r_[0.0, u[:-1]]
    oracle = residuals.independence_p_value(e, u, range(8), rng, permutations=999)
    found = cross_correlation(e, u, lags=7)
    assert found.p_value == pytest.approx(oracle, abs=0.08)
    assert found.correlation == pytest.approx(residuals.cross_correlations(e, u, range(8)), abs=1e-12)
    assert (oracle < 0.01) == (case == 3)


@pytest.mark.parametrize("condition", [1.0, 1e4, 1e7, 1e12])
def test_normal_equations_give_way_where_they_do_not_bear_least_squares(condition):
    """Both against LAPACK's decompositions: the first digits that these themselves have are the same, whatever the columns' units."""
    rng, m = np.random.default_rng(7), 5
    U, V = np.linalg.qr(rng.standard_normal((300, m)))[0], np.linalg.qr(rng.standard_normal((m, m)))[0]
    X = U * np.geomspace(1.0, 1.0 / condition, m) @ V
    y, units = X @ rng.standard_normal(m) + 0.1 * rng.standard_normal(300), 10.0 ** np.arange(-4, 6, 2)
    known = np.linalg.lstsq(X, y, rcond=None)[0]
    np.testing.assert_allclose(X @ least_squares(X, y), X @ known, atol=1e-12 * condition)
    np.testing.assert_allclose(X @ (least_squares(X * units, y) * units), X @ known, atol=1e-9 * condition)
    A = V.T * np.geomspace(1.0, 1.0 / condition, m) @ V
    b = rng.standard_normal(m)  # rounding of a solution as large as 1 / condition
    np.testing.assert_allclose(A @ definite(A, b, 1e-15), b, atol=1e-14 * condition)
