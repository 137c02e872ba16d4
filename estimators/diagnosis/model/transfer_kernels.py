"""Compiled transfer function of a model: its output, and the output's derivatives by its coefficients and its start."""

import numpy as np

from estimators.diagnosis.effects.kernels.recursion_kernels import compiled


@compiled
def rational(u, b, f, delay, start):  # pragma: no cover - compiled
    """Sum of B_j/F u_j with B_j = b[j, 0] z^-(1+delay) + ..., and 1/F of an impulse of shape `start`; infinite once it overflows."""
    n = u.shape[0]
    channels = b.shape[0]
    taps = b.shape[1]
    order = f.shape[0]
    y = np.zeros(n)
    for k in range(n):
        total = start[k] if k < start.shape[0] else 0.0
        for j in range(channels):
            for i in range(min(taps, k - delay)):
                total += b[j, i] * u[k - 1 - delay - i, j]
        for i in range(min(order, k)):
            total -= f[i] * y[k - 1 - i]
        if not abs(total) < 1e100:
            y[k:] = np.inf
            return y
        y[k] = total
    return y


@compiled
def derived(u, y, f, delay, taps, started):  # pragma: no cover - compiled
    """Derivatives of `rational`, one in each row: by f, by the coefficients of each input, and (`started`) by the start.

    Each is -y, an input or an impulse through 1/F, at its lags.
    """
    n = u.shape[0]
    channels = u.shape[1]
    order = f.shape[0]
    out = np.zeros((order + channels * taps + (order if started else 0), n))
    for source in range(channels + 2):
        row, count, lag = 0, order, 1
        if 0 < source <= channels:
            row, count, lag = order + (source - 1) * taps, taps, 1 + delay
        elif source > channels:
            row, count, lag = order + channels * taps, order if started else 0, 0
        if count == 0:
            continue
        for k in range(lag, n):
            if source == 0:
                total = -y[k - 1]
            elif source <= channels:
                total = u[k - lag, source - 1]
            else:
                total = 1.0 if k == 0 else 0.0
            for i in range(min(order, k)):
                total -= f[i] * out[row, k - 1 - i]
            if not abs(total) < 1e100:
                out[row, k:] = np.inf
                break
            out[row, k] = total
        for i in range(1, count):
            out[row + i, i:] = out[row, : n - i]
    return out
