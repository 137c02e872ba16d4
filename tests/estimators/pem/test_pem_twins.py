"""The same optimum as independent implementations: closed-form least squares, scipy, statsmodels; 50 seeded cases each.

statsmodels is no dependency: `pip install statsmodels patsy --no-deps` in a copy of the environment, then
`pytest -m validate tests/estimators/pem/test_pem_twins.py`.
"""

from __future__ import annotations

import importlib.util
import warnings

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.predictors.of_structure import predictor_is_stable
from oed.data import Record
from tests.estimators.pem.test_pem_global import polynomial
from tests.oracles import pem as oracle

CASES, SAMPLES = 50, 600


def case(kind, k):
    """A record of a random plant of order 1 to 4, its orders and true parameters."""
    rng = np.random.default_rng([ord(kind[0]), ord(kind[-1]), k])
    n = 1 + k % 4
    F, B = polynomial(rng, n, 0.4, 0.95), np.r_[0.0, rng.normal(size=n)]
    nc, nd = (int(v) for v in rng.integers(1, 3, size=2))
    C, D = polynomial(rng, nc, 0.2, 0.8), polynomial(rng, nd, 0.2, 0.8)
    u, e = rng.normal(size=SAMPLES), rng.normal(size=SAMPLES)
    if kind == "fir":
        F = np.ones(1)
    x = lfilter(B, F, u)
    noise = {"armax": (C, F), "arx": ([1.0], F), "bj": (C, D)}.get(kind, ([1.0], [1.0]))
    v = lfilter(*noise, e)
    y = x + 0.5 * x.std() / v.std() * v
    truth = {
        "fir": B[1:], "arx": np.r_[F[1:], B[1:]], "armax": np.r_[F[1:], B[1:], C[1:]],
        "oe": np.r_[B[1:], F[1:]], "bj": np.r_[B[1:], C[1:], D[1:], F[1:]],
    }[kind]  # fmt: skip
    orders = {"fir": (n,), "arx": (n, n), "armax": (n, n, nc), "oe": (n, n), "bj": (n, nc, nd, n)}[kind]
    return Record(u, y), orders, truth


def lagged(x, lags):
    return np.column_stack([np.r_[np.zeros(k), x[: len(x) - k]] for k in lags])


@pytest.mark.parametrize("kind", ["fir", "arx"])
def test_closed_form_least_squares(kind) -> None:
    """All 50: parameters to 1e-8 of the largest, covariance too; zeros before the record on both sides."""
    for k in range(CASES):
        record, orders, _ = case(kind, k)
        u, y = record.u[:, 0], record.y[:, 0]
        n = orders[0]
        X = lagged(u, range(1, n + 1))
        X = X if kind == "fir" else np.column_stack([-lagged(y, range(1, n + 1)), X])
        theta, rest, *_ = np.linalg.lstsq(X, y, rcond=None)
        fit = identify(record, kind, orders, offset=False)
        assert np.abs(fit.theta - theta).max() < 1e-8 * np.abs(theta).max(), k
        covariance = np.linalg.inv(X.T @ X) * rest[0] / (SAMPLES - len(theta))
        assert np.allclose(fit.covariance, covariance, rtol=1e-6, atol=1e-9 * np.abs(covariance).max()), k
    record, _, _ = case("fir", 3)
    assert identify(record, "fir", (4,), offset=False).theta == pytest.approx(
        oracle.fir(record.u[:, 0], record.y[:, 0], 5)[1:], abs=0.1
    )


def residual(kind, orders, record):
    u, y = record.u[:, 0], record.y[:, 0]
    one = lambda tail: np.r_[1.0, tail]

    def errors(theta):
        if kind == "oe":
            b, f = np.split(theta, [orders[0]])
            return y - lfilter(np.r_[0.0, b], one(f), u)
        b, c, d, f = np.split(theta, np.cumsum(orders)[:3])
        return lfilter(one(d), one(c), y - lfilter(np.r_[0.0, b], one(f), u))

    return errors


@pytest.mark.validate
@pytest.mark.parametrize("kind", ["oe", "bj"])
def test_scipy_ends_at_the_same_optimum(kind, record_figure) -> None:
    """scipy's least squares on lfilter, begun at the truth: never lower with a stable predictor (nothing keeps scipy
    from an unstable one); the same to 1e-3 standard errors where it converges to the same loss."""
    same, lower, higher, outside = 0, 0, 0, 0
    for k in range(CASES):
        record, orders, truth = case(kind, k)
        ours = identify(record, kind, orders, offset=False)
        with np.errstate(all="ignore"):
            theirs = least_squares(residual(kind, orders, record), truth, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        gap = 2 * theirs.cost / SAMPLES / ours.loss - 1
        stable = predictor_is_stable(ours.model.structure, theirs.x)
        outside, lower = outside + (not stable), lower + int(gap < -1e-8 and stable)
        higher += int(gap > 1e-6 and stable)
        same += bool(np.all(np.abs(theirs.x - ours.theta) < 1e-3 * ours.standard_errors))
    found = {
        "same": same, "scipy lower": lower, "scipy higher": higher, "scipy unstable": outside, "cases": CASES,
    }  # fmt: skip
    record_figure(f"scipy against {kind}", found, samples=SAMPLES)
    assert lower == 0, found
    assert same + higher + outside >= CASES, found
    assert same >= 0.8 * CASES, found


@pytest.mark.validate
@pytest.mark.skipif(
    importlib.util.find_spec("statsmodels") is None, reason="statsmodels is not installed (see above)"
)
def test_statsmodels_ends_at_the_same_optimum(record_figure) -> None:
    """ARMAX as a regression with moving-average errors on past outputs and inputs, by its Kalman filter; its state
    known to be zero before the record, which is what zero initial states mean here."""
    from statsmodels.tsa.statespace.sarimax import SARIMAX

    class FromRest(SARIMAX):
        def update(self, params, **options):
            out = super().update(params, **options)
            R, Q = self.ssm["selection"], self.ssm["state_cov"]
            self.ssm.initialize_known(np.zeros(R.shape[0]), R @ Q @ R.T)
            return out

    same, lower, higher = 0, 0, 0
    for k in range(CASES):
        record, (na, nb, nc), truth = case("armax", k)
        u, y = record.u[:, 0], record.y[:, 0]
        ours = identify(record, "armax", (na, nb, nc), offset=False)
        X = np.column_stack([-lagged(y, range(1, na + 1)), lagged(u, range(1, nb + 1))])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = FromRest(
                y, exog=X, order=(0, 0, nc), enforce_invertibility=False, concentrate_scale=True,
                loglikelihood_burn=0,
            )  # fmt: skip
            theirs = model.fit(truth, disp=0, method="bfgs", maxiter=500, gtol=1e-9)
            loss = float(theirs.scale)
            at_ours = float(model.filter(ours.theta).scale)
        assert at_ours == pytest.approx(ours.loss, rel=1e-9)  # the two losses are the same function
        lower, higher = lower + (loss < ours.loss * (1 - 1e-8)), higher + (loss > ours.loss * (1 + 1e-6))
        same += bool(np.all(np.abs(theirs.params - ours.theta) < 1e-2 * ours.standard_errors))
    found = {"same": same, "statsmodels lower": lower, "statsmodels higher": higher, "cases": CASES}
    record_figure("statsmodels against armax", found, samples=SAMPLES)
    assert lower == 0, found
    assert same + higher >= CASES, found
    assert same >= 0.8 * CASES, found
