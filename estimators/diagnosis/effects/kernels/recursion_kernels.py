"""Compiled twins of the recursive effects: play, rate limit, broken lines, tanks.

CasADi defines the same steps in `terms`; a test holds the two to 1e-9.
"""

import numpy as np
from numba import njit

WITHIN = 8
"""Steps per sample of a loop that winds up: of one that settles in two samples its midpoint steps are off by a thousandth."""

LEAST_LEFT = 0.02
"""Of a capacity at the start of a record, that is left of it however much has been drawn: what is empty has no time constant."""
SETTLING = 100
"""Halved steps towards where a loss that its own power changes has settled: beyond any share that can be told."""


def compiled(function):
    """Compile with a cache on disk, or without one where no folder for it can be written."""
    try:
        return njit(cache=True)(function)
    except RuntimeError:
        return njit(function)


LEAST_PACE = 0.02  # of a rate that changes with its signal: one that has stopped would hold for ever


@compiled
def play(signal, half_width, start=0.0):  # pragma: no cover - compiled
    """Output of a play (backlash) operator that stands at `start` before the record."""
    out = np.empty_like(signal)
    m = start
    for k in range(signal.shape[0]):
        v = signal[k]
        if m < v - half_width:
            m = v - half_width
        elif m > v + half_width:
            m = v + half_width
        out[k] = m
    return out


@compiled
def settled(signal, lead):  # pragma: no cover - compiled
    """The signal, at rest for the `lead` samples before its record instead of on its way there from zero."""
    out = signal.copy()
    if 0 < lead < signal.shape[0]:
        out[:lead] = signal[lead - 1]
    return out


@compiled
def reported(signal, least, start, beaten):  # pragma: no cover - compiled
    """The signal as last reported: before the record as `start`, then wherever it is further from that than the least step, or `beaten`."""
    out = np.empty_like(signal)
    last = start
    for k in range(signal.shape[0]):
        if beaten[k] or abs(signal[k] - last) > least:
            last = signal[k]
        out[k] = last
    return out


@compiled
def paced(signal, rate, change):  # pragma: no cover - compiled
    """A lag that follows the signal at a rate that changes with it: `LEAST_PACE` of the rate at least."""
    out = np.empty_like(signal)
    y = signal[0]
    for k in range(signal.shape[0]):
        y = signal[k] + (y - signal[k]) * np.exp(-rate * max(1.0 + change * signal[k], LEAST_PACE))
        out[k] = y
    return out


@compiled
def unpaced(signal, rate, change):  # pragma: no cover - compiled
    """The signal that such a lag has followed, by Newton's steps, and how much of its error the lag lets through.

    Where it hardly moves nothing says what it follows: no further beyond what it shows than half of its span.
    """
    x, through = signal.copy(), np.ones_like(signal)
    low, high = np.min(signal), np.max(signal)
    more = 0.5 * (high - low)
    for k in range(1, signal.shape[0]):
        before = signal[k - 1]
        guess = x[k - 1]
        for _ in range(8):
            pace = 1.0 + change * guess
            left = np.exp(-rate * max(pace, LEAST_PACE))
            slope = 1.0 - left + (guess - before) * left * (rate * change if pace > LEAST_PACE else 0.0)
            guess -= (guess + (before - guess) * left - signal[k]) / max(slope, 1e-3)
            guess = min(max(guess, low - more), high + more)
        x[k], through[k] = guess, 1.0 - left
    return x, through


@compiled
def size_of_late(size, rises, falls):  # pragma: no cover - compiled
    """The average of late of a size that had settled on its first value, by other time constants as it rises and as it falls."""
    out = np.empty_like(size)
    late, up, down = size[0], 1.0 - np.exp(-1.0 / rises), 1.0 - np.exp(-1.0 / falls)
    for k in range(size.shape[0]):
        out[k] = late
        more = size[k] - late
        late += (up if more > 0.0 else down) * more
    return out


@compiled
def levelled(signal, share, power, rises, falls):  # pragma: no cover - compiled
    """A signal over a power of 1 + share times its size of late, an average of other time constants as it rises and as it falls."""
    return signal * (1.0 + share * size_of_late(np.abs(signal), rises, falls)) ** -power


@compiled
def unplayed(signal, widths, weights):  # pragma: no cover - compiled
    """The signal that has a given sum with its plays of positive weights: by bisection, as the sum grows with it."""
    out = np.empty_like(signal)
    stood = np.full(len(widths), signal[0] / (1.0 + np.sum(weights)))
    reach = np.max(np.abs(signal)) + np.sum(weights * widths) + 1e-300
    for k in range(signal.shape[0]):
        low, high = -reach, reach
        for _ in range(50):  # to the last digits
            x = 0.5 * (low + high)
            total = x
            for i in range(len(widths)):
                total += weights[i] * min(max(stood[i], x - widths[i]), x + widths[i])
            if total < signal[k]:
                low = x
            else:
                high = x
        out[k] = x
        for i in range(len(widths)):
            stood[i] = min(max(stood[i], x - widths[i]), x + widths[i])
    return out


