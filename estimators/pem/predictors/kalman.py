"""The predictor when outputs are missing: a Kalman filter bridges the gaps of polynomial and state-space models.

The part driven by the inputs, w = sum_j B_j / (A F_j) u_j, is known whatever was measured. The noise v = y - w,
v = C / (A D) e, has the innovations form x+ = F x + K e, v = x_1 + e, and the Kalman filter for it with gaps is

    S = 1 + P_11,  eps = v - x_1,  L = (F P h + K) / S,  x+ = F x + L eps,  P+ = F P F' + K K' - L S L'

without the terms in eps and L where the sample is missing (e of unit variance; P = 0 at the start and as long as
nothing is missing, so that the filter is then the predictor). The likelihood wants eps^2 / S and log S. A
state-space model is in innovations form already: F = A, h = C; of several outputs, any of which may be missing, the
covariance Lambda of e stands where the 1 and K K' do, up to a factor that the likelihood is concentrated over.
"""

from typing import Any

import numpy as np

from estimators.pem.predictors.recursion import Recursion, differentiated
from oed.models.model import Polynomial, StateSpace


def _product(ca: Any, p: list, q: list) -> list:
    """Coefficients of the product of two polynomials."""
    out = [ca.SX(0)] * (len(p) + len(q) - 1)
    for i, a in enumerate(p):
        for j, b in enumerate(q):
            out[i + j] = out[i + j] + a * b
    return out


def _as_long(ca: Any, p: list, q: list) -> tuple[list, list, int]:
    """Two polynomials of one degree, and that degree."""
    degree = max(len(p), len(q)) - 1
    p, q = (x + [ca.SX(0)] * (degree + 1 - len(x)) for x in (p, q))
    return p, q, degree


