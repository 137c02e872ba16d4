"""Prediction-error estimates against an independent implementation, and their claimed uncertainty."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.campaign.plants import hair_dryer_record
from estimators.pem import identify
from estimators.pem.predictors import filter_kernels, state_kernels
from estimators.pem.predictors.compiled import polynomial_kernel, state_space_kernel
from estimators.pem.predictors.kernel import kernel_of
from estimators.residual.measures import fit_percent
from oed.data import Record
from oed.errors import InputError, NotIdentifiable, Status
from oed.files import to_control, to_pandas, to_xarray
from oed.models.model import StateSpace, armax, arx, bj, fir, model_from_json, oe, polynomial
from tests.oracles import pem as oracle
from tests.oracles import predictors

B, A = [0.0, 0.2155, 0.2012], [1.0, -0.9854, 0.8187]
THETA = np.array([0.2155, 0.2012, -0.9854, 0.8187])


def records(rng, count=1, length=1000, deviation=1.0, offset=0.0):
    made = []
    for _ in range(count):
        u = rng.normal(size=length)
        made.append(Record(u, lfilter(B, A, u) + offset + deviation * rng.normal(size=length)))
    return made


def power_records(rng, count, length, deviation):
    """Inputs of the power iterations: the reversed output, normalised; ever more narrow-band."""
    u, made = rng.normal(size=length), []
    for _ in range(count):
        u = u / np.sqrt(np.mean(u**2))
        y = lfilter(B, A, u) + deviation * rng.normal(size=length)
        made.append(Record(u, y))
        u = y[::-1]
    return made


@pytest.mark.parametrize("structure", [oe(2, 2), arx(2, 2), armax(2, 2, 2), bj(2, 2, 1, 2), fir(4)])
@pytest.mark.parametrize("initial", [False, True])
def test_sensitivities_are_the_derivatives_of_the_residual(structure, initial, rng) -> None:
    """Central differences; error O(h^2) = 1e-10, times rounding 1e-16 / h = 1e-10."""
    kernel = polynomial_kernel(structure, levels=True, initial=initial)
    data = np.ascontiguousarray(rng.normal(size=(60, 3)))
    data[:, 2] = np.eye(60)[0]
    p, h = 0.1 * rng.normal(size=kernel.n), 1e-5
    e, jacobian = kernel.trace(data, p, True)
    for k, step in enumerate(h * np.eye(kernel.n)):
        slope = (kernel.trace(data, p + step, False)[0] - kernel.trace(data, p - step, False)[0]) / (2 * h)
        assert np.abs(jacobian[:, :, k] - slope).max() < 1e-8 * max(1, np.abs(slope).max())
    sums = kernel.sums(data, np.array([60]), p[None], np.eye(1))
    assert np.allclose(sums.hessian[0], jacobian[:, 0].T @ jacobian[:, 0], rtol=1e-12)
    assert np.allclose(sums.gradient[0], jacobian[:, 0].T @ e[:, 0], rtol=1e-10, atol=1e-10)


def test_output_error_is_that_of_an_independent_implementation(rng) -> None:
    """scipy's least squares on lfilter; the optimum agrees to a millionth of a standard error, rounded up."""
    data = records(rng, count=3, length=500)
    ours = identify(data, "oe", (2, 2), offset=False)
    theirs = oracle.output_error([(r.u[:, 0], r.y[:, 0]) for r in data], THETA, 2, 1)
    assert np.all(np.abs(ours.theta - theirs["theta"]) < 1e-4 * ours.standard_errors)
    assert np.allclose(ours.covariance, theirs["covariance"], rtol=1e-4)
    assert ours.loss <= theirs["loss"] * (1 + 1e-10)
    assert ours.noise_variance == pytest.approx(theirs["noise_variance"], rel=1e-8)


def test_offset_is_estimated(rng) -> None:
    data = records(rng, offset=5.0)
    ours = identify(data, "oe", (2, 2), offset=True, initial="zero")
    theirs = oracle.output_error(
        [(r.u[:, 0] - r.u.mean(), r.y[:, 0]) for r in data], np.r_[THETA, 5.0], 2, 1, offset=True
    )
    assert ours.theta == pytest.approx(theirs["theta"][:4], abs=1e-6)
    assert ours.output_level[0] == pytest.approx(theirs["theta"][4], abs=1e-6)
    assert ours.output_level_errors[0] == pytest.approx(np.sqrt(theirs["covariance"][4, 4]), rel=1e-3)


