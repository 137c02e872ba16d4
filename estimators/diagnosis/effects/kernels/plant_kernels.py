"""Compiled recursion of a plant with nonlinear feedback: forces, dry friction, hysteresis, stops.

CasADi defines the same step in `terms`; a test holds the two to 1e-9.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import cfunc, types
from numba.extending import intrinsic

from estimators.diagnosis.effects.kernels.recursion_kernels import compiled

MOST_FORCES = 2
"""Forces of a model at the same time; a compiled recursion takes each as an argument."""
_FORCE = types.float64(*[types.float64] * 5, types.CPointer(types.float64))


class Elements(NamedTuple):
    """What acts inside a plant and is no function of its present state alone; every field 0 where it is not there.

    Dry friction of level (1 +- tilt) (coulomb + grip |p| + static exp(-(v / speed)^2)), a spring on the hysteretic part of a
    Bouc-Wen element that saturates at `width`, a stop that holds the first state within +-stop, and a state that follows the squared
    position at a rate per sample, `pace`, and modulates the forces.

    """

    coulomb: float = 0.0
    static: float = 0.0
    speed: float = 1.0
    tilt: float = 0.0
    spring: float = 0.0
    width: float = 0.0
    stop: float = 0.0
    grip: float = 0.0
    pace: float = 0.0


class Held(NamedTuple):
    """A linear plant over one integration step: transition, response to inputs and force, rows that read position and velocity."""

    phi: Any
    gamma_u: Any
    gamma_w: Any
    position: Any
    velocity: Any


_POINTERS: list[Any] = []  # what is compiled stays alive as long as its address is known


@cache
def pointer(force: Callable[..., Any]) -> int:
    """Address of a force, compiled at its first use and kept on disk where its file allows: one recursion serves all forces."""
    try:
        _POINTERS.append(cfunc(_FORCE, cache=True)(force))
    except RuntimeError:  # written in a console: there is no file beside which to keep it
        _POINTERS.append(cfunc(_FORCE)(force))
    return int(_POINTERS[-1].address)


@intrinsic
def _called(typing, address, p, v, u, q, s, c):  # pragma: no cover - compiled
    """Value of the force at an address: numba's own function types cost more than a step of the recursion at each call."""

    def generate(context, builder, signature, values):
        double = context.get_value_type(types.float64)
        kind = ir.FunctionType(double, [double] * 5 + [double.as_pointer()])
        function = builder.inttoptr(values[0], kind.as_pointer())
        row = context.make_array(signature.args[6])(context, builder, values[6])
        return builder.call(function, [*values[1:6], row.data])

    return types.float64(types.intp, *[types.float64] * 5, types.float64[::1]), generate


@compiled
def hysteresis_step(z, move, width):  # pragma: no cover - compiled
    """Hysteretic part of a Bouc-Wen element after a monotone move of its ends."""
    side = 1.0 if move >= 0 else -1.0
    left = abs(move)
    if side * z < 0.0:
        back = min(left, abs(z))
        z += side * back
        left -= back
    if left > 0.0 and width > 0.0:
        z = side * (width - (width - side * z) * np.exp(-left / width))
    return z


@compiled
def bouc_wen(signal, width):  # pragma: no cover - compiled
    """Hysteretic part z of a Bouc-Wen element, z' = x' - |x'| (z + sign(x') |z|) / (2 width), exact between samples.

    The signal moves monotonically from sample to sample. Towards zero z follows it one to one, away from zero
    it bends towards +-width exponentially.
    """
    out = np.empty_like(signal)
    z = 0.0
    before = 0.0
    for k in range(signal.shape[0]):
        z = hysteresis_step(z, signal[k] - before, width)
        before = signal[k]
        out[k] = z
    return out


@compiled
def held_response(a, columns, h):  # pragma: no cover - compiled
    """exp(A h) and the integral over h of exp(A s) ds times the columns, by a scaled Taylor series."""
    n = a.shape[0]
    m = n + columns.shape[1]
    big = np.zeros((m, m))
    size = 0.0
    for i in range(n):
        for j in range(n):
            big[i, j] = a[i, j] * h
            size += abs(big[i, j])
        for j in range(columns.shape[1]):
            big[i, n + j] = columns[i, j] * h
            size += abs(big[i, n + j])
    squarings = 0
    while size > 0.5:
        size *= 0.5
        squarings += 1
    big = big / 2.0**squarings
    out = np.eye(m)
    term = np.eye(m)
    for k in range(1, 13):
        new = np.zeros((m, m))
        for i in range(m):
            for j in range(m):
                total = 0.0
                for l in range(m):
                    total += term[i, l] * big[l, j]
                new[i, j] = total / k
        term = new
        out = out + term
    for _ in range(squarings):
        new = np.zeros((m, m))
        for i in range(m):
            for j in range(m):
                total = 0.0
                for l in range(m):
                    total += out[i, l] * out[l, j]
                new[i, j] = total
        out = new
    return out[:n, :n].copy(), out[:n, n:].copy()


