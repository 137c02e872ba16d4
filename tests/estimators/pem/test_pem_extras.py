"""Known and bounded parameters, priors, robust losses, prefilters, missing samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.optimize import least_squares
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.search.problem import prepare
from oed.data import Record
from oed.errors import InputError
from oed.models.model import armax, bj, oe

B, A = [0.0, 0.2155, 0.2012], [1.0, -0.9854, 0.8187]
THETA = np.array([0.2155, 0.2012, -0.9854, 0.8187])


def record(rng, length=600, deviation=0.5, offset=0.0):
    u = rng.normal(size=length)
    return Record(u, offset + lfilter(B, A, u) + deviation * rng.normal(size=length))


def test_known_parameters_are_held(rng) -> None:
    data = record(rng)
    held = identify(data, fixed={"f1": -0.9854, "f2": 0.8187}, offset=False)
    assert held.theta[2:].tolist() == [-0.9854, 0.8187]
    assert held.standard_errors[2:].tolist() == [0, 0]
    x = lfilter([1.0], A, data.u[:, 0])
    rows = np.column_stack([np.r_[0, x[:-1]], np.r_[0, 0, x[:-2]]])
    assert held.theta[:2] == pytest.approx(np.linalg.lstsq(rows, data.y[:, 0], rcond=None)[0], rel=1e-9)
    free = identify(data, offset=False)
    assert np.all(held.standard_errors[:2] < free.standard_errors[:2])


def test_bounds_hold_and_are_told(rng) -> None:
    data = record(rng)
    fit = identify(data, bounds={"b1": (0.3, 0.4)}, offset=False)
    assert fit.theta[0] == pytest.approx(0.3)
    assert any("b1 is at its bound" in note for note in fit.notes)
    idle = identify(data, bounds={"b1": (-5, 5)}, offset=False)
    assert idle.theta == pytest.approx(identify(data, offset=False).theta, rel=1e-7)
    grid = [identify(data, fixed={"b1": 0.3}, offset=False).loss]
    assert fit.loss == pytest.approx(grid[0], rel=1e-9)


def test_prior_pulls_as_the_posterior_mode(rng) -> None:
    """fir is linear: the posterior mode is ridge regression in closed form, at the noise variance of the fit."""
    data = record(rng, 80)
    prior = {f"b{k}": (0.0, 0.05) for k in range(1, 9)}
    fit = identify(data, "fir", 8, prior=prior, offset=False)
    rows = np.column_stack([np.r_[np.zeros(k), data.u[:-k, 0]] for k in range(1, 9)])
    variance = fit.loss
    ridge = np.linalg.solve(rows.T @ rows + variance / 0.05**2 * np.eye(8), rows.T @ data.y[:, 0])
    assert fit.theta == pytest.approx(ridge, rel=1e-6)
    assert np.linalg.norm(fit.theta) < np.linalg.norm(identify(data, "fir", 8, offset=False).theta)


@pytest.mark.parametrize("robust", ["huber", "student"])
def test_robust_losses_withstand_outliers(rng, robust) -> None:
    data = record(rng)
    y = np.array(data.y)
    y[rng.choice(600, 30, replace=False)] += 40 * rng.choice([-1, 1], size=(30, 1))
    dirty = data.replace(y=y)
    plain, ours = identify(dirty, offset=False), identify(dirty, robust=robust, offset=False)
    # The robust estimate stays within 4.5 of its own errors, and these are those of clean data times at most 1.5.
    assert np.all(np.abs(ours.theta - THETA) < 4.5 * ours.standard_errors)
    assert np.all(ours.standard_errors < 1.5 * identify(data, offset=False).standard_errors)
    assert np.linalg.norm(ours.theta - THETA) < 0.5 * np.linalg.norm(plain.theta - THETA)


def test_huber_covariance_in_monte_carlo() -> None:
    """150 replicates of Gaussian noise: the ratio of spread to claimed error is 1 within 4 of its errors (5.8 %)."""
    rng = np.random.default_rng(3)
    fits = [identify(record(rng, 400), start=THETA, robust="huber", offset=False) for _ in range(150)]
    ratio = np.std([f.theta for f in fits], axis=0) / np.mean([f.standard_errors for f in fits], axis=0)
    assert np.all(np.abs(ratio - 1) < 0.23)


def test_prefilter_is_least_squares_on_filtered_data(rng) -> None:
    data = record(rng)
    fit = identify(data, prefilter=([1.0], [1.0, -0.5]), offset=False)
    through = lambda x: lfilter([1.0], [1.0, -0.5], x, axis=0)
    assert fit.theta == pytest.approx(
        identify(Record(through(data.u), through(data.y)), offset=False).theta, rel=1e-9
    )


@pytest.mark.parametrize("structure", [oe(2, 2), armax(2, 2, 1), bj(2, 1, 2, 1)])
def test_loss_with_gaps_is_the_gaussian_likelihood(structure, rng) -> None:
    """Against the dense covariance of the observed samples: quadratic form times det^(1/N), to rounding."""
    u, y = rng.normal(size=40), rng.normal(size=40)
    seen = rng.random(40) > 0.3
    data = Record(u, np.where(seen, y, np.nan))
    ones = np.ones(1), np.ones(1)
    problem = prepare(structure, [data], scales=ones, missing=True)
    theta = 0.3 * rng.normal(size=structure.n)
    row = structure.coefficients(theta)[0]
    clean = structure.simulate(theta, u[:, None])[:, 0]
    impulse = lfilter(row["c"][0], np.convolve(row["a"][0], row["d"][0]), np.r_[1, np.zeros(39)])
    T = toeplitz(impulse, np.r_[impulse[0], np.zeros(39)])
    sigma = (T @ T.T)[np.ix_(seen, seen)]
    v = (y - clean)[seen]
    expected = v @ np.linalg.solve(sigma, v) * np.exp(np.linalg.slogdet(sigma)[1] / seen.sum())
    point = problem.evaluate(theta)
    assert point.loss == pytest.approx(expected, rel=1e-9)
    h = 1e-6
    slope = [
        (problem.evaluate(theta + s).loss - problem.evaluate(theta - s).loss) / (4 * h)
        for s in h * np.eye(structure.n)
    ]
    assert point.gradient == pytest.approx(np.array(slope), rel=1e-5, abs=1e-6)


def test_gaps_are_bridged(rng) -> None:
    u = rng.normal(size=900)
    y = 3 + lfilter(B, A, u) + lfilter([0.3], [1, -0.8], rng.normal(size=900))
    y[rng.random(900) < 0.2] = np.nan
    y[300:340] = np.nan
    data = Record(u, y)
    fit = identify(data, "bj", (2, 0, 1, 2), offset=True, missing=True, initial="estimate")
    true = np.r_[THETA[:2], -0.8, THETA[2:]]
    assert np.all(np.abs(fit.theta - true) < 4.5 * fit.standard_errors)
    assert abs(fit.output_level[0] - 3) < 4.5 * fit.output_level_errors[0]
    assert np.isnan(fit.residuals[0]).sum() == np.isnan(y).sum()
    complete = identify(
        Record(u, np.where(np.isnan(y), 3.0, y)), "bj", (2, 0, 1, 2), offset=True, initial="zero"
    )
    assert np.linalg.norm(complete.theta - true) > np.linalg.norm(fit.theta - true)  # filling in is worse


def test_nothing_missing_is_the_plain_fit(rng) -> None:
    data = record(rng)
    assert (
        identify(data, missing=True, offset=False).theta.tolist()
        == identify(data, offset=False).theta.tolist()
    )


def test_means_are_those_of_the_samples_that_are_there(rng):
    u = rng.standard_normal(300)
    y = lfilter([0.0, 1.0], [1.0, -0.5], u) + 3.0 + 0.1 * rng.standard_normal(300)
    y[50:60] = np.nan
    fit = identify(Record(u, y), "oe", (1, 1), offset="mean", missing=True, initial="zero")
    assert fit.output_level == pytest.approx(np.nanmean(y))
    np.testing.assert_allclose(fit.theta, [1.0, -0.5], atol=0.05)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"fixed": {"q1": 1.0}}, "no parameter 'q1'"),
        ({"bounds": {"b1": (1, 0)}}, "must not exceed"),
        ({"prior": {"b1": (0, 0)}}, "must be positive"),
        ({"robust": "l1"}, "huber, student"),
        ({"prefilter": ([1], [1, -2])}, "stable"),
        ({"search": "hard"}, "auto, quick, thorough"),
    ],
)
def test_bad_requests_are_told(change, words, rng) -> None:
    with pytest.raises(InputError, match=words):
        identify(record(rng), **change)


def test_missing_inputs_are_refused(rng) -> None:
    data = record(rng, 60)
    u = np.array(data.u)
    u[3] = np.nan
    with pytest.raises(InputError, match="missing input"):
        identify(data.replace(u=u), missing=True, offset=False)


@pytest.mark.parametrize("initial", ["zero", "estimate"])
def test_state_space_with_gaps_is_armax_with_gaps(initial, rng) -> None:
    """One output: the same model, its gaps bridged by another recursion; to 1e-8 of the loss and the response."""
    u = rng.normal(size=400)
    y = 2 + lfilter([0, 0.5, 0.3], [1, -1.2, 0.6], u)
    y = y + lfilter([1, 0.4, 0.1], [1, -1.2, 0.6], 0.5 * rng.normal(size=400))
    y[rng.random(400) < 0.15] = np.nan
    how = {"missing": True, "offset": True, "initial": initial}
    ss, armax_fit = (
        identify(Record(u, y), "ss", [2], **how),
        identify(Record(u, y), "armax", (2, 2, 2), **how),
    )
    omega = np.linspace(0.1, 3, 7)
    assert ss.loss == pytest.approx(armax_fit.loss, rel=1e-8)
    assert np.allclose(ss.model.response(omega)[0], armax_fit.model.response(omega)[0], rtol=1e-5)
    with pytest.raises(InputError, match="take the robust loss off"):
        identify(Record(u, y), "ss", [2], missing=True, robust="huber", offset=False)


def test_constraints_of_the_user_hold(rng) -> None:
    """A static gain of at most 0.48, by IPOPT; SciPy's least squares on lfilter, b2 taken from the gain that binds, ends
    at the same place. The covariance has nothing across the constraint, and one that does not bind changes nothing."""
    data = record(rng, 400)
    free = identify(data, offset=False)
    u, y = data.u[:, 0], data.y[:, 0]
    gain = lambda b1, b2, f1, f2: (b1 + b2) / (1 + f1 + f2)
    most = 0.95 * gain(*free.theta)
    fit = identify(
        data, constraints=lambda p: p["b1"] + p["b2"] - most * (1 + p["f1"] + p["f2"]), offset=False
    )
    bound = lambda x: np.r_[x[0], most * (1 + x[1] + x[2]) - x[0], x[1:]]
    theirs = least_squares(
        lambda x: y - lfilter(np.r_[0, bound(x)[:2]], np.r_[1, x[1:]], u), free.theta[[0, 2, 3]],
        method="lm", ftol=1e-15, xtol=1e-15, gtol=1e-15,
    )  # fmt: skip
    assert gain(*fit.theta) == pytest.approx(most, rel=1e-7)
    assert fit.loss == pytest.approx(2 * theirs.cost / 400, rel=1e-6)
    assert fit.theta == pytest.approx(bound(theirs.x), abs=1e-2 * free.standard_errors.min())
    normal = np.array([1.0, 1.0, -most, -most])
    assert abs(normal @ fit.covariance @ normal) < 1e-9 * (normal @ free.covariance @ normal)
    assert any("active constraints: 1" in note for note in fit.notes)
    loose = identify(data, constraints=lambda p: [p["b1"] - 5, -5 - p["b1"]], offset=False)
    assert loose.theta.tolist() == free.theta.tolist()


@pytest.mark.parametrize(
    "constraints, words",
    [
        (lambda p: p["q"], "no parameter 'q'"),
        (lambda p: "b1 > 0", "CasADi expressions"),
        (lambda p: [p["b1"] - 1, 2 - p["b1"]], "no parameters that obey"),
    ],
)
def test_constraints_that_cannot_be_used_are_told(constraints, words, rng) -> None:
    with pytest.raises(InputError, match=words):
        identify(record(rng, 200), constraints=constraints, offset=False)
