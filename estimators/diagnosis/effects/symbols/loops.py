"""Loops and limited rates, as parts of a step."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.kernels.loop_kernels import (
    COURSE,
    flow_at_rest,
    geared_at_rest,
    geared_matrices,
)
from estimators.diagnosis.effects.kernels.plant_kernels import held_response
from estimators.diagnosis.effects.kernels.recursion_kernels import WITHIN
from estimators.diagnosis.effects.loops.flows import FLOWS, of_flow, of_penstock
from estimators.diagnosis.effects.loops.geared import GEARED, of_drive
from estimators.diagnosis.effects.loops.stores import STORES, cleared_at, ends_of, of_clearance
from estimators.diagnosis.effects.loops.triggered import held_to
from estimators.diagnosis.effects.loops.vehicles import at_rest, of_strut, of_tyres
from estimators.diagnosis.effects.sensing.rates import limits
from estimators.diagnosis.effects.symbols import terms
from estimators.diagnosis.effects.symbols.wiring import Wiring

Array = NDArray[Any]


def _servo(which: int) -> Callable[[Wiring, Any, Array], Any]:
    def limited(w: Wiring, x: Any, p: Array) -> Any:
        s = w.state(w.value(x))
        out = terms.servo_step()(s.x, x, abs(p[0]), abs(p[len(p) // 2]), abs(p[2]) if len(p) > 2 else 0.0)
        s.after = out[0]
        return out[which]

    return limited


def _three_point(w: Wiring, x: Any, p: Array) -> Any:
    up, down, halt, zone = (max(abs(float(v)), 1e-300) for v in p)
    s, ca = w.state([w.value(x), 0.0]), w.ca
    v, gap = s.x[0], x - s.x[0]
    way = ca.if_else(ca.fabs(gap) > halt + zone, ca.sign(gap), s.x[1])
    rate = ca.if_else(way > 0.0, up, down)
    running = ca.if_else(way == 0.0, 0.0, ca.fmin(ca.fmax((way * gap - halt) / rate, 0.0), 1.0))
    s.after = ca.vertcat(v + way * rate * running, ca.if_else(running < 1.0, 0.0, way))
    return v + way * rate * running * (1.0 - 0.5 * running)


def _wound_up(w: Wiring, x: Any, p: Array) -> Any:
    pace, proportional, integral = (abs(float(v)) for v in p[:3])
    level = float(np.clip(w.value(x), p[3], p[4]))
    s = w.state([level, level])
    y, i, h = s.x[0], s.x[1], 1.0 / WITHIN
    limited = lambda e, i: w.ca.fmin(w.ca.fmax(proportional * e + i, p[3]), p[4])
    for _ in range(WITHIN):
        middle, then = y + 0.5 * h * pace * (limited(x - y, i) - y), i + 0.5 * h * integral * (x - y)
        y, i = y + h * pace * (limited(x - middle, then) - middle), i + h * integral * (x - middle)
    s.after = w.ca.vertcat(y, i)
    return y


def _closed(ca: Any, gap: Any, limits: tuple[float, float, float]) -> Any:
    """What a lag closes of a gap in one of `WITHIN` steps, no faster than its rates up and down."""
    (up, down, lag), h, size = limits, 1.0 / WITHIN, ca.fabs(gap)
    rate = ca.if_else(gap > 0.0, up, down)
    full = ca.fmin(ca.fmax(size / rate - lag, 0.0), h)
    return ca.sign(gap) * (size - (size - rate * full) * ca.exp((full - h) / lag))


def _steered(which: int) -> Callable[[Wiring, Any, Array], Any]:
    def steered(w: Wiring, x: Any, p: Array) -> Any:
        pace, proportional, integral, up, down, lag, behind = (max(abs(float(v)), 1e-9) for v in p)
        start = w.value(x)
        state = w.state([0.0, 0.0, 0.0, 0.0, start] if which == COURSE else [start] * 5)
        h = 1.0 / WITHIN
        y, z, i, s, at = (state.x[j] for j in range(5))
        stays, still = np.exp(-h / behind), np.exp(-h * pace)
        for _ in range(WITHIN):
            e = x - y
            middle = e - 0.5 * h * pace * (z - y)
            if which == COURSE:
                gap = integral * (x - at - 0.5 * h * y) + proportional * (middle - x) - s
            else:
                gap = proportional * middle + i + 0.5 * h * integral * e - s
            then = s + _closed(w.ca, gap, (up, down, lag))
            drive, z = z, 0.5 * (s + then) + (z - 0.5 * (s + then)) * stays
            drive = 0.5 * (drive + z)
            at = at + 0.5 * h * y
            y, s, i = drive + (y - drive) * still, then, i + h * integral * middle
            at = at + 0.5 * h * y
        state.after = w.ca.vertcat(y, z, i, s, at)
        return (y, s, at)[which]

    return steered


def _switched(w: Wiring, x: Any, p: Array) -> Any:
    rate, push, share, (low, high) = abs(float(p[0])), float(p[1]), float(p[2]), sorted(map(float, p[3:]))
    level = w.value(x)
    first = level > high
    s = w.state([(level + push) / (1.0 - share) if first and share < 1.0 else level, float(first)])
    y, on, passive, active = s.x[0], s.x[1], np.exp(-rate / WITHIN), np.exp(-rate * (1.0 - share) / WITHIN)
    for _ in range(WITHIN):
        rest = (x + push) / (1.0 - share) if share != 1.0 else y
        y = w.ca.if_else(on > 0.5, rest + (y - rest) * active, x + (y - x) * passive)
        on = w.ca.logic_or(y > high, w.ca.logic_and(on > 0.5, y >= low))
    s.after = w.ca.vertcat(y, on)
    return y


def _trailed(w: Wiring, x: Any, p: Array) -> Any:
    s, h = w.state([w.value(x)] * 2), 1.0 / WITHIN
    v, before = s.x[0], s.x[1]
    for i in range(WITHIN):
        v = v + _closed(w.ca, before + (i + 0.5) * h * (x - before) - v, limits(p))
    s.after = w.ca.vertcat(v, x)
    return v


def _geared(torque: bool, seen: int) -> Callable[[Wiring, Any, Array], Any]:
    def geared(w: Wiring, x: Any, p: Array) -> Any:
        p, ca = of_drive(p, torque), w.ca
        (free, touching), (push, twisted) = geared_matrices(p, torque)
        s, half, h = w.state(geared_at_rest(p, w.value(x), torque)), float(p[6]), 1.0 / WITHIN
        after, clip = s.x, lambda v: ca.fmin(ca.fmax(v, 0.0), 1.0)

        def beyond(at: Any, move: Any) -> Any:
            share = lambda left: clip(left / ca.if_else(move == 0.0, 1.0, move))
            moved = ca.if_else(move > 0.0, share(at + move - half), share(half - at))
            return ca.if_else(move == 0.0, ca.if_else(at > half, 1.0, 0.0), moved)

        for _ in range(WITHIN):
            twist, turn = after[0] - after[2], h * (after[1] - after[3])
            above, below = beyond(twist, turn), beyond(-twist, -turn)
            loose = ca.mtimes(free, after) + push[:, 0] * x
            held = ca.mtimes(touching, after) + twisted[:, 0] * x
            after = loose + (above + below) * (held - loose) + (above - below) * half * twisted[:, 1]
        s.after = after
        return after[seen]

    return geared


def _stored(ends: tuple[float, float]) -> Callable[[Wiring, Any, Array], Any]:
    def stored(w: Wiring, x: Any, p: Array) -> Any:
        (low, high, start), leak = ends_of(p, ends), abs(float(p[0]))
        s, stays = w.state(start), float(np.exp(-leak))
        filled = stays * s.x + ((1.0 - stays) / leak if leak > 1e-9 else 1.0) * (x - p[1])
        held = w.ca.fmin(w.ca.fmax(filled, low), high)
        s.after = w.ca.if_else(w.k < 0.0, s.x, held)  # it waits before the record
        return s.after

    return stored


def _flowed(way: float) -> Callable[[Wiring, Any, Array], Any]:
    def flowed(w: Wiring, x: Any, p: Array) -> Any:
        ca, h, (plant, least, _) = w.ca, 1.0 / WITHIN, of_flow(p, way)
        fast, _, leak = map(float, plant)
        phi, gamma = held_response(
            np.array([[-plant[1], -fast], [fast, -leak]]), np.array([[fast], [0.0]]), h
        )
        s = w.state(flow_at_rest(plant, way * w.value(x), least))
        after = s.x
        for _ in range(WITHIN):
            free = ca.mtimes(phi, after) + gamma[:, 0] * way * x
            fallen = after[0] - free[0]
            share = ca.if_else(
                after[0] > least, (after[0] - least) / ca.if_else(fallen == 0.0, 1.0, fallen), 0.0
            )
            level, left = after[1] + share * (free[1] - after[1]), (1.0 - share) * h
            stays = ca.exp(-leak * left)
            level = stays * level + fast * least * ((1.0 - stays) / leak if leak > 1e-9 else left)
            held = ca.vertcat(least, level)
            after = ca.if_else(free[0] < least, held, free)
        s.after = after
        return way * after[1]

    return flowed


def _carried(w: Wiring, x: Any, p: Array) -> Any:
    fast, bump, rebound, lag = map(float, of_strut(p))
    h, start = 1.0 / WITHIN, w.value(x)
    s, near = w.state([start, start, 0.0]), float(np.exp(-0.5 * h / lag))
    r, at, v = s.x[0], s.x[1], s.x[2]
    damped = lambda gain: w.ca.if_else(gain > 0.0, bump, rebound) * gain
    for _ in range(WITHIN):
        force = fast**2 * (r - at) + damped((x - r) / lag - v)
        middle, speed = at + 0.5 * h * v, v + 0.5 * h * force
        r = x + (r - x) * near
        v, at = v + h * (fast**2 * (r - middle) + damped((x - r) / lag - speed)), at + h * speed
        r = x + (r - x) * near
    s.after = w.ca.vertcat(r, at, v)
    return at


def _cornered(w: Wiring, x: Any, p: Array) -> Any:
    known, h, start = of_tyres(p), 1.0 / WITHIN, w.value(x)
    *_, steepness, shape, lag = map(float, known)
    s, near = w.state([start, *at_rest(start, known)]), float(np.exp(-0.5 * h / lag))
    steer, b, r = s.x[0], s.x[1], s.x[2]
    side = lambda slip: w.ca.sin(shape * w.ca.atan(steepness * slip)) / (steepness * shape)

    def rates(b: Any, r: Any, steer: Any) -> tuple[Any, Any]:
        front, rear = known[0] * side(b + r - steer), known[1] * side(b - known[3] * r)
        return -front - rear - known[2] * r, known[4] * (known[3] * rear - front)

    for _ in range(WITHIN):
        slip, yaw = rates(b, r, steer)
        steer = x + (steer - x) * near
        slip, yaw = rates(b + 0.5 * h * slip, r + 0.5 * h * yaw, steer)
        b, r, steer = b + h * slip, r + h * yaw, x + (steer - x) * near
    s.after = w.ca.vertcat(steer, b, r)
    return r


def _headed(w: Wiring, x: Any, p: Array) -> Any:
    pull, loss, idle, lag = map(float, of_penstock(p))
    h, start = 1.0 / WITHIN, w.value(x)
    s, near = w.state([start, start / float(np.sqrt(1.0 + loss * start**2))]), float(np.exp(-0.5 * h / lag))
    g, q = s.x[0], s.x[1]
    speeding = lambda q, g: pull * (1.0 - loss * q**2 - (q / g) ** 2)
    for _ in range(WITHIN):
        middle = q + 0.5 * h * speeding(q, g)
        g = x + (g - x) * near
        q = q + h * speeding(middle, g)
        g = x + (g - x) * near
    s.after = w.ca.vertcat(g, q)
    return (q / g) ** 2 * (q - idle)


def _eliminated(w: Wiring, x: Any, p: Array) -> Any:
    known, h = of_clearance(p), 1.0 / WITHIN
    rate, share, limit, half, out, back = map(float, known)
    start = cleared_at(w.value(x), known)
    s = w.state([start, start])
    at, aside = s.x[0], s.x[1]
    change = lambda a, z: rate * (x - share * a - limit * a / (half + w.ca.fabs(a))) + out * (z - a)
    for _ in range(WITHIN):
        middle, other = at + 0.5 * h * change(at, aside), aside + 0.5 * h * back * (at - aside)
        at, aside = at + h * change(middle, other), aside + h * back * (middle - other)
    s.after = w.ca.vertcat(at, aside)
    return at


def _above(ca: Any, first: Any, last: Any, mean: Any) -> Any:
    """Mean of what goes from one value to another, above zero."""
    crosses = 0.5 * ca.fmax(first, last) ** 2 / ca.fmax(ca.fabs(last - first), 1e-300)
    return ca.if_else(
        ca.fmin(first, last) >= 0.0, mean, ca.if_else(ca.fmax(first, last) <= 0.0, 0.0, crosses)
    )


def _triggered(adds: bool) -> Callable[[Wiring, Any, Array], Any]:
    def triggered(w: Wiring, x: Any, p: Array) -> Any:
        threshold, dose, duration, value, lag = map(float, held_to(p))
        ca, h, lag = w.ca, 1.0 / WITHIN, max(lag, 1e-9)
        stays = float(np.exp(-h / lag))
        s = w.state([w.value(x), 0.0, 0.0])
        at, level, left, total = s.x[0], s.x[1], s.x[2], 0.0
        for _ in range(WITHIN):
            then, mean = x + (at - x) * stays, x + (at - x) * lag / h * (1.0 - stays)
            runs, left = ca.fmin(left / h, 1.0), ca.fmax(left - h, 0.0)
            rise = h * _above(ca, at - threshold, then - threshold, mean - threshold)
            filled = level + (1.0 - runs) * rise
            starts = ca.logic_and(left == 0.0, filled >= dose)
            begins = ca.if_else(starts, (filled - dose) / ca.if_else(rise > 0.0, rise, 1.0), 0.0)
            runs, left = runs + begins, ca.if_else(starts, ca.fmax(duration - begins * h, 0.0), left)
            level = ca.if_else(ca.logic_or(starts, left > 0.0), 0.0, filled)
            total, at = total + mean + runs * (value if adds else value - mean), then
        s.after = w.ca.vertcat(at, _begun(w, level), _begun(w, left))
        return ca.if_else(w.k < 0.0, x, total * h)

    return triggered


def _begun(w: Wiring, state: Any) -> Any:
    """A state that is nothing before the record."""
    return w.ca.if_else(w.k < 0.0, 0.0, state)


LOOPED: Mapping[str, Callable[[Wiring, Any, Array], Any]] = {
    "rate_limit": _servo(1), "rate_limit_sampled": _servo(0), "rate_limit_servo": _servo(1), "three_point": _three_point, "wind_up": _wound_up, "relay_feedback": _switched,
    "rate_in_loop": _steered(0), "rate_of_loop": _steered(1), "rate_in_course": _steered(COURSE),
    "sensor_rate": _trailed, "strut": _carried, "tyre_slip": _cornered, "water_column": _headed, "loss_saturating": _eliminated, **{e.key: _geared(*how) for e, how in GEARED.items()},
    **{e.key: _stored(ends) for e, ends in STORES.items()}, **{e.key: _flowed(way) for e, way in FLOWS.items()},
    "event_replaces": _triggered(False), "event_adds": _triggered(True),
}  # fmt: skip
