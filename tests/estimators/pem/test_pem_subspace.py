"""Subspace identification: exact without noise, a plain twin, standard errors, clear errors."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.campaign.plants import hair_dryer_record
from estimators.pem import identify
from estimators.pem.choice import held_out_error, select_orders
from estimators.pem.subspace import errors, hankel, observability, subspace_fit
from estimators.pem.subspace.errors import range_sensitivity
from estimators.pem.subspace.hankel import autoregressive_order, factored, windows
from estimators.pem.subspace.observability import range_of
from estimators.pem.subspace.subspace_fit import TRIED
from estimators.pem.uncertainty import profile_interval, sandwich
from estimators.residual.tests import residual_tests
from oed.data import Record
from oed.errors import InputError
from oed.models.model import StateSpace, model_from_json
from tests.oracles.subspace import po_moesp

METHODS = ("moesp", "n4sid", "cva")
OMEGA = np.linspace(0, np.pi, 9)
B, F = [0.0, 1.0, 0.5], np.poly([0.8 * np.exp(0.6j), 0.8 * np.exp(-0.6j)]).real
TRUTH = np.array([-F[2], -F[1], 1.0, 0.5 - F[1]])
"""A21, A22, B11, B21 of (B, F): the state holds the next two outputs, whose first two answers are 1 and 0.5 - f1."""


def filtered(b, f, x) -> np.ndarray:
    return np.asarray(lfilter(b, f, x, axis=0))


def subspace(*given, **how):
    """A fit, and how it came about."""
    fit = identify(*given, **{"offset": False, "initial": "zero"} | how)
    assert fit.subspace is not None
    return fit, fit.subspace


def siso(rng, length=1000, noise=0.5, transient=200) -> Record:
    u = rng.normal(size=length + transient)
    y = filtered(B, F, u) + noise * rng.normal(size=length + transient)
    return Record(u[transient:], y[transient:])


def mimo(rng, lengths=(300, 500)):
    """Three states, two inputs, two outputs, free of noise, each record from a state of its own."""
    A = np.array([[0.7, 0.3, 0], [-0.3, 0.7, 0], [0.1, 0.2, 0.5]])
    B2, C, D = rng.normal(size=(3, 2)), rng.normal(size=(2, 3)), 0.3 * rng.normal(size=(2, 2))
    records = []
    for length in lengths:
        u, x, y = rng.normal(size=(length, 2)), rng.normal(size=3), np.zeros((length, 2))
        for t in range(length):
            y[t] = C @ x + D @ u[t]
            x = A @ x + B2 @ u[t]
        records.append(Record(u, y))
    answer = [C @ np.linalg.solve(np.exp(1j * w) * np.eye(3) - A, B2) + D for w in OMEGA]
    return records, np.array(answer)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("offset", [False, True])
def test_exact_without_noise(rng, method, offset) -> None:
    """Two records from different states; with levels and other units too, if levels are asked for."""
    records, answer = mimo(rng)
    if offset:
        records = [r.replace(u=1e-3 * (r.u + 5), y=1e4 * (r.y - 7)) for r in records]
    fit = identify(records, "ss", (3,), 0, initial="estimate", method=method, offset=offset)
    found = fit.model.structure.response(fit.theta, OMEGA)[0] * (1e-7 if offset else 1)
    assert np.allclose(found, answer, atol=1e-9)
    if not offset:
        return
    assert np.all(fit.output_level_errors < 1e-6 * np.abs(fit.output_level))
    static = np.real(answer[0]) @ (1e3 * fit.input_level - 5)  # the inputs' means are their levels
    assert np.allclose(fit.output_level, 1e4 * (static - 7), rtol=1e-8)


@pytest.mark.parametrize("delay", [0, 1])
def test_plain_twin(rng, delay) -> None:
    record = siso(rng)
    fit = identify(record, "ss", (2,), delay, initial="estimate", method="moesp", horizon=11, offset=False)
    *matrices, simulated = po_moesp(record.u[:, 0], record.y[:, 0], 11, 2, delay == 0)
    twin = fit.model.structure.theta_of(*matrices, np.zeros((2, 1)))
    assert np.allclose(fit.theta, twin, rtol=1e-8, atol=1e-10)
    assert np.allclose(record.y[:, 0] - fit.residuals[0][:, 0], simulated, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_near_the_optimum(rng, method) -> None:
    """In white noise the estimate is within the errors of the output-error optimum, and nearly as precise."""
    record = siso(rng)
    fit = identify(record, "ss", (2,), initial="estimate", method=method, offset=False)
    best = identify(record, StateSpace((2,), noise=False), initial="estimate", offset=False)
    assert np.all(np.abs(fit.theta - best.theta) < 2 * best.standard_errors)
    assert fit.standard_errors == pytest.approx(best.standard_errors, rel=0.3)
    assert best.loss <= fit.loss < 1.01 * best.loss
    assert 0 < fit.decrement < 0.02  # what the optimum would still take off the loss


def test_means_as_levels(rng) -> None:
    record = siso(rng)
    moved = record.replace(u=record.u + 3, y=record.y - 5)
    fit, plain = (
        identify(r, "ss", (2,), initial="estimate", method="moesp", horizon=9, offset="mean")
        for r in (moved, record)
    )
    assert np.allclose(fit.theta, plain.theta)
    assert fit.output_level == pytest.approx(moved.y.mean(axis=0))
    assert not fit.output_level_errors.any()


def test_default_horizon(rng) -> None:
    """The horizon is that of the least simulation error among those tried; given, it leads to the same numbers."""
    record = siso(rng, 400)
    fit, how = subspace(record, "ss", (2,), initial="estimate", method="moesp")
    assert how.horizon == min(how.tried, key=lambda i: how.tried[i])
    scaled = record.u / np.sqrt(np.mean(record.u**2)), record.y / np.sqrt(np.mean(record.y**2))
    back = autoregressive_order([scaled], 26, False)
    assert min(how.tried) == 2 * back
    assert max(how.tried) <= 6 * back
    again, found = subspace(record, "ss", (2,), initial="estimate", method="moesp", horizon=how.horizon)
    assert np.array_equal(again.theta, fit.theta)
    assert np.array_equal(again.covariance, fit.covariance)
    assert list(found.tried) == [how.horizon]


@pytest.mark.parametrize(("order", "samples", "method"), [(4, 500, "n4sid"), (5, 800, "moesp")])
def test_unstable_horizons_are_passed_over(order, samples, method) -> None:
    """Too many states for the hair dryer: most horizons give an unstable model, the best one once it has all samples."""
    fit, how = subspace(
        hair_dryer_record()[:samples], "ss", (order,), offset=True, initial="estimate", method=method
    )
    assert fit.model.stable
    assert len(how.tried) < TRIED
    assert how.tried[how.horizon] > min(how.tried.values())


def test_all_horizons_are_tried_where_the_first_few_give_no_model(rng, monkeypatch) -> None:
    record, seen, real = siso(rng), [], subspace_fit._foretold

    def foretold(form, problem, found):
        seen.append(found.factor.horizon)
        if len(seen) <= TRIED:
            raise InputError("unstable")
        return real(form, problem, found)

    monkeypatch.setattr(subspace_fit, "_foretold", foretold)
    how = subspace(record, "ss", (2,), initial="estimate", method="moesp")[1]
    assert len(how.tried) > 2 * TRIED
    assert {min(how.tried), max(how.tried)} == {seen[0], seen[TRIED - 1]}


def test_noise_is_folded_over_the_horizon_as_sample_by_sample(rng) -> None:
    """What noise adds to A, by correlations and Fourier transforms, is the plain sum over samples and lags."""
    u, y = rng.normal(size=(60, 2)), rng.normal(size=(60, 2))
    found = observability.range_of(factored([(u, y)], 4, False), 2, "moesp")
    lever = rng.normal(size=(3, 8, 2))
    L11, L21, *_ = found.factor.blocks()
    known, past = np.linalg.solve(L11.T, L21.T @ found.instruments), found.instruments
    expected = np.zeros((60, 2, 3))
    for t in range(60 - 7):
        x = np.r_[u[t : t + 4].ravel(), y[t : t + 4].ravel()] @ past - u[t + 4 : t + 8].ravel() @ known
        for k in range(4):
            expected[t + 4 + k] += np.einsum("ajs,s->ja", lever.reshape(3, 4, 2, 2)[:, k], x)
    np.testing.assert_allclose(errors._moves(found, u, y, lever), expected, atol=1e-12)


def test_standard_errors(rng) -> None:
    """200 records of 1000 samples: the spread of the estimates is what each says of itself (`make validate` looks at
    the coverage in 2000)."""
    found = [
        identify(siso(rng), "ss", (2,), initial="estimate", method="moesp", horizon=8, offset=False)
        for _ in range(200)
    ]
    away = np.array([f.theta - TRUTH for f in found])
    said = np.mean([f.standard_errors for f in found], axis=0)
    assert np.std(away, axis=0) == pytest.approx(said, rel=0.15)
    assert np.all(np.abs(away.mean(axis=0)) < 0.3 * said)


@pytest.mark.parametrize("offset", [False, True])
def test_residual_tests_know_the_method(rng, offset) -> None:
    """100 records with nothing missing: as many false alarms at 5 and 20 % as there should be. An estimate that is taken
    for the minimum that it is not gives 60 % at 5 %. A pole too few is seen."""
    p_values = []
    for _ in range(100):
        record = siso(rng, 600)
        fit = identify(record, "ss", (2,), initial="estimate", method="moesp", horizon=8, offset=offset)
        p_values.append(residual_tests(fit, record)["input"].p_value)
    assert np.mean(np.array(p_values) < 0.05) <= 0.12
    assert 0.08 <= np.mean(np.array(p_values) < 0.2) <= 0.32
    small = identify(record, "ss", (1,), initial="estimate", method="moesp", horizon=8, offset=False)
    assert residual_tests(small, record)["input"].p_value < 1e-10
    with pytest.raises(InputError, match="records of .500. samples, and .600. were fitted"):
        residual_tests(fit, record[:500])


def test_standard_errors_of_several_outputs(rng) -> None:
    """Outputs of different size, in correlated noise, two records each."""

    def one():
        records = []
        for _ in range(2):
            u = rng.normal(size=(400, 2))
            e = 0.3 * rng.normal(size=(400, 2)) @ np.array([[1.0, 0.8], [0.0, 20.0]])
            first = filtered([0, 1.0], [1, -0.7], u[:, 0])
            second = filtered([0, 30.0], [1, 0.5], u[:, 1])
            records.append(Record(u, np.column_stack([first + second / 30, second]) + e))
        return identify(records, "ss", (2,), method="cva", horizon=6, offset=False)

    found = [one() for _ in range(120)]
    spread = np.std([f.theta for f in found], axis=0)
    assert spread == pytest.approx(np.mean([f.standard_errors for f in found], axis=0), rel=0.2)


def test_sensitivity_of_the_range(rng) -> None:
    """Against the range that a small change of the future outputs gives: cva, two outputs."""
    records, _ = mimo(rng)
    form = StateSpace((2, 1), 2, noise=False)
    found = range_of(factored([(r.u, r.y) for r in records], 5, False), 3, "cva")
    theta = lambda basis: np.concatenate(
        [form.theta_of(A, np.zeros((3, 2)), basis[:2], np.zeros((2, 2)), np.zeros((3, 2)))[:6]
         for A in [np.linalg.lstsq(basis[:-2], basis[2:], rcond=None)[0]]]
    )  # fmt: skip
    across = np.eye(10) - (own := found.weight @ found.basis) @ own.T
    lever = range_sensitivity(found, form)
    for _ in range(3):
        noise, state = rng.normal(size=10), rng.normal(size=3)
        shift = 1e-6 * np.outer(found.unweight @ across @ found.weight @ noise, state)
        slope = (theta(found.basis + shift) - theta(found.basis - shift)) / 2e-6
        assert np.einsum("arj,r,j->a", lever, noise, state) == pytest.approx(slope, rel=1e-5, abs=1e-7)


def test_factor_in_chunks_and_of_fewer_rows(rng, monkeypatch) -> None:
    u, y = rng.normal(size=(90, 2)), rng.normal(size=(90, 1))
    rows = [windows(s, 4, first, 83) for s, first in ((u, 4), (u, 0), (y, 0), (y, 4))]
    whole = np.column_stack(rows)
    centred = whole - whole.mean(axis=0)
    monkeypatch.setattr(hankel, "CHUNK", 7)
    direct = np.column_stack([windows(s, 3, first, 83) for s, first in ((u, 4), (u, 1), (y, 1), (y, 4))])
    for apart in (hankel.APART, np.inf):  # of the products of the rows, and of the rows
        monkeypatch.setattr(hankel, "APART", apart)
        for matrix, about_means in ((whole, False), (centred, True)):
            found = factored([(u, y)], 4, about_means)
            assert (found.gram is None) == (apart == np.inf)
            assert np.allclose(found.R.T @ found.R, matrix.T @ matrix)
        short = factored([(u, y)], 4, False).shorter(3)
        assert np.allclose(short.R.T @ short.R, direct.T @ direct)


def test_products_of_several_records_and_where_they_have_no_digits(rng) -> None:
    """The factor by products is that of the rows; a record without noise is factored by its rows."""
    signals = [(rng.normal(size=(n, 1)) + 2, rng.normal(size=(n, 2))) for n in (200, 90, 9)]
    rows = [
        np.column_stack([windows(s, 5, first, len(u) - 9) for s, first in ((u, 5), (u, 0), (y, 0), (y, 5))])
        for u, y in signals[:2]
    ]
    matrix = np.concatenate(rows) - np.concatenate(rows).mean(axis=0)
    found = factored(signals, 5, True)
    assert found.gram is not None
    assert np.allclose(np.abs(np.linalg.qr(matrix, mode="r")), np.abs(found.R), rtol=1e-9, atol=1e-9)
    u = rng.normal(size=(300, 1))
    assert factored([(u, lfilter([0, 1.0], [1, -0.5], u, axis=0))], 5, False).gram is None


def test_autoregressive_order(rng) -> None:
    """Against the criterion with each order's own least squares, at the same samples."""
    u = rng.normal(size=(600, 1))
    y = filtered(B, F, u) + filtered([1.0], [1, -1.1, 0.5, -0.2, 0.1], rng.normal(size=(600, 1)))
    values = []
    for order in range(1, 13):
        past = [x[12 - k : -k] for k in range(1, order + 1) for x in (u, y)]
        regressor = np.column_stack([np.ones(588), u[12:], *past])
        e = y[12:] - regressor @ np.linalg.lstsq(regressor, y[12:], rcond=None)[0]
        values.append(588 * np.log(np.sum(e**2)) + 4 * order)
    assert autoregressive_order([(u, y)], 12, True) == 1 + int(np.argmin(values))


