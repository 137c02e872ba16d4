"""The compiled cubic spline through equal steps, for sensors that are read at other times: SciPy's, without its setting up."""

import numpy as np

from estimators.diagnosis.effects.kernels.recursion_kernels import compiled


@compiled
def read_between(y, at):  # pragma: no cover - compiled
    """Values of the not-a-knot cubic spline through (0, y[0]), (1, y[1]).. at other places; the first and the last value beyond."""
    n, bend = y.shape[0], np.zeros(y.shape[0])
    if n > 2:
        for i in range(1, n - 1):
            bend[i] = y[i + 1] - 2.0 * y[i] + y[i - 1]
        # the first and the last cubic are those beside them: there the bend is the second difference itself
        pivot, last = np.zeros(n), bend[n - 2]
        for i in range(2, n - 2):
            row = 6.0 * bend[i] - bend[i - 1] - (last if i == n - 3 else 0.0)
            pivot[i] = 1.0 / (4.0 - pivot[i - 1])
            bend[i] = row * pivot[i]
        for i in range(n - 4, 1, -1):
            bend[i] -= pivot[i] * bend[i + 1]
        bend[0] = 2.0 * bend[1] - bend[2] if n > 3 else last
        bend[n - 1] = 2.0 * bend[n - 2] - bend[n - 3] if n > 3 else last
    out = np.empty(at.shape[0])
    for k in range(at.shape[0]):
        t = min(max(at[k], 0.0), n - 1.0)
        if not np.isfinite(t):
            out[k] = np.nan
        elif n == 1:
            out[k] = y[0]
        else:
            i = min(int(t), n - 2)
            b = t - i
            a = 1.0 - b
            out[k] = a * y[i] + b * y[i + 1] + ((a**3 - a) * bend[i] + (b**3 - b) * bend[i + 1]) / 6.0
    return out
