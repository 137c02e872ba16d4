"""Compiled recursions of a linear model: its run on from past outputs, and the derivatives of its error."""

import numpy as np

from estimators.diagnosis.effects.kernels.recursion_kernels import compiled


@compiled
def continued(driven, a, past):  # pragma: no cover - compiled
    """Runs (N, m) of y(k) = driven(k) - a1 y(k-1) - ..., a without its leading 1, each after a column of past (n, m): y(-1), y(-2), ..."""
    length = driven.shape[0]
    n = a.shape[0]
    runs = past.shape[1]
    y = np.empty((length, runs))
    for k in range(length):
        for j in range(runs):
            total = driven[k]
            for i in range(n):
                total -= a[i] * (y[k - 1 - i, j] if i < k else past[i - k, j])
            y[k, j] = total
    return y


@compiled
def sensed(y, X, later, b, a, past, states):  # pragma: no cover - compiled
    """Rows (p + 1, N): derivatives by a, b and, with `states`, past of the run of y(k) = b X(k) - a1 y(k-1) - ... after past (n,), then y less
    the run; X (N, m), its columns `later` (m,) are the one before, moved by a sample, but for their first value."""
    length, m = X.shape
    n = a.shape[0]
    rows = n + m + (n if states else 0)
    Z = np.empty((rows + 1, length))
    run, pulse = Z[rows], np.empty(length)
    for k in range(length):
        total, one = 0.0, 1.0 if k == 0 else 0.0
        for i in range(m):
            total += b[i] * X[k, i]
        for i in range(n):
            total -= a[i] * (run[k - 1 - i] if i < k else past[i - k])
            one -= a[i] * pulse[k - 1 - i] if i < k else 0.0
        run[k], pulse[k] = total, one
    for r in range(n + m):
        lag = r < n
        first = -past[r] if lag else X[0, r - n]
        if (lag and r > 0) or (not lag and later[r - n]):  # moved, but for what came first
            Z[r, 0] = first
            for k in range(1, length):
                Z[r, k] = Z[r - 1, k - 1] + first * pulse[k]
            continue
        for k in range(length):
            total = first if k == 0 else (-run[k - 1] if lag else X[k, r - n])
            for i in range(min(n, k)):
                total -= a[i] * Z[r, k - 1 - i]
            Z[r, k] = total
    for r in range(n + m, rows):
        for k in range(length):
            ahead = r - n - m + k
            total = -a[ahead] if ahead < n else 0.0
            for i in range(min(n, k)):
                total -= a[i] * Z[r, k - 1 - i]
            Z[r, k] = total
    for k in range(length):
        run[k] = y[k] - run[k]
    return Z