def test_goes_with_the_rest(rng) -> None:
    """Saved and read back, printed, put into JSON, judged on what was left out, orders compared."""
    record = siso(rng, 600)
    fit = identify(record, "ss", (2,), initial="estimate", method="cva", horizon=8, offset=False)
    assert np.array_equal(model_from_json(fit.model.to_json()).theta, fit.theta)
    plain = json.loads(json.dumps(fit.to_dict()))
    assert plain["subspace"]["method"] == "cva"
    assert plain["subspace"]["horizon"] == 8
    assert len(plain["subspace"]["singular_values"]) == 8
    assert "by cva with 8 block rows; singular values" in repr(fit)
    how = {"method": "moesp", "horizon": 8, "offset": False, "initial": "estimate"}
    error, spread = held_out_error(record, "ss", (2,), folds=3, window=10, **how)
    assert abs(error - 0.5) < 4 * spread
    assert select_orders(record, "ss", [(1,), (2,), (4,)], **how).orders == (2,)


def test_a_minimum_is_not_pretended(rng) -> None:
    record = siso(rng, 300)
    fit = identify(record, "ss", (2,), method="moesp", horizon=6, offset=False)
    for ask in (lambda: sandwich(fit, record), lambda: profile_interval(fit, record, "A21")):
        with pytest.raises(InputError, match="minimises no loss"):
            ask()


