"""State-space models: the same model as ARMAX for one output, recovered for several."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.search.problem import prepare
from estimators.residual.tests import residual_tests
from oed.data import Record
from oed.errors import InputError, Status
from oed.models.model import Model, StateSpace, model_from_json
from oed.models.statespaces import state_space

B, A, C = [0.0, 0.2155, 0.2012], [1.0, -0.9854, 0.8187], [1.0, 0.5, 0.2]


def siso(rng, length=800):
    u = rng.normal(size=length)
    return Record(u, 2.0 + lfilter(B, A, u) + lfilter(C, A, 0.5 * rng.normal(size=length)))


def mimo(rng, length=1500):
    n = 4
    block = lambda r, w: r * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]])
    F = np.block([[block(0.9, 1.0), np.zeros((2, 2))], [np.zeros((2, 2)), block(0.8, 0.3)]])
    G, H = rng.normal(size=(n, 2)), rng.normal(size=(2, n))
    K = 0.3 * F @ np.linalg.pinv(H)
    u, e = rng.normal(size=(length, 2)), rng.normal(size=(length, 2)) @ np.array([[1, 0], [0.6, 0.4]])
    x, y = np.zeros(n), np.zeros((length, 2))
    for t in range(length):
        y[t] = H @ x + e[t]
        x = F @ x + G @ u[t] + K @ e[t]
    return Record(u, y), (F, G, H, np.zeros((2, 2)), K)


@pytest.mark.parametrize("initial", ["zero", "estimate"])
@pytest.mark.parametrize("delay", [0, 1])
def test_one_output_is_armax(rng, initial, delay) -> None:
    """Two parametrisations of one model: the loss and the peak gain with its error agree to rounding."""
    record = siso(rng)
    options = {"initial": initial, "offset": True}
    ours = identify(record, "ss", [2], delay, **options)
    twin = identify(record, "armax", (2, 3 - delay, 2), delay, **options)
    assert ours.loss == pytest.approx(twin.loss, rel=1e-9)
    assert ours.hinf_norm[:2] == pytest.approx(twin.hinf_norm[:2], rel=1e-5)
    omega = np.linspace(0, np.pi, 9)
    for verb in ("response", "noise_response"):
        one, other = (getattr(f.model, verb)(omega)[0] for f in (ours, twin))
        assert np.allclose(one, other, atol=1e-5)
    assert np.allclose(ours.simulate(record.u), twin.simulate(record.u), atol=1e-4)


def test_several_outputs(rng) -> None:
    record, truth = mimo(rng, 700)
    fit = identify(record, "ss", [4], offset=False)
    structure = fit.model.structure
    theta = structure.theta_of(*truth)
    away = fit.theta - theta
    # chi-squared with 28 degrees of freedom: above 65 once in 10^4.
    assert away @ np.linalg.solve(fit.covariance, away) < 65
    assert residual_tests(fit, record)["whiteness_1"].p_value > 1e-4
    omega = np.linspace(0.1, 3, 5)
    assert np.allclose(
        Model(structure, theta).response(omega)[0],
        truth[2] @ np.linalg.inv(np.exp(1j * omega)[:, None, None] * np.eye(4) - truth[0]) @ truth[1],
    )


def dense_log_likelihood(m, level, Lambda, u, y):
    """-2 log L of the observed outputs by the covariance of all of them at once, from rest; no filter."""
    length, ny = y.shape
    n = len(m["A"])
    markov, power = [np.eye(ny)], np.eye(n)
    forced = [m["D"]]
    for _ in range(length - 1):
        markov.append(m["C"] @ power @ m["K"])
        forced.append(m["C"] @ power @ m["B"])
        power = m["A"] @ power
    lag = np.subtract.outer(np.arange(length), np.arange(length))

    def stack(blocks):
        all_blocks = np.where((lag >= 0)[:, :, None, None], np.array(blocks)[np.maximum(lag, 0)], 0.0)
        return all_blocks.transpose(0, 2, 1, 3).reshape(length * ny, -1)

    H = stack(markov)
    mean = (stack(forced) @ u.ravel()).reshape(length, ny) + level
    seen = np.isfinite(y).ravel()
    S = (H @ np.kron(np.eye(length), Lambda) @ H.T)[np.ix_(seen, seen)]
    e = (y - mean).ravel()[seen]
    return float(np.linalg.slogdet(2 * np.pi * S)[1] + e @ np.linalg.solve(S, e))


def test_several_outputs_with_missing_samples(rng) -> None:
    """The likelihood at the fit is that of the dense covariance matrix, and the highest in its neighbourhood."""
    A, G = np.array([[0.7, 0.2], [-0.3, 0.5]]), np.array([[0.5, 0.2], [-0.3, 0.6]])
    u, e = rng.normal(size=(100, 2)), rng.normal(size=(100, 2)) @ np.array([[0.5, 0.3], [0.0, 0.4]])
    x, y = np.zeros(2), e.copy()
    for t in range(100):
        y[t] += x
        x = A @ x + G @ u[t] + 0.3 * A @ e[t]
    y[rng.random(100) < 0.2, 0] = np.nan
    y[rng.random(100) < 0.1, 1] = np.nan
    y[60:66] = np.nan
    record = Record(u, y)
    fit = identify(record, "ss", [2], missing=True, offset=False)
    structure, values = fit.model.structure, int(np.isfinite(y).sum())
    assert fit.status is Status.CONVERGED
    noise = fit.noise_covariance

    def minus_log(theta, Lambda):
        return dense_log_likelihood(structure.matrices(theta), fit.output_level, Lambda, record.u, y)

    factors = np.linspace(0.85, 1.15, 7)
    best = min(minus_log(fit.theta, s * noise) for s in factors)
    for k in range(structure.n):
        for sign in (-1, 1):
            moved = fit.theta + sign * 0.5 * fit.standard_errors[k] * np.eye(structure.n)[k]
            assert min(minus_log(moved, s * noise) for s in factors) > best
    for change in (
        [[0.1, 0], [0, -0.1]],
        [[0, 0.1], [0.1, 0]],
        [[0, -0.1], [-0.1, 0]],
        [[-0.1, 0], [0, 0.1]],
    ):
        root = np.linalg.cholesky(noise) @ (np.eye(2) + np.array(change))
        assert min(minus_log(fit.theta, s * root @ root.T) for s in factors) > best
    problem = prepare(structure, [record], missing=True)
    units = problem.output_scale
    problem = problem.with_noise(noise / np.outer(units, units))
    loss = problem.evaluate(fit.theta / problem.scale).loss
    concentrated = values * (np.log(2 * np.pi * loss / values) + 1) + 2 * float(
        np.isfinite(y).sum(axis=0) @ np.log(units)
    )
    one, two = minus_log(fit.theta, noise), minus_log(fit.theta, 2 * noise)
    squares = 2 * (one - two + values * np.log(2))  # -2 log L is values log s + squares / s + a constant
    direct = minus_log(fit.theta, squares / values * noise)
    assert concentrated == pytest.approx(direct, rel=1e-9)
    assert np.array_equal(np.isnan(fit.residuals[0]), np.isnan(y))


def test_hardly_any_missing_sample_hardly_matters(rng) -> None:
    """Two of 1400 values: each tells at most three of its deviations, 0.11 standard errors of one parameter or so."""
    record, _ = mimo(rng, 700)
    y = np.array(record.y)
    y[[100, 350], [0, 1]] = np.nan
    ours, whole = (
        identify(record.replace(y=y), "ss", [4], missing=True, offset=False),
        identify(record, "ss", [4], offset=False),
    )
    assert np.all(np.abs(ours.theta - whole.theta) < 0.4 * whole.standard_errors)
    assert np.allclose(ours.standard_errors, whole.standard_errors, rtol=0.03)
    assert np.allclose(ours.noise_covariance, whole.noise_covariance, rtol=0.02)


def test_derivatives_of_the_responses(rng) -> None:
    structure = StateSpace((2, 1), 2, True)
    theta, omega, h = 0.3 * rng.normal(size=structure.n), np.array([0.0, 0.7, np.pi]), 1e-6
    for verb in ("response", "noise_response"):
        slope = getattr(structure, verb)(theta, omega)[1]
        for k, step in enumerate(h * np.eye(structure.n)):
            up, down = (getattr(structure, verb)(theta + s * step, omega)[0] for s in (1, -1))
            assert np.allclose(slope[:, k], (up - down) / (2 * h), atol=1e-8)


def test_json_and_control(rng) -> None:
    fit = identify(siso(rng), "ss", [2], offset=True, initial="zero")
    again = model_from_json(fit.model.to_json())
    assert again.theta.tobytes() == fit.model.theta.tobytes()
    system, omega = fit.model.to_control(), np.array([0.3, 1.0])
    assert np.allclose(system(np.exp(1j * omega)), fit.model.response(omega)[0][:, 0, 0])
    plant = fit.to_plant()
    assert np.allclose(plant.response(omega)[0], fit.model.response(omega)[0], rtol=1e-6)


def test_bad_orders_are_told(rng) -> None:
    record, _ = mimo(rng, 100)
    with pytest.raises(InputError, match="at least one state per output"):
        identify(record, "ss", [1], offset=False)
    with pytest.raises(InputError, match="takes 0 or 1"):
        identify(record, "ss", [2], 3, offset=False)
    with pytest.raises(InputError, match="ss takes n"):
        identify(record, "ss", [2, 2], offset=False)
    with pytest.raises(InputError, match="not an observable basis"):
        state_space(2, n_outputs=2).theta_of(*(np.zeros((2, 2)) for _ in range(5)))
