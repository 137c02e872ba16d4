"""Covariance of a subspace estimate, to first order in the noise.

With V the noise in the future outputs and q the instruments, the range moves off itself by sum_t V_t q_t' / s^2 (of the
singular values s), A and C with it; B, D, levels and initial states follow, as the simulation error stays orthogonal to
what they are linear in. Sorted by the sample at which the noise enters, the estimate's error is a sum of terms
kappa_t v(t), in which kappa_t depends on the past alone if v is white: what instrumental variables have. The sum's
long-run covariance is found as that of the sandwich is, so that it holds for coloured noise and unequal variances too.
Terms of second order in the noise and the choice of the horizon are left out."""

import numpy as np
from numpy.typing import NDArray

from estimators.pem.search.levenberg_marquardt import Point
from estimators.pem.search.problem import Problem
from estimators.pem.subspace.observability import Range
from estimators.pem.uncertainty import default_lags, long_run
from oed.models.model import StateSpace


def influence(
    form: StateSpace, problem: Problem, point: Point, found: Range, signals: list[tuple[NDArray, NDArray]]
) -> list[NDArray[np.float64]]:
    """What noise in each output at each sample adds to the estimate: kappa; returns (N, ny, n + levels)."""
    free = linear_entries(form, problem.n_parameters)
    at = np.flatnonzero(free)
    follow = np.linalg.pinv(point.hessian[at[:, None], at], rcond=1e-14, hermitian=True)
    lever, drag = range_sensitivity(found, form), _pull(problem, point, free)
    terms = []
    for (u, y), slope in zip(signals, _slopes(problem, point), strict=True):
        kappa = np.zeros(slope.shape)
        moved = _moves(found, u, y, lever)
        kappa[:, :, ~free] = moved
        push = np.einsum("tik,ij->tjk", slope[:, :, free], problem.weight)
        kappa[:, :, free] = -(push + moved @ drag.T) @ follow
        terms.append(kappa)
    return terms


def covariance(
    problem: Problem, residuals: list[NDArray], terms: list[NDArray], horizon: int
) -> NDArray[np.float64]:
    """Covariance of the parameters of A, B and D and of the levels: residuals (N, ny), terms (N, ny, n +
    levels) -> (n + levels, n + levels)."""
    total, n, ny = problem.n_samples, problem.n_parameters, residuals[0].shape[1]
    # noise that the states colour enters a whole horizon at a time, and cancels only over all of it
    lags = max(default_lags(total), horizon)
    # as many degrees of freedom are lost as parameters were fitted, and by Bartlett's weights as lags are taken
    left = max(total - (n + len(residuals) * problem.n_initial) / ny - lags, 1.0)
    moved = [np.einsum("tjk,tj->tk", kappa, e) for kappa, e in zip(terms, residuals, strict=True)]
    return total / left * long_run(moved, lags)


def linear_entries(form: StateSpace, count: int) -> NDArray[np.bool_]:
    """Which parameters the simulated output is linear in: returns (count,)."""
    free = np.ones(count, bool)
    free[: form.n] = [letter != "A" for letter, _, _ in form.entries()]
    return free


def _slopes(problem: Problem, point: Point) -> list[NDArray[np.float64]]:
    """Slopes of the simulation errors, free of what the initial states can do, (N, ny, n + levels) of each record."""
    n, states, slopes = problem.n_parameters, point.extra[0], []
    for r, data in enumerate(problem.records()):
        own = np.zeros(0) if states is None else states[r]
        slope = np.asarray(problem.kernel.trace(data, np.concatenate([point.z, own]), True)[1])
        if own.size:
            initial = slope[:, :, n:].reshape(-1, own.size)
            weighted = np.einsum("ij,tjk->tik", problem.weight, slope[:, :, n:]).reshape(-1, own.size)
            flat = slope[:, :, :n].reshape(-1, n)
            part = np.linalg.pinv(weighted.T @ initial, rcond=1e-12, hermitian=True) @ (weighted.T @ flat)
            slope = (flat - initial @ part).reshape(len(slope), -1, n)
        slopes.append(slope)
    return slopes


