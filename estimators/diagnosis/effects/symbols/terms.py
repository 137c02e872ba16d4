"""The effects' terms in CasADi: the definition that the NumPy maps and compiled recursions are held to.

Static maps and forces are evaluated with symbols as they stand (`Effect.apply`, `Effect.force`); these advance a state.
"""

from collections.abc import Callable
from typing import Any

from estimators.diagnosis.effects.effect import Clock


def _clip(ca: Any, x: Any, low: Any, high: Any) -> Any:
    return ca.fmin(ca.fmax(x, low), high)


def with_numpy() -> Any:
    """CasADi, told to take NumPy functions of its symbols without a notice."""
    import casadi as ca

    ca.GlobalOptions.setNumpyMode(-1)
    return ca


def map_term(apply: Callable[[Any, Any, Clock], Any], p: Any, length: int) -> Any:
    """CasADi function (x, k) -> out of a map of one sample and its time with given parameters."""
    ca = with_numpy()
    x, k = ca.SX.sym("x"), ca.SX.sym("k")
    return ca.Function("map", [x, k], [apply(x, p, Clock(k, length))])


def factor_term(kind: int, s: Any, p: float, q: float) -> Any:
    """A factor of a discovered term, as `discovery.recursion_kernels.factor`."""
    ca, d = with_numpy(), s - p
    return (
        lambda: d, lambda: d**2, lambda: d**3, lambda: ca.fabs(d), lambda: ca.tanh(d / q), lambda: q * ca.tanh(d / q),
        lambda: ca.fmax(d, 0), lambda: d * ca.fabs(d), lambda: ca.sin(q * d), lambda: ca.cos(q * d),
        lambda: ca.exp(ca.fmin(d / q, 30)), lambda: ca.sqrt(ca.fmax(d, 1e-6)), lambda: ca.log(ca.fmax(d, 1e-6)),
        lambda: 1 / ca.fmax(d, 1e-2), lambda: d / ca.sqrt(ca.fabs(d) + 1e-3), lambda: ca.exp(-((d / q) ** 2)),
    )[kind]()  # fmt: skip


def play_step() -> Any:
    """CasADi function (m, v, half_width) -> next m of a play operator."""
    import casadi as ca

    m, v, h = ca.SX.sym("m"), ca.SX.sym("v"), ca.SX.sym("h")
    return ca.Function("play", [m, v, h], [_clip(ca, m, v - h, v + h)])


def bouc_wen_step() -> Any:
    """CasADi function (z, before, now, width) -> next z of a Bouc-Wen element, exact for a monotone move."""
    import casadi as ca

    z, before, now, w = (ca.SX.sym(name) for name in ("z", "before", "now", "w"))
    side = ca.if_else(now >= before, 1, -1)
    left = ca.fabs(now - before)
    back = ca.if_else(side * z < 0, ca.fmin(left, ca.fabs(z)), 0)
    at = z + side * back
    end = side * (w - (w - side * at) * ca.exp(-(left - back) / w))
    return ca.Function("bouc_wen", [z, before, now, w], [ca.if_else(left > back, end, at)])


def lag_step() -> Any:
    """CasADi function (y, x, pole) -> next y of a first-order lag of unit gain."""
    import casadi as ca

    y, x, pole = ca.SX.sym("y"), ca.SX.sym("x"), ca.SX.sym("pole")
    inside = _clip(ca, pole, -0.999, 0.9999)
    return ca.Function("lag", [y, x, pole], [inside * y + (1 - inside) * x])


def delay_term(largest: int) -> Any:
    """CasADi function (past, delay) -> out of a fractional delay, linear between samples."""
    import casadi as ca

    past, delay = ca.SX.sym("past", largest + 2), ca.SX.sym("delay")
    total = ca.SX(0)
    for i in range(largest + 2):  # a hat over every sample: linear interpolation
        total += past[i] * ca.fmax(1 - ca.fabs(delay - i), 0)
    return ca.Function("delay", [past, delay], [total])


def hinges_term(corners: int) -> Any:
    """CasADi function (x, c) -> x + sum of slope max(x - corner, 0), a broken line."""
    import casadi as ca

    x, c = ca.SX.sym("x"), ca.SX.sym("c", 2 * corners)
    total = x
    for i in range(corners):
        total = total + c[2 * i] * ca.fmax(x - c[2 * i + 1], 0)
    return ca.Function("hinges", [x, c], [total])