@compiled
def dry_friction(v, ahead, gain, coulomb, elements):  # pragma: no cover - compiled
    """Mean dry friction over a step in which the velocity moves on a straight line, to second order in the step.

    The force keeps its side until the velocity is zero. From there on it holds what pushes less than the friction at rest,
    and else it is on the other side for the rest of the step.
    """
    static, speed, tilt = elements.static, elements.speed, elements.tilt
    side = 1.0 if v > 0.0 else -1.0
    here, there = side * (1.0 + side * tilt), -side * (1.0 - side * tilt)
    force = here * (coulomb + static * np.exp(-((v / speed) ** 2)))
    end = ahead - gain * force
    if end * side > 0.0:
        force = here * (coulomb + static * np.exp(-((0.5 * (v + end) / speed) ** 2)))
        if (ahead - gain * force) * side > 0.0:
            return force
    force = here * (coulomb + static * np.exp(-((0.5 * v / speed) ** 2)))
    end = ahead - gain * force
    before = min(max(v / (v - end), 0.0), 1.0) if v != end else 0.0  # the share of the step before the stop
    if side * (ahead - v) / gain >= -abs(there) * (coulomb + static):
        return ahead / gain
    other = there * (coulomb + static)
    end = ahead - gain * (before * force + (1.0 - before) * other)
    other = there * (coulomb + static * np.exp(-((0.5 * end / speed) ** 2)))
    return before * force + (1.0 - before) * other


@compiled
def simulate_feedback(drive, held, elements, x0, steps, c, f, g):  # pragma: no cover - compiled
    """States (N, n) of x' = A x + B u - E w, with `steps` exponential Heun steps per sample.

    w = f(p, v, u, q, s, c[0]) + g(..., c[1]) + spring z + dry friction, with p and v the position and velocity that
    `held` reads off x, q the last state, z the hysteretic displacement. drive (N, inputs + 4): the inputs, then for each
    force the signal s that modulates it and the input u that it reads. c has a row per force, none where there is none; f and g are addresses. A stop takes the velocity
    (second state).

    """
    n = drive.shape[0]
    phi, gamma_u, gamma_w, position, velocity = held
    m = phi.shape[0]
    out = np.empty((n, m))
    x = x0.copy()
    free, push = np.empty(m), np.empty(m)
    nu = gamma_u.shape[1]
    dry = elements.coulomb != 0.0 or elements.static != 0.0 or elements.grip != 0.0
    bending = elements.spring != 0.0
    forces = c.shape[0]
    z = 0.0
    z1 = 0.0
    gv = 0.0
    worked = 0.0
    taken = 1.0 - np.exp(-elements.pace / steps)
    for i in range(m):
        gv += velocity[i] * gamma_w[i]
        worked += position[i] * x[i]
    worked = worked**2 if elements.pace > 0.0 else 0.0  # at rest where the plant is
    # linear: most fits of the screening
    idle = forces == 0 and not dry and not bending and elements.stop == 0.0
    for k in range(n):
        for i in range(m):
            out[k, i] = x[i]
            push[i] = 0.0
            for j in range(nu):
                push[i] += gamma_u[i, j] * drive[k, j]
        for _ in range(steps):
            for i in range(m):
                total = push[i]
                for j in range(m):
                    total += phi[i, j] * x[j]
                free[i] = total
            if idle:
                for i in range(m):
                    x[i] = free[i]
                continue
            p = 0.0
            v = 0.0
            for i in range(m):
                p += position[i] * x[i]
                v += velocity[i] * x[i]
            w = elements.spring * z
            if forces > 0:
                w += _called(f, p, v, drive[k, nu + 1], x[m - 1], drive[k, nu] + worked, c[0])  # pyright: ignore[reportCallIssue]
            if forces > 1:
                w += _called(g, p, v, drive[k, nu + 3], x[m - 1], drive[k, nu + 2] + worked, c[1])  # pyright: ignore[reportCallIssue]
            p1 = 0.0
            v1 = 0.0
            e = 0.0
            for i in range(m):
                e = free[i] - gamma_w[i] * w
                p1 += position[i] * e
                v1 += velocity[i] * e
            if bending:
                z1 = hysteresis_step(z, p1 - p, elements.width)
            ahead = elements.spring * z1
            if forces > 0:
                ahead += _called(f, p1, v1, drive[k, nu + 1], e, drive[k, nu] + worked, c[0])  # pyright: ignore[reportCallIssue]
            if forces > 1:
                ahead += _called(g, p1, v1, drive[k, nu + 3], e, drive[k, nu + 2] + worked, c[1])  # pyright: ignore[reportCallIssue]
            w = 0.5 * (w + ahead)
            if dry and gv != 0.0:
                v1 = 0.0
                for i in range(m):
                    v1 += velocity[i] * (free[i] - gamma_w[i] * w)
                w += dry_friction(v, v1, gv, elements.coulomb + elements.grip * abs(p), elements)
            p1 = 0.0
            for i in range(m):
                x[i] = free[i] - gamma_w[i] * w
                p1 += position[i] * x[i]
            if bending:
                z = hysteresis_step(z, p1 - p, elements.width)
            if elements.pace > 0.0:
                worked += taken * (p1 * p1 - worked)
            if elements.stop > 0.0 and abs(x[0]) > elements.stop:
                x[0] = elements.stop if x[0] > 0.0 else -elements.stop
                x[1] = min(x[1], 0.0) if x[0] > 0.0 else max(x[1], 0.0)
        big = 0.0
        for i in range(m):
            big += abs(x[i])
        if not big < 1e100:
            out[k:] = np.inf
            return out
    return out
