"""The output of a sampled linear model between its samples, the input held: what a play at the output follows."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.model.transfer_kernels import rational
from estimators.residual.algebra import delayed

Array = NDArray[Any]


def between_samples(U: Array, b: Array, f: Array, delay: int, by: int) -> Array | None:
    """Values of B/F u at `by` equal steps per sample, exact for an input that is held over each interval.

    Shapes: U (N, nu), b (nu, taps), f (n,), returns (N, by).

    With x(k+1) = A x(k) + e u(k) in companion form, x(k+s) = A^s x(k) + (A^s - I)(A - I)^-1 e u(k), 0 <= s <
    1.
    """
    n, taps = len(f), b.shape[1]
    if taps > n or n == 0:
        return None
    A = np.zeros((n, n))
    A[0] = -f
    A[np.arange(1, n), np.arange(n - 1)] = 1.0
    poles, V = np.linalg.eig(A)
    if np.any((np.abs(poles) < 1e-6) | ((np.abs(np.imag(poles)) < 1e-9) & (np.real(poles) <= 0))):
        return None
    try:
        inverse = np.linalg.inv(V)
        if np.abs(inverse).max() > 1e8:  # the columns of V have length 1
            return None
        e = np.zeros(n)
        e[0] = 1.0
        settled = np.linalg.solve(A - np.eye(n), e)
    except np.linalg.LinAlgError:
        return None
    steps = np.arange(by) / by
    powers = np.real((V * (poles.astype(complex)[None, :] ** steps[:, None])[:, None, :]) @ inverse)
    out = np.zeros((len(U), by))
    for j in range(U.shape[1]):
        u = delayed(U[:, j : j + 1], [delay])[:, 0]
        w = rational(np.ascontiguousarray(u[:, None]), np.ones((1, 1)), f, 0, np.zeros(0))
        X = delayed(w[:, None], range(n))
        c = np.concatenate((b[j], np.zeros(n - taps)))
        rows = c @ powers
        out += X @ rows.T + u[:, None] * (rows @ settled - c @ settled)
    return out if np.all(np.isfinite(out)) else None