@pytest.mark.parametrize(
    "structure, options, message",
    [
        ("oe", {"method": "moesp"}, 'take the structure "ss" instead of oe'),
        ("ss", {"method": "best"}, "method is 'best'; choose pem, moesp, n4sid, cva"),
        ("ss", {"horizon": 10}, "a horizon of 10 is for a subspace method"),
        ("ss", {"method": "moesp", "horizon": 2}, "the horizon is 2 block rows; .* needs 3 or more"),
        ("ss", {"method": "moesp", "horizon": 60}, "allow 30 at most .*: choose one between"),
        ("ss", {"method": "moesp", "horizon": 7.5}, "the horizon is 7.5; give a whole number"),
        ("ss", {"method": "moesp", "robust": "huber"}, "robust cannot go with moesp"),
        ("ss", {"method": "cva", "fixed": {"A21": 0.1}}, "fixed cannot go with cva"),
    ],
)
def test_refusals(rng, structure, options, message) -> None:
    with pytest.raises(InputError, match=message):
        identify(siso(rng, 300), structure, (2,) if structure == "ss" else (2, 2), **options)


def test_too_short_too_many_states_unstable(rng) -> None:
    with pytest.raises(InputError, match="give longer records or lower the order"):
        identify(siso(rng, 30), "ss", (6,), method="moesp", offset=False)
    with pytest.raises(InputError, match="the data show 2 states, of 3 asked for"):
        identify(siso(rng, 300, noise=0.0, transient=0), "ss", (3,), method="moesp", horizon=10, offset=False)
    u = rng.normal(size=300)
    with pytest.raises(InputError, match="unstable .a pole of size 1.02.*; choose another horizon"):
        identify(
            Record(u, filtered([0, 1.0], [1, -1.02], u)), "ss", (1,), method="moesp", horizon=10, offset=False
        )
    record = siso(rng, 300)
    y = record.y.copy()
    y[50] = np.nan
    with pytest.raises(InputError, match="missing cannot go with moesp"):
        identify(record.replace(y=y), "ss", (2,), method="moesp", missing=True, offset=False)


@pytest.mark.parametrize("count", [4, 8])
@pytest.mark.parametrize("ratio", [1e-1, 1e-2, 1e-5])
def test_leading_singular_vectors_are_those_of_the_decomposition(ratio, count):
    """From the products of the rows where these have the digits (1e-2), else (1e-5) by the decomposition itself."""
    rng = np.random.default_rng(0)
    left, right = (np.linalg.qr(rng.normal(size=(size, 8)))[0] for size in (8, 20))
    along = (left * np.geomspace(1, ratio**2, 8)) @ right.T
    U, s, _ = np.linalg.svd(along, full_matrices=False)
    found = observability._decomposed(along, count)
    np.testing.assert_allclose(found[1][:4], s[:4], rtol=1e-10)
    np.testing.assert_allclose(np.abs(np.sum(found[0][:, :4] * U[:, :4], axis=0)), 1, rtol=1e-10)
    np.testing.assert_allclose(found[2][:4] * found[1][:4, None], found[0][:, :4].T @ along, atol=1e-12)
