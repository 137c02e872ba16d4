"""Compiled loops of which only the set point and what they drive are seen: an actuator of limited stroke or speed, a relay, a store.

CasADi defines the same steps in `symbols.loops`; a test holds the two to 1e-9.
"""

import numpy as np

from estimators.diagnosis.effects.kernels.plant_kernels import held_response
from estimators.diagnosis.effects.kernels.recursion_kernels import WITHIN, compiled, left_over, written

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
            left = left_over(abs(gap), p[3] if gap > 0.0 else p[4], lag, h, near)
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


@compiled
def geared_matrices(p, torque):  # pragma: no cover - compiled
    """Transitions (2, 4, 4) of a geared drive over one of `WITHIN` steps, out of contact and in it, and the responses (2, 4, 2) to the
    input and to the torque that half the play takes away."""
    own, damping, reaction, stiff, contact, friction = p[0] ** 2, p[1], p[2], p[3] ** 2, p[4], p[5]
    a, columns = np.zeros((4, 4)), np.zeros((4, 2))
    a[0, 1] = a[2, 3] = 1.0
    a[1, 0], a[1, 1], a[3, 3] = 0.0 if torque else -own, -damping, -friction
    columns[1, 0] = damping if torque else own
    phi, gamma = np.empty((2, 4, 4)), np.empty((2, 4, 2))
    phi[0], gamma[0] = held_response(a, columns, 1.0 / WITHIN)
    columns[1, 1], columns[3, 1] = reaction * stiff, -stiff
    for row, share in ((1, -reaction), (3, 1.0)):
        a[row, 0] += share * stiff
        a[row, 1] += share * contact
        a[row, 2] -= share * stiff
        a[row, 3] -= share * contact
    phi[1], gamma[1] = held_response(a, columns, 1.0 / WITHIN)
    return phi, gamma


@compiled
def geared_at_rest(p, start, torque):  # pragma: no cover - compiled
    """The states of a geared drive that has settled under a torque, or in the middle of its play where it stands still."""
    x = np.zeros(4)
    if torque:
        x[1] = x[3] = start * p[1] / max(p[1] + p[2] * p[5], 1e-300)
        x[0] = p[5] * x[3] / p[3] ** 2 + p[6] * np.sign(x[3])
    else:
        x[0] = x[2] = start
    return x


@compiled
def beyond(at, move, edge):  # pragma: no cover - compiled
    """The share of a step in which what is moved evenly is beyond an edge."""
    if move > 0.0:
        return min(max((at + move - edge) / move, 0.0), 1.0)
    if move < 0.0:
        return min(max((edge - at) / move, 0.0), 1.0)
    return 1.0 if at > edge else 0.0


@compiled
def geared(signal, p, start, torque, seen):  # pragma: no cover - compiled
    """One of the states (`seen`: angle and speed of the drive, of the load) at the end of each sample, of a drive that moves a load
    through an elastic gear with play: by its torque, or to a held set point as a servo.

    p: natural frequency of the servo, its damping, the load's share of its inertia, natural frequency of the gear on the load alone,
    its damping in contact, friction of the load, half the play; settled under `start`. `WITHIN` steps per sample, exact but for the ones
    in which contact comes or goes: a step in contact and one without, in the shares of it that an even motion would have.
    """
    out = np.empty_like(signal)
    phi, gamma = geared_matrices(p, torque)
    half = p[6]
    x, ahead = geared_at_rest(p, start, torque), np.zeros(4)
    h = 1.0 / WITHIN
    for k in range(signal.shape[0]):
        for _ in range(WITHIN):
            twist = x[0] - x[2]
            turn = h * (x[1] - x[3])
            above, below = beyond(twist, turn, half), beyond(-twist, -turn, half)
            for i in range(4):
                free, touching = gamma[0, i, 0] * signal[k], gamma[1, i, 0] * signal[k]
                for j in range(4):
                    free += phi[0, i, j] * x[j]
                    touching += phi[1, i, j] * x[j]
                ahead[i] = (
                    free + (above + below) * (touching - free) + (above - below) * gamma[1, i, 1] * half
                )
            x[:] = ahead
        if not written(out, k, x[seen]):
            return out
    return out


@compiled
def stored(signal, leak, level, ends, lead):  # pragma: no cover - compiled
    """State at the end of each sample of x' = u - level - leak x, held between two ends; it waits `lead` samples at its start, the
    third of them. Exact for an input that is held: it goes one way within a sample, and stays at the end that it meets."""
    out = np.empty_like(signal)
    stays = np.exp(-leak)
    fills = (1.0 - stays) / leak if leak > 1e-9 else 1.0
    x = ends[2]
    for k in range(signal.shape[0]):
        if k >= lead:
            x = min(max(stays * x + fills * (signal[k] - level), ends[0]), ends[1])
        out[k] = x
    return out


