"""Cases with an undeclared effect, drawn at random: plants, inputs, effects, strengths, noise.

Everything is simulated here, in continuous time with Runge-Kutta steps between samples, and shares no code with
the models that are fitted. `write_case` makes the same folders as the practice cases, so that one scorer serves both.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import chirp, lfilter

FAMILIES = (
    "input_saturation", "input_deadzone", "output_nonlinearity", "hammerstein", "duffing", "coulomb_friction",
    "stribeck_friction", "nonlinear_drag", "bilinear", "backlash", "rate_limiter", "transport_delay", "missing_mode",
    "sensor_lag", "mimo_cross", "output_offset", "output_drift", "periodic_disturbance", "step_disturbance",
    "coloured_noise", "closed_loop", "outliers", "quantisation", "dropouts", "gain_drift", "parameter_change",
    "initial_condition",
)  # fmt: skip
SECOND = (
    "input_saturation", "input_deadzone", "output_nonlinearity", "hammerstein", "backlash", "transport_delay",
    "sensor_lag", "output_offset", "output_drift", "periodic_disturbance", "step_disturbance", "coloured_noise",
    "outliers", "gain_drift", "initial_condition", "duffing", "coulomb_friction", "nonlinear_drag",
)  # fmt: skip
KINDS = ("lag1", "lag2", "osc", "osc_zero", "osc_lag", "two_mode")
SUBSTEPS = 12


def draw_plant(rng: np.random.Generator, kind: str) -> dict[str, float | str]:
    """A stable plant with unit static gain, rates per sample."""
    u = rng.uniform
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


def order_of(kind: str) -> int:
    """Order of a kind of plant."""
    return {"lag1": 1, "lag2": 2, "osc": 2, "osc_zero": 2, "osc_lag": 3, "two_mode": 4}[kind]


def draw_input(rng: np.random.Generator, kind: str, n: int) -> np.ndarray:
    """One of five kinds of input, of about unit size."""
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


def _static_input(effect: dict, u: np.ndarray) -> np.ndarray:
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


def _after(effect: dict, fine: np.ndarray, k: np.ndarray, scale: float) -> np.ndarray:
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


def write_case(
    folder: Path,
    name: str,
    families: tuple[str, ...],
    rng: np.random.Generator,
    tier: str = "normal",
    mimo: str = "",
) -> bool:
    """Draw a case and write it; False where the draw makes no case (too weak, unstable, or hidden)."""
    from estimators.diagnosis.fitting import Channel
    from estimators.diagnosis.linear import fit_linear
    from estimators.diagnosis.structure import Structure, simulate
    from estimators.effects.catalogue import Clock

    kinds = list(KINDS)
    inner = {"duffing": ["osc", "osc_lag"], "coulomb_friction": ["lag1", "lag2", "osc"], "bilinear": ["lag1", "lag2", "osc"],
             "stribeck_friction": ["lag1", "lag2", "osc"], "nonlinear_drag": ["lag1", "lag2", "osc"],
             "closed_loop": ["lag1", "lag2", "osc"]}  # fmt: skip
    for family in families:
        kinds = [k for k in kinds if k in inner.get(family, kinds)]
    if not kinds:
        return False
    ny = 2 if mimo or "mimo_cross" in families else 1
    n, m = int(rng.choice([400, 500, 600, 1000, 1500, 2000])), int(rng.choice([500, 600, 800, 1000, 1200]))
    gap = float(int(rng.integers(0, 100)))
    k_train, k_test = np.arange(n), n + gap + np.arange(m)
    size = {"normal": 1.0, "weak": 0.45, "two_effects": 0.9}[tier]
    if ny == 2:
        kinds = [k for k in kinds if k in ("lag1", "lag2", "osc")] or kinds
    plants = [draw_plant(rng, str(rng.choice(kinds))) for _ in range(ny)]
    struck = int(rng.integers(ny))
    excitations = [str(rng.choice(["noise", "prbs", "aprbs", "multisine", "chirp"])) for _ in range(ny)]
    if set(families) & {"input_saturation", "input_deadzone", "hammerstein"}:
        excitations = [e if e != "prbs" else "aprbs" for e in excitations]
    test_kinds = [
        str(rng.choice(["noise", "prbs", "aprbs", "multisine", "chirp"])) if rng.integers(2) else e
        for e in excitations
    ]
    effect: dict[str, Any] = {}
    for family in families:
        effect |= draw_effect(rng, family, plants[struck], n, m, size)
    u = [
        np.stack([draw_input(rng, e, count) for e in group], axis=1)
        for group, count in ((excitations, n), (test_kinds, m))
    ]
    coupling = rng.uniform(0.05, 0.2, 2) * size if "mimo_cross" in families else np.zeros(2)
    full = mimo == "full"
    if full:
        coupling = rng.uniform(0.1, 0.3, 2)

    # closed loop: the input of the training record follows the noise
    colour = [1.0]
    if "coloured_noise" in families or "closed_loop" in families:
        if rng.integers(2):
            colour = [1.0, -rng.uniform(0.6, 0.95)]
        else:
            r, w = rng.uniform(0.7, 0.95), rng.uniform(0.1, 1.0)
            colour = [1.0, -2 * r * np.cos(w), r * r]
    raw = [rng.standard_normal((c, ny)) for c in (n, m)]
    shaped = [lfilter([1.0], colour, e, axis=0) for e in raw]
    power = np.std(shaped[0])
    shaped = [s / power for s in shaped]
    innovation_share = 1.0 / power

    def outputs(which: int, drive: np.ndarray, effects: dict) -> np.ndarray:
        k = (k_train, k_test)[which]
        columns = []
        for i in range(ny):
            mine = effects if i == struck else {}
            fine = run_plant(plants[i], mine, _static_input(mine, drive[:, i]), float(k[0]), which == 1)
            y = fine
            if coupling.any():
                other = run_plant(plants[i if full else 1 - i], {}, drive[:, 1 - i], float(k[0]), which == 1)
                y = y + coupling[i] * other
            columns.append(_after(mine, y, k, scale) if i == struck else y[:, 0])
        return np.stack(columns, axis=1)

    scale = 1.0
    plain = np.stack([run_plant(plants[i], {}, u[0][:, i], 0.0, True)[:, 0] for i in range(ny)], axis=1)
    scale = float(np.std(plain))
    nsr = float(np.exp(rng.uniform(np.log(0.004), np.log(0.12))))
    sigma = nsr * scale
    if "closed_loop" in families:
        sigma = max(sigma, 0.15 * scale)
        gain = rng.uniform(0.6, 1.6) if plants[0]["kind"] == "lag1" else rng.uniform(0.3, 0.9)
        u[0] = _closed_loop(plants[0], u[0][:, 0], gain, sigma * shaped[0][:, 0])[:, None]
        if not np.all(np.isfinite(u[0])):
            return False
    clean = [outputs(i, u[i], effect) for i in (0, 1)]
    if not all(np.all(np.isfinite(c)) and np.max(np.abs(c)) < 50 * scale for c in clean):
        return False
    structure = "SISO" if ny == 1 else ("full" if full else "diagonal")
    orders = [order_of(str(p["kind"])) for p in plants]
    if full:
        orders = [sum(orders)] * 2

    def linear(y: np.ndarray, i: int) -> np.ndarray:
        s = Structure(orders[i], (0, 1) if full else (i,))
        channel = Channel(u[0], y[:, i], Clock(k_train.astype(float), n), np.ones(n, dtype=bool))
        f = fit_linear(channel, s)
        return simulate(f.structure, f.p, u[1], Clock(k_test.astype(float), n), rest=True)

    deterministic = set(families) - {"coloured_noise", "closed_loop", "outliers", "quantisation", "dropouts"}
    if deterministic and families != ("none",):
        lti = np.stack([linear(clean[0] + 1e-3 * sigma * raw[0], i) for i in range(ny)], axis=1)
        miss = float(np.sqrt(np.mean((clean[1] - lti) ** 2)))
        ratio = rng.uniform(1.8, 6.0) if tier != "weak" else rng.uniform(1.12, 1.5)
        sigma = float(np.clip(miss / np.sqrt(ratio**2 - 1), 0.003 * scale, 0.12 * scale))
        if np.sqrt(miss**2 + sigma**2) / sigma < (1.5 if tier != "weak" else 1.1):
            return False
    noisy = [c + sigma * s for c, s in zip(clean, shaped)]
    metric, ideal_y = "sim_rmse", clean[1]
    if "outliers" in families:
        metric = "clean_sim_rmse"
        for y in noisy:
            hit = rng.random(y.shape) < rng.uniform(0.006, 0.03)
            signs = rng.choice([-1.0, 1.0], y.shape) if rng.integers(2) else np.ones(y.shape)
            y += np.where(
                hit, signs * rng.uniform(0.8, 1.2, y.shape) * rng.uniform(8, 25) * size * sigma, 0.0
            )
    if "quantisation" in families:
        step = rng.uniform(1.5, 4) * sigma if rng.integers(2) else rng.uniform(0.2, 0.5) * scale
        if step > 4 * sigma:
            sigma *= 0.3
            noisy = [c + sigma * s for c, s in zip(clean, shaped)]
        noisy = [np.round(y / step) * step for y in noisy]
        ideal_y = np.round(clean[1] / step) * step
    if "dropouts" in families:
        for y in noisy:
            lost, k = rng.random(len(y)) < 0.02, 1
            while k < len(y):
                if lost[k]:
                    run = int(rng.integers(1, 7))
                    y[k : k + run] = y[k - 1]
                    k += run
                k += 1
    if "closed_loop" in families:
        metric = "clean_sim_rmse"
    elif "coloured_noise" in families and len(families) == 1:
        metric = "pred_rmse"
    su, sy = [float(f"{np.exp(rng.uniform(np.log(0.3), np.log(30))):.2g}") for _ in range(2)]
    dt = float(rng.choice([1e-3, 0.01, 0.02, 1.0, 5.0]))
    _write(folder, name, families, tier, metric, u, noisy, clean[1], ideal_y, linear, innovation_share * sigma,
           (su, sy, dt), (k_train, k_test), structure, orders, effect, plants, (excitations, test_kinds))  # fmt: skip
    return True


def _closed_loop(plant: dict, reference: np.ndarray, gain: float, noise: np.ndarray) -> np.ndarray:
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


def _write(folder, name, families, tier, metric, u, noisy, clean, ideal_y, linear, innovation, units, clocks, structure, orders, effect, plants, excitations) -> None:  # fmt: skip
    su, sy, dt = units
    ny = clean.shape[1]
    lti = np.stack([linear(noisy[0], i) for i in range(ny)], axis=1)
    rms = lambda e: float(np.sqrt(np.mean(np.square(e))))
    before, ideal = rms(noisy[1] - lti), rms(noisy[1] - ideal_y)
    if metric == "clean_sim_rmse":
        before = rms(clean - lti)
        ideal = 0.1 * before
    elif metric == "pred_rmse":
        ideal = innovation
    public, truth = folder / "public" / "B" / name, folder / "truth" / "B"
    public.mkdir(parents=True, exist_ok=True)
    truth.mkdir(parents=True, exist_ok=True)
    names = ["u", "y"] if ny == 1 else ["u1", "u2", "y1", "y2"]
    for part, uu, y, k in (("train", u[0], noisy[0], clocks[0]), ("test", u[1], noisy[1], clocks[1])):
        rows = np.column_stack((k * dt, uu * su, y * sy))
        lines = [",".join(["t", *names])] + [",".join(f"{v:.8g}" for v in row) for row in rows]
        (public / f"{part}.csv").write_text("\n".join(lines) + "\n")
    meta = {"id": name, "sampling_time": dt, "inputs": names[:ny], "outputs": names[ny:], "structure": structure,
            "suggested_order": orders[0] if structure != "diagonal" else orders}  # fmt: skip
    (public / "meta.json").write_text(json.dumps(meta))
    given = [f for f in families if f != "none"] or ["none"]
    record = {"id": name, "families": given, "metric": metric, "is_control": given == ["none"], "is_high_order": False,
              "tier": tier, "criterion_before": before * sy, "criterion_ideal": ideal * sy, "effect": repr(effect),
              "reference": {"e_oracle": ideal * sy}, "plant": repr(plants), "excitation": repr(excitations)}  # fmt: skip
    (truth / f"{name}.json").write_text(json.dumps(record))
    table = np.column_stack((clean, ideal_y, lti)) * sy
    header = ",".join(f"{c}{i}" for c in ("clean", "oracle", "lti") for i in range(ny))
    (truth / f"{name}_clean.csv").write_text(
        header + "\n" + "\n".join(",".join(f"{v:.9g}" for v in row) for row in table) + "\n"
    )


def write_cases(
    folder: Path, count: int, seed: int, tiers: tuple[str, ...] = ("normal", "weak", "two_effects")
) -> list[str]:
    """Write `count` cases, families in turn, every seventh without an effect."""
    names, index, attempt = [], 0, 0
    while len(names) < count and attempt < 30 * count:
        attempt += 1
        rng = np.random.default_rng([seed, attempt])
        tier = tiers[index % len(tiers)]
        families: tuple[str, ...] = (
            FAMILIES[
                int(rng.permutation(len(FAMILIES))[0])
                if tier == "two_effects"
                else (index // len(tiers)) % len(FAMILIES)
            ],
        )
        mimo = ""
        if len(names) % 7 == 6:
            families, tier = ("none",), "normal"
        elif tier == "two_effects":
            pair = rng.permutation(len(SECOND))[:2]
            families = (SECOND[pair[0]], SECOND[pair[1]])
        if rng.random() < 0.12 and not set(families) & {
            "closed_loop",
            "duffing",
            "coulomb_friction",
            "stribeck_friction",
            "nonlinear_drag",
            "bilinear",
            "initial_condition",
        }:
            mimo = str(rng.choice(["diagonal", "full"]))
        name = f"case_{len(names):03d}"
        if "mimo_cross" in families and mimo == "full":
            mimo = "diagonal"
        if write_case(folder, name, families, rng, tier, mimo):
            names.append(name)
            index += 1
        elif attempt % 12 == 0:
            index += 1
    return names


if __name__ == "__main__":
    import sys

    write_cases(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
