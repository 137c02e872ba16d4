"""Regularised impulse responses against the dense formulas of Gaussian-process regression."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.choice import held_out_error
from estimators.pem.regularised.impulse_priors import SlowNoise, kernel_factor
from estimators.residual.tests import residual_tests
from oed.data import Record
from oed.errors import InputError
from oed.models.model import fir, model_from_json

TAPS = 12


def kernel(name: str, taps: int, a: float, rho: float) -> np.ndarray:
    k = np.arange(1, taps + 1)
    both, last = np.add.outer(k, k), np.maximum.outer(k, k)
    return {
        "tc": a**last,
        "dc": a ** (both / 2) * rho ** np.abs(np.subtract.outer(k, k)),
        "ss": a ** (both + last) / 2 - a ** (3 * last) / 6,
    }[name]


def slow(phi: float, q: float, size: int) -> np.ndarray:
    t = np.arange(size)
    if phi >= 1:
        return q * (np.minimum.outer(t, t) + 1)
    return q * phi ** np.abs(np.subtract.outer(t, t)) / (1 - phi**2)


def measured(seed: int, size: int = 60, before: float = 1.0) -> Record:
    """A record cut from a longer one, whose input was `before` times as large until then."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=size + 50)
    u[:50] *= before
    d = lfilter([1.0], [1.0, -0.95], 0.2 * rng.normal(size=size + 50))
    y = 3 + lfilter([0, 0.5, 0.3], [1, -0.7], u) + d + 0.2 * rng.normal(size=size + 50)
    return Record(u[50:], y[50:])


def dense(fit, record: Record, level: bool, taps: int = TAPS) -> tuple:
    """Minus twice the restricted log-likelihood without its constant; taps, their covariance, level, its error."""
    how, size = fit.regularisation, len(record)
    u, sy = record.u[:, 0] - fit.input_level[0], 1.0
    X = np.column_stack([np.r_[np.zeros(k), u[: size - k]] for k in range(1, taps + 1)])
    K = how.scale[0, 0] * kernel(how.kernel, taps, how.decay[0, 0], how.correlation[0, 0])
    T = np.zeros((size, size))
    T[:taps, :taps] = K * how.transient[0] * how.input_scale[0] ** 2
    V = how.noise[0] * (np.eye(size) + slow(how.phi[0], how.q[0], size)) + T
    y, ones = record.y[:, 0] / sy, np.ones((size, 1))
    Z = np.linalg.inv(X @ K @ X.T + V)
    if level:
        information = ones.T @ Z @ ones
        at = float((ones.T @ Z @ y / information).item())
        P = Z - Z @ ones @ ones.T @ Z / information
    else:
        at, P, information = 0.0, Z, np.eye(1)
    value = y @ P @ y - np.linalg.slogdet(Z)[1] + np.linalg.slogdet(information)[1]
    return value, K @ X.T @ P @ y, K - K @ X.T @ P @ X @ K, at, float(1 / np.sqrt(information[0, 0]))


def left_of(fit, record: Record, taps: np.ndarray) -> np.ndarray:
    """What the posterior's mean leaves of a response, were the record its answer without noise."""
    size = len(record)
    u = record.u[:, 0] - fit.input_level[0]
    X = np.column_stack([np.r_[np.zeros(k), u[: size - k]] for k in range(1, TAPS + 1)])
    return taps - dense(fit, record.replace(y=(X @ taps)[:, None]), True)[1]