@compiled
def flow_at_rest(p, start, least):  # pragma: no cover - compiled
    """Flow and level that have settled under `start`."""
    w, leak = p[0] ** 2, p[2]
    level = start * w / (w + p[1] * leak)
    flow = max(leak * level / p[0], least)
    return np.array([flow, p[0] * flow / leak if leak > 0.0 else level])


@compiled
def flowing(signal, p, start, least, begun, lead):  # pragma: no cover - compiled
    """Level at the end of each sample that a flow with inertia fills, i' = w (u - v) - r i and v' = w i - g v, where the flow is held at
    or above its least.

    p: w, r, g. It begins `begun` (2,) off what has settled under `start`, and waits there for `lead` samples. `WITHIN` steps per
    sample, exact but for the ones in which the flow meets its end: without it and with it, in the shares of an even way.
    """
    out = np.empty_like(signal)
    h, w, leak = 1.0 / WITHIN, p[0], p[2]
    a, column = np.array([[-p[1], -w], [w, -leak]]), np.array([[w], [0.0]])
    phi, gamma = held_response(a, column, h)
    x = flow_at_rest(p, start, least) + begun
    x[0] = max(x[0], least)
    for k in range(signal.shape[0]):
        for _ in range(WITHIN if k >= lead else 0):
            flow = phi[0, 0] * x[0] + phi[0, 1] * x[1] + gamma[0, 0] * signal[k]
            level = phi[1, 0] * x[0] + phi[1, 1] * x[1] + gamma[1, 0] * signal[k]
            if flow < least:
                share = (x[0] - least) / (x[0] - flow) if x[0] > least else 0.0
                level = x[1] + share * (level - x[1])
                left = (1.0 - share) * h
                stays = np.exp(-leak * left)
                level = stays * level + w * least * ((1.0 - stays) / leak if leak > 1e-9 else left)
                flow = least
            x[0], x[1] = flow, level
        if not written(out, k, x[1]):
            return out
    return out


@compiled
def carried(signal, p, start):  # pragma: no cover - compiled
    """Position at the end of each sample of what rides on a moved base by a spring and a damper, x'' = w^2 (r - x) + c (r' - x'), where the
    base nears the signal with a lag and the damper has a constant for each way.

    p: w, c where the base gains on it, c where it falls back, the lag in samples; at rest at `start`. Midpoint steps, `WITHIN` of them.
    """
    out = np.empty_like(signal)
    h, stiff = 1.0 / WITHIN, p[0] ** 2
    near = np.exp(-0.5 * h / p[3])
    r, x, v = start, start, 0.0
    for k in range(signal.shape[0]):
        for _ in range(WITHIN):
            gain = (signal[k] - r) / p[3] - v
            force = stiff * (r - x) + (p[1] if gain > 0.0 else p[2]) * gain
            middle, speed = x + 0.5 * h * v, v + 0.5 * h * force
            r = signal[k] + (r - signal[k]) * near
            gain = (signal[k] - r) / p[3] - speed
            v += h * (stiff * (r - middle) + (p[1] if gain > 0.0 else p[2]) * gain)
            x += h * speed
            r = signal[k] + (r - signal[k]) * near
        if not written(out, k, x):
            return out
    return out


@compiled
def headed(signal, p, start):  # pragma: no cover - compiled
    """Power at the end of each sample of a turbine at the foot of a long pipe, head times the flow above idling, where the head is what
    drives the flow through the gate, h = (q / g)^2, and what the pipe leaves moves the water, q' = a (1 - k q^2 - h).

    p: a, k, the idling flow, and the lag in samples in which the gate follows the signal; it has settled at `start`. Midpoint steps,
    `WITHIN` of them.
    """
    out = np.empty_like(signal)
    h = 1.0 / WITHIN
    near = np.exp(-0.5 * h / p[3])
    g = start
    q = g / np.sqrt(1.0 + p[1] * g**2)
    for k in range(signal.shape[0]):
        for _ in range(WITHIN):
            middle = q + 0.5 * h * p[0] * (1.0 - p[1] * q**2 - (q / g) ** 2)
            g = signal[k] + (g - signal[k]) * near
            q += h * p[0] * (1.0 - p[1] * middle**2 - (middle / g) ** 2)
            g = signal[k] + (g - signal[k]) * near
        if not written(out, k, (q / g) ** 2 * (q - p[2])):
            return out
    return out


