"""Compiled loops of events that a hidden level triggers: what an actuator gives, and how a residual is asked for them.

CasADi defines the same steps in `symbols.loops`; a test holds the two to 1e-9.
"""

import numpy as np

from estimators.diagnosis.effects.kernels.recursion_kernels import WITHIN, compiled


@compiled
def exceeded(first, last, mean):  # pragma: no cover - compiled
    """Mean of what a signal is above zero, that goes from one value to another; as along a straight line where it crosses zero."""
    if first >= 0.0 and last >= 0.0:
        return mean
    if first <= 0.0 and last <= 0.0:
        return 0.0
    above = max(first, last)
    return 0.5 * above * above / abs(last - first)


@compiled
def triggered(signal, p, adds, start, lead):  # pragma: no cover - compiled
    """Mean over each sample interval of a held signal behind a lag, which an event replaces by a value, or to which it adds that (`adds`).

    p: threshold, dose, duration, value, lag. A level rises by what the signal exceeds the threshold by; once it has risen by the dose, the
    event runs for its duration, after which the level starts again from nothing. It is empty for the first `lead` samples, and the lag
    has settled at `start`. `WITHIN` steps per sample, within which the level rises evenly.
    """
    out = np.empty_like(signal)
    h = 1.0 / WITHIN
    lag = max(p[4], 1e-9)
    stays = np.exp(-h / lag)
    closes = lag / h * (1.0 - stays)
    x, level, left = start, 0.0, 0.0
    for k in range(signal.shape[0]):
        total = 0.0
        for _ in range(WITHIN):
            off = x - signal[k]
            then, mean = signal[k] + off * stays, signal[k] + off * closes
            runs = 0.0  # share of the step that an event takes
            if k >= lead:
                if left > 0.0:
                    runs = min(left / h, 1.0)
                    left = max(left - h, 0.0)
                    level = 0.0
                rise = h * exceeded(x - p[0], then - p[0], mean - p[0])
                filled = level + (1.0 - runs) * rise
                if left == 0.0 and filled >= p[1]:
                    begins = (filled - p[1]) / rise
                    runs += begins
                    left = max(p[2] - begins * h, 0.0)
                    filled = 0.0
                level = filled if left == 0.0 else 0.0
            total += mean + (runs * p[3] if adds else runs * (p[3] - mean))
            x = then
        out[k] = total * h
    return out


@compiled
def between(values, at):  # pragma: no cover - compiled
    """A signal (N,) between its samples; at its last from there on."""
    i = int(at)
    if i >= values.shape[0] - 1:
        return values[-1]
    return values[i] + (at - i) * (values[i + 1] - values[i])


@compiled
def reached(filled, goal, first):  # pragma: no cover - compiled
    """Where a signal that does not fall, (N,), first reaches a value that it does reach, at or after a place."""
    low, high = int(first), filled.shape[0] - 1
    while high - low > 1:
        middle = (low + high) // 2
        if filled[middle] < goal:
            low = middle
        else:
            high = middle
    rise = filled[high] - filled[low]
    return max(low + (goal - filled[low]) / rise if rise > 0.0 else float(high), first)


@compiled
def scanned_events(filled, told, doses, duration, least):  # pragma: no cover - compiled
    """(M,) what events at each of the doses (M,) have in common with a residual: the squares of two sums over the number of events;
    none below a `least` number.

    filled (N + 1,): integral of what the input is above a threshold; told (2, N + 1): integrals of what a unit of the input at each sample
    would explain, and of what the input itself would.
    """
    out = np.zeros(doses.shape[0])
    n = filled.shape[0] - 1
    for i in range(doses.shape[0]):
        at, first, second, count = 0.0, 0.0, 0.0, 0
        while at < n:
            goal = between(filled, at) + doses[i]
            if not filled[n] > goal:
                break
            begins = reached(filled, goal, at)
            at = begins + duration
            first += between(told[0], at) - between(told[0], begins)
            second += between(told[1], at) - between(told[1], begins)
            count += 1
        if count >= least:
            out[i] = (first * first + second * second) / count
    return out