def test_arx_with_free_initial_state_is_least_squares(rng) -> None:
    """An unknown state takes the first max(na, nb + nk - 1) residuals out of the sum."""
    u = rng.normal(size=300)
    y = lfilter([0, 0, 1.0, 0.5], [1, -1.2, 0.5], u) + lfilter([1.0], [1, -1.2, 0.5], rng.normal(size=300))
    ours = identify(Record(u[20:], y[20:]), "arx", (2, 2), 2, initial="estimate", offset=False)
    assert ours.theta == pytest.approx(oracle.arx(u[20:], y[20:], 2, 2, 2), rel=1e-8)


def test_fir_is_least_squares(rng) -> None:
    data = records(rng)[0]
    ours = identify(data, "fir", 12, 0, offset=False)
    assert ours.theta == pytest.approx(oracle.fir(data.u[:, 0], data.y[:, 0], 12), abs=1e-10)


@pytest.mark.parametrize("seed", range(6))
def test_narrow_band_inputs_end_at_the_global_optimum(seed) -> None:
    """Power iterations at noise variance 9: no other start does better, the true one included."""
    rng = np.random.default_rng(seed)
    data = power_records(rng, 6, 400, 3.0)
    best = identify(data, offset=False)
    pole = [rng.uniform(0.5, 0.99) * np.exp(1j * rng.uniform(0, np.pi)) for _ in range(4)]
    starts = [THETA] + [np.array([*(0.3 * rng.normal(size=2)), -2 * p.real, abs(p) ** 2]) for p in pole]
    assert min(identify(data, start=s, offset=False).loss for s in starts) >= best.loss * (1 - 1e-9)


def test_peak_gain_has_the_error_of_monte_carlo() -> None:
    """400 replicates: the spread's own error is 1/sqrt(800) = 3.5 %; the tolerance is 4 of these."""
    rng = np.random.default_rng(5)
    u = rng.normal(size=1000)
    clean, values, errors = lfilter(B, A, u), [], []
    for _ in range(400):
        fit = identify(Record(u, clean + rng.normal(size=1000)), start=THETA, offset=False)
        value, error, _ = fit.hinf_norm
        values.append(value)
        errors.append(error)
    ratio = np.std(values) / np.mean(errors)
    assert abs(ratio - 1) < 0.14
    assert abs(np.sqrt(2) * ratio - 1) > 0.14  # the negative control: an error off by sqrt(2) is seen


def test_units_do_not_matter(rng) -> None:
    data = records(rng)[0]
    mixed = Record(data.u * 1e6, data.y * 1e-6)
    one, other = identify(data, offset=False), identify(mixed, offset=False)
    assert other.theta * [1e12, 1e12, 1, 1] == pytest.approx(one.theta, rel=1e-6)


def test_diagonal_model_is_its_channels_where_the_noise_is_independent(rng) -> None:
    u = rng.normal(size=(800, 2))
    y = np.column_stack([lfilter(B, A, u[:, 0]), lfilter([0, 0.5], [1, -0.7], u[:, 1])])
    both = Record(u, y + 0.3 * rng.normal(size=(800, 2)))
    fit = identify(both, "oe", ([2, 1], [2, 1]), diagonal=True, offset=False)
    assert fit.names == ("b1_11", "b2_11", "f1_11", "f2_11", "b1_22", "f1_22")
    first = identify(Record(both.u[:, 0], both.y[:, 0]), "oe", (2, 2), offset=False)
    assert np.all(np.abs(fit.theta[:4] - first.theta) < 0.5 * first.standard_errors)
    assert fit.status is Status.CONVERGED


def test_full_two_by_two(rng) -> None:
    u = rng.normal(size=(1500, 2))
    entry = [[(B, A), ([0, 0.3], [1, -0.5])], [([0, -0.4], [1, 0.3]), ([0, 1.0, 0.2], [1, -1.4, 0.7])]]
    y = np.column_stack([sum(lfilter(*entry[i][j], u[:, j]) for j in range(2)) for i in range(2)])
    root = np.array([[0.3, 0.0], [0.24, 0.1]])
    fit = identify(
        Record(u, y + rng.normal(size=(1500, 2)) @ root.T),
        "oe",
        ([[2, 1], [1, 2]], [[2, 1], [1, 2]]),
        offset=False,
    )
    true = np.concatenate([entry[i][j][k][1:] for i in range(2) for k in range(2) for j in range(2)])
    assert np.all(np.abs(fit.theta - true) < 4.5 * fit.standard_errors)
    assert np.allclose(fit.noise_covariance, root @ root.T, rtol=0.15)