@compiled
def relay(signal, half_width):  # pragma: no cover - compiled
    """-1 or 1: a relay that switches up above `half_width` and down below -`half_width`, down at first."""
    out = np.empty_like(signal)
    state = -1.0
    for k in range(signal.shape[0]):
        if signal[k] > half_width:
            state = 1.0
        elif signal[k] < -half_width:
            state = -1.0
        out[k] = state
    return out


@compiled
def sticky(signal, stays, left, start, slides):  # pragma: no cover - compiled
    """A stem that stays at `start` while its command is within `stays` of it, and then jumps to `left` short of the command; there it
    sticks again, or `slides` on behind it until it halts or turns."""
    out = np.empty_like(signal)
    m, way, before = start, 0.0, signal[0]
    for k in range(signal.shape[0]):
        gap = signal[k] - m
        if not slides or (signal[k] - before) * way <= 0.0:
            way = 0.0
        if way == 0.0 and abs(gap) > stays:
            way = 1.0 if gap > 0.0 else -1.0
        if way * gap > left:
            m = signal[k] - way * left
        before = signal[k]
        out[k] = m
    return out


@compiled
def servo_mean(signal, up, down, lag, start):  # pragma: no cover - compiled
    """Mean over each sample interval of an actuator that nears a held command as a first-order lag, but no faster than `up`
    and `down` per sample, (1,) or of each sample; it stands at `start` before the record."""
    out = np.empty_like(signal)
    v = start
    whole = np.exp(-1.0 / max(lag, 1e-300))
    for k in range(signal.shape[0]):
        side = 1.0 if signal[k] > v else -1.0
        most = up if signal[k] > v else down
        rate = max(most[k] if len(most) > 1 else most[0], 1e-300)
        gap = abs(signal[k] - v)
        # at its full rate for a part of the interval, until the lag asks for less
        full = min(max(gap / rate - lag, 0.0), 1.0)
        left = gap - rate * full
        near = whole if full == 0.0 else 1.0 if full == 1.0 else np.exp(-(1.0 - full) / max(lag, 1e-300))
        out[k] = signal[k] - side * (0.5 * (gap + left) * full + left * lag * (1.0 - near))
        v = signal[k] - side * left * near
    return out


@compiled
def written(out, k, x):  # pragma: no cover - compiled
    """Whether a sample's value was written; where it has exploded, all from there on is infinite."""
    if not abs(x) < 1e100:
        out[k:] = np.inf
        return False
    out[k] = x
    return True


@compiled
def filled(signal, flow, p, lead):  # pragma: no cover - compiled
    """State at the end of each sample of g x' = rate (u - x) + fill f (bring - carry x), g' = fill f from the record's first sample
    on, 1 before; p: rate, fill, bring, carry, u and f before, where it had settled. Exact for a g of the middle of each of
    `WITHIN` steps.
    """
    out = np.empty_like(signal)
    g = 1.0
    h = 1.0 / WITHIN
    loss = p[0] + p[1] * p[3] * p[5]
    x = (p[0] * p[4] + p[1] * p[2] * p[5]) / loss if loss > 0.0 else p[4]
    for k in range(signal.shape[0]):
        loss = p[0] + p[1] * p[3] * flow[k]
        source = p[0] * signal[k] + p[1] * p[2] * flow[k]
        grows = p[1] * flow[k] if k >= lead else 0.0
        for _ in range(WITHIN):
            a = h / max(g + 0.5 * h * grows, LEAST_LEFT)
            stays = np.exp(-a * loss)
            x = x * stays + source * ((1.0 - stays) / loss if abs(a * loss) > 1e-9 else a)
            g = max(g + h * grows, LEAST_LEFT)
        if not written(out, k, x):
            return out
    return out


@compiled
def lagged(signal, times):  # pragma: no cover - compiled
    """First-order lag of a signal that is held over each sample, with a time constant of its own in each; it starts settled."""
    out = np.empty_like(signal)
    z = signal[0]
    for k in range(signal.shape[0]):
        z = signal[k] + (z - signal[k]) * np.exp(-1.0 / max(times[k], 1e-3))
        out[k] = z
    return out


@compiled
def used_up(signal, use, recovery, start):  # pragma: no cover - compiled
    """Mean over each sample of a held signal times its gain, g' = recovery (1 - g) - use |signal| g; settled at `start`."""
    out = np.empty_like(signal)
    g = recovery / (recovery + use * abs(start))
    for k in range(signal.shape[0]):
        rate = recovery + use * abs(signal[k])
        rest, stays = recovery / rate, np.exp(-rate)
        out[k] = signal[k] * (rest + (g - rest) * (1.0 - stays) / rate)
        g = rest + (g - rest) * stays
    return out


