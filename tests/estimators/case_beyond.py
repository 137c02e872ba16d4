"""One record per effect of the whole list, catalogued and not, on plants drawn at random: who is mistaken for whom.

Simulated with Runge-Kutta steps between samples, in units of the rig; shares no code with the models that are fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from oed.data import Record

__all__ = ["BEYOND", "Beyond", "draw_beyond"]

SUBSTEPS = 10
Force = Callable[
    [float, float, float], float
]  # (position, velocity, drive) -> force subtracted from the drive


@dataclass(frozen=True)
class Beyond:
    """An effect with the answers that are right for it: causes, and natures where "unknown" is said."""

    causes: frozenset[str]
    natures: frozenset[str]
    plants: tuple[str, ...] = ("lag1", "lag2", "osc")


def _entry(causes: str, natures: str, plants: str = "lag1 lag2 osc") -> Beyond:
    return Beyond(frozenset(causes.split()), frozenset(natures.split(", ")), tuple(plants.split()))


_DYN, _IN, _OUT = "dynamic nonlinearity", "static input nonlinearity", "static output nonlinearity"
_ADD, _TIME, _LIN, _NOISE = "disturbance", "time variation", "linear dynamics", "noise"

BEYOND: dict[str, Beyond] = {
    "stiffness_square": _entry("duffing", _DYN, "osc"),
    "stiffness_asymmetric": _entry("duffing", _DYN, "osc"),
    "stiffness_fifth": _entry("duffing", _DYN, "osc"),
    "stiffness_gap": _entry("duffing", _DYN, "osc"),
    "end_stop": _entry("duffing", _DYN, "osc"),
    "hysteretic_spring": _entry("backlash", _DYN, "osc"),
    "position_damping": _entry("nonlinear_drag", _DYN, "osc"),
    "product_late": _entry("unknown", _DYN, "lag1 lag2 osc"),
    "product_square": _entry("unknown", _DYN, "lag1 lag2 osc"),
    "product_of_inputs": _entry("unknown", _DYN, "lag1 lag2 osc"),
    "direction_rates": _entry("unknown", _DYN, "lag1 lag2"),
    "outflow": _entry("square_root_outflow", _DYN, "lag1"),
    "relay": _entry("hammerstein input_deadzone", _IN),
    "input_sign": _entry("hammerstein", _IN),
    "input_tanh": _entry("input_saturation hammerstein", _IN),
    "input_staircase": _entry("unknown hammerstein", _IN),
    "output_exponential": _entry("output_nonlinearity", _OUT),
    "output_absolute": _entry("output_nonlinearity", _OUT),
    "between_blocks": _entry("output_nonlinearity", f"{_OUT}, {_DYN}, {_IN}", "lag2 osc"),
    "hysteresis_input": _entry("backlash", _DYN),
    "gain_breathing": _entry("gain_drift", _TIME),
    "pulse_disturbance": _entry("unknown step_disturbance", _ADD),
    "square_disturbance": _entry("periodic_disturbance step_disturbance", _ADD),
    "random_walk": _entry("coloured_noise output_drift", f"{_ADD}, {_NOISE}"),
    "noise_of_level": _entry("none coloured_noise outliers", _NOISE),
    "noise_grows": _entry("none outliers", _NOISE),
    "fractional_lag": _entry("sensor_lag missing_mode", _LIN),
    "two_modes": _entry("missing_mode", _LIN),
    "lead": _entry("missing_mode sensor_lag transport_delay", _LIN, "lag2 osc"),
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


def _before(key: str, rng: np.random.Generator, u: np.ndarray, strength: float) -> np.ndarray:
    n, k = len(u), np.arange(len(u))
    if key == "relay":
        return u + 0.5 * strength * np.sign(u)
    if key == "input_sign":
        return u + 0.35 * strength * np.abs(u)
    if key == "input_tanh":
        return np.tanh(1.1 * u) / 1.1
    if key == "input_staircase":
        return np.round(u / 0.9) * 0.9
    if key == "product_of_inputs":
        return u + 0.5 * strength * u * np.concatenate(([0.0] * 3, u[:-3]))
    if key == "gain_breathing":
        return u * (1.0 + 0.45 * strength * np.sin(2 * np.pi * rng.uniform(1.5, 3.5) * k / n + 1.0))
    if key == "fractional_lag":  # half an order: a cascade of leads and lags
        for p in (0.6, 0.85, 0.95, 0.99):
            z = p * 0.86
            u = np.asarray(lfilter([1.0 - p, -(1.0 - p) * z], [1.0 - z, -(1.0 - z) * p], u))
        return u
    if key == "two_modes":
        total = u.copy()
        for w, z, g in ((rng.uniform(0.8, 1.1), 0.02, 0.25), (rng.uniform(1.5, 2.2), 0.02, 0.35)):
            r = np.exp(-z * w)
            total += g * np.asarray(
                lfilter([0.0, 1 - 2 * r * np.cos(w) + r * r], [1, -2 * r * np.cos(w), r * r], u)
            )
        return total
    if key == "lead":
        return np.asarray(lfilter([-1.5 * strength - 0.5, 2.5 + 1.5 * strength - 1.0], [1.0, -0.0], u))
    if key == "hysteresis_input":
        z, before, out, width = 0.0, 0.0, np.empty(n), 0.6
        for i, v in enumerate(u):
            for _ in range(20):
                move = (v - before) / 20
                z += move - abs(move) * (z + np.sign(move) * abs(z)) / (2 * width)
            before, out[i] = v, 0.35 * v + 0.65 * z
        return out
    return u


def _force(key: str, strength: float, rates: dict[str, float]) -> Force:
    s, w = strength, rates["w"]
    forces: dict[str, Force] = {
        "stiffness_square": lambda x, v, u: 0.5 * s * abs(x) * x,
        "stiffness_asymmetric": lambda x, v, u: 0.7 * s * max(x, 0.0),
        "stiffness_fifth": lambda x, v, u: 0.15 * s * x**5,
        "stiffness_gap": lambda x, v, u: 2.0 * s * (max(x - 0.6, 0.0) + min(x + 0.6, 0.0)),
        "end_stop": lambda x, v, u: 20.0 * max(x - 1.0, 0.0),
        "position_damping": lambda x, v, u: 1.2 * s * x * x * v / w,
        "outflow": lambda x, v, u: 4.0 * (np.sqrt(max(1.0 + 0.5 * x, 0.02)) - 1.0) - x,
    }
    return forces.get(key, lambda x, v, u: 0.0)


def _run(key: str, rng: np.random.Generator, kind: str, u: np.ndarray, strength: float) -> np.ndarray:
    """Sampled output of the plant with the effect inside it."""
    w, zeta = rng.uniform(0.2, 0.5), rng.uniform(0.08, 0.5)
    t1, t2 = rng.uniform(4, 12), rng.uniform(1.5, 4)
    force = _force(key, strength, {"w": w})
    h = 1.0 / SUBSTEPS
    x, y = [0.0, 0.0, 0.0], np.empty(len(u))
    past = np.zeros(8)

    def slope(x: list[float], v: float) -> list[float]:
        if kind == "lag1":
            rate = 1.0 / t1 if not (key == "direction_rates" and v > x[0]) else (1.0 + 1.2 * strength) / t1
            return [rate * (v - x[0] - force(x[0], 0.0, v)), 0.0, 0.0]
        if kind == "lag2":
            rate = 1.0 / t1 if not (key == "direction_rates" and x[1] > x[0]) else (1.0 + 1.2 * strength) / t1
            return [rate * (x[1] - x[0]), (v - x[1]) / t2, 0.0]
        spring, bend = x[0], 0.0
        if key == "hysteretic_spring":
            move = x[1]
            bend = move - abs(move) * (x[2] + np.sign(move) * abs(x[2])) / 1.2
            spring = 0.5 * x[0] + 0.5 * strength * x[2] * 1.6
        pull = v - spring - force(x[0], x[1], v)
        return [x[1], w * w * pull - 2 * zeta * w * x[1], bend]

    for k, value in enumerate(u):
        y[k] = x[0]
        past = np.concatenate(([x[0]], past[:-1]))
        v = float(value)
        if key == "product_late":
            v += 0.5 * strength * (u[k - 4] if k >= 4 else 0.0) * past[6]
        if key == "product_square":
            v += 0.35 * strength * v * past[2] ** 2
        for _ in range(SUBSTEPS):
            a = slope(x, v)
            b = slope([p + h / 2 * q for p, q in zip(x, a)], v)
            c = slope([p + h / 2 * q for p, q in zip(x, b)], v)
            d = slope([p + h * q for p, q in zip(x, c)], v)
            x = [p + h / 6 * (q + 2 * r + 2 * t + z) for p, q, r, t, z in zip(x, a, b, c, d)]
        if abs(x[0]) > 1e3:
            return np.full(len(u), np.inf)
    return y


def _after(key: str, rng: np.random.Generator, y: np.ndarray, strength: float) -> np.ndarray:
    n, k, size = len(y), np.arange(len(y)), float(np.std(y))
    if key == "output_exponential":
        return size * (np.exp(0.5 * y / size) - 1.0)
    if key == "output_absolute":
        return y + 0.3 * strength * np.abs(y)
    if key == "between_blocks":
        z = size * np.tanh(1.3 * y / size)
        return np.asarray(lfilter([0.25], [1.0, -0.75], z))
    if key == "pulse_disturbance":
        start = int(rng.uniform(0.2, 0.5) * n)
        return y + 0.8 * size * ((k > start) & (k < start + int(rng.uniform(0.08, 0.2) * n)))
    if key == "square_disturbance":
        return y + 0.3 * size * np.sign(np.sin(2 * np.pi * rng.uniform(0.008, 0.03) * k))
    return y


def draw_beyond(key: str, seed: int, n: int = 1200, m: int = 800) -> tuple[Record, Record, int]:
    """Training record, test record and the linear order of one random case of an effect; units are random too."""
    for attempt in range(20):
        rng = np.random.default_rng([seed, attempt, *key.encode()])
        kind = str(rng.choice(list(BEYOND[key].plants)))
        strength = rng.uniform(0.7, 1.3)
        u = _input(rng, n + m)
        v = _before(key, rng, u, strength)
        state = rng.bit_generator.state
        parts = []
        for rows in (slice(0, n), slice(n, n + m)):  # the same plant twice, from rest
            rng.bit_generator.state = state
            parts.append(_run(key, rng, kind, v[rows], strength))
        y = np.concatenate(parts)
        if not np.all(np.isfinite(y)):
            continue
        y = _after(key, rng, y, strength)
        size = float(np.std(y))
        noise = rng.uniform(0.01, 0.04) * size * rng.standard_normal(n + m)
        if key == "random_walk":
            noise += 0.03 * size * np.cumsum(rng.standard_normal(n + m))
        if key == "noise_of_level":
            noise *= 3.0 * np.abs(y) / size
        if key == "noise_grows":
            noise *= 0.3 + 2.5 * np.arange(n + m) / (n + m)
        y = y + noise
        su, sy = np.exp(rng.uniform(-4, 4, 2))
        records = [Record(u=u[rows, None] * su, y=y[rows, None] * sy, dt=0.1, t0=0.1 * first)
                   for rows, first in ((slice(0, n), 0), (slice(n, n + m), n))]  # fmt: skip
        return records[0], records[1], {"lag1": 1, "lag2": 2, "osc": 2}[kind]
    raise RuntimeError(f"no draw of {key} made a case")
