"""What the rigs of `case_classes` and `case_hidden` are made of: inputs, small Euler steps in plain Python, filters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

__all__ = ["FINE", "PLANT", "excitation", "lag", "linear", "process", "read", "sensor", "swing", "wheel"]

FINE = 25  # Euler steps per sample
PLANT = ([0.0, 0.12, 0.08], np.real(np.poly([0.85 * np.exp(0.25j), 0.85 * np.exp(-0.25j)])))


def excitation(
    rng: np.random.Generator,
    n: int,
    mean: float = 0.0,
    size: float = 1.0,
    hold: int = 7,
    inputs: int = 1,
    two: bool = False,
) -> np.ndarray:
    """Held levels, or `two` in turn, about a mean, at rest on it for the first 15 samples; (n, inputs) where there are several."""
    if inputs > 1:
        return np.stack([excitation(rng, n, mean, size, hold) for _ in range(inputs)], axis=1)
    levels = np.resize([1.0, -1.0], n) if two else rng.uniform(-1.7, 1.7, n)
    u = np.repeat(levels, rng.integers(max(hold // 2, 1), 2 * hold, n))[:n]
    u[:15] = 0.0
    return mean + size * u


def linear(u: np.ndarray, poles: tuple[float, ...] = ()) -> np.ndarray:
    den = np.convolve(PLANT[1], np.poly(poles)) if poles else PLANT[1]
    return np.asarray(lfilter(PLANT[0], den, u - u[0])) + u[0] * np.sum(PLANT[0]) / np.sum(den)


def lag(u: np.ndarray, pole: float) -> np.ndarray:
    return u[0] + np.asarray(lfilter([1 - pole], [1, -pole], u - u[0]))


def sensor(x: np.ndarray, start: float, pole: float = 0.5) -> np.ndarray:
    """What is read at the start of each sample of a state given at the ends, behind a lag."""
    return lag(np.concatenate(([start], x[:-1])), pole)


def process(slope: Callable[[float, float], float], u: np.ndarray, x: float) -> np.ndarray:
    """State at the end of each sample of x' = slope(x, u)."""
    out = np.empty(len(u))
    for k, value in enumerate(u):
        for _ in range(FINE):
            x += slope(x, value) / FINE
        out[k] = x
    return out


def swing(force: Callable[[float, float, float, float], float], u: np.ndarray) -> np.ndarray:
    """Position at the start of each sample of x'' = force(x, v, u, t), from rest."""
    x = v = 0.0
    out = np.empty(len(u))
    for k, value in enumerate(u):
        out[k] = x
        for i in range(FINE):
            v += force(x, v, value, k + i / FINE) / FINE
            x += v / FINE
    return out


def read(u, at):
    """The continuous output of a linear plant at any time, by filtering an input held on a fine grid."""
    fine = np.repeat(u, FINE)
    den = np.poly(np.exp(np.log(np.roots(PLANT[1]).astype(complex)) / FINE)).real
    y = lfilter([np.sum(den)], den, fine - u[0]) + u[0]
    return np.interp(at * FINE, np.arange(len(y)), y)


def wheel(u, pace, height, turn):
    """Speed of a wheel with an eccentric, parked at its lowest point: `height` what that needs, `turn` radian per unit of the angle."""
    angle, speed, out = 0.0, 0.0, np.empty(len(u))
    for k, value in enumerate(u):
        out[k] = speed
        for _ in range(FINE):
            speed += pace * (value - speed - height * np.sin(turn * angle)) / FINE
            angle += speed / FINE
    return out
