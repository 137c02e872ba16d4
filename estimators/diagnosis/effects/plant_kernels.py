"""Compiled twin of a plant with nonlinear feedback: smooth forces, dry friction, hysteresis.

CasADi defines the same step in `estimators.diagnosis.effects.terms`; a test holds the two to 1e-9.
"""

from __future__ import annotations

import numpy as np

from estimators.diagnosis.effects.recursion_kernels import compiled

__all__ = ["bouc_wen", "dry_friction", "held_response", "hysteresis_step", "load", "simulate_feedback"]


@compiled
def hysteresis_step(z, move, width):  # pragma: no cover - compiled
    """Hysteretic part of a Bouc-Wen element after a monotone move of its ends.

    Parameters
    ----------
    z : float
        Before.
    move : float
        Change of the displacement.
    width : float
        Where the hysteretic part saturates.

    Returns
    -------
    float
        After.
    """
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

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    width : float
        Where the hysteretic part saturates.

    Returns
    -------
    ndarray
        (N,).
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
    """exp(A h) and the integral over h of exp(A s) ds times the columns, by a scaled Taylor series.

    Parameters
    ----------
    a : ndarray
        (n, n) the matrix A.
    columns : ndarray
        (n, m) what is integrated.
    h : float
        Length of the interval.

    Returns
    -------
    tuple of ndarray
        The transition and the integral.
    """
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
def load(c, p, v, u, q, z):  # pragma: no cover - compiled
    """Force of the smooth effects inside a plant, see `simulate_feedback`.

    Parameters
    ----------
    c : ndarray
        (19,) coefficients.
    p, v : float
        Position and velocity.
    u, q : float
        Input, and the last state, which drives the others where the input has a lag of its own.
    z : float
        Hysteretic displacement.

    Returns
    -------
    float
        Force.
    """
    w = (c[0] + c[1] * p) * p * p + c[2] * abs(p) * p + c[3] * abs(v) * v - (c[4] * u + c[17] * q) * p
    if c[9] != 0.0:
        w += c[9] * p**5
    if c[10] != 0.0 and p > c[11]:
        w += c[10] * (p - c[11])
    if c[12] != 0.0 and p < c[13]:
        w += c[12] * (p - c[13])
    return w + c[14] * p * p * v + c[15] * z


@compiled
def dry_friction(v, ahead, gain, coulomb, static, speed, tilt):  # pragma: no cover - compiled
    """Mean dry friction over a step in which the velocity moves on a straight line, to second order in the step.

    The force keeps its side until the velocity is zero. From there on it holds what pushes less than the friction at rest,
    and else it is on the other side for the rest of the step.

    Parameters
    ----------
    v, ahead : float
        Velocity at the start of the step, and at its end were there no friction.
    gain : float
        What a unit of force takes from the velocity over the step.
    coulomb, static, speed, tilt : float
        The level is (1 +- tilt) (coulomb + static exp(-(v / speed)^2)), + where the velocity is positive.

    Returns
    -------
    float
        Force.
    """
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
def simulate_feedback(u, phi, gamma_u, gamma_w, position, velocity, c, x0, steps):  # pragma: no cover
    """States of x' = A x + B u - E w(x, u), sampled, with `steps` exponential Heun steps per sample.

    w = k2 p^2 + k3 p^3 + k5 p^5 + k |p| p + drag |v| v + damping p^2 v - (beta u + product q) p
    + upper max(p - high, 0) + lower min(p - low, 0) + spring z + friction, with p = position x, v = velocity x, q the last state and z the hysteretic
    displacement of a Bouc-Wen element; c = (k2, k3, k, drag, beta, coulomb, static, stribeck_speed, asymmetry, k5,
    upper, high, lower, low, damping, spring, width, product,
    stop). Dry friction is that of `dry_friction`. A stop holds a position (the first state, its velocity the second)
    within +-stop and takes the velocity; 0 for none.

    Parameters
    ----------
    u : ndarray
        (N,) input.
    phi : ndarray
        (n, n) transition over one step.
    gamma_u : ndarray
        (n,) effect of the held input over one step.
    gamma_w : ndarray
        (n,) effect of the nonlinear term over one step.
    position : ndarray
        (n,) row that reads the position off the state.
    velocity : ndarray
        (n,) row that reads the velocity off the state.
    c : ndarray
        (19,) coefficients of the nonlinear term w.
    x0 : ndarray
        Initial state.
    steps : int
        Integration steps per sample.

    Returns
    -------
    ndarray
        (N, n) states.
    """
    n = u.shape[0]
    m = phi.shape[0]
    out = np.empty((n, m))
    x = x0.copy()
    free = np.empty(m)
    coulomb, static, speed, tilt = c[5], c[6], c[7], c[8]
    dry = coulomb != 0.0 or static != 0.0
    bending = c[15] != 0.0
    width = c[16]
    stop = c[18]
    z = 0.0
    z1 = 0.0
    gv = 0.0
    for i in range(m):
        gv += velocity[i] * gamma_w[i]
    if not np.any(c):  # linear: most fits of the screening
        for k in range(n):
            big = 0.0
            for i in range(m):
                out[k, i] = x[i]
            for _ in range(steps):
                for i in range(m):
                    total = gamma_u[i] * u[k]
                    for j in range(m):
                        total += phi[i, j] * x[j]
                    free[i] = total
                for i in range(m):
                    x[i] = free[i]
            for i in range(m):
                big += abs(x[i])
            if not big < 1e60:
                out[k:] = np.inf
                return out
        return out
    for k in range(n):
        for i in range(m):
            out[k, i] = x[i]
        for _ in range(steps):
            p = 0.0
            v = 0.0
            for i in range(m):
                p += position[i] * x[i]
                v += velocity[i] * x[i]
            w = load(c, p, v, u[k], x[m - 1], z)
            for i in range(m):
                total = gamma_u[i] * u[k]
                for j in range(m):
                    total += phi[i, j] * x[j]
                free[i] = total
            p1 = 0.0
            v1 = 0.0
            e = 0.0
            for i in range(m):
                e = free[i] - gamma_w[i] * w
                p1 += position[i] * e
                v1 += velocity[i] * e
            if bending:
                z1 = hysteresis_step(z, p1 - p, width)
            w = 0.5 * (w + load(c, p1, v1, u[k], e, z1))  # e: the last state
            if dry:
                v1 = 0.0
                for i in range(m):
                    v1 += velocity[i] * (free[i] - gamma_w[i] * w)
                force = dry_friction(v, v1, gv, coulomb, static, speed, tilt) if gv != 0.0 else 0.0
                w += force
            big = 0.0
            p1 = 0.0
            for i in range(m):
                x[i] = free[i] - gamma_w[i] * w
                big += abs(x[i])
                p1 += position[i] * x[i]
            if bending:
                z = hysteresis_step(z, p1 - p, width)
            if stop > 0.0 and abs(x[0]) > stop:
                x[0] = stop if x[0] > 0.0 else -stop
                x[1] = min(x[1], 0.0) if x[0] > 0.0 else max(x[1], 0.0)
            if not big < 1e60:
                out[k:] = np.inf
                return out
    return out