@pytest.mark.parametrize(
    ("name", "disturbance"), [("tc", "ar1"), ("dc", "walk"), ("ss", None), ("tc", None), ("ss", "walk")]
)
def test_posterior_is_the_dense_one(name, disturbance) -> None:
    """At the hyperparameters found: taps, covariance, level; and no other hyperparameters nearby are likelier."""
    record = measured(5)
    fit = identify(
        record, "fir", (TAPS,), regularisation=name, disturbance=disturbance, offset=True, initial="estimate"
    )
    value, taps, covariance, level, error = dense(fit, record, True)
    assert fit.theta[:TAPS] == pytest.approx(taps, abs=1e-7 * np.abs(taps).max())
    posterior = fit.regularisation.posterior[:TAPS, :TAPS]
    assert posterior == pytest.approx(covariance, abs=1e-7 * np.abs(covariance).max())
    # Beside it: the square of what the prior takes from the response, told of the response with as much put back; and what as many
    # combinations of the taps as there are hyperparameters gain.
    left = left_of(fit, record, taps)
    left = left + left_of(fit, record, left)
    beside = fit.covariance[:TAPS, :TAPS] - posterior - np.outer(left, left)
    gained = np.linalg.eigvalsh(beside)
    assert gained[0] > -1e-7 * covariance.max()
    assert gained[-1] > 1e-4 * covariance.max()
    assert np.all(np.abs(gained[: TAPS - len(fit.regularisation.errors[0])]) < 1e-7 * covariance.max())
    assert fit.output_level[0] == pytest.approx(level, rel=1e-7)
    assert fit.output_level_errors[0] == pytest.approx(error, rel=1e-6)
    size = len(record) - 1
    # the variance of e is concentrated: y' P y is N there, and the outputs are scaled to unit deviation
    concentrated = value - size * (1 + 2 * np.log(record.y.std()))
    assert fit.regularisation.log_likelihood == pytest.approx(-concentrated / 2, abs=1e-6)


def test_hyperparameters_are_the_likeliest_of_the_dense_formula() -> None:
    """A search on the dense restricted likelihood from another start ends at the same hyperparameters."""
    from dataclasses import replace

    record = measured(6, before=5.0)
    fit = identify(
        record, "fir", (TAPS,), regularisation="tc", disturbance="ar1", offset=True, initial="estimate"
    )
    how = fit.regularisation
    names = ("scale", "decay", "transient", "phi", "q", "noise")
    share = lambda x: 1 / (1 + np.exp(-x))

    def value(x: np.ndarray) -> float:
        new = [np.exp(x[0] + x[5]), share(x[1]), np.exp(x[2]), share(x[3]), np.exp(x[4]), np.exp(x[5])]
        changed = {k: np.full_like(getattr(how, k), v) for k, v in zip(names, new, strict=True)}
        return dense(replace(fit, regularisation=replace(how, **changed)), record, True)[0]

    found = minimize(value, [2.0, 1.0, 0.0, 2.0, -1.0, -3.0], method="BFGS", options={"gtol": 1e-4})
    logit = lambda p: np.log(p / (1 - p))
    ours = np.array(
        [
            np.log(how.scale[0, 0] / how.noise[0]), logit(how.decay[0, 0]), np.log(how.transient[0]),
            logit(how.phi[0]), np.log(how.q[0]), np.log(how.noise[0]),
        ]
    )  # fmt: skip
    assert value(ours) <= found.fun + 1e-4
    assert ours == pytest.approx(found.x, abs=0.05)
    steps = 0.05 * np.eye(6)
    curvature = [
        [value(ours + a + b) - value(ours + a - b) - value(ours - a + b) + value(ours - a - b) for b in steps]
        for a in steps
    ]
    # half of minus twice the log-likelihood; the concentrated variance's curvature is in the inverse
    errors = np.sqrt(np.diag(np.linalg.inv(np.array(curvature) / (8 * 0.05**2))))
    assert list(how.errors[0].values()) == pytest.approx(errors[[0, 1, 2, 4, 3]], rel=0.02)


def test_record_is_continued_as_the_dense_formula_foretells() -> None:
    record, fresh, window = measured(7), measured(8), 10
    fit = identify(
        record, "fir", (TAPS,), regularisation="dc", disturbance="ar1", offset="mean", initial="estimate"
    )
    how, size = fit.regularisation, len(fresh)
    bare = fit.simulate(fresh.u)[:, 0]
    K = how.scale[0, 0] * kernel("dc", TAPS, how.decay[0, 0], how.correlation[0, 0])
    Z = how.noise[0] * slow(how.phi[0], how.q[0], size)
    Z[:TAPS, :TAPS] += K * how.transient[0] * how.input_scale[0] ** 2
    seen = Z[:window, :window] + how.noise[0] * np.eye(window)
    expected = bare + Z[:, :window] @ np.linalg.solve(seen, (fresh.y[:, 0] - bare)[:window])
    assert fit.simulate_record(fresh, window=window)[window:, 0] == pytest.approx(expected[window:], abs=1e-9)


