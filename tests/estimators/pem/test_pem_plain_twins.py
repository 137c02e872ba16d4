"""estimators.pem against scipy.optimize.least_squares with lfilter: estimates, covariances, several experiments."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.pem import identify
from oed.data import Record
from tests.oracles import lti, pem

TRUTH = np.array([0.2155, 0.2012, -0.9854, 0.8187])


def records(rng, lengths, noise: float, *, amplitude: float = 1.0, level: float = 0.0):
    made = []
    for n in lengths:
        u = amplitude * rng.standard_normal(n)
        y = lti.difference_equation([0.0, *TRUTH[:2]], [1.0, *TRUTH[2:]], u) + noise * rng.standard_normal(n)
        made.append((u, y + level))
    return made


@pytest.mark.parametrize("lengths", [(400,), (250, 120, 300)])
@pytest.mark.parametrize("noise", [0.05, 0.5])
def test_output_error(lengths, noise, rng) -> None:
    """Both stop where the gradient is rounding: differences of 1e-5 give the oracle's Jacobian 1e-9 and its optimum about the same."""
    data = records(rng, lengths, noise)
    oracle = pem.output_error(data, TRUTH, 2, 1)
    fit = identify([Record(u, y) for u, y in data], "oe", (2, 2), 1, offset=False)
    assert fit.status.ok
    assert fit.names == ("b1", "b2", "f1", "f2")
    spread = np.sqrt(np.diag(oracle["covariance"]))
    assert np.abs((fit.theta - oracle["theta"]) / spread).max() < 1e-5
    assert fit.loss == pytest.approx(oracle["loss"], rel=1e-9)
    assert fit.noise_variance == pytest.approx(oracle["noise_variance"], rel=1e-9)
    assert np.abs((fit.covariance - oracle["covariance"]) / np.outer(spread, spread)).max() < 1e-5
    e = pem.residuals(fit.theta, data, 2, 1)
    assert np.concatenate([x[:, 0] for x in fit.residuals]) == pytest.approx(e, abs=1e-10)


def test_output_error_with_offset(rng) -> None:
    """With an offset the suite subtracts the input's mean and estimates the output's level; the oracle fits y = G (u - mean) + c."""
    (u, y), (v, z) = records(rng, (300, 200), 0.2, level=3.0)
    mean = np.concatenate([u, v]).mean()
    oracle = pem.output_error([(u - mean, y), (v - mean, z)], np.r_[TRUTH, 3.0], 2, 1, offset=True)
    fit = identify([Record(u, y), Record(v, z)], "oe", (2, 2), 1, offset=True, initial="zero")
    spread = np.sqrt(np.diag(oracle["covariance"]))
    assert np.abs((fit.theta - oracle["theta"][:4]) / spread[:4]).max() < 1e-5
    assert fit.output_level[0] == pytest.approx(oracle["theta"][4], abs=1e-5 * spread[4])
    assert fit.output_level_errors[0] == pytest.approx(spread[4], rel=1e-5)
    assert (
        np.abs((fit.covariance - oracle["covariance"][:4, :4]) / np.outer(spread[:4], spread[:4])).max()
        < 1e-5
    )


def test_peak_gain_with_its_error(rng) -> None:
    data = records(rng, (500,), 0.1)
    oracle = pem.output_error(data, TRUTH, 2, 1)
    value, error, frequency = identify(Record(*data[0]), "oe", (2, 2), 1, offset=False).hinf_norm

    def gamma(theta):
        return lti.peak_gain(([[[0.0, *theta[:2]]]], [[[1.0, *theta[2:]]]]))[0]

    c = np.array([(gamma(oracle["theta"] + h) - gamma(oracle["theta"] - h)) / 2e-5 for h in 1e-5 * np.eye(4)])
    assert value == pytest.approx(gamma(oracle["theta"]), rel=1e-7)
    assert error == pytest.approx(np.sqrt(c @ oracle["covariance"] @ c), rel=1e-4)
    assert frequency == pytest.approx(
        lti.peak_gain(([[[0.0, *oracle["theta"][:2]]]], [[[1.0, *oracle["theta"][2:]]]]))[1], abs=1e-5
    )


