"""Free run of a small recurrent network, and its derivatives by all parameters: compiled.

x(k+1) = A x + B w + E tanh(F [x, w] + g),  y = C x + D w + K tanh(F [x, w] + g) + d
"""

import numpy as np

from estimators.diagnosis.effects.kernels.recursion_kernels import compiled


@compiled
def free_run(A, B, E, F, g, C, D, K, d, w):  # pragma: no cover - compiled
    """(N,) output under inputs w (N, m), from the state zero."""
    n, m, h = A.shape[0], w.shape[1], g.shape[0]
    y, x, ahead = np.empty(w.shape[0]), np.zeros(n), np.empty(n)
    for k in range(w.shape[0]):
        s = d[0]
        for i in range(n):
            s += C[i] * x[i]
            v = 0.0
            for j in range(n):
                v += A[i, j] * x[j]
            for j in range(m):
                v += B[i, j] * w[k, j]
            ahead[i] = v
        for j in range(m):
            s += D[j] * w[k, j]
        for q in range(h):
            v = g[q]
            for j in range(n):
                v += F[q, j] * x[j]
            for j in range(m):
                v += F[q, n + j] * w[k, j]
            t = np.tanh(v)
            s += K[q] * t
            for i in range(n):
                ahead[i] += E[i, q] * t
        y[k] = s
        for i in range(n):
            x[i] = ahead[i]
    return y


@compiled
def derivatives(A, B, E, F, g, C, D, K, d, w):  # pragma: no cover - compiled
    """(N,) output and (N, p) its derivatives by A, B, E, F (each by rows), g, C, D, K, d."""
    N, n, m, h = w.shape[0], A.shape[0], w.shape[1], g.shape[0]
    at_b = n * n
    at_e = at_b + n * m
    at_f = at_e + n * h
    at_g = at_f + h * (n + m)
    at_c = at_g + h
    at_d = at_c + n
    at_k = at_d + m
    p = at_k + h + 1
    y, J = np.empty(N), np.zeros((N, p))
    S, later = np.zeros((n, p)), np.empty((n, p))
    x, ahead, t = np.zeros(n), np.empty(n), np.empty(h)
    M, c = np.empty((n, n)), np.empty(n)
    for k in range(N):
        s = d[0]
        for i in range(n):
            s += C[i] * x[i]
            c[i] = C[i]
            for j in range(n):
                M[i, j] = A[i, j]
        for j in range(m):
            s += D[j] * w[k, j]
            J[k, at_d + j] += w[k, j]
        for q in range(h):
            v = g[q]
            for j in range(n):
                v += F[q, j] * x[j]
            for j in range(m):
                v += F[q, n + j] * w[k, j]
            t[q] = np.tanh(v)
            s += K[q] * t[q]
            slope = 1.0 - t[q] * t[q]
            for j in range(n):
                f = F[q, j] * slope
                c[j] += K[q] * f
                J[k, at_f + q * (n + m) + j] += K[q] * slope * x[j]
                for i in range(n):
                    M[i, j] += E[i, q] * f
            for j in range(m):
                J[k, at_f + q * (n + m) + n + j] += K[q] * slope * w[k, j]
            J[k, at_g + q] += K[q] * slope
            J[k, at_k + q] += t[q]
        y[k] = s
        J[k, p - 1] += 1.0
        for i in range(n):
            J[k, at_c + i] += x[i]
            for a in range(p):
                J[k, a] += c[i] * S[i, a]
            for a in range(p):
                later[i, a] = 0.0
            v = 0.0
            for j in range(n):
                v += A[i, j] * x[j]
                for a in range(p):
                    later[i, a] += M[i, j] * S[j, a]
                later[i, i * n + j] += x[j]
            for j in range(m):
                v += B[i, j] * w[k, j]
                later[i, at_b + i * m + j] += w[k, j]
            for q in range(h):
                v += E[i, q] * t[q]
                later[i, at_e + i * h + q] += t[q]
                slope = (1.0 - t[q] * t[q]) * E[i, q]
                for j in range(n):
                    later[i, at_f + q * (n + m) + j] += slope * x[j]
                for j in range(m):
                    later[i, at_f + q * (n + m) + n + j] += slope * w[k, j]
                later[i, at_g + q] += slope
            ahead[i] = v
        S, later = later, S
        for i in range(n):
            x[i] = ahead[i]
    return y, J
