"""The effects' terms in CasADi: the definition that the NumPy maps and compiled recursions are held to.

A static term is out = f(x, p); a time-dependent one out = f(x, t, p); a recursive one advances its own state.
"""

from __future__ import annotations

from typing import Any

__all__ = [
    "bouc_wen_step",
    "delay_term",
    "dry_friction_term",
    "feedback_step",
    "hinges_term",
    "lag_step",
    "play_step",
    "rate_step",
    "static_term",
    "timed_term",
]


def _clip(ca: Any, x: Any, low: Any, high: Any) -> Any:
    return ca.fmin(ca.fmax(x, low), high)


def static_term(key: str) -> Any:
    """CasADi function (x, p) -> out of a static effect.

    Parameters
    ----------
    key : str
        Key of the catalogue, in the slots input or output.

    Returns
    -------
    casadi.Function
        Inputs x (1) and p (number of parameters).

    Raises
    ------
    KeyError
        If the effect is not static.
    """
    import casadi as ca

    from estimators.diagnosis.effects.catalogue import CATALOGUE

    x = ca.SX.sym("x")
    p = ca.SX.sym("p", max(1, len(CATALOGUE[key].parameters)))
    limit = ca.fabs(p[0])
    second = p[1] if p.numel() > 1 else p[0]
    terms = {
        "saturation": lambda: _clip(ca, x, -limit, limit),
        "saturation_asymmetric": lambda: _clip(ca, x, ca.fmin(p[0], second), ca.fmax(p[0], second)),
        "saturation_upper": lambda: ca.fmin(x, p[0]),
        "saturation_lower": lambda: ca.fmax(x, p[0]),
        "dead_zone": lambda: ca.fmax(x - limit, 0) + ca.fmin(x + limit, 0),
        "dead_zone_asymmetric": lambda: ca.fmax(x - ca.fabs(second), 0) + ca.fmin(x + limit, 0),
        "input_quadratic": lambda: x + p[0] * x**2,
        "input_cubic": lambda: x + p[0] * x**3,
        "input_polynomial": lambda: x + p[0] * x**2 + second * x**3,
        "output_quadratic": lambda: x + p[0] * x**2,
        "output_cubic": lambda: x + p[0] * x**3,
        "output_polynomial": lambda: x + p[0] * x**2 + second * x**3,
        "output_arctan": lambda: ca.atan(p[0] * x) / p[0],
        "output_tanh": lambda: ca.tanh(p[0] * x) / p[0],
        "output_clip": lambda: _clip(ca, x, -limit, limit),
        "output_clip_upper": lambda: ca.fmin(x, p[0]),
        "output_clip_lower": lambda: ca.fmax(x, p[0]),
        "output_dead_zone": lambda: ca.fmax(x - limit, 0) + ca.fmin(x + limit, 0),
        "output_absolute": lambda: x + p[0] * ca.fabs(x),
        "offset": lambda: x + p[0],
    }
    return ca.Function(key, [x, p], [terms[key]()])


def timed_term(key: str) -> Any:
    """CasADi function (x, k, n, p) -> out of an effect that depends on time.

    Parameters
    ----------
    key : str
        gain_drift, gain_change, step_input, step_output, drift or tones (one sinusoid).

    Returns
    -------
    casadi.Function
        Inputs x, sample number k, samples n of the training record, parameters p.

    Raises
    ------
    KeyError
        If the effect does not depend on time alone.
    """
    import casadi as ca

    from estimators.diagnosis.effects.catalogue import CATALOGUE

    x, k, n = ca.SX.sym("x"), ca.SX.sym("k"), ca.SX.sym("n")
    p = ca.SX.sym("p", len(CATALOGUE[key].parameters))
    second = p[1] if p.numel() > 1 else p[0]
    third = p[2] if p.numel() > 2 else p[0]
    after = _clip(ca, k - second, 0, 1)
    terms = {
        "gain_drift": lambda: (1 + p[0] * k / n) * x,
        "gain_change": lambda: x * (1 + p[0] * after),
        "step_input": lambda: x + p[0] * after,
        "step_output": lambda: x + p[0] * after,
        "drift": lambda: x + p[0] + second * k / n,
        "tones": lambda: x + second * ca.cos(p[0] * k) + third * ca.sin(p[0] * k),
    }
    return ca.Function(key, [x, k, n, p], [terms[key]()])


def play_step() -> Any:
    """CasADi function (m, v, half_width) -> next m of a play operator.

    Returns
    -------
    casadi.Function
        One step.
    """
    import casadi as ca

    m, v, h = ca.SX.sym("m"), ca.SX.sym("v"), ca.SX.sym("h")
    return ca.Function("play", [m, v, h], [_clip(ca, m, v - h, v + h)])


def bouc_wen_step() -> Any:
    """CasADi function (z, before, now, width) -> next z of a Bouc-Wen element, exact for a monotone move.

    Returns
    -------
    casadi.Function
        One step.
    """
    import casadi as ca

    z, before, now, w = (ca.SX.sym(name) for name in ("z", "before", "now", "w"))
    side = ca.if_else(now >= before, 1, -1)
    left = ca.fabs(now - before)
    back = ca.if_else(side * z < 0, ca.fmin(left, ca.fabs(z)), 0)
    at = z + side * back
    end = side * (w - (w - side * at) * ca.exp(-(left - back) / w))
    return ca.Function("bouc_wen", [z, before, now, w], [ca.if_else(left > back, end, at)])