def test_fir_is_linear_least_squares(rng) -> None:
    (u, y), *_ = records(rng, (300,), 0.3)
    fit = identify(Record(u, y), "fir", 12, 0, offset=False)
    assert fit.theta == pytest.approx(pem.fir(u, y, 12), abs=1e-10)


def test_arx_is_linear_least_squares(rng) -> None:
    """At rest before the record: the oracle gets the zeros that precede it as data."""
    (u, y), *_ = records(rng, (300,), 0.3)
    padded_u, padded_y = np.r_[np.zeros(5), u], np.r_[np.zeros(5), y]
    oracle = pem.arx(padded_u, padded_y, 2, 2, 1, first=5)
    fit = identify(Record(u, y), "arx", (2, 2), 1, offset=False)
    named = dict(zip(fit.names, fit.theta, strict=True))
    assert [named[k] for k in ("a1", "a2", "b1", "b2")] == pytest.approx(oracle, abs=1e-9)


def test_several_channels_with_equal_noise_are_separate_fits(rng) -> None:
    """Two outputs of output-error models share nothing; the criterion is det of the residuals' moment, whose weight couples only
    through the correlation of the residuals, which is zero for orthogonal ones: made so here by adding the noise in different experiments.
    """
    u, v = rng.standard_normal((2, 300))
    first = lti.difference_equation([0.0, *TRUTH[:2]], [1.0, *TRUTH[2:]], u)
    second = lti.difference_equation([0.0, 0.4], [1.0, -0.6], u)
    other_first = lti.difference_equation([0.0, *TRUTH[:2]], [1.0, *TRUTH[2:]], v)
    other_second = lti.difference_equation([0.0, 0.4], [1.0, -0.6], v)
    y = np.column_stack([first + 0.3 * rng.standard_normal(300), second])
    z = np.column_stack([other_first, other_second + 0.2 * rng.standard_normal(300)])
    fit = identify([Record(u, y), Record(v, z)], "oe", ([[2], [1]], [[2], [1]]), 1, offset=False)
    top = pem.output_error([(u, y[:, 0]), (v, z[:, 0])], TRUTH, 2, 1)
    low = pem.output_error([(u, y[:, 1]), (v, z[:, 1])], np.array([0.4, -0.6]), 1, 1)
    oracle, spread = (
        np.r_[top["theta"], low["theta"]],
        np.sqrt(np.r_[np.diag(top["covariance"]), np.diag(low["covariance"])]),
    )
    # the fits' own residuals in the noise-free experiments are not exactly zero: a correlation of about 1 / N is left
    assert np.abs((fit.theta - oracle) / spread).max() < 0.05


def coloured(rng, n: int, num, den) -> np.ndarray:
    return lti.difference_equation(num, den, rng.standard_normal(n))


def compare(fit, oracle, names) -> None:
    """Estimates and covariances in the order of the oracle's names, in standard errors; the optimum is flat to its own rounding."""
    at = [fit.names.index(name) for name in names]
    n = len(at)
    spread = np.sqrt(np.diag(oracle["covariance"])[:n])
    assert np.abs((fit.theta[at] - oracle["theta"][:n]) / spread).max() < 2e-5
    difference = fit.covariance[np.ix_(at, at)] - oracle["covariance"][:n, :n]
    assert np.abs(difference / np.outer(spread, spread)).max() < 1e-4
    assert fit.loss == pytest.approx(oracle["loss"], rel=1e-8)


def test_box_jenkins(rng) -> None:
    data = []
    for n in (500, 300):
        u = rng.standard_normal(n)
        y = lti.difference_equation([0.0, *TRUTH[:2]], [1.0, *TRUTH[2:]], u)
        data.append((u, y + 0.4 * coloured(rng, n, [1.0, 0.5], [1.0, -0.7])))
    start = np.r_[TRUTH[:2], 0.5, -0.7, TRUTH[2:]]
    oracle = pem.least_squares(lambda x: pem.box_jenkins(x, data, 2, 1, 1, 2, 1), start)
    fit = identify([Record(u, y) for u, y in data], "bj", (2, 1, 1, 2), 1, offset=False)
    compare(fit, oracle, ("b1", "b2", "c1", "d1", "f1", "f2"))