def test_innovations_are_those_of_the_dense_covariance() -> None:
    """e = what the past does not foretell; its sensitivities are differences of it."""
    record = measured(9)
    fit = identify(
        record, "fir", (TAPS,), regularisation="tc", disturbance="ar1", offset=True, initial="zero"
    )
    how = fit.regularisation
    V = np.eye(len(record)) + slow(how.phi[0], how.q[0], len(record))
    L = np.linalg.cholesky(V)
    rest = (record.y - fit.simulate(record.u))[:, 0]
    e, J = fit.linearised(record)
    assert e[:, 0] == pytest.approx(np.linalg.solve(L / np.diag(L), rest), abs=1e-9)
    X = np.column_stack([np.r_[np.zeros(k), record.u[:-k, 0] - fit.input_level] for k in range(1, TAPS + 1)])
    columns = np.linalg.solve(L / np.diag(L), np.column_stack([X, np.ones(len(X))]))
    assert J[:, 0, [*range(TAPS), -1]] == pytest.approx(-columns, abs=1e-9)
    for k, at in ((0, TAPS), (1, TAPS + 1)):
        c, d = fit.theta[TAPS:]
        move = np.zeros(2)
        move[k] = 1e-5
        e_of = lambda s: lfilter([1, d + s[1]], [1, c + s[0]], rest)  # noqa: B023
        slope = (e_of(move) - e_of(-move)) / 2e-5
        assert J[30:, 0, at] == pytest.approx(slope[30:], abs=2e-3 * np.abs(slope).max())


def test_several_channels_and_records_are_the_dense_posterior() -> None:
    """Two inputs, two outputs, two records, a delay of 2 on one entry; each output by itself."""
    rng = np.random.default_rng(11)
    records = []
    for size in (60, 70):
        u = rng.normal(size=(size, 2))
        y = np.column_stack([lfilter([0, 0.5], [1, -0.6], u[:, 0]), lfilter([0, 0, 0.8], [1, -0.4], u[:, 1])])
        records.append(Record(u, y + 0.1 * rng.normal(size=y.shape)))
    fit = identify(records, "fir", [[[8, 8], [8, 6]]], [[1, 1], [1, 2]], regularisation="tc", offset=False)
    how = fit.regularisation
    for i, nk in enumerate(((1, 1), (1, 2))):
        taps = (8, 8 if i == 0 else 6)
        X = np.vstack(
            [
                np.column_stack(
                    [
                        np.r_[np.zeros(k), r.u[: len(r) - k, j]]
                        for j in (0, 1)
                        for k in range(nk[j], nk[j] + taps[j])
                    ]
                )
                for r in records
            ]
        )
        K = np.zeros((sum(taps), sum(taps)))
        for j, part in ((0, slice(0, taps[0])), (1, slice(taps[0], None))):
            K[part, part] = how.scale[i, j] * kernel("tc", taps[j], how.decay[i, j], 0)
        y = np.concatenate([r.y[:, i] for r in records])
        expected = K @ X.T @ np.linalg.solve(X @ K @ X.T + how.noise[i] * np.eye(len(y)), y)
        places = fit.model.structure.places()[i]["b"]
        found = np.concatenate([fit.theta[p] for p in places])
        assert found == pytest.approx(expected, abs=1e-8)
    assert fit.covariance.shape == (30, 30)
    assert np.linalg.eigvalsh(fit.covariance)[0] > -1e-15


