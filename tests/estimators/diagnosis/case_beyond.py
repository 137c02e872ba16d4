"""Records of effects that the case generator does not draw: springs, hysteresis inside a plant, products, jumps.

Simulated with Runge-Kutta steps between samples, in random units; shares no code with the models that are fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from oed.data import Record

__all__ = ["BEYOND", "Beyond", "draw_beyond"]

SUBSTEPS = 10


@dataclass(frozen=True)
class Beyond:
    """The right cause of an effect, its nature, and the plants that it is drawn on."""

    cause: str
    nature: str
    plants: tuple[str, ...] = ("lag1", "lag2", "osc")


BEYOND = {
    "stiffness_square": Beyond("duffing", "dynamic nonlinearity", ("osc",)),
    "stiffness_asymmetric": Beyond("duffing", "dynamic nonlinearity", ("osc",)),
    "hysteretic_spring": Beyond("hysteresis", "dynamic nonlinearity", ("osc",)),
    "position_damping": Beyond("nonlinear_drag", "dynamic nonlinearity", ("osc",)),
    "product_late": Beyond("unknown", "dynamic nonlinearity"),  # u(k-4) y(k-6): no product of the catalogue
    "product_of_inputs": Beyond("unknown", "dynamic nonlinearity"),  # u(k) u(k-3)
    "relay": Beyond("hammerstein", "static input nonlinearity"),  # a jump at zero: no polynomial
}


def _input(rng: np.random.Generator, n: int) -> np.ndarray:
    kind = rng.integers(3)
    if kind == 0:
        u = np.asarray(lfilter([1.0], [1.0, -rng.uniform(0.3, 0.85)], rng.standard_normal(n)))
        return u / np.std(u)
    if kind == 1:
        hold = int(rng.integers(3, 12))
        return np.repeat(rng.uniform(-1.8, 1.8, n // hold + 1), hold)[:n]
    period = int(rng.choice([200, 250]))
    lines = np.arange(1, max(6, int(period * rng.uniform(0.1, 0.2))))
    t = np.arange(n)
    u = np.sum([np.cos(2 * np.pi * k * t / period + rng.uniform(0, 2 * np.pi)) for k in lines], axis=0)
    return u / np.std(u)


def _before(key: str, u: np.ndarray, strength: float) -> np.ndarray:
    if key == "relay":
        return u + 0.5 * strength * np.sign(u)
    if key == "product_of_inputs":
        return u + 0.5 * strength * u * np.concatenate(([0.0] * 3, u[:-3]))
    return u


def _run(key: str, rng: np.random.Generator, kind: str, u: np.ndarray, strength: float) -> np.ndarray:
    """Sampled output of the plant from rest, with the effect inside it."""
    w, zeta = rng.uniform(0.2, 0.5), rng.uniform(0.08, 0.5)
    t1, t2 = rng.uniform(4, 12), rng.uniform(1.5, 4)
    h = 1.0 / SUBSTEPS
    x, y, past = [0.0, 0.0, 0.0], np.empty(len(u)), np.zeros(8)

    def slope(x: list[float], v: float) -> list[float]:
        if kind == "lag1":
            return [(v - x[0]) / t1, 0.0, 0.0]
        if kind == "lag2":
            return [(x[1] - x[0]) / t1, (v - x[1]) / t2, 0.0]
        force, bend = x[0], 0.0
        if key == "stiffness_square":
            force += 0.5 * strength * abs(x[0]) * x[0]
        elif key == "stiffness_asymmetric":
            force += 0.7 * strength * max(x[0], 0.0)
        elif key == "position_damping":
            force += 1.2 * strength * x[0] ** 2 * x[1] / w
        elif key == "hysteretic_spring":
            bend = x[1] - abs(x[1]) * (x[2] + np.sign(x[1]) * abs(x[2])) / 1.2
            force = 0.5 * x[0] + 0.8 * strength * x[2]
        return [x[1], w * w * (v - force) - 2 * zeta * w * x[1], bend]

    for k, value in enumerate(u):
        y[k] = x[0]
        past = np.concatenate(([x[0]], past[:-1]))
        v = float(value)
        if key == "product_late":
            v += 0.5 * strength * (u[k - 4] if k >= 4 else 0.0) * past[6]
        for _ in range(SUBSTEPS):
            a = slope(x, v)
            b = slope([p + h / 2 * q for p, q in zip(x, a)], v)
            c = slope([p + h / 2 * q for p, q in zip(x, b)], v)
            d = slope([p + h * q for p, q in zip(x, c)], v)
            x = [p + h / 6 * (q + 2 * r + 2 * t + z) for p, q, r, t, z in zip(x, a, b, c, d)]
        if abs(x[0]) > 1e3:
            return np.full(len(u), np.inf)
    return y


def draw_beyond(key: str, seed: int, n: int = 1200, m: int = 800) -> tuple[Record, Record, int]:
    """Training record, test record (both from rest) and the linear order of one random case of an effect."""
    for attempt in range(20):
        rng = np.random.default_rng([seed, attempt, *key.encode()])
        kind = str(rng.choice(list(BEYOND[key].plants)))
        strength = rng.uniform(0.7, 1.3)
        u = _input(rng, n + m)
        state = rng.bit_generator.state
        parts = []
        for rows in (slice(0, n), slice(n, n + m)):  # the same plant twice
            rng.bit_generator.state = state
            parts.append(_run(key, rng, kind, _before(key, u[rows], strength), strength))
        y = np.concatenate(parts)
        if not np.all(np.isfinite(y)):
            continue
        y = y + rng.uniform(0.01, 0.04) * np.std(y) * rng.standard_normal(n + m)
        su, sy = np.exp(rng.uniform(-4, 4, 2))
        train, test = (Record(u=u[rows, None] * su, y=y[rows, None] * sy, dt=0.1, t0=0.1 * first)
                       for rows, first in ((slice(0, n), 0), (slice(n, n + m), n)))  # fmt: skip
        return train, test, {"lag1": 1, "lag2": 2, "osc": 2}[kind]
    raise RuntimeError(f"no draw of {key} made a case")
