"""The state-space predictor and its sensitivities as one recursion, compiled once for all orders.

With e = y - C x - D u - level and x+ = A x + B u + K e, what a change of a parameter does to the state obeys

    dx+ = (A - K C) dx + dA x + dB u + dK e - K (dD u + dlevel),      de = -C dx - dD u - dlevel"""

import numpy as np
from numba import njit

TINY = 1e-290
"""What has decayed this far is zero: subnormal numbers cost a hundred times a normal operation."""
BLOCK = 64
"""Samples whose sensitivities are kept before they go into the sums: they stay in the nearest cache."""


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, cache=True)
def _added(to, scale, what):
    for k in range(len(to)):
        to[k] += scale * what[k]


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, cache=True)
def _product(x, y):
    total = 0.0
    for t in range(len(x)):
        total += x[t] * y[t]
    return total


@njit(error_model="numpy", cache=True)
def _turned(rows, weight, N, found):
    """Every sample's outputs multiplied by the weight."""
    ny = len(weight)
    for k in range(len(rows)):
        for t in range(N):
            for i in range(ny):
                total = 0.0
                for j in range(ny):
                    total += weight[i, j] * rows[k, t * ny + j]
                found[k, t * ny + i] = total


@njit(error_model="numpy", cache=True)
def run(data, state, slope, matrices, entries, e, jacobian):
    """Residuals (N, ny) and sensitivities (N, ny, P) of some samples (N, nu + ny + ...); state and slope go
    on; state (n,), slope (n, P), entries (P', 3): matrix (A 0, B 1, K 2, D 3, level 4), row, column. The
    other columns of the slope are the initial state's."""
    A, B, C, D, K, level, F = matrices
    n, nu, ny, P = len(A), B.shape[1], len(C), slope.shape[1]
    after, following = np.empty(n), np.empty_like(slope)
    for t in range(len(data)):
        u, y = data[t, :nu], data[t, nu : nu + ny]
        J = jacobian[t]
        for i in range(ny):
            e[t, i] = y[i] - level[i]
            for j in range(n):
                e[t, i] -= C[i, j] * state[j]
            for j in range(nu):
                e[t, i] -= D[i, j] * u[j]
            J[i] = 0.0
            for j in range(n):
                if C[i, j] != 0.0:
                    _added(J[i], -C[i, j], slope[j])
        for i in range(n):
            after[i] = 0.0
            for j in range(n):
                after[i] += A[i, j] * state[j]
            for j in range(nu):
                after[i] += B[i, j] * u[j]
            for j in range(ny):
                after[i] += K[i, j] * e[t, j]
            following[i] = 0.0
            for j in range(n):
                if F[i, j] != 0.0:
                    _added(following[i], F[i, j], slope[j])
        for k in range(len(entries)):
            which, i, j = entries[k]
            if which < 3:
                following[i, k] += state[j] if which == 0 else (u[j] if which == 1 else e[t, j])
                continue
            push = u[j] if which == 3 else 1.0
            J[i, k] -= push
            for m in range(n):
                following[m, k] -= K[m, i] * push
        for i in range(n):
            state[i] = after[i] if abs(after[i]) > TINY else 0.0
            for k in range(P):
                slope[i, k] = following[i, k] if abs(following[i, k]) > TINY else 0.0


@njit(error_model="numpy", cache=True)
def fold(data, starts, matrices, entries, weight, weights):
    """Of one record: loss, half its gradient (P,), Gauss-Newton matrix (P, P), moment of the residuals (ny,
    ny); data (N, nd), starts (n,) and (n, P), weight (ny, ny), weights (N, ny), or (0, ny) for none."""
    state, slope = starts[0].copy(), starts[1].copy()
    ny, P = len(weight), slope.shape[1]
    e, J = np.empty((BLOCK, ny)), np.empty((BLOCK, ny, P))
    flat, heavy, rows, turned = (
        np.empty((1, BLOCK * ny)),
        np.empty((1, BLOCK * ny)),
        np.empty((P, BLOCK * ny)),
        np.empty((P, BLOCK * ny)),
    )
    loss, gradient, hessian, moment = 0.0, np.zeros(P), np.zeros((P, P)), np.zeros((ny, ny))
    for start in range(0, len(data), BLOCK):
        N = min(BLOCK, len(data) - start)
        run(data[start : start + N], state, slope, matrices, entries, e[:N], J[:N])
        for t in range(N):
            for i in range(ny):
                if len(weights):
                    e[t, i] *= weights[start + t, i]
                    J[t, i] *= weights[start + t, i]
                flat[0, t * ny + i] = e[t, i]
                for k in range(P):
                    rows[k, t * ny + i] = J[t, i, k]
            for i in range(ny):
                for j in range(ny):
                    moment[i, j] += e[t, i] * e[t, j]
        _turned(flat, weight, N, heavy)
        _turned(rows, weight, N, turned)
        loss += _product(flat[0, : N * ny], heavy[0, : N * ny])
        for k in range(P):
            row = turned[k, : N * ny]
            gradient[k] += _product(row, flat[0, : N * ny])
            for m in range(k + 1):
                hessian[k, m] += _product(row, rows[m, : N * ny])
    for k in range(P):
        for m in range(k):
            hessian[m, k] = hessian[k, m]
    return loss, gradient, hessian, moment
