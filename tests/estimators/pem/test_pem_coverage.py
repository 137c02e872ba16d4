"""Coverage of the 95 % intervals in Monte Carlo, structure by structure; long, so `make validate` runs it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from estimators.pem import identify
from estimators.pem.choice import estimate_delay
from estimators.pem.greybox import GreyBox, identify_grey_box
from estimators.pem.uncertainty import sandwich
from oed.data import Record
from oed.models.statespaces import state_space

SEED, REPLICATES, SAMPLES = 20261121, 2000, 1000
LOW, HIGH = 0.93, 0.97
B, F = [0.0, 0.5, 0.3], [1.0, -1.2, 0.6]
C, D = [1.0, 0.4], [1.0, -0.7]
CASES = {
    "fir": (([0, 0.5, 0.3, -0.2, 0.1], [1.0], [1.0], [1.0]), (4,), [0.5, 0.3, -0.2, 0.1]),
    "arx": ((B, F, [1.0], F), (2, 2), [-1.2, 0.6, 0.5, 0.3]),
    "armax": ((B, F, C, F), (2, 2, 1), [-1.2, 0.6, 0.5, 0.3, 0.4]),
    "oe": ((B, F, [1.0], [1.0]), (2, 2), [0.5, 0.3, -1.2, 0.6]),
    "bj": ((B, F, C, D), (2, 1, 1, 2), [0.5, 0.3, 0.4, -0.7, -1.2, 0.6]),
}
ENTRIES = np.array([[[0.5, -0.8], [0.3, -0.5]], [[-0.4, 0.6], [0.6, -0.7]]])
"""b, f of each entry of a plant of two outputs and two inputs, (ny, nu, 2)."""


def simulated(rng, filters):
    b, f, c, d = filters
    u = rng.normal(size=SAMPLES)
    return Record(u, lfilter(b, f, u) + lfilter(c, d, 0.7 * rng.normal(size=SAMPLES)))


def several(rng, rows):
    """Outputs of first-order entries driven by two inputs; the noises of two outputs are correlated."""
    u, e = rng.normal(size=(SAMPLES, 2)), rng.normal(size=(SAMPLES, 2)) @ np.array([[0.5, 0.3], [0.0, 0.4]])
    y = [sum(lfilter([0, b], [1, f], u[:, j]) for j, (b, f) in enumerate(row)) for row in rows]
    return Record(u, np.column_stack(y) + e[:, : len(rows)])


def standardised(
    one: Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]], seed: int = SEED
) -> np.ndarray:
    """Estimate minus truth over its standard error, (REPLICATES, n); one(rng) gives both."""
    rng = np.random.default_rng(seed)
    return np.array([np.divide(*one(rng)) for _ in range(REPLICATES)])


def covered(z: np.ndarray) -> np.ndarray:
    return np.mean(np.abs(z) < 1.959964, axis=0)


def check(name: str, one: Callable, record_figure) -> None:
    """Between 93 and 97 %, parameter by parameter; 2000 replicates know 95 % to 0.5 %."""
    share = covered(standardised(one))
    record_figure(f"coverage {name}", share, seed=SEED, replicates=REPLICATES)
    assert np.all((share > LOW) & (share < HIGH)), share


@pytest.mark.validate
@pytest.mark.parametrize("kind", CASES)
def test_coverage(kind, record_figure) -> None:
    filters, orders, theta = CASES[kind]

    def one(rng):
        fit = identify(simulated(rng, filters), kind, orders, search="quick", offset=False)
        return fit.theta - theta, fit.standard_errors

    check(kind, one, record_figure)


@pytest.mark.validate
def test_coverage_of_state_space(record_figure) -> None:
    """The parameters of the observable form of the ARMAX case."""
    filters, _, theta = CASES["armax"]
    a, b, c = np.array(theta[:2]), np.array(theta[2:4]), np.array([theta[4], 0.0])
    A = np.array([[-a[0], 1.0], [-a[1], 0.0]])
    true = state_space(2).theta_of(A, b[:, None], np.array([[1.0, 0.0]]), np.zeros((1, 1)), (c - a)[:, None])

    def one(rng):
        fit = identify(simulated(rng, filters), "ss", [2], search="quick", offset=False)
        return fit.theta - true, fit.standard_errors

    check("ss", one, record_figure)


@pytest.mark.validate
@pytest.mark.parametrize("method", ["moesp", "n4sid", "cva"])
def test_coverage_of_subspace_methods(method, record_figure) -> None:
    """The output-error case with a horizon of 15: no likelihood, but errors to first order in the noise."""
    filters, _, theta = CASES["oe"]
    b, f = np.array(theta[:2]), np.array(theta[2:])
    true = np.array([-f[1], -f[0], b[0], b[1] - f[0] * b[0]])  # the state holds the next two outputs

    def one(rng):
        fit = identify(simulated(rng, filters), "ss", [2], method=method, horizon=15, offset=False)
        return fit.theta - true, fit.standard_errors

    check(f"ss by {method}", one, record_figure)


@pytest.mark.validate
@pytest.mark.parametrize("outputs", [1, 2])
def test_coverage_of_several_channels(outputs, record_figure) -> None:
    """Output error, two inputs; one output, and two with correlated noise."""
    rows = ENTRIES[:outputs]
    truth = np.concatenate([row.T.ravel() for row in rows])

    def one(rng):
        fit = identify(several(rng, rows), "oe", (1, 1), search="quick", offset=False)
        return fit.theta - truth, fit.standard_errors

    check(f"oe, {outputs} x 2", one, record_figure)


@pytest.mark.validate
def test_coverage_of_state_space_of_two_outputs(record_figure) -> None:
    """Two states, two inputs, two outputs, K = 0.3 A, noises correlated."""
    A, G, K = np.array([[0.7, 0.2], [-0.3, 0.5]]), np.array([[0.5, 0.2], [-0.3, 0.6]]), np.zeros((2, 2))
    K = 0.3 * A
    structure = state_space(2, n_outputs=2, n_inputs=2)
    true = structure.theta_of(A, G, np.eye(2), np.zeros((2, 2)), K)

    def one(rng):
        u = rng.normal(size=(SAMPLES, 2))
        e = rng.normal(size=(SAMPLES, 2)) @ np.array([[0.5, 0.3], [0.0, 0.4]])
        drive, x, y = u @ G.T + e @ K.T, np.zeros(2), e.copy()
        for t in range(SAMPLES):
            y[t] += x
            x = A @ x + drive[t]
        fit = identify(Record(u, y), "ss", [2], search="quick", offset=False)
        return fit.theta - true, fit.standard_errors

    check("ss, 2 x 2", one, record_figure)


def held(rng, A, b, dt, deviation):
    """Position of a linear system driven by a held input, exactly discretised."""
    whole = expm(np.block([[A, b[:, None]], [np.zeros((1, 3))]]) * dt)
    num = np.r_[0.0, whole[0, 2], whole[0, 1] * whole[1, 2] - whole[1, 1] * whole[0, 2]]
    den = np.r_[1.0, -np.trace(whole[:2, :2]), np.linalg.det(whole[:2, :2])]
    u = np.repeat(rng.normal(size=SAMPLES // 5), 5)
    return Record(u, lfilter(num, den, u) + deviation * rng.normal(size=SAMPLES), dt=dt)


@pytest.mark.validate
@pytest.mark.parametrize("name", ["continuous", "grey box"])
def test_coverage_in_continuous_time(name, record_figure) -> None:
    """The coefficients of (b1 s + b0) / (s^2 + a1 s + a0), and mass, damping and stiffness of a spring."""
    import casadi as ca

    if name == "continuous":
        truth = np.array([0.4, 2.5, 0.5, 0.3])
        a1, a0, b0, b1 = truth
        A, b = np.array([[0.0, 1.0], [-a0, -a1]]), np.array([b1, b0 - a1 * b1])
        dynamics = lambda x, u, p: ca.vertcat(
            x[1] + p[3] * u[0], (p[2] - p[0] * p[3]) * u[0] - p[0] * x[1] - p[1] * x[0]
        )
        start = {"a1": 0.5, "a0": 2.3, "b0": 0.6, "b1": 0.25}
    else:
        truth = np.array([2.0, 0.8, 5.0])
        A, b = np.array([[0.0, 1.0], [-truth[2] / truth[0], -truth[1] / truth[0]]]), np.array([0.0, 0.5])
        dynamics = lambda x, u, p: ca.vertcat(x[1], (u[0] - p[1] * x[1] - p[2] * x[0]) / p[0])
        start = {"mass": 1.8, "damping": 1.0, "stiffness": 4.5}
    model = GreyBox(dynamics=dynamics, output=lambda x, u, p: x[0], n_states=2, start=start)

    def one(rng):
        fit = identify_grey_box(held(rng, A, b, 0.1, 0.05), model)
        return fit.theta - truth, fit.standard_errors

    check(name, one, record_figure)


@pytest.mark.validate
def test_coverage_with_an_estimated_delay(record_figure) -> None:
    """Box-Jenkins behind a delay of 4 samples, found each time among 2 to 6."""
    (b, f, c, d), orders, theta = CASES["bj"]
    b = [0.0, 0.0, 0.0, *b]

    def one(rng):
        found = estimate_delay(
            simulated(rng, (b, f, c, d)), "bj", orders, delays=range(2, 7), search="quick", offset=False
        )
        return found.fit.theta - theta, found.fit.standard_errors

    check("bj with an estimated delay", one, record_figure)


@pytest.mark.validate
def test_sandwich_covers_where_the_plain_covariance_does_not(record_figure) -> None:
    """Output error in strongly coloured noise: the model of the noise is wrong, that of the plant is right. The same
    2000 fits for both. With twice the noise one fit in twenty has the global minimum of its loss at a slow mode that
    imitates the noise, which no covariance covers; elsewhere the sandwich holds there too."""
    found = {}
    for name, deviation in (("moderate noise", 0.35), ("twice the noise", 0.7)):

        def one(rng, deviation=deviation):
            u = rng.normal(size=SAMPLES)
            noise = lfilter([1.0], [1.0, -0.95], deviation * rng.normal(size=SAMPLES))
            data = Record(u, lfilter(B, F, u) + noise)
            fit = identify(data, "oe", (2, 2), search="quick", offset=False)
            errors = np.r_[fit.standard_errors, sandwich(fit, data).standard_errors]
            return np.tile(fit.theta - CASES["oe"][2], 2), errors

        z = standardised(one)
        away = np.any(np.abs(z[:, 4:]) > 5, axis=1)
        found[name] = {"plain": covered(z[:, :4]), "sandwich": covered(z[:, 4:]), "far away": away.mean()}
        found[name]["sandwich elsewhere"] = covered(z[~away, 4:])
    record_figure("coverage in coloured noise", found, seed=SEED, replicates=REPLICATES)
    share = found["moderate noise"]
    assert np.all((share["sandwich"] > LOW) & (share["sandwich"] < HIGH)), found
    assert np.any((share["plain"] < 0.9) | (share["plain"] > 0.98)), found
    assert share["far away"] < 0.002, found


@pytest.mark.validate
def test_coverage_of_the_peak_gain(record_figure) -> None:
    filters, orders, _ = CASES["oe"]
    z = np.exp(-1j * np.linspace(0, np.pi, 200_001))
    gamma = np.abs(np.polyval(B[::-1], z) / np.polyval(F[::-1], z)).max()

    def one(rng):
        value, error, _ = identify(
            simulated(rng, filters), "oe", orders, search="quick", offset=False
        ).hinf_norm
        return np.array([value - gamma]), np.array([error])

    check("peak gain of oe", one, record_figure)


def test_too_small_errors_would_be_seen() -> None:
    """The negative control: normal errors with standard errors 15 % too small are covered in 90.5 %."""
    z = np.random.default_rng(0).normal(size=REPLICATES)
    assert LOW < covered(z) < HIGH
    assert covered(z / 0.85) < LOW