def test_armax(rng) -> None:
    data = []
    for n in (500, 300):
        u = rng.standard_normal(n)
        y = lti.difference_equation([0.0, *TRUTH[:2]], [1.0, *TRUTH[2:]], u)
        data.append((u, y + coloured(rng, n, [0.3, 0.15], [1.0, *TRUTH[2:]])))
    start = np.r_[TRUTH[2:], TRUTH[:2], 0.5]
    oracle = pem.least_squares(lambda x: pem.armax(x, data, 2, 2, 1, 1), start)
    fit = identify([Record(u, y) for u, y in data], "armax", (2, 2, 1), 1, offset=False)
    compare(fit, oracle, ("a1", "a2", "b1", "b2", "c1"))


def test_estimated_initial_states(rng) -> None:
    """Records cut out of a longer run, so that they do not start at rest; control: at rest, the fit is another one."""
    u = rng.standard_normal(700)
    y = lti.difference_equation([0.0, *TRUTH[:2]], [1.0, *TRUTH[2:]], u) + 0.1 * rng.standard_normal(700)
    data = [(u[40:100], y[40:100]), (u[300:420], y[300:420])]
    oracle = pem.least_squares(
        lambda x: pem.free_response_errors(x, data, 2, 2, 1), np.r_[TRUTH, np.zeros(4)]
    )
    records_ = [Record(a, b) for a, b in data]
    compare(
        identify(records_, "oe", (2, 2), 1, initial="estimate", offset=False),
        oracle,
        ("b1", "b2", "f1", "f2"),
    )
    spread = np.sqrt(np.diag(oracle["covariance"])[:4])
    backcast = identify(records_, "oe", (2, 2), 1, initial="backcast", offset=False)
    assert np.abs((backcast.theta - oracle["theta"][:4]) / spread).max() < 1e-3
    at_rest = identify(records_, "oe", (2, 2), 1, initial="zero", offset=False)
    assert np.abs((at_rest.theta - oracle["theta"][:4]) / spread).max() > 0.1


def test_two_outputs_with_correlated_noise(rng) -> None:
    """The determinant criterion against weighted least squares iterated to its own weight: one shared input, noise of correlation .8."""
    n = 400
    u = rng.standard_normal(n)
    e = rng.standard_normal((n, 2)) @ np.array([[0.3, 0.32], [0.0, 0.24]])
    y = e + np.column_stack(
        [
            lti.difference_equation([0.0, *TRUTH[:2]], [1.0, *TRUTH[2:]], u),
            lti.difference_equation([0.0, 0.4], [1.0, -0.6], u),
        ]
    )

    def rows(x):
        return np.column_stack(
            [pem.residuals(x[:4], [(u, y[:, 0])], 2, 1), pem.residuals(x[4:], [(u, y[:, 1])], 1, 1)]
        )

    oracle = pem.several_outputs(rows, np.r_[TRUTH, 0.4, -0.6])
    fit = identify(Record(u, y), "oe", ([[2], [1]], [[2], [1]]), 1, offset=False)
    spread = np.sqrt(np.diag(np.linalg.inv(oracle["gram"])))
    assert np.abs((fit.theta - oracle["theta"]) / spread).max() < 1e-3  # the weight settles to 1e-5 of itself
    assert fit.loss == pytest.approx(np.linalg.det(oracle["moment"]), rel=1e-7)
    ratio = np.sqrt(np.diag(fit.covariance)) / spread
    assert ratio == pytest.approx(np.full(6, ratio[0]), rel=1e-3)
    assert ratio[0] == pytest.approx(1.0, abs=6 / n)  # the degrees of freedom that the suite allows for