@compiled
def warm_rest(level, share, heat):  # pragma: no cover - compiled
    """State and slow state of `warmed` that have settled under a constant input."""
    s = 0.0
    for _ in range(SETTLING):
        s += 0.5 * (level * level / (1.0 + share * (1.0 - np.exp(-heat * s))) - s)
    return level / (1.0 + share * (1.0 - np.exp(-heat * s))), s


@compiled
def warmed(signal, rate, share, p, start):  # pragma: no cover - compiled
    """State at the end of each sample of x' = rate (u - b x), b = 1 + share (1 - exp(-heat s)), s' = pace (b x^2 - s): a loss that
    changes with a slow state that its own power feeds; p: heat, pace; settled at `start`. Midpoint steps.
    """
    out = np.empty_like(signal)
    h = 1.0 / WITHIN
    x, s = warm_rest(start, share, p[0])
    for k in range(signal.shape[0]):
        for _ in range(WITHIN):
            b = 1.0 + share * (1.0 - np.exp(-p[0] * s))
            middle = x + 0.5 * h * rate * (signal[k] - b * x)
            then = s + 0.5 * h * p[1] * (b * x * x - s)
            b = 1.0 + share * (1.0 - np.exp(-p[0] * then))
            x += h * rate * (signal[k] - b * middle)
            s += h * p[1] * (b * middle * middle - then)
        if not written(out, k, x):
            return out
    return out


@compiled
def rate_limited(signal, rate, start):  # pragma: no cover - compiled
    """Command that changes by at most `rate` from one sample to the next, and is held between them."""
    out = np.empty_like(signal)
    v = start
    for k in range(signal.shape[0]):
        v += min(max(signal[k] - v, -rate), rate)
        out[k] = v
    return out


@compiled
def left_over(gap, rate, lag, h, near):  # pragma: no cover - compiled
    """What is left of a gap after a step h of a lag that closes it no faster than a rate; `near` of it where no part of the step is."""
    full = min(max(gap / rate - lag, 0.0), h)
    left = gap - rate * full
    if full == 0.0:
        return left * near
    return left * np.exp((full - h) / lag) if full < h else left


@compiled
def trailed(signal, up, down, lag):  # pragma: no cover - compiled
    """Readings of a sensor that nears its signal with a lag, but no faster than one rate up and another down per sample.

    It starts on the signal, which moves evenly from sample to sample: `WITHIN` steps in each, with that of its middle.
    """
    out = np.empty_like(signal)
    v = signal[0]
    h = 1.0 / WITHIN
    near = np.exp(-h / lag)
    for k in range(signal.shape[0]):
        before = signal[max(k - 1, 0)]
        for i in range(WITHIN):
            gap = before + (i + 0.5) * h * (signal[k] - before) - v
            left = left_over(abs(gap), up if gap > 0.0 else down, lag, h, near)
            v += gap - left if gap > 0.0 else gap + left
        out[k] = v
    return out


@compiled
def hinges(x, c):  # pragma: no cover - compiled
    """x + sum c[2i] max(x - c[2i + 1], 0): a broken line of slope 1 at the far left."""
    out = np.empty_like(x)
    for k in range(x.shape[0]):
        total = x[k]
        for i in range(0, c.shape[0], 2):
            if x[k] > c[i + 1]:
                total += c[i] * (x[k] - c[i + 1])
        out[k] = total
    return out


@compiled
def tank_levels(u, p, x0, steps):  # pragma: no cover - compiled
    """Levels of two tanks in series with square-root outflow; the first overflows, partly into the second.

    x1' = a u + b - k1 sqrt(x1) - spill, x2' = k2 sqrt(x1) - k3 sqrt(x2) + share spill, with
    p = (a, b, k1, k2, k3, brim, share); `spill` is whatever would raise the first tank above its brim.
    """
    n = u.shape[0]
    out = np.empty((n, 2))
    x1, x2 = x0[0], x0[1]
    h = 1.0 / steps
    for k in range(n):
        out[k, 0] = x1
        out[k, 1] = x2
        for _ in range(steps):
            r1 = np.sqrt(max(x1, 0.0))
            r2 = np.sqrt(max(x2, 0.0))
            d1 = p[0] * u[k] + p[1] - p[2] * r1
            d2 = p[3] * r1 - p[4] * r2
            y1 = max(x1 + h * d1, 0.0)
            y2 = max(x2 + h * d2, 0.0)
            s1 = np.sqrt(y1)
            s2 = np.sqrt(y2)
            x1 = x1 + 0.5 * h * (d1 + p[0] * u[k] + p[1] - p[2] * s1)
            spill = 0.0
            if x1 > p[5]:
                spill = x1 - p[5]
                x1 = p[5]
            if x1 < 0.0:
                x1 = 0.0
            x2 = max(x2 + 0.5 * h * (d2 + p[3] * s1 - p[4] * s2) + p[6] * spill, 0.0)
    return out
