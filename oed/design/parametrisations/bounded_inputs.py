"""How much power a filter can pass from an input within an amplitude: an upper bound by sums of squares.

A signal with |u| <= 1 has at most the power 1, so a filter F passes at most ||F||_inf^2. This is never reached: at the
peak a square wave carries 8 / pi^2 of its power. With the state s of F (s+ = A s + B u, y = C s), a storage function V and
sums of squares sigma_0, sigma_1 in (s, u),

    eta - (C s)^2 - V(A s + B u) + V(s) = sigma_0 + sigma_1 (1 - u^2)

makes the mean of y^2 at most eta (the sum over time telescopes, and s is bounded). Degree 2 gives ||F||_inf^2 again; for a
sharp resonance degrees 4, 6, 8 give 0.889, 0.854, 0.838 of it, above the 0.811 of the square wave: the quadratures of
|cos| by nodes of Gauss and Radau."""

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.design.solvers.whole_grid import solve_cvxpy
from oed.errors import InputError

Polynomial = dict[tuple[int, ...], float]


def passed_power(num: ArrayLike, den: ArrayLike, *, degree: int = 8) -> float:
    """Certified bound on the mean square of a filter's output over all inputs with |u| <= 1. Source: P. A.
    Parrilo, Mathematical Programming 96 (2003) 293-320, for sums of squares. Twin: simulated square waves and
    greedy inputs stay below."""
    import cvxpy as cp

    if degree not in (2, 4, 6, 8):
        raise InputError(f"the degree is {degree}; choose 2, 4, 6 or 8.")
    A, B, C = _realised(np.asarray(num, dtype=float), np.asarray(den, dtype=float))
    k = len(A)
    monomials = lambda most: [e for e in product(range(most + 1), repeat=k + 1) if sum(e) <= most]
    row = {e: i for i, e in enumerate(monomials(degree))}
    squares, multiplied = monomials(degree // 2), monomials(degree // 2 - 1)
    # Even V: the plant is linear, the limit symmetric.
    stored = [e for e in monomials(degree) if e[-1] == 0 and sum(e) % 2 == 0 and sum(e) > 0]
    steps = np.zeros((len(row), len(stored)))
    for j, e in enumerate(stored):
        steps[row[e], j] += 1
        for f, value in _moved(e, A, B).items():
            steps[row[f], j] -= value
    output = np.zeros(len(row))
    for f, value in _power([*C, 0.0], 2).items():
        output[row[f]] = value
    one = np.zeros(len(row))
    one[row[(0,) * (k + 1)]] = 1.0
    whole, limited = _gram(squares, row), _gram(multiplied, row)
    for j, (e, f) in enumerate(product(multiplied, repeat=2)):
        limited[row[(*(a + b for a, b in zip(e[:-1], f[:-1], strict=True)), e[-1] + f[-1] + 2)], j] -= 1
    eta, v = cp.Variable(), cp.Variable(len(stored))
    Q0 = cp.Variable((len(squares),) * 2, PSD=True)
    Q1 = cp.Variable((len(multiplied),) * 2, PSD=True)
    left = eta * one - output + steps @ v
    match = left == whole @ cp.vec(Q0, order="C") + limited @ cp.vec(Q1, order="C")
    solve_cvxpy(cp.Problem(cp.Minimize(eta), [match]), 1e-10)
    # What rounding leaves of the equation goes into sigma_0; where that is no longer positive semidefinite, by at most
    # floor sum m_i^2 <= floor * count (every coordinate is at most 1), eta grows by as much.
    sigma_1 = np.asarray(Q1.value)
    values, vectors = np.linalg.eigh((sigma_1 + sigma_1.T) / 2)
    sigma_1 = (vectors * np.clip(values, 0, None)) @ vectors.T
    sigma_0 = (np.asarray(Q0.value) + np.asarray(Q0.value).T) / 2
    reached = float(np.asarray(eta.value))
    rest = reached * one - output + steps @ np.asarray(v.value) - limited @ sigma_1.ravel()
    rest -= whole @ sigma_0.ravel()
    counts = whole.sum(axis=1)
    sigma_0 = sigma_0 + (whole.T @ (rest / np.maximum(counts, 1))).reshape(sigma_0.shape)
    floor = max(0.0, -float(np.linalg.eigvalsh(sigma_0)[0]))
    return reached + floor * len(squares)


def _realised(num: NDArray, den: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """A real state-space form whose states are at most 1 for |u| <= 1."""
    k = max(len(num), len(den)) - 1
    if num[0] != 0:
        raise InputError(f"the filter passes {num[0]:g} of the input without delay; it needs num[0] = 0.")
    if not 1 <= k <= 2:
        raise InputError(f"the filter has {k} states; sums of squares are for one or two.")
    if np.abs(np.roots(den)).max(initial=0.0) >= 1:
        raise InputError("the filter is not stable, so bounded inputs can make its output grow for ever.")
    a, b = np.zeros(k + 1), np.zeros(k + 1)
    a[: len(den)], b[: len(num)] = den / den[0], num / den[0]
    A = np.eye(k, k=-1)
    A[0] = -a[1:]
    B, C = np.eye(k)[:, 0], b[1:]
    poles, vectors = np.linalg.eig(A)
    if k == 2 and np.iscomplexobj(poles):
        # A rotation times the modulus: the states of a resonance are of one size.
        T = np.column_stack([vectors[:, 0].real, vectors[:, 0].imag])
        A, B, C = np.linalg.solve(T, A @ T), np.linalg.solve(T, B), C @ T
    total, step = np.zeros(k), B.copy()
    for _ in range(200_000):
        total += np.abs(step)
        step = A @ step
        if np.abs(step).max() < 1e-14 * total.max():
            break
    # Beyond the last term the sum is a geometric series of no size.
    total = total * (1 + 1e-9)
    return A * total / total[:, None], B / total, C * total


def _power(linear: Any, exponent: int) -> Polynomial:
    """(sum_i linear_i x_i)^exponent."""
    units = map(tuple, np.eye(len(linear), dtype=int).tolist())
    base, result = dict(zip(units, map(float, linear), strict=True)), {(0,) * len(linear): 1.0}
    for _ in range(exponent):
        result = _times(result, base)
    return result


def _times(one: Polynomial, other: Polynomial) -> Polynomial:
    result: Polynomial = {}
    for e, a in one.items():
        for f, b in other.items():
            key = tuple(x + y for x, y in zip(e, f, strict=True))
            result[key] = result.get(key, 0.0) + a * b
    return result


def _moved(exponents: tuple[int, ...], A: NDArray, B: NDArray) -> Polynomial:
    """The monomial of the next state, in state and input."""
    result: Polynomial = {(0,) * (len(A) + 1): 1.0}
    for i, exponent in enumerate(exponents[:-1]):
        result = _times(result, _power([*A[i], B[i]], exponent))
    return result


def _gram(monomials: list[tuple[int, ...]], row: dict[tuple[int, ...], int]) -> NDArray[np.float64]:
    """Coefficients of sum_ij Q_ij m_i m_j as a linear map of Q."""
    result = np.zeros((len(row), len(monomials) ** 2))
    for j, (e, f) in enumerate(product(monomials, repeat=2)):
        result[row[tuple(x + y for x, y in zip(e, f, strict=True))], j] += 1
    return result
