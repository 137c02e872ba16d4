"""Compiled recursion of a linear model: its run on from past outputs."""

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