def lag_step() -> Any:
    """CasADi function (y, x, pole) -> next y of a first-order lag of unit gain.

    Returns
    -------
    casadi.Function
        One step.
    """
    import casadi as ca

    y, x, pole = ca.SX.sym("y"), ca.SX.sym("x"), ca.SX.sym("pole")
    inside = _clip(ca, pole, -0.999, 0.9999)
    return ca.Function("lag", [y, x, pole], [inside * y + (1 - inside) * x])


def delay_term(largest: int) -> Any:
    """CasADi function (past, delay) -> out of a fractional delay, linear between samples.

    Parameters
    ----------
    largest : int
        Largest delay in whole samples.

    Returns
    -------
    casadi.Function
        Inputs past (largest + 2): x(k), x(k-1), ...; delay between 0 and largest.
    """
    import casadi as ca

    past, delay = ca.SX.sym("past", largest + 2), ca.SX.sym("delay")
    total = ca.SX(0)
    for i in range(largest + 2):  # a hat over every sample: linear interpolation
        total += past[i] * ca.fmax(1 - ca.fabs(delay - i), 0)
    return ca.Function("delay", [past, delay], [total])


def hinges_term(corners: int) -> Any:
    """CasADi function (x, c) -> x + sum of slope max(x - corner, 0), a broken line.

    Parameters
    ----------
    corners : int
        Number of corners.

    Returns
    -------
    casadi.Function
        Inputs x and c (2 corners): slopes and corners in turn.
    """
    import casadi as ca

    x, c = ca.SX.sym("x"), ca.SX.sym("c", 2 * corners)
    total = x
    for i in range(corners):
        total = total + c[2 * i] * ca.fmax(x - c[2 * i + 1], 0)
    return ca.Function("hinges", [x, c], [total])


def rate_step() -> Any:
    """CasADi function (v, command, rate) -> (next v, mean over the interval) of a rate-limited actuator.

    Where the command itself is limited from sample to sample, the next v is what acts.

    Returns
    -------
    casadi.Function
        One step.
    """
    import casadi as ca

    v, u, r = ca.SX.sym("v"), ca.SX.sym("u"), ca.SX.sym("r")
    gap = u - v
    reached = ca.fabs(gap) <= r
    mean = ca.if_else(reached, u - 0.5 * gap * ca.fabs(gap) / r, v + 0.5 * r * ca.sign(gap))
    return ca.Function("rate", [v, u, r], [v + _clip(ca, gap, -r, r), mean])


def dry_friction_term() -> Any:
    """CasADi function of the mean dry friction over a step, as in `plant_kernels.dry_friction`.

    Returns
    -------
    casadi.Function
        Inputs v, ahead, gain, coulomb, static, speed, tilt.
    """
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


def feedback_step(order: int) -> Any:
    """CasADi function (x+, z+) of one exponential Heun step of a plant with nonlinear feedback.

    x+ = phi x + gamma_u u - gamma_w w with w = k2 p^2 + k3 p^3 + k5 p^5 + k |p| p + drag |v| v + damping p^2 v
    - (beta u + product q) p + upper max(p - high, 0) + lower min(p - low, 0) + spring z + friction, q the last state.

    Parameters
    ----------
    order : int
        Number of states.

    Returns
    -------
    casadi.Function
        Inputs x, u, phi, gamma_u, gamma_w, position, velocity, c (19), z; a position within +-c[18] where that is not 0.
    """
    import casadi as ca

    x, u = ca.SX.sym("x", order), ca.SX.sym("u")
    phi, gu, gw = ca.SX.sym("phi", order, order), ca.SX.sym("gu", order), ca.SX.sym("gw", order)
    position, velocity = ca.SX.sym("position", order), ca.SX.sym("velocity", order)
    c, z = ca.SX.sym("c", 19), ca.SX.sym("z")
    bend = bouc_wen_step()

    def load(at: Any, hysteretic: Any) -> Any:
        p, v = ca.dot(position, at), ca.dot(velocity, at)
        stiff = (c[0] + c[1] * p) * p**2 + c[2] * ca.fabs(p) * p + c[9] * p**5
        stops = c[10] * ca.fmax(p - c[11], 0) + c[12] * ca.fmin(p - c[13], 0)
        damping = c[3] * ca.fabs(v) * v + c[14] * p**2 * v
        return stiff + stops + damping - (c[4] * u + c[17] * at[order - 1]) * p + c[15] * hysteretic

    free = phi @ x + gu * u
    before = load(x, z)
    start, trial = ca.dot(position, x), free - gw * before
    w = 0.5 * (before + load(trial, bend(z, start, ca.dot(position, trial), c[16])))
    ahead, gain = ca.dot(velocity, free - gw * w), ca.dot(velocity, gw)
    w = w + dry_friction_term()(ca.dot(velocity, x), ahead, gain, c[5], c[6], c[7], c[8])
    after = free - gw * w
    hysteretic = bend(z, start, ca.dot(position, after), c[16])
    if order > 1:  # position and velocity are the first two states
        held, speed = _clip(ca, after[0], -c[18], c[18]), after[1]
        speed = ca.if_else(
            after[0] > c[18], ca.fmin(speed, 0), ca.if_else(after[0] < -c[18], ca.fmax(speed, 0), speed)
        )
        after = ca.if_else(c[18] > 0, ca.vertcat(held, speed, after[2:]), after)
    return ca.Function("feedback", [x, u, phi, gu, gw, position, velocity, c, z], [after, hysteretic])
