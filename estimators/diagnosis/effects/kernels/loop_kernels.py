"""Compiled loops of which only the set point and what they drive are seen: an actuator of limited stroke or speed, a relay.

CasADi defines the same steps in `symbols.parts`; a test holds the two to 1e-9.
"""

import numpy as np

from estimators.diagnosis.effects.kernels.recursion_kernels import WITHIN, compiled, written

COURSE = 2
"""Which of what a steered loop moves is seen: its plant, its actuator, or the plant's integral, which is what it steers then."""


@compiled
def wound_up(signal, pace, proportional, integral, low, high, start):  # pragma: no cover - compiled
    """What a first-order plant reaches by the end of each sample, whose actuator between two limits a PI controller moves after a
    held set point; it has settled at `start`, or at the limit before it. Midpoint steps, `WITHIN` of them per sample.
    """
    out = np.empty_like(signal)
    x = min(max(start, low), high)
    i = x
    h = 1.0 / WITHIN
    for k in range(signal.shape[0]):
        for _ in range(WITHIN):
            e = signal[k] - x
            middle = x + 0.5 * h * pace * (min(max(proportional * e + i, low), high) - x)
            then = i + 0.5 * h * integral * e
            e = signal[k] - middle
            x += h * pace * (min(max(proportional * e + then, low), high) - middle)
            i += h * integral * e
        if not written(out, k, x):
            return out
    return out


@compiled
def steered_loop(signal, p, start, which):  # pragma: no cover - compiled
    """What a first-order plant (`which` 0) or the actuator before it (1) reaches by the end of each sample, where a PI controller
    moves the actuator after a held set point: it nears its command with a lag, but no faster than one rate up, another down.
    Or (`COURSE`) the plant's integral, in proportion to how far it is off, while the plant's own state damps it.

    p: pace of the plant, proportional, integral, rate up, rate down, lag, and a lag between actuator and plant; settled at
    `start`. `WITHIN` steps per sample, each with the command of its middle, the lags exact.
    """
    out = np.empty_like(signal)
    course = which == COURSE
    x = 0.0 if course else start
    z, i, s, at = x, x, x, start
    h = 1.0 / WITHIN
    pace, proportional, integral, lag = p[0], p[1], p[2], max(p[5], 1e-9)
    still = np.exp(-pace * h)
    stays = np.exp(-h / max(p[6], 1e-9))
    near = np.exp(
        -h / lag
    )  # where no part of a step is at the full rate; where all of it is, nothing is left to near
    for k in range(signal.shape[0]):
        for _ in range(WITHIN):
            e = signal[k] - x
            middle = signal[k] - x - 0.5 * h * pace * (z - x)
            if course:
                gap = integral * (signal[k] - at - 0.5 * h * x) + proportional * (middle - signal[k]) - s
            else:
                gap = proportional * middle + i + 0.5 * h * integral * e - s
            rate = p[3] if gap > 0.0 else p[4]
            full = min(max(abs(gap) / rate - lag, 0.0), h)
            left = abs(gap) - rate * full
            if full == 0.0:
                left *= near
            elif full < h:
                left *= np.exp(-(h - full) / lag)
            move = abs(gap) - left
            then = s + (move if gap > 0.0 else -move)
            drive = z
            z = 0.5 * (s + then) + (z - 0.5 * (s + then)) * stays
            drive = 0.5 * (drive + z)
            at += 0.5 * h * x
            x = drive + (x - drive) * still
            at += 0.5 * h * x
            s = then
            i += h * integral * middle
        if not written(out, k, at if course else (x if which == 0 else s)):
            return out
    return out


@compiled
def switched(signal, rate, push, share, low, high, start):  # pragma: no cover - compiled
    """What a lag reaches by the end of each sample, x' = rate (u - x + s (push + share x)), while a relay is on, s = 1, which
    switches on above `high` and off below `low`; off before, where it may be. Exact between the ends of `WITHIN` steps.
    """
    out = np.empty_like(signal)
    on = start > high
    x = (start + push) / (1.0 - share) if on and share < 1.0 else start
    passive = np.exp(-rate / WITHIN)
    active = np.exp(-rate * (1.0 - share) / WITHIN)
    for k in range(signal.shape[0]):
        for _ in range(WITHIN):
            if on:
                rest = (signal[k] + push) / (1.0 - share) if share != 1.0 else x
                x = rest + (x - rest) * active
            else:
                x = signal[k] + (x - signal[k]) * passive
            on = x > high or (on and x >= low)
        if not written(out, k, x):
            return out
    return out
