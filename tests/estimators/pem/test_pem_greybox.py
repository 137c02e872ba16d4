"""Physically parametrised models against their exact discretisation and against output error."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.greybox import GreyBox, identify_grey_box
from oed.data import Record
from oed.errors import InputError, NotIdentifiable

DT, MASS, DAMPING, STIFFNESS = 0.1, 2.0, 0.8, 5.0


def spring(**change):
    """m x'' + d x' + k x = u, position measured."""
    return GreyBox(
        dynamics=lambda x, u, p: _column(x[1], (u[0] - p[1] * x[1] - p[2] * x[0]) / p[0]),
        output=lambda x, u, p: x[0],
        n_states=2,
        start={"mass": 1.0, "damping": 1.0, "stiffness": 3.0} | change,
    )


def _column(*entries):
    import casadi as ca

    return ca.vertcat(*entries)


def record(rng, length=500, deviation=0.02, x0=(0.0, 0.0)):
    A = np.array([[0, 1], [-STIFFNESS / MASS, -DAMPING / MASS]])
    both = expm(np.block([[A, np.array([[0], [1 / MASS]])], [np.zeros((1, 3))]]) * DT)
    u, x, y = np.repeat(rng.normal(size=(length // 5, 1)), 5, axis=0), np.array(x0), np.zeros(length)
    for t in range(length):
        y[t] = x[0]
        x = both[:2, :2] @ x + both[:2, 2] * u[t]
    return Record(u, y + deviation * rng.normal(size=length), dt=DT)


def test_physical_parameters(rng) -> None:
    data = [record(rng, x0=(0.3, -0.2)), record(rng, 300)]
    fit = identify_grey_box(data, spring(), initial="estimate")
    assert np.all(np.abs(fit.theta - [MASS, DAMPING, STIFFNESS]) < 4.5 * fit.standard_errors)
    assert np.all(fit.standard_errors < 0.1 * np.abs(fit.theta))
    assert fit.initial_states[0] == pytest.approx([0.3, -0.2], abs=0.1)
    assert np.allclose(
        data[0].y - fit.residuals[0], fit.simulate(data[0].u, fit.initial_states[0]), atol=1e-9
    )
    assert "mass" in repr(fit)


def test_discrete_grey_box_is_output_error(rng) -> None:
    u = rng.normal(size=400)
    y = lfilter([0, 0.5, 0.3], [1, -1.2, 0.6], u) + 0.1 * rng.normal(size=400)
    model = GreyBox(
        dynamics=lambda x, u, p: _column(-p[2] * x[0] + x[1] + p[0] * u[0], -p[3] * x[0] + p[1] * u[0]),
        output=lambda x, u, p: x[0],
        n_states=2,
        start={"b1": 0.4, "b2": 0.4, "f1": -1.0, "f2": 0.5},
        continuous=False,
    )
    ours, twin = identify_grey_box(Record(u, y), model), identify(Record(u, y), offset=False)
    assert ours.theta == pytest.approx(twin.theta, rel=1e-5)
    assert ours.covariance == pytest.approx(twin.covariance, rel=1e-4)


def test_bounds_and_refusals(rng) -> None:
    data = record(rng)
    held = identify_grey_box(data, spring(), bounds={"mass": (0.5, 1.5)})
    assert held.theta[0] == pytest.approx(1.5)
    with pytest.raises(InputError, match="parameters are"):
        identify_grey_box(data, spring(), bounds={"weight": (0, 1)})
    twice = GreyBox(lambda x, u, p: -p[0] * p[1] * x + u, lambda x, u, p: x, 1, {"one": 1.0, "other": 2.0})
    with pytest.raises(NotIdentifiable, match="one, other"):
        identify_grey_box(data, twice)
    with pytest.raises(InputError, match="outputs"):
        identify_grey_box(data, GreyBox(lambda x, u, p: x, lambda x, u, p: x, 2, {"a": 1.0}))