def _pull(problem: Problem, point: Point, free: NDArray) -> NDArray[np.float64]:
    """How the gradient in the linear parameters turns with those of A, by central differences."""
    columns = []
    for k in np.flatnonzero(~free):
        step = 1e-6 * max(abs(point.z[k]), 1e-2)
        ends = None
        while ends is None and step > 1e-12:  # smaller where a pole would leave the unit circle
            shift = step * np.eye(len(point.z))[k]
            up, down = (problem.evaluate(z, affine=True) for z in (point.z + shift, point.z - shift))
            if up is not None and down is not None:
                ends = (up.gradient - down.gradient)[free] / (2 * step)
            step /= 10
        columns.append(point.hessian[free, k] if ends is None else ends)
    return np.column_stack(columns)


def _moves(found: Range, u: NDArray, y: NDArray, lever: NDArray) -> NDArray[np.float64]:
    """What the noise at each sample adds to the parameters of A, (N, ny, p)."""
    factor = found.factor
    i, nu, ny = factor.horizon, factor.n_inputs, factor.n_outputs
    moved = np.zeros((len(y), ny, len(lever)))
    count = len(u) - 2 * i + 1
    if count <= 0:
        return moved
    L11, L21, *_ = factor.blocks()
    past = found.instruments
    known = factor.divided(L11, L21.T @ past, transposed=True)
    n = past.shape[1]
    x = np.zeros((count, n))
    ahead = np.concatenate([past[: i * nu], -known]).reshape(2 * i, nu, n)
    back = past[i * nu :].reshape(i, ny, n)
    for signal, weights in ((u, ahead), (y[: len(y) - i], back)):
        for c in range(signal.shape[1]):
            for s in range(n):
                x[:, s] += np.correlate(signal[:, c], weights[:, c, s], "valid")
    # noise k samples ahead of the present: a convolution over k
    length = count + i
    pushed = np.zeros((length // 2 + 1, ny, len(lever)), dtype=complex)
    for s in range(n):
        state, own = (
            np.fft.rfft(x[:, s], length),
            np.fft.rfft(lever[:, :, s].reshape(-1, i, ny), length, axis=1),
        )
        pushed += np.einsum("f,afj->fja", state, own)
    moved[i : i + count + i - 1] = np.fft.irfft(pushed, length, axis=0)[: count + i - 1]
    return moved


def range_sensitivity(found: Range, form: StateSpace) -> NDArray[np.float64]:
    """Change of the parameters of A with noise in the future outputs times the state: returns (p, i ny, n)."""
    G, A, ny = found.basis, found.A, form.n_outputs
    n, rows = len(A), len(G)
    changes = np.eye(rows * n).reshape(-1, rows, n)
    up, down = G[:-ny], G[ny:]
    inverse = np.linalg.pinv(up)
    left = down - up @ A
    dA = inverse @ inverse.T @ changes[:, :-ny].transpose(0, 2, 1) @ left
    dA += inverse @ (changes[:, ny:] - changes[:, :-ny] @ A)
    dC = changes[:, :ny]
    basis, dbasis, last, dlast = [], [], [], []
    for k, block in enumerate(form.blocks):
        row, drow = found.C[k], dC[:, k]
        for _ in range(block):
            basis.append(row)
            dbasis.append(drow)
            row, drow = row @ A, drow @ A + row @ dA
        last.append(row)
        dlast.append(drow)
    inverse_basis = np.linalg.inv(np.array(basis))
    coefficients = np.array(last) @ inverse_basis
    moved = (np.stack(dlast, axis=1) - coefficients @ np.stack(dbasis, axis=1)) @ inverse_basis
    slope = moved.reshape(rows, n, -1).transpose(2, 0, 1)
    across = found.weight @ (np.eye(rows) - (own := found.weight @ G) @ own.T) @ found.unweight
    return np.einsum("rs,asj->arj", across, slope)
