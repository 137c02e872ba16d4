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
def _products(x, length, found):
    """Adds the products x x' to the lower half: four by two rows at a time, so that what is read is multiplied more than once."""
    P = len(x)
    for k in range(0, P, 2):
        a, b = x[k, :length], x[min(k + 1, P - 1), :length]
        for m in range(0, k + 2, 4):
            p, q, r, s = x[m], x[min(m + 1, P - 1)], x[min(m + 2, P - 1)], x[min(m + 3, P - 1)]
            ap = aq = ar = a_s = bp = bq = br = bs = 0.0
            for t in range(length):
                ap += a[t] * p[t]
                aq += a[t] * q[t]
                ar += a[t] * r[t]
                a_s += a[t] * s[t]
                bp += b[t] * p[t]
                bq += b[t] * q[t]
                br += b[t] * r[t]
                bs += b[t] * s[t]
            for j, one, two in ((0, ap, bp), (1, aq, bq), (2, ar, br), (3, a_s, bs)):
                if m + j <= k:
                    found[k, m + j] += one
                if m + j <= k + 1 and k + 1 < P:
                    found[k + 1, m + j] += two


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
def fold(data, starts, matrices, entries, root, weights):
    """Of one record: loss, half its gradient (P,), Gauss-Newton matrix (P, P), moment of the residuals (ny,
    ny); data (N, nd), starts (n,) and (n, P), root (ny, ny) lower, the weight is root root'; weights (N, ny), or (0, ny) for none."""
    state, slope = starts[0].copy(), starts[1].copy()
    ny, P = len(root), slope.shape[1]
    e, J, heavy = np.empty((BLOCK, ny)), np.empty((BLOCK, ny, P)), np.empty(P + 1)
    rows, total = np.empty((P + 1, BLOCK * ny)), np.zeros((P + 1, P + 1))
    moment = np.zeros((ny, ny))
    for start in range(0, len(data), BLOCK):
        N = min(BLOCK, len(data) - start)
        run(data[start : start + N], state, slope, matrices, entries, e[:N], J[:N])
        for t in range(N):
            for i in range(ny):
                if len(weights):
                    e[t, i] *= weights[start + t, i]
                    for k in range(P):
                        J[t, i, k] *= weights[start + t, i]
            for i in range(ny):
                heavy[:] = 0.0
                for j in range(i, ny):
                    _added(heavy[:P], root[j, i], J[t, j])
                    heavy[P] += root[j, i] * e[t, j]
                    moment[j, i] += e[t, j] * e[t, i]
                for k in range(P + 1):
                    rows[k, t * ny + i] = heavy[k]
        _products(rows, N * ny, total)
    for i in range(ny):
        for j in range(i):
            moment[j, i] = moment[i, j]
    hessian = np.empty((P, P))
    for k in range(P):
        for m in range(k + 1):
            hessian[k, m] = hessian[m, k] = total[k, m]
    return total[P, P], total[P, :P].copy(), hessian, moment
