"""Compiled twins of the recursive effects: play, rate limit, and a plant with nonlinear feedback.

CasADi defines the same steps in `estimators.effects.terms`; a test holds the two to 1e-9.
"""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = [
    "bouc_wen",
    "held_response",
    "hinges",
    "play",
    "rate_limited_mean",
    "rational",
    "simulate_feedback",
    "tank_levels",
]


def _compile(function):
    """Compile with a cache on disk, or without one where no folder for it can be written."""
    try:
        return njit(cache=True)(function)
    except RuntimeError:
        return njit(function)


@_compile
def play(signal, half_width):  # pragma: no cover - compiled
    """Output of a play (backlash) operator that starts at the middle of its gap.

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    half_width : float
        Half the gap.

    Returns
    -------
    ndarray
        (N,).
    """
    out = np.empty_like(signal)
    m = 0.0
    for k in range(signal.shape[0]):
        v = signal[k]
        if m < v - half_width:
            m = v - half_width
        elif m > v + half_width:
            m = v + half_width
        out[k] = m
    return out


@_compile
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
        move = signal[k] - before
        before = signal[k]
        side = 1.0 if move >= 0 else -1.0
        left = abs(move)
        if side * z < 0.0:
            back = min(left, abs(z))
            z += side * back
            left -= back
        if left > 0.0 and width > 0.0:
            z = side * (width - (width - side * z) * np.exp(-left / width))
        out[k] = z
    return out


@_compile
def rate_limited_mean(signal, rate):  # pragma: no cover - compiled
    """Mean over each sample interval of an actuator that follows a held command at a limited rate.

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    rate : float
        Largest change per sample.

    Returns
    -------
    ndarray
        (N,).
    """
    out = np.empty_like(signal)
    v = 0.0
    for k in range(signal.shape[0]):
        gap = signal[k] - v
        distance = abs(gap)
        if distance <= rate:
            # it arrives after distance/rate of the interval and then rests
            out[k] = signal[k] - 0.5 * gap * distance / rate if rate > 0 else signal[k]
            v = signal[k]
        else:
            move = rate if gap > 0 else -rate
            out[k] = v + 0.5 * move
            v += move
    return out


@_compile
def rational(u, b, f, delay):  # pragma: no cover - compiled
    """Sum of B_j/F u_j with B_j = b[j, 0] z^-(1+delay) + ...; infinite once it overflows.

    Parameters
    ----------
    u : ndarray
        (N, nu) inputs.
    b : ndarray
        (nu, nb) numerator coefficients.
    f : ndarray
        (nf,) denominator coefficients after the leading 1.
    delay : int
        Samples of delay beyond the first.

    Returns
    -------
    ndarray
        (N,).
    """
    n = u.shape[0]
    channels = b.shape[0]
    taps = b.shape[1]
    order = f.shape[0]
    y = np.zeros(n)
    for k in range(n):
        total = 0.0
        for j in range(channels):
            for i in range(taps):
                at = k - 1 - delay - i
                if at >= 0:
                    total += b[j, i] * u[at, j]
        for i in range(order):
            if k - 1 - i >= 0:
                total -= f[i] * y[k - 1 - i]
        if not abs(total) < 1e100:
            y[k:] = np.inf
            return y
        y[k] = total
    return y


@_compile
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


@_compile
def simulate_feedback(u, phi, gamma_u, gamma_w, position, velocity, c, x0, steps):  # pragma: no cover
    """States of x' = A x + B u - E w(x, u), sampled, with `steps` exponential Heun steps per sample.

    w = k2 p^2 + k3 p^3 + k5 |p| p + drag |v| v - beta u p + friction, with p = position x, v = velocity x;
    c = (k2, k3, k5, drag, beta, coulomb, static, stribeck_speed, asymmetry). Dry friction is implicit:
    it is the force within +-level that stops v, or the level where that does not suffice.

    Parameters
    ----------
    u : ndarray
        (N, nu) inputs.
    phi : ndarray
        (n, n) transition over one step.
    gamma_u : ndarray
        (n, nu) effect of the held inputs over one step.
    gamma_w : ndarray
        (n, 1) effect of the nonlinear term over one step.
    position : ndarray
        (n,) row that reads the position off the state.
    velocity : ndarray
        (n,) row that reads the velocity off the state.
    c : ndarray
        Coefficients of the nonlinear term w.
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
    k2, k3, k5, drag, beta = c[0], c[1], c[2], c[3], c[4]
    coulomb, static, speed, tilt = c[5], c[6], c[7], c[8]
    dry = coulomb != 0.0 or static != 0.0
    gv = 0.0
    for i in range(m):
        gv += velocity[i] * gamma_w[i]
    for k in range(n):
        for i in range(m):
            out[k, i] = x[i]
        for _ in range(steps):
            p = 0.0
            v = 0.0
            for i in range(m):
                p += position[i] * x[i]
                v += velocity[i] * x[i]
            w = (k2 + k3 * p) * p * p + k5 * abs(p) * p + drag * abs(v) * v - beta * u[k] * p
            for i in range(m):
                total = gamma_u[i] * u[k]
                for j in range(m):
                    total += phi[i, j] * x[j]
                free[i] = total
            p1 = 0.0
            v1 = 0.0
            for i in range(m):
                e = free[i] - gamma_w[i] * w
                p1 += position[i] * e
                v1 += velocity[i] * e
            w1 = (k2 + k3 * p1) * p1 * p1 + k5 * abs(p1) * p1 + drag * abs(v1) * v1 - beta * u[k] * p1
            w = 0.5 * (w + w1)
            if dry:
                level = coulomb
                if static != 0.0:
                    level = coulomb + static * np.exp(-((v / speed) ** 2))
                v1 = 0.0
                for i in range(m):
                    v1 += velocity[i] * (free[i] - gamma_w[i] * w)
                force = v1 / gv if gv != 0.0 else 0.0
                if force > level * (1.0 + tilt):
                    force = level * (1.0 + tilt)
                elif force < -level * (1.0 - tilt):
                    force = -level * (1.0 - tilt)
                w += force
            big = 0.0
            for i in range(m):
                x[i] = free[i] - gamma_w[i] * w
                big += abs(x[i])
            if not big < 1e60:
                out[k:] = np.inf
                return out
    return out


@_compile
def hinges(x, c):  # pragma: no cover - compiled
    """x + sum c[2i] max(x - c[2i + 1], 0): a broken line of slope 1 at the far left.

    Parameters
    ----------
    x : ndarray
        (N,) the signal.
    c : ndarray
        Slopes and corners in turn.

    Returns
    -------
    ndarray
        (N,).
    """
    out = np.empty_like(x)
    for k in range(x.shape[0]):
        total = x[k]
        for i in range(0, c.shape[0], 2):
            if x[k] > c[i + 1]:
                total += c[i] * (x[k] - c[i + 1])
        out[k] = total
    return out


@_compile
def tank_levels(u, p, x0, steps):  # pragma: no cover - compiled
    """Levels of two tanks in series with square-root outflow; the first overflows, partly into the second.

    x1' = a u + b - k1 sqrt(x1) - spill, x2' = k2 sqrt(x1) - k3 sqrt(x2) + share spill, with
    p = (a, b, k1, k2, k3, brim, share); `spill` is whatever would raise the first tank above its brim.

    Parameters
    ----------
    u : ndarray
        (N, nu) inputs.
    p : ndarray
        Parameters.
    x0 : ndarray
        Initial state.
    steps : int
        Integration steps per sample.

    Returns
    -------
    ndarray
        (N, 2) levels.
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
