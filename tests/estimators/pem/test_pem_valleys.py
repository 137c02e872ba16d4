"""Orders that are too high with several outputs: the search ends where only noise is fitted, and the right order is not blamed."""

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.checks import structure_for
from estimators.pem.search.confirmation import Standing, over_ordered, standing
from estimators.pem.search.joint_fit import determinant
from estimators.pem.search.levenberg_marquardt import Optimum, determined
from estimators.pem.search.problem import prepare
from oed.data import Record
from oed.errors import Status
from oed.models.model import oe


def two_by_two(seed: int, size: int = 1000) -> Record:
    """A plant of two states behind two inputs, seen by two outputs."""
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=(2, size, 2))
    states = np.column_stack(
        [lfilter([0, 1.0], [1, -0.8], u @ [1.0, 0.4]), lfilter([0, 1.0], [1, 0.5], u @ [0.3, -1.0])]
    )
    return Record(u, states @ [[1.0, 0.6], [0.5, -1.0]] + 0.3 * e)


def alike(seed: int, size: int = 1000) -> Record:
    """Three inputs that act through the same poles: initial states of their paths are told apart by nothing."""
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=(size, 3)), rng.normal(size=size)
    return Record(u, lfilter([0, 0.2155, 0.2012], [1, -0.9854, 0.8187], u @ [1.0, 0.7, 1.3]) + 0.3 * e)


@pytest.mark.parametrize("order, too_high", [(2, False), (4, True)])
@pytest.mark.parametrize("offset", [False, True])
def test_a_state_space_model_says_that_its_order_is_too_high(order, too_high, offset) -> None:
    """It had gone on for 410 steps, to the limit, along a valley; with the plant's own order nothing is said."""
    fit = identify(two_by_two(1), "ss", (order,), offset=offset)
    assert fit.status is Status.CONVERGED
    assert fit.iterations < 100
    assert any("orders are too high" in note for note in fit.notes) is (too_high and fit.decrement > 1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_modes_that_nothing_reaches_are_told_from_those_that_something_does(seed) -> None:
    found = []
    for order in (2, 3):
        form = structure_for("ss", (order,), 1, False, [two_by_two(seed)])
        fit = identify(two_by_two(seed), "ss", (order,), offset=False)
        problem = prepare(form, [two_by_two(seed)])
        weight = np.linalg.inv(fit.noise_covariance / np.outer(problem.output_scale, problem.output_scale))
        problem = problem.replace(weight=weight)
        point = problem.evaluate(fit.theta / problem.scale)
        assert point is not None
        found.append(over_ordered(problem, point))
    assert found == [False, True]


def test_the_loss_of_several_outputs_is_their_determinant_with_its_gradient() -> None:
    """Twin: central differences of the determinant of the residuals' moment."""
    data = two_by_two(2, 300)
    problem = prepare(structure_for("oe", (2, 2), 1, False, [data]), [data], offset=True)
    z = np.tile([0.3, 0.1, -0.4, 0.2], 4)[: problem.structure.n]
    z = np.concatenate([z, [0.1, -0.1]])

    def loss(z):
        e = problem.kernel.trace(problem.data, z, False)[0]
        return 2 * np.sqrt(np.linalg.det(e.T @ e))

    point = determinant(problem)(z, None)
    assert point is not None
    assert point.loss == pytest.approx(loss(z), rel=1e-9)
    steps = 1e-6 * np.eye(len(z))
    slope = [(loss(z + step) - loss(z - step)) / 4e-6 for step in steps]  # half the gradient
    np.testing.assert_allclose(point.gradient, slope, rtol=1e-5, atol=1e-5 * np.abs(slope).max())


def test_initial_states_that_nothing_tells_apart_leave_the_information_its_digits() -> None:
    """Twin: sensitivities less what initial states can do, by singular values. The pseudoinverse of the products had kept
    eigenvalues that were rounding, and the information of the parameters had become indefinite."""
    data = alike(3)
    problem = prepare(structure_for("oe", (2, 2), 1, False, [data]), [data], offset=True, initial=True)
    f = [-0.9854, 0.8187]
    z = np.concatenate([np.tile([0.2, 0.2], 3), f, np.add(f, 1e-6), np.add(f, -2e-6), [0.0]])
    point = problem.evaluate(z)
    assert point is not None
    states = point.extra[0][0]
    _, J = problem.kernel.trace(problem.data, np.concatenate([z, states]), True)
    assert J is not None
    J = J[:, 0]
    left, singular, _ = np.linalg.svd(J[:, len(z) :], full_matrices=False)
    left = left[:, singular > 1e-4 * singular[0]]
    bare = J[:, : len(z)] - left @ (left.T @ J[:, : len(z)])
    size = np.sqrt(np.diag(bare.T @ bare))
    error = (point.hessian - bare.T @ bare) / np.outer(size, size)
    assert np.abs(error).max() < 1e-5
    assert determined(point.hessian)


@pytest.mark.parametrize("status", [Status.INACCURATE, Status.MAX_ITERATIONS])
def test_singular_information_is_the_sign_of_an_order_too_high_and_hides_none(status) -> None:
    """A search that ended where nothing determines the parameters had been open, and was followed by 14 s of moved modes."""
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=(2, 1000))
    data = Record(u, lfilter([0, 0.5], [1, -0.8], u) + 0.3 * e)
    problem = prepare(oe(2, 2), [data])
    point = problem.evaluate(
        np.array([0.5 * problem.input_scale[0] / problem.output_scale[0], 0.0, -0.8, 0.0])
    )
    assert point is not None
    assert not determined(point.hessian) or np.linalg.cond(point.hessian) > 1e10
    assert standing(problem, Optimum(point, status, 50, np.inf)) is Standing.OVER_ORDERED


def test_an_order_too_high_of_several_inputs_leaves_a_model() -> None:
    """NotIdentifiable it had been, where a mode too many had gone to where it is a level and an initial state too."""
    for seed in (0, 1):
        fit = identify(alike(seed), "oe", (3, 3))
        assert np.isfinite(fit.covariance).all()
        assert fit.loss < 0.092