def test_units_do_not_matter() -> None:
    record = measured(12)
    how = {"regularisation": "tc", "disturbance": "walk", "offset": True, "initial": "estimate"}
    fit = identify(record, "fir", (TAPS,), **how)
    other = identify(Record(1e-6 * record.u, 1e3 * record.y), "fir", (TAPS,), **how)
    assert other.theta[:TAPS] == pytest.approx(1e9 * fit.theta[:TAPS], rel=1e-3, abs=1e5)
    assert other.standard_errors[:TAPS] == pytest.approx(1e9 * fit.standard_errors[:TAPS], rel=1e-3)


def test_more_taps_than_samples_and_no_input_that_excites_them() -> None:
    """Plain least squares refuses; the kernel decides what the data do not."""
    record = measured(13, 40)
    with pytest.raises(InputError):
        identify(record, "fir", (60,), offset=False)
    fit = identify(record, "fir", (60,), regularisation="tc", offset="mean", initial="zero")
    truth = lfilter([0.5, 0.3], [1, -0.7], np.eye(60)[0])
    assert np.linalg.norm(fit.theta - truth) < 0.5 * np.linalg.norm(truth)
    assert np.all(fit.standard_errors > 0)


def test_saved_and_read_back() -> None:
    fit = identify(
        measured(14), "fir", (TAPS,), regularisation="ss", disturbance="walk", offset=True, initial="zero"
    )
    model = model_from_json(fit.model.to_json())
    assert np.array_equal(model.theta, fit.theta)
    assert fit.names[-2:] == ("c1", "d1")
    payload = json.loads(json.dumps(fit.to_dict()))
    assert payload["regularisation"]["kernel"] == "ss"
    assert payload["parameters"]["d1"] == [-1.0, 0.0]
    assert "kernel ss" in repr(fit)


def test_residual_tests_of_a_good_and_of_a_poor_prior() -> None:
    """The whiteness and input tests pass on what the model describes, and see a disturbance that it has no term for."""
    record = measured(15, 400)
    how = {"regularisation": "tc", "offset": True, "initial": "estimate"}
    good = residual_tests(identify(record, "fir", (30,), disturbance="ar1", **how), record)
    poor = residual_tests(identify(record, "fir", (30,), **how), record)
    assert min(good["whiteness"].p_value, good["input"].p_value) > 0.01
    assert poor["whiteness"].p_value < 1e-6


def test_what_does_not_go_with_a_kernel_is_refused() -> None:
    record = measured(16)
    for call, words in (
        ({"structure": "oe", "orders": (2, 2), "regularisation": "tc"}, "take fir"),
        ({"regularisation": "rbf"}, "choose tc, dc or ss"),
        ({"disturbance": "walk"}, "goes with a regularisation"),
        ({"regularisation": "tc", "disturbance": "sine"}, "choose ar1, walk"),
        ({"regularisation": "tc", "robust": "huber"}, "does not go with robust"),
        ({"regularisation": "tc", "initial": "backcast"}, "backcast"),
    ):
        with pytest.raises(InputError, match=words):
            identify(record, **({"structure": "fir", "orders": (TAPS,)} | call))


def test_held_out_error_prefers_what_simulates_better() -> None:
    record = measured(17, 400)
    error, spread = held_out_error(record, "oe", (2, 1), offset=True, initial="estimate", window=20)
    poor, _ = held_out_error(record, "fir", (1,), offset=True, initial="estimate", window=20)
    assert 0.3 < error < 0.75 * poor
    assert 0 < spread < 0.5 * error
    with pytest.raises(InputError, match="folds"):
        held_out_error(record, "oe", (2, 1), folds=1, offset=False)


def test_factor_of_a_long_kernel_is_finite() -> None:
    """a^n underflows where the kernel has no inverse."""
    for name in ("tc", "dc", "ss"):
        M = kernel_factor(name, 2000, 0.5, 0.9)
        assert np.isfinite(M).all()
    assert SlowNoise(1.0, 0.5).weighed(np.ones((1, 1)))[0] == pytest.approx(1 / 1.5)
    assert fir(3).n == 3