def agree(fast, slow, data, lengths, p):
    """Sums and traces of two kernels, to 1e-9 of the largest entry."""
    weight = np.array([[2.0, 0.5], [0.5, 1.0]])
    assert fast.n == slow.n
    ours, theirs = fast.sums(data, lengths, p, weight), slow.sums(data, lengths, p, weight)
    for name in ("loss", "gradient", "hessian", "covariance"):
        one, other = getattr(ours, name), getattr(theirs, name)
        assert np.allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())
    first = data[: lengths[0]]
    for one, other in zip(fast.trace(first, p[0], True), slow.trace(first, p[0], True), strict=True):
        assert np.allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("initial", [False, True])
def test_filter_kernels_are_the_recursion_in_casadi(initial, weighted, rng) -> None:
    """Two outputs, two inputs, every polynomial, some of degree above two; records of 70 and 2 samples."""
    structure = polynomial(
        "bj", [[[2, 1], [0, 3]], [1, 2], [3, 1], [[1, 4], [0, 1]]], 1, n_outputs=2, n_inputs=2
    )
    recursion = predictors.polynomial_recursion(structure, levels=True, initial=initial)
    slow = kernel_of(predictors.weighted(recursion) if weighted else recursion)
    data = np.ascontiguousarray(np.abs(rng.normal(size=(72, 3 + 2 + 1 + 2 * weighted))))
    data[:, 5], lengths = np.isin(np.arange(72), (0, 70)), np.array([70, 2])
    fast = polynomial_kernel(structure, True, initial, weighted)
    agree(fast, slow, data, lengths, 0.2 * rng.normal(size=(2, slow.n)))
    assert np.finfo(float).eps ** 2 > filter_kernels.TINY


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("initial", [False, True])
def test_state_kernels_are_the_recursion_in_casadi(initial, weighted, rng) -> None:
    """With feedthrough; a record longer than the block of the sums, and one shorter."""
    structure = StateSpace((2, 1), 2, feedthrough=True)
    recursion = predictors.state_space_recursion(structure, levels=True, initial=initial)
    slow = kernel_of(predictors.weighted(recursion) if weighted else recursion)
    N = state_kernels.BLOCK + 9
    data = np.ascontiguousarray(np.abs(rng.normal(size=(N + 5, 2 + 2 + 1 + 2 * weighted))))
    data[:, 4], lengths = np.isin(np.arange(N + 5), (0, N)), np.array([N, 5])
    agree(
        state_space_kernel(structure, True, initial, weighted),
        slow,
        data,
        lengths,
        0.1 * rng.normal(size=(2, slow.n)),
    )


def test_model_survives_json_bit_for_bit(rng) -> None:
    model = identify(records(rng)[0], offset=False).model
    again = model_from_json(model.to_json())
    assert again.theta.tobytes() == model.theta.tobytes()
    assert again.noise_covariance.tobytes() == model.noise_covariance.tobytes()
    assert again.structure.to_dict() == model.structure.to_dict()


def test_plant_of_a_fit_has_its_response(rng) -> None:
    fit = identify(records(rng)[0], offset=False)
    omega = np.linspace(0, np.pi, 7)
    plant = fit.to_plant()
    assert np.allclose(plant.response(omega)[0], fit.model.response(omega)[0], rtol=1e-12)
    assert np.allclose(plant.simulate(np.eye(9)[:, :1]), fit.simulate(np.eye(9)[:, :1]), atol=1e-14)


def test_unexcited_directions_are_named(rng) -> None:
    t = np.arange(400)
    u = np.sin(0.7 * t)
    with pytest.raises(NotIdentifiable, match="b1|b2|b3"):
        identify(Record(u, u * 0.5 + rng.normal(size=400)), "fir", 5, 1, initial="estimate", offset=False)
    with pytest.raises(NotIdentifiable, match="u of order 2, and this structure has use for order 5"):
        identify(Record(u, u * 0.5 + rng.normal(size=400)), "fir", 5, 1, initial="estimate", offset=False)


