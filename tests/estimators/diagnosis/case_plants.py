"""Plants and inputs of the cases with an undeclared effect, simulated in continuous time between samples."""

from __future__ import annotations

import numpy as np
from scipy.signal import chirp, lfilter

KINDS = ("lag1", "lag2", "osc", "osc_zero", "osc_lag", "two_mode")
SUBSTEPS = 12


def draw_plant(rng: np.random.Generator, kind: str, wide: bool = False) -> dict[str, float | str]:
    """A stable plant with unit static gain, rates per sample; `wide` draws slower, faster and less damped ones."""
    u = rng.uniform
    if wide:
        return _wide_plant(rng, kind)
    if kind == "lag1":
        return {"kind": kind, "tau": u(3, 14)}
    if kind == "lag2":
        return {"kind": kind, "tau1": u(5, 13), "tau2": u(1.5, 5)}
    osc = {"kind": kind, "wn": u(0.15, 0.6), "zeta": float(np.exp(u(np.log(0.02), np.log(0.7))))}
    if kind == "osc_zero":
        osc["zero"] = u(0.8, 2.5) * rng.choice([-1, 1])
    if kind == "osc_lag":
        osc["tau"] = u(1.5, 4)
    if kind == "two_mode":
        osc |= {
            "wn": u(0.2, 0.4),
            "zeta": u(0.03, 0.2),
            "w2": u(0.5, 1.0),
            "z2": u(0.03, 0.15),
            "g2": u(0.3, 0.8) * rng.choice([-1, 1]),
        }
    return osc


