"""State-space models: the same model as ARMAX for one output, recovered for several."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.residuals import residual_tests
from oed.data import Record
from oed.errors import InputError
from oed.models import Model, StateSpace, model_from_json, state_space

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
    fit = identify(record, "ss", [4])
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


def test_derivatives_of_the_responses(rng) -> None:
    structure = StateSpace((2, 1), 2, True)
    theta, omega, h = 0.3 * rng.normal(size=structure.n), np.array([0.0, 0.7, np.pi]), 1e-6
    for verb in ("response", "noise_response"):
        slope = getattr(structure, verb)(theta, omega)[1]
        for k, step in enumerate(h * np.eye(structure.n)):
            up, down = (getattr(structure, verb)(theta + s * step, omega)[0] for s in (1, -1))
            assert np.allclose(slope[:, k], (up - down) / (2 * h), atol=1e-8)


def test_json_and_control(rng) -> None:
    fit = identify(siso(rng), "ss", [2], offset=True)
    again = model_from_json(fit.model.to_json())
    assert again.theta.tobytes() == fit.model.theta.tobytes()
    system, omega = fit.model.to_control(), np.array([0.3, 1.0])
    assert np.allclose(system(np.exp(1j * omega)), fit.model.response(omega)[0][:, 0, 0])
    plant = fit.to_plant()
    assert np.allclose(plant.response(omega)[0], fit.model.response(omega)[0], rtol=1e-6)


def test_bad_orders_are_told(rng) -> None:
    record, _ = mimo(rng, 100)
    with pytest.raises(InputError, match="at least one state per output"):
        identify(record, "ss", [1])
    with pytest.raises(InputError, match="takes 0 or 1"):
        identify(record, "ss", [2], 3)
    with pytest.raises(InputError, match="ss takes n"):
        identify(record, "ss", [2, 2])
    with pytest.raises(InputError, match="not an observable basis"):
        state_space(2, n_outputs=2).theta_of(*(np.zeros((2, 2)) for _ in range(5)))