def kalman_recursion(structure: Polynomial, levels: bool, initial: bool) -> Recursion:
    """The step of the predictor with missing outputs."""
    import casadi as ca

    ny, nu = structure.n_outputs, structure.n_inputs
    entries = [(i, j) for i in range(ny) for j in range(nu) if structure.nb[i, j]]
    u = {ij: ca.SX.sym("u") for ij in entries}
    y, seen = ca.SX.sym("y", ny), ca.SX.sym("seen", ny)
    pulse = ca.SX.sym("pulse")
    theta, level = ca.SX.sym("theta", structure.n), ca.SX.sym("level", ny if levels else 0)
    state: list = []
    after: list = []
    unknown: list[bool] = []
    residual, log_variance = [], ca.SX(0)

    def remembered(name: str, count: int, starts_unknown: bool) -> list:
        symbols = [ca.SX.sym(f"{name}_{k}") for k in range(count)]
        state.extend(symbols)
        unknown.extend([starts_unknown] * count)
        return symbols

    for i, place in enumerate(structure.places()):
        letters = {x: [[theta[k] for k in range(s.start, s.stop)] for s in place[x]] for x in "abcdf"}
        one = [ca.SX(1)]
        a, c, d = (one + letters[x][0] for x in "acd")
        v = y[i] - level[i] if levels else y[i]
        for j in range(nu):
            if (i, j) not in u:
                continue
            b, f = letters["b"][j], _product(ca, a, one + letters["f"][j])
            b, f, order = _as_long(ca, b, f)
            s = remembered(f"w{i}{j}", order, True)
            w = b[0] * u[i, j] + (s[0] if order else 0)
            for k in range(order):
                after.append(b[k + 1] * u[i, j] - f[k + 1] * w + (s[k + 1] if k + 1 < order else 0))
            v = v - w
        c, den, n = _as_long(ca, c, _product(ca, a, d))
        x = remembered(f"x{i}", n, True)
        lower = remembered(f"P{i}", n * (n + 1) // 2, False)
        if not n:
            residual.append(seen[i] * v)
            continue
        P, F = _symmetric(ca, lower, n), ca.SX(n, n)
        K = ca.vertcat(*(c[k + 1] - den[k + 1] for k in range(n)))
        for k in range(n):
            F[k, 0] = -den[k + 1]
            if k + 1 < n:
                F[k, k + 1] = 1
        S = 1 + P[0, 0]
        innovation = v - x[0]
        L = (F @ P[:, 0] + K) / S
        x_next = F @ ca.vertcat(*x) + seen[i] * L * innovation
        P_next = F @ P @ F.T + K @ K.T - seen[i] * S * (L @ L.T)
        after += [x_next[k] for k in range(n)]
        after += [P_next[k, m] for k in range(n) for m in range(k + 1)]
        residual.append(seen[i] * innovation / ca.sqrt(S))
        log_variance += seen[i] * ca.log(S)

    x0 = ca.SX.sym("x0", sum(unknown) if initial else 0)
    parameters = ca.vertcat(theta, level, x0)
    sample = ca.vertcat(*(u[ij] for ij in entries), y, seen, pulse)
    start = ca.SX.zeros(len(state), 1)
    if initial:
        at = 0
        for k, free in enumerate(unknown):
            if free:
                start[k] = x0[at]
                at += 1
    e = ca.vertcat(*residual, log_variance)
    made = differentiated(
        ca.vertcat(*state), sample, parameters, ca.vertcat(*after), e, start if initial else None
    )
    return _with_variance(made, ca.vertcat(*(u[ij] for ij in entries), y, pulse, seen), ny)


def _with_variance(made: Recursion, sample: Any, ny: int) -> Recursion:
    """The step whose last residual is the log variance, which goes by itself."""
    return Recursion(
        made.state, sample, made.parameters, made.next_state,
        made.residual[:ny], made.jacobian[:ny, :], made.residual[ny], made.jacobian[ny, :],
    )  # fmt: skip


def state_space_kalman_recursion(structure: StateSpace, levels: bool, initial: bool) -> Recursion:
    """The step of the predictor of a state-space model with missing samples, any of the outputs at any time."""
    import casadi as ca

    n, nu, ny = structure.order, structure.n_inputs, structure.n_outputs
    theta, level = ca.SX.sym("theta", structure.n), ca.SX.sym("level", ny if levels else 0)
    x0 = ca.SX.sym("x0", n if initial else 0)
    m = {letter: ca.SX(value) for letter, value in structure.matrices(np.zeros(structure.n)).items()}
    for k, (letter, i, j) in enumerate(structure.entries()):
        m[letter][i, j] = theta[k]
    m = {letter: ca.sparsify(value) for letter, value in m.items()}
    x, lower = ca.SX.sym("x", n), ca.SX.sym("P", n * (n + 1) // 2)
    u, y, seen, pulse = ca.SX.sym("u", nu), ca.SX.sym("y", ny), ca.SX.sym("seen", ny), ca.SX.sym("pulse")
    noise = ca.SX.sym("noise", ny * (ny + 1) // 2 if ny > 1 else 0)
    P, Lambda = _symmetric(ca, lower, n), _symmetric(ca, noise, ny) if ny > 1 else ca.SX(1)
    A, B, C, D, K = (m[letter] for letter in "ABCDK")
    innovation = seen * (y - C @ x - D @ u - (level if levels else 0))
    # A missing output is one of unit variance that is observed to be as foretold and tells nothing of the state.
    S = ca.densify(seen @ seen.T * (Lambda + C @ P @ C.T)) + ca.diag(1 - seen)
    root = _root(ca, S, ny)
    L = ca.solve(S, ((A @ P @ C.T + K @ Lambda) @ ca.diag(seen)).T).T if ny > 1 else None
    L = seen * (A @ P @ C.T + K) / S if L is None else L
    P_next = A @ P @ A.T + K @ Lambda @ K.T - L @ S @ L.T
    after = ca.vertcat(
        A @ x + B @ u + L @ innovation, *(P_next[k, i] for k in range(n) for i in range(k + 1))
    )
    white: list = []
    for k in range(ny):
        white.append((innovation[k] - sum((root[k][i] * white[i] for i in range(k)), ca.SX(0))) / root[k][k])
    log_variance = sum((2 * ca.log(root[k][k]) for k in range(ny)), ca.SX(0))
    start = ca.vertcat(x0, ca.SX.zeros(n * (n + 1) // 2, 1)) if initial else None
    made = differentiated(
        ca.vertcat(x, lower), ca.vertcat(u, y, seen, noise, pulse), ca.vertcat(theta, level, x0),
        ca.densify(after), ca.densify(ca.vertcat(*white, log_variance)), start,
    )  # fmt: skip
    return _with_variance(made, ca.vertcat(u, y, pulse, seen, noise), ny)


def _symmetric(ca: Any, lower: Any, n: int) -> Any:
    """The matrix of a lower triangle stored row by row."""
    full = ca.SX(n, n)
    for k in range(n):
        for i in range(k + 1):
            full[k, i] = full[i, k] = lower[k * (k + 1) // 2 + i]
    return full


def _root(ca: Any, S: Any, n: int) -> list[list]:
    """Rows of the Cholesky factor of a small matrix, entry by entry."""
    rows: list[list] = []
    for k in range(n):
        row: list = []
        for i in range(k):
            row.append((S[k, i] - sum((row[j] * rows[i][j] for j in range(i)), ca.SX(0))) / rows[i][i])
        row.append(ca.sqrt(S[k, k] - sum((v * v for v in row), ca.SX(0))))
        rows.append(row)
    return rows