def _wide_plant(rng: np.random.Generator, kind: str) -> dict[str, float | str]:
    def u(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    if kind == "lag1":
        return {"kind": kind, "tau": u(1.5, 40)}
    if kind == "lag2":
        return {"kind": kind, "tau1": u(3, 25), "tau2": u(1, 12)}
    plant: dict[str, float | str] = {"kind": kind, "wn": u(0.06, 1.1), "zeta": u(0.01, 1.3)}
    if kind == "osc_zero":
        plant["zero"] = u(0.3, 4.0) * float(rng.choice([-1, 1]))
    if kind == "osc_lag":
        plant["tau"] = u(1, 8)
    if kind == "two_mode":
        w = u(0.1, 0.4)
        plant |= {"wn": w, "zeta": u(0.02, 0.3), "w2": w * u(1.8, 4), "z2": u(0.02, 0.2),
                  "g2": u(0.2, 0.9) * float(rng.choice([-1, 1]))}  # fmt: skip
    return plant


def order_of(kind: str) -> int:
    """Order of a kind of plant."""
    return {"lag1": 1, "lag2": 2, "osc": 2, "osc_zero": 2, "osc_lag": 3, "two_mode": 4}[kind]


def draw_input(rng: np.random.Generator, kind: str, n: int) -> np.ndarray:
    """One of eight kinds of input, of about unit size."""
    if kind == "white":
        return rng.standard_normal(n)
    if kind == "steps":  # few and long, of any level
        ends = np.sort(
            rng.choice(np.arange(10, n - 10), size=max(6, n // int(rng.integers(25, 60))), replace=False)
        )
        return np.repeat(rng.uniform(-1.7, 1.7, len(ends) + 1), np.diff(np.concatenate(([0], ends, [n]))))
    if kind == "sweep":  # logarithmic, up and down again
        half = n // 2
        up = chirp(np.arange(half + 1), 0.003, half, rng.uniform(0.08, 0.4), method="logarithmic")
        return 1.4 * np.concatenate((up, up[::-1]))[:n]
    if kind == "noise":
        u = lfilter([1.0], [1.0, -rng.uniform(0, 0.8)], rng.standard_normal(n))
        return u / np.std(u)
    hold = int(rng.integers(2, 12))
    if kind == "prbs":
        return np.repeat(rng.choice([-1.0, 1.0], n // hold + 1), hold)[:n]
    if kind == "aprbs":
        return np.repeat(rng.uniform(-1.8, 1.8, n // hold + 1), hold)[:n]
    if kind == "multisine":
        period = int(rng.choice([100, 125, 200, 250]))
        lines = np.arange(1, max(4, int(period * rng.uniform(0.1, 0.25))))
        t = np.arange(n)
        u = sum(np.cos(2 * np.pi * k * t / period + rng.uniform(0, 2 * np.pi)) for k in lines)
        return u / np.std(u)
    f1 = rng.uniform(0.1, 0.25)
    return 1.4 * chirp(np.arange(n), 0.002, n, f1)


def _derivative(plant: dict, effect: dict, x: list[float], u: float) -> list[float]:
    kind = plant["kind"]
    if kind == "lag1":
        drive = u - effect.get("drag", 0.0) * abs(x[0]) * x[0] + effect.get("bilinear", 0.0) * u * x[0]
        return [(drive - x[0] - effect.get("k3", 0.0) * x[0] ** 3) / plant["tau"]]
    if kind == "lag2":
        if effect.get("speed"):
            load = effect.get("drag", 0.0) * abs(x[0]) * x[0]
            return [(x[1] - x[0] - load) / plant["tau1"], (u - x[1]) / plant["tau2"]]
        return [
            (x[1] - x[0]) / plant["tau2"],
            (u + effect.get("bilinear", 0.0) * u * x[1] - x[1]) / plant["tau1"],
        ]
    w, z = plant["wn"], plant["zeta"]
    drive = u
    if kind == "osc_lag":
        drive = x[2]
    force = drive - x[0] - effect.get("k3", 0.0) * x[0] ** 3 - effect.get("k2", 0.0) * x[0] ** 2
    force += effect.get("bilinear", 0.0) * u * x[0]
    d = [x[1], w * w * force - 2 * z * w * x[1] - effect.get("drag", 0.0) * w * w * abs(x[1]) * x[1]]
    if kind == "osc_lag":
        d.append((u - x[2]) / plant["tau"])
    if kind == "two_mode":
        d += [x[3], plant["w2"] ** 2 * (u - x[2]) - 2 * plant["z2"] * plant["w2"] * x[3]]
    return d


def _output(plant: dict, x: list[float]) -> float:
    kind = plant["kind"]
    if kind == "osc_zero":
        return x[0] + plant["zero"] * x[1]
    if kind == "two_mode":
        return x[0] + plant["g2"] * x[2]
    return x[0]


def run_plant(plant: dict, effect: dict, u: np.ndarray, k0: float, rest: bool) -> np.ndarray:
    """Sampled output (N,) at SUBSTEPS values per sample, so that play sees the extremes: (N, SUBSTEPS)."""
    n, h = len(u), 1.0 / SUBSTEPS
    size = {"lag1": 1, "lag2": 2, "osc": 2, "osc_zero": 2, "osc_lag": 3, "two_mode": 4}[plant["kind"]]
    x = [0.0] * size
    if not rest and "x0" in effect:
        x[0] = effect["x0"]
    step = effect.get("step")
    if step and rest:  # the disturbance began before: settled at its level
        x[0] += step[1]
        if plant["kind"] in ("lag2", "osc_lag"):
            x[-1] += step[1]
        if plant["kind"] == "two_mode":
            x[2] += step[1]
    lag_state, mode, actuator = 0.0, [0.0, 0.0], 0.0
    delay = round(effect.get("delay", 0.0) * SUBSTEPS)
    fine = np.repeat(u, SUBSTEPS)
    if delay:
        fine = np.concatenate((np.zeros(delay), fine[:-delay]))
    out = np.empty((n, SUBSTEPS))
    base = dict(plant)
    rate = effect.get("rate")
    friction = effect.get("friction")
    velocity_index = 1 if plant["kind"] not in ("lag1", "lag2") else 0
    if friction:
        if plant["kind"] == "lag1":
            gain = 1 / plant["tau"]
        elif plant["kind"] == "lag2":
            gain = 1 / plant["tau1"]
        else:
            gain = plant["wn"] ** 2
    for k in range(n):
        change = effect.get("change")
        if change and k0 + k >= change[0]:
            plant = base | {name: base[name] * factor for name, factor in change[1].items()}
        for s in range(SUBSTEPS):
            v = float(fine[k * SUBSTEPS + s])
            v *= 1.0 + effect.get("slope", 0.0) * (k0 + k)
            if change and k0 + k >= change[0]:
                v *= change[2]
            if step and k0 + k + s * h >= step[0]:
                v += step[1]
            if rate:
                actuator += min(max(v - actuator, -rate * h), rate * h)
                v = actuator
            y = _output(plant, x)
            if "mode" in effect:
                y += effect["mode"][2] * mode[0]
            if "lag" in effect:
                out[k, s] = lag_state
                lag_state += h * (y - lag_state) / effect["lag"]
            else:
                out[k, s] = y
            a = _derivative(plant, effect, x, v)
            b = _derivative(plant, effect, [p + h / 2 * q for p, q in zip(x, a)], v)
            c = _derivative(plant, effect, [p + h / 2 * q for p, q in zip(x, b)], v)
            d = _derivative(plant, effect, [p + h * q for p, q in zip(x, c)], v)
            x = [p + h / 6 * (q + 2 * r + 2 * t + w) for p, q, r, t, w in zip(x, a, b, c, d)]
            if friction:
                level, excess, speed = friction
                now = x[velocity_index]
                push = h * gain * (level + excess * np.exp(-((now / speed) ** 2)))
                x[velocity_index] = np.sign(now) * max(abs(now) - push, 0.0)
            if "mode" in effect:
                w, z, _ = effect["mode"]
                mode[1] += h * (w * w * (v - mode[0]) - 2 * z * w * mode[1])
                mode[0] += h * mode[1]
            if abs(x[0]) > 1e6:
                return np.full((n, SUBSTEPS), np.inf)
    return out


def closed_loop(plant: dict, reference: np.ndarray, gain: float, noise: np.ndarray) -> np.ndarray:
    """Input of a proportional loop around the plant, simulated sample by sample."""
    size = order_of(str(plant["kind"]))
    x, h, u = [0.0] * size, 1.0 / SUBSTEPS, np.empty(len(reference))
    for k in range(len(reference)):
        u[k] = reference[k] - gain * (_output(plant, x) + noise[k])
        for _ in range(SUBSTEPS):
            a = _derivative(plant, {}, x, u[k])
            b = _derivative(plant, {}, [p + h / 2 * q for p, q in zip(x, a)], u[k])
            x = [p + h * q for p, q in zip(x, b)]
        if abs(x[0]) > 1e4:
            return np.full(len(reference), np.inf)
    return u