def test_tables_and_time_responses_are_data(rng) -> None:
    """A DataFrame, a Dataset and a TimeResponseData give what the record gives, alone and several together."""
    (record,) = records(rng, length=300)
    theta = identify(record, offset=False).theta
    for given in (to_pandas(record), to_xarray(record), to_control(record)):
        fit = identify(given, offset=False)
        assert fit.theta.tobytes() == theta.tobytes()
        assert fit.predict(given).tobytes() == identify(record, offset=False).predict(record).tobytes()
        assert fit.simulate_record(given, window=9).shape == (300, 1)
    both = identify([record, to_pandas(record)], offset=False).theta
    assert both == pytest.approx(identify([record, record], offset=False).theta, abs=1e-12)
    for wrong in (5, "data.csv", [], [record, record.u]):
        with pytest.raises(InputError, match="give a Record, a pandas DataFrame"):
            identify(wrong, offset=False)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"structure": "oee"}, "unknown"),
        ({"orders": (2, 2, 2)}, "oe takes nb nf"),
        ({"delay": -1}, "causal"),
        ({"initial": "guess"}, "zero, estimate, backcast"),
        ({"start": [1.0, 2.0]}, "4 finite numbers"),
    ],
)
def test_bad_requests_are_told(change, words, rng) -> None:
    with pytest.raises(InputError, match=words):
        identify(**({"records": records(rng)[0], "structure": "oe", "orders": (2, 2)} | change))


@pytest.mark.parametrize(
    ("u", "y", "words"),
    [
        (np.ones(100), np.arange(100.0), "input u is constant"),
        (np.arange(100.0), np.full(100, 3.0), "output y is constant"),
        (np.arange(6.0), np.arange(6.0), "6 samples"),
        (np.arange(50.0), np.r_[np.nan, np.arange(49.0)], "missing"),
    ],
)
def test_bad_records_are_told(u, y, words) -> None:
    with pytest.raises(InputError, match=words):
        identify(Record(u, y), "oe", (2, 2), offset=True, initial="zero")


def test_a_fit_says_of_what_it_is() -> None:
    """One step ahead an ARX model in slow noise ranks above OE; simulated, on these data and fresh ones, below."""
    rng = np.random.default_rng(3)
    u = rng.normal(size=(2, 800))
    y = (
        lfilter([0, 0.2155, 0.2012], [1, -0.9854, 0.8187], u)
        + 2
        + lfilter([1], [1, -0.95], 0.4 * rng.normal(size=(2, 800)))
    )
    data, fresh = (Record(a, b) for a, b in zip(u, y, strict=True))
    arx, oe = identify(data, "arx", (3, 2)), identify(data, "oe", (2, 2))
    assert arx.fit_percent > oe.fit_percent + 5
    assert oe.fit_percent == pytest.approx(oe.simulation_fit_percent, abs=1e-6)
    on_fresh = [fit_percent(fresh.y[50:], f.simulate_record(fresh, window=50)[50:]) for f in (arx, oe)]
    assert on_fresh[0] < on_fresh[1] - 5
    assert arx.simulation_fit_percent < oe.simulation_fit_percent - 5
    assert "% one step ahead" in repr(arx)
    assert "% simulated" in repr(arx)
    assert arx.to_dict()["simulation_fit_percent"] == arx.simulation_fit_percent
    means = identify(data, "oe", (2, 2), offset="mean", initial="estimate")
    assert means.simulation_fit_percent == pytest.approx(oe.simulation_fit_percent, abs=1)
    gap = data.replace(y=np.where(np.arange(800) == 7, np.nan, y[0]))
    assert identify(gap, missing=True).simulation_fit_percent == pytest.approx(
        oe.simulation_fit_percent, abs=1
    )


def test_python_has_the_defaults_of_the_command() -> None:
    """The published hair-dryer record has levels and is in motion at its first sample: 89 %, and 40 without either."""
    record = hair_dryer_record()
    ours, bare = identify(record, delay=3), identify(record, delay=3, offset=False)
    assert ours.fit_percent > 85
    assert bare.fit_percent < 60
