"""Cases with an undeclared effect, drawn at random: plants, inputs, effects, strengths, noise.

Everything is simulated here, in continuous time with Runge-Kutta steps between samples, and shares no code with
the models that are fitted. `write_case` makes the same folders as the practice cases, so that one scorer serves both.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from tests.estimators.diagnosis.case_effects import after, draw_effect, static_input
from tests.estimators.diagnosis.case_plants import (
    KINDS,
    closed_loop,
    draw_input,
    draw_plant,
    order_of,
    run_plant,
)

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


def write_case(
    folder: Path,
    name: str,
    families: tuple[str, ...],
    rng: np.random.Generator,
    tier: str = "normal",
    mimo: str = "",
    wide: bool = False,
) -> bool:
    """Draw a case and write it; False where the draw makes no case (too weak, unstable, or hidden).

    `wide` draws plants, inputs, strengths, noise levels, record lengths and units from wider ranges.
    """
    from estimators.diagnosis.effects import Clock
    from estimators.diagnosis.model.fitting import Channel
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Structure

    kinds = list(KINDS)
    inner = {"duffing": ["osc", "osc_lag"], "coulomb_friction": ["lag1", "lag2", "osc"], "bilinear": ["lag1", "lag2", "osc"],
             "stribeck_friction": ["lag1", "lag2", "osc"], "nonlinear_drag": ["lag1", "lag2", "osc"],
             "closed_loop": ["lag1", "lag2", "osc"]}  # fmt: skip
    for family in families:
        kinds = [k for k in kinds if k in inner.get(family, kinds)]
    if not kinds:
        return False
    ny = 2 if mimo or "mimo_cross" in families else 1
    lengths = [300, 450, 700, 900, 1300, 1700, 2600, 3500] if wide else [400, 500, 600, 1000, 1500, 2000]
    n, m = int(rng.choice(lengths)), int(rng.choice([500, 600, 800, 1000, 1200]))
    gap = float(int(rng.integers(0, 100)))
    k_train, k_test = np.arange(n), n + gap + np.arange(m)
    size = {"normal": 1.0, "weak": 0.45, "two_effects": 0.9}[tier]
    if wide:
        size *= float(np.exp(rng.uniform(np.log(0.5), np.log(1.8))))
    if ny == 2:
        kinds = [k for k in kinds if k in ("lag1", "lag2", "osc")] or kinds
    plants = [draw_plant(rng, str(rng.choice(kinds)), wide) for _ in range(ny)]
    struck = int(rng.integers(ny))
    signals = ["noise", "prbs", "aprbs", "multisine", "chirp"] + (["white", "steps", "sweep"] if wide else [])
    excitations = [str(rng.choice(signals)) for _ in range(ny)]
    if set(families) & {"input_saturation", "input_deadzone", "hammerstein"}:
        excitations = [e if e != "prbs" else "aprbs" for e in excitations]
    test_kinds = [str(rng.choice(signals)) if rng.integers(2) else e for e in excitations]
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
            fine = run_plant(plants[i], mine, static_input(mine, drive[:, i]), float(k[0]), which == 1)
            y = fine
            if coupling.any():
                other = run_plant(plants[i if full else 1 - i], {}, drive[:, 1 - i], float(k[0]), which == 1)
                y = y + coupling[i] * other
            columns.append(after(mine, y, k, scale) if i == struck else y[:, 0])
        return np.stack(columns, axis=1)

    scale = 1.0
    plain = np.stack([run_plant(plants[i], {}, u[0][:, i], 0.0, True)[:, 0] for i in range(ny)], axis=1)
    scale = float(np.std(plain))
    nsr = float(np.exp(rng.uniform(np.log(0.002 if wide else 0.004), np.log(0.2 if wide else 0.12))))
    sigma = nsr * scale
    if "closed_loop" in families:
        sigma = max(sigma, 0.15 * scale)
        gain = rng.uniform(0.6, 1.6) if plants[0]["kind"] == "lag1" else rng.uniform(0.3, 0.9)
        u[0] = closed_loop(plants[0], u[0][:, 0], gain, sigma * shaped[0][:, 0])[:, None]
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
        ratio = (
            rng.uniform(1.6 if wide else 1.8, 9.0 if wide else 6.0)
            if tier != "weak"
            else rng.uniform(1.12, 1.5)
        )
        sigma = float(np.clip(miss / np.sqrt(ratio**2 - 1), 0.003 * scale, (0.25 if wide else 0.12) * scale))
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
    low, high = (1e-5, 1e4) if wide else (0.3, 30)
    su, sy = [float(f"{np.exp(rng.uniform(np.log(low), np.log(high))):.2g}") for _ in range(2)]
    dt = float(rng.choice([1e-3, 0.01, 0.02, 1.0, 5.0]))
    _write(folder, name, families, tier, metric, u, noisy, clean[1], ideal_y, linear, innovation_share * sigma,
           (su, sy, dt), (k_train, k_test), structure, orders, effect, plants, (excitations, test_kinds))  # fmt: skip
    return True


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
    folder: Path,
    count: int,
    seed: int,
    tiers: tuple[str, ...] = ("normal", "weak", "two_effects"),
    wide: bool = False,
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
        if write_case(folder, name, families, rng, tier, mimo, wide):
            names.append(name)
            index += 1
        elif attempt % 12 == 0:
            index += 1
    return names


if __name__ == "__main__":
    import sys

    write_cases(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), wide=sys.argv[4:] == ["wide"])
