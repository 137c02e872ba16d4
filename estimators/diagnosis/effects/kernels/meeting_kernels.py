"""Compiled loops of two inputs that meet behind lags of their own: one grows what the other does, or how fast it is lost.

CasADi has the same steps in `symbols/meeting`; a test holds the two together.
"""

import numpy as np

from estimators.diagnosis.effects.kernels.recursion_kernels import compiled

WITHIN = 4
"""Steps per sample, each at its middle: of lags of two samples they are off by a thousandth."""
LOWEST = 0.02  # of what a power below one is taken: it grows without end where that comes to nothing
STEEPEST = 40.0  # exponent from which on nothing grows any more
SETTLING = 200  # steps towards a rest at which what is lost keeps the other input off its own
SLOWEST = 1e-9  # loss in a step, below which what is driven adds up
LEAST = 1e-300  # a loss that no quotient by it leaves without a number


@compiled
def growth(d, slope, power):  # pragma: no cover - compiled
    """What a deviation makes of a coefficient that is one without it: (1 + slope d / power)^power, and exp(slope d) at a power of none."""
    if power == 0.0:
        return np.exp(min(max(slope * d, -STEEPEST), STEEPEST))
    base = 1.0 + slope * d / power
    if power == 1.0:
        return base
    if power == 2.0:
        return base * base
    return max(base, LOWEST) ** power


@compiled
def met(one, other, law, lags, start):  # pragma: no cover - compiled
    """(N,) the mean over each sample of an input's lag above a level, times the growth by another's; law: level, slope, centre, power."""
    out = np.empty(one.shape[0])
    w, v = start
    h = 1.0 / WITHIN
    for k in range(one.shape[0]):
        total = 0.0
        for _ in range(WITHIN):
            middle = one[k] + (w - one[k]) * np.exp(-0.5 * h / lags[0])
            beside = other[k] + (v - other[k]) * np.exp(-0.5 * h / lags[1])
            total += (middle - law[0]) * growth(beside - law[2], law[1], law[3])
            w = one[k] + (w - one[k]) * np.exp(-h / lags[0])
            v = other[k] + (v - other[k]) * np.exp(-h / lags[1])
        out[k] = total * h
    return out


@compiled
def at_rest(one, other, law):  # pragma: no cover - compiled
    """What is left of two constant inputs, and what the second has come to; law: rate, slope, share, rise, centre, power, drive."""
    v, x = other, 0.0
    for _ in range(SETTLING):
        s = growth(v - law[4], law[1], law[5])
        x = one * max(s, 0.0) ** law[6] / max(1.0 - law[2] + law[2] * max(s, 0.0), LEAST)
        v = other + law[3] * s * x
    return x, v


@compiled
def lost(one, other, law, lags, start):  # pragma: no cover - compiled
    """(N,) at the end of each sample, x' = rate (s^drive w - (1 - share + share s) x), where s is the growth by another input, which what
    is lost raises."""
    out = np.empty(one.shape[0])
    w, x, v = start
    h = 1.0 / WITHIN
    half, whole = 1.0 - np.exp(-0.5 * h / lags[1]), 1.0 - np.exp(-h / lags[1])
    for k in range(one.shape[0]):
        for _ in range(WITHIN):
            middle = one[k] + (w - one[k]) * np.exp(-0.5 * h / lags[0])
            w = one[k] + (w - one[k]) * np.exp(-h / lags[0])
            beside = v + half * (other[k] + law[3] * growth(v - law[4], law[1], law[5]) * x - v)
            s = max(growth(beside - law[4], law[1], law[5]), 0.0)
            loss = law[0] * h * (1.0 - law[2] + law[2] * s)
            drive = law[0] * h * s ** law[6] * middle
            left = np.exp(-loss)
            y = x * left + (drive * (1.0 - left) / loss if loss > SLOWEST else drive)
            v += whole * (other[k] + law[3] * s * 0.5 * (x + y) - v)
            x = y
        out[k] = x
    return out