def servo_step() -> Any:
    """CasADi function (v, command, up, down, lag) -> (next v, mean over the interval), as in `recursion_kernels.servo_mean`.

    Where the command itself is limited from sample to sample, the next v without a lag is what acts."""
    import casadi as ca

    v, u, up, down, lag = (ca.SX.sym(name) for name in ("v", "u", "up", "down", "lag"))
    gap = ca.fabs(u - v)
    rate = ca.if_else(u > v, up, down)
    full = _clip(ca, gap / rate - lag, 0, 1)
    left = gap - rate * full
    near = ca.exp((full - 1) / ca.fmax(lag, 1e-300))
    missed = 0.5 * (gap + left) * full + left * lag * (1 - near)
    return ca.Function(
        "servo", [v, u, up, down, lag], [u - ca.sign(u - v) * at for at in (left * near, missed)]
    )


def dry_friction_term() -> Any:
    """CasADi function of the mean dry friction over a step, as in `plant_kernels.dry_friction`."""
    import casadi as ca

    given: Any = ca.SX.sym("given", 7)
    v, ahead, gain, coulomb, static, speed, tilt = (given[i] for i in range(7))
    level = lambda at: coulomb + static * ca.exp(-((at / speed) ** 2))
    side = ca.if_else(v > 0, 1, -1)
    here, there = side * (1 + side * tilt), -side * (1 - side * tilt)
    onward = here * level(0.5 * (v + ahead - gain * here * level(v)))
    goes_on = ca.logic_and(side * (ahead - gain * here * level(v)) > 0, side * (ahead - gain * onward) > 0)
    force = here * level(0.5 * v)
    drop = v - (ahead - gain * force)
    before = ca.if_else(drop != 0, _clip(ca, v / (drop + (drop == 0)), 0, 1), 0)
    held = side * (ahead - v) / gain >= -ca.fabs(there) * level(0)
    end = ahead - gain * (before * force + (1 - before) * there * level(0))
    turned = before * force + (1 - before) * there * level(0.5 * end)
    return ca.Function(
        "friction",
        [v, ahead, gain, coulomb, static, speed, tilt],
        [ca.if_else(goes_on, onward, ca.if_else(held, ahead / gain, turned))],
    )


def feedback_step(order: int, held: Any, elements: Any, forces: list[tuple[Any, Any]]) -> Any:
    """CasADi function (x, u, z) -> (next x, next z) of one exponential Heun step of a plant with nonlinear feedback.

    The same as one step of `plant_kernels.simulate_feedback`: `held` and `elements` as there, forces with their parameters
    evaluated with symbols, no modulating signal.
    """
    ca = with_numpy()

    x, u, z = ca.SX.sym("x", order), ca.SX.sym("u"), ca.SX.sym("z")
    phi, gu, gw, position, velocity = (ca.DM(a) for a in held)
    bend = bouc_wen_step()

    def load(at: Any, hysteretic: Any) -> Any:
        p, v, q = ca.dot(position, at), ca.dot(velocity, at), at[order - 1]
        return sum((f(p, v, u, q, 0.0, c) for f, c in forces), elements.spring * hysteretic)

    free = phi @ x + gu * u
    before = load(x, z)
    start, trial = ca.dot(position, x), free - gw * before
    w = 0.5 * (before + load(trial, bend(z, start, ca.dot(position, trial), elements.width or 1.0)))
    ahead, gain = ca.dot(velocity, free - gw * w), ca.dot(velocity, gw)
    level = elements.coulomb + elements.grip * ca.fabs(start)
    dry = (level, elements.static, elements.speed, elements.tilt)
    if elements.coulomb or elements.grip or elements.static:
        w = w + dry_friction_term()(ca.dot(velocity, x), ahead, gain, *dry)
    after = free - gw * w
    hysteretic = bend(z, start, ca.dot(position, after), elements.width or 1.0)
    if elements.stop:  # position and velocity are the first two states
        s = elements.stop
        speed = ca.if_else(
            after[0] > s, ca.fmin(after[1], 0), ca.if_else(after[0] < -s, ca.fmax(after[1], 0), after[1])
        )
        after = ca.vertcat(_clip(ca, after[0], -s, s), speed, after[2:])
    return ca.Function("feedback", [x, u, z], [after, hysteretic])
