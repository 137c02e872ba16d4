"""Effects of the cases: how their parameters are drawn, and what they do before and after the plant."""

from __future__ import annotations

import numpy as np


def static_input(effect: dict, u: np.ndarray) -> np.ndarray:
    if "limits" in effect:
        u = np.clip(u, *effect["limits"])
    if "dead" in effect:
        low, high = effect["dead"]
        u = np.maximum(u - high, 0) + np.minimum(u + low, 0)
    if "poly" in effect:
        u = u + effect["poly"][0] * u**2 + effect["poly"][1] * u**3
    if "play_in" in effect:
        m, out = 0.0, np.empty_like(u)
        for k, v in enumerate(u):
            m = min(max(m, v - effect["play_in"]), v + effect["play_in"])
            out[k] = m
        u = out
    return u


def after(effect: dict, fine: np.ndarray, k: np.ndarray, scale: float) -> np.ndarray:
    if "play_out" in effect:
        half, m, flat = effect["play_out"] * scale, 0.0, fine.ravel()
        out = np.empty_like(flat)
        for i, v in enumerate(flat):
            m = min(max(m, v - half), v + half)
            out[i] = m
        fine = out.reshape(fine.shape)
    y = fine[:, 0]
    if "curve" in effect:
        name, c = effect["curve"]
        c = c / scale
        if name == "atan":
            y = np.arctan(c * y) / c
        elif name == "cubic":
            y = y + c * abs(c) * 0.3 * y**3
        elif name == "quadratic":
            y = y + c * 0.4 * y**2
        else:
            y = np.clip(y, -1.3 / abs(c), 1.3 / abs(c))
    y = y + effect.get("offset", 0.0) * scale + effect.get("trend", 0.0) * scale * k
    for w, a, phase in effect.get("tones", ()):
        y = y + a * scale * np.sin(w * k + phase)
    return y


def draw_effect(
    rng: np.random.Generator, family: str, plant: dict, n_train: int, n_test: int, size: float
) -> dict:
    """Parameters of one effect; `size` near 1 is of normal strength."""
    u = rng.uniform
    kind = plant["kind"]
    if family == "input_saturation":
        high = u(0.6, 1.1) / size**0.3
        variant = rng.integers(3)
        return {"limits": [(-high, high), (-3 * high, high), (-high, 1.4 * high)][variant]}
    if family == "input_deadzone":
        return {
            "dead": (u(0.15, 0.6) * size, u(0.15, 0.6) * size)
            if rng.integers(2)
            else (d := u(0.2, 0.6) * size, d)
        }
    if family == "hammerstein":
        c2, c3 = u(0.1, 0.3) * rng.choice([-1, 1]) * size, u(0.03, 0.08) * rng.choice([-1, 1]) * size
        return {"poly": [(c2, 0.0), (0.0, c3), (c2, c3)][rng.integers(3)]}
    if family == "output_nonlinearity":
        return {
            "curve": (
                str(rng.choice(["atan", "cubic", "quadratic", "clip"])),
                u(0.6, 1.2) * size * rng.choice([-1, 1]),
            )
        }
    if family == "duffing":
        return {
            "k3": u(0.05, 0.4) * size * (1 if rng.integers(3) else -0.3),
            "k2": u(0, 0.1) if rng.integers(4) == 0 else 0.0,
        }
    if family in ("coulomb_friction", "stribeck_friction"):
        level = u(0.1, 0.35) * size
        excess = u(0.4, 1.0) * level if family == "stribeck_friction" else 0.0
        speed = u(0.1, 0.4) if kind in ("lag1", "lag2") else u(0.1, 0.4) * plant["wn"]
        return {"friction": (level, excess, speed), "speed": kind == "lag2"}
    if family == "nonlinear_drag":
        return {
            "drag": u(0.5, 2.0) * size if kind in ("lag1", "lag2") else u(0.5, 3.0) * size,
            "speed": kind == "lag2",
        }
    if family == "bilinear":
        return {"bilinear": u(0.15, 0.35) * size * rng.choice([-1, 1])}
    if family == "backlash":
        return {str(rng.choice(["play_in", "play_out"])): u(0.15, 0.45) * size}
    if family == "rate_limiter":
        return {"rate": u(0.15, 0.5) / size**0.5}
    if family == "transport_delay":
        return {"delay": float(rng.integers(1, 6)) if rng.integers(2) else u(0.6, 5.0)}
    if family == "missing_mode":
        return {"mode": (u(0.4, 1.3), float(np.exp(u(np.log(0.006), np.log(0.08)))), u(0.03, 0.25) * size)}
    if family == "sensor_lag":
        return {"lag": u(1.5, 6) * size}
    if family == "output_offset":
        return {"offset": u(0.1, 0.5) * size * rng.choice([-1, 1])}
    if family == "output_drift":
        return {"trend": u(0.3, 1.0) * size * rng.choice([-1, 1]) / n_train, "offset": u(-0.2, 0.2)}
    if family == "periodic_disturbance":
        w, a = u(0.1, 1.5), u(0.1, 0.5) * size
        tones = [(w, a, u(0, 6.28))]
        if rng.integers(2):
            tones.append((2 * w if rng.integers(2) else u(0.1, 1.5), a * u(0.3, 0.7), u(0, 6.28)))
        return {"tones": tones}
    if family == "step_disturbance":
        return {"step": (u(0.2, 0.8) * n_train, u(0.2, 0.6) * size * rng.choice([-1, 1]))}
    if family == "gain_drift":
        return {"slope": u(0.3, 0.8) * size / n_train * rng.choice([-0.6, 1])}
    if family == "parameter_change":
        at, factor = u(0.25, 0.75) * n_train, float(np.exp(u(0.25, 0.5) * size * rng.choice([-1, 1])))
        names = {"lag1": ["tau"], "lag2": ["tau1"], "two_mode": ["wn"]}.get(kind, ["wn", "zeta"])
        if rng.integers(2):
            return {"change": (at, {}, factor)}
        name = str(rng.choice(names))
        return {"change": (at, {name: factor if name != "zeta" else factor**3}, 1.0)}
    if family == "initial_condition":
        return {"x0": u(1.5, 5) * size * rng.choice([-1, 1])}
    return {family: size}


LINEAR = {
    "lag": [0.6], "clock_drift": [1.5], "interleaved": [0.3], "clock_settles": [2.0, 0.3], "lost_samples": [1.7, 90.3],
    "refreshed": [3.3, 1.2], "lag_drift": [2.0, 3.0, 0.5], "delay_periodic": [0.1, 1.2, -0.4], "clock_slips": [41.3, 0.2, 2.2],
}  # fmt: skip
"""Parameters of every effect with a memory that is linear in the output."""