@compiled
def eliminated(signal, p, start):  # pragma: no cover - compiled
    """Content at the end of each sample of what loses by a way that saturates, x' = a (u - s x - m x / (k + |x|)) + out (z - x), and exchanges
    with a second content, z' = back (x - z); p: a, s, m, k, out, back. Both are at `start`. Midpoint steps, `WITHIN` of them."""
    out = np.empty_like(signal)
    h = 1.0 / WITHIN
    x = z = start
    for k in range(signal.shape[0]):
        for _ in range(WITHIN):
            loss = p[1] * x + p[2] * x / (p[3] + abs(x))
            middle = x + 0.5 * h * (p[0] * (signal[k] - loss) + p[4] * (z - x))
            other = z + 0.5 * h * p[5] * (x - z)
            loss = p[1] * middle + p[2] * middle / (p[3] + abs(middle))
            x += h * (p[0] * (signal[k] - loss) + p[4] * (other - middle))
            z += h * p[5] * (middle - other)
        if not written(out, k, x):
            return out
    return out


@compiled
def sideways(b, r, steer, p):  # pragma: no cover - compiled
    """Rates of side slip and yaw of a steered vehicle; p: stiffnesses of front and rear over mass and speed, how far yaw slips an axle, the
    rear's lever over the front's, the front's square over that of gyration, and a tyre's `B` and `C` of unit slope."""
    front = p[0] * np.sin(p[6] * np.arctan(p[5] * (b + r - steer))) / (p[5] * p[6])
    rear = p[1] * np.sin(p[6] * np.arctan(p[5] * (b - p[3] * r))) / (p[5] * p[6])
    return -front - rear - p[2] * r, p[4] * (p[3] * rear - front)


@compiled
def cornered(signal, p, steer, begun):  # pragma: no cover - compiled
    """Side slip and yaw rate (N, 2) at the end of each sample of a vehicle whose tyres' side forces saturate with their slip, `sideways` with
    its p, from `begun` (2,), its wheels steered to the signal from `steer` with a lag, p[7] in samples. Midpoint steps, `WITHIN` of them.
    """
    out = np.empty((signal.shape[0], 2))
    h = 1.0 / WITHIN
    near = np.exp(-0.5 * h / p[7])
    b, r = begun
    for k in range(signal.shape[0]):
        for _ in range(WITHIN):
            slip, yaw = sideways(b, r, steer, p)
            steer = signal[k] + (steer - signal[k]) * near
            slip, yaw = sideways(b + 0.5 * h * slip, r + 0.5 * h * yaw, steer, p)
            b, r = b + h * slip, r + h * yaw
            steer = signal[k] + (steer - signal[k]) * near
        out[k] = b, r
        if not np.isfinite(r):
            out[k:] = np.inf
            return out
    return out


@compiled
def three_point(signal, up, down, halt, zone, start):  # pragma: no cover - compiled
    """Mean over each sample interval of a motor that starts where a held command is more than `halt + zone` away, at `up` or `down` per
    sample, and halts `halt` before it; it stands at `start` before the record."""
    out = np.empty_like(signal)
    v, way = start, 0.0
    for k in range(signal.shape[0]):
        gap = signal[k] - v
        if abs(gap) > halt + zone:
            way = 1.0 if gap > 0.0 else -1.0
        rate = max(up if way > 0.0 else down, 1e-300)
        running = min(max((way * gap - halt) / rate, 0.0), 1.0) if way != 0.0 else 0.0
        out[k] = v + way * rate * running * (1.0 - 0.5 * running)
        v += way * rate * running
        if running < 1.0:
            way = 0.0
    return out


@compiled
def in_own_time(signal, starts_late, stops_late, pause, run):  # pragma: no cover - compiled
    """Mean over each sample interval of what takes a switched signal over so many samples late, and once it has fallen does not rise for a
    pause, nor fall for a run once it has risen."""
    out = np.empty_like(signal)
    v, way, taken, since, last = signal[0], 0, 0, 0.0, -1e300
    for k in range(signal.shape[0]):
        if k and signal[k] != signal[k - 1]:
            way, since = (1 if signal[k] > signal[k - 1] else -1), float(k)
        waits = 0.0
        if way != taken:
            due = max(
                since + (starts_late if way > 0 else stops_late), last + (pause if way > 0 else run), float(k)
            )
            waits = min(due - k, 1.0)
            if waits < 1.0:
                taken, last = way, due
        out[k] = waits * v + (1.0 - waits) * signal[k]
        if waits < 1.0:
            v = signal[k]
    return out
