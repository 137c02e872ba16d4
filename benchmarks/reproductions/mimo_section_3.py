"""[M] (5), (6) and (13), the frequency response of Fig. 4, and the map of Sec. V-B."""

from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import hankel

from benchmarks.tables.reproduced import row, traced
from estimators.norm.frf import frequency_response
from estimators.norm.gains import gain, rayleigh
from estimators.rules.inputs import multisine
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import Trace
from oed.plants.named import named_plant
from oed.plants.plant import Plant
from oed.theory.finite import finite_norm, singular_values

PLAIN = Plant([-0.5, -1.0, -0.3], [1.0, -0.2], noise_covariance=0.0, name="few-taps")
"""Its eigenvalue of largest modulus is negative on 12 samples: [M] (5) needs the modulus."""
SAMPLES = 12


def rows() -> list[dict[str, Any]]:
    """Equations, a response and a map."""
    return [*_equations(), *_scaling(), _response(), *_map()]


def _from(rule: Any, plant: Plant, samples: int, experiments: int, seed: int = 0) -> Trace:
    start = np.random.default_rng(seed).standard_normal((samples, plant.n_inputs))
    return traced(partial(rule, start=start), plant, samples, experiments)


def _equations() -> list[dict[str, Any]]:
    values = np.linalg.eigvalsh(hankel(PLAIN.impulse_response(SAMPLES)[::-1, 0, 0]))
    top = values[np.argmax(np.abs(values))]
    trace = _from(power_iterations, PLAIN, SAMPLES, 400)
    return [
        row("||Delta||_i2 is the eigenvalue of T Delta of largest modulus", "[M] (5), with |lambda|",
            float(singular_values(PLAIN, SAMPLES)[0]), float(abs(top)), 1e-12,
            f"{SAMPLES} samples; without the modulus (5) would say {values.max():.6g}.", kind="statement"),
        row("gamma_1 tends to that eigenvalue", "[M] (6), with |lambda|", float(top), rayleigh(trace).last, 1e-9,
            f"Procedure 1, {SAMPLES} samples, 400 experiments without noise.", kind="statement"),
    ]  # fmt: skip


def _scaling() -> list[dict[str, Any]]:
    single = [rayleigh(_from(power_iterations, PLAIN, SAMPLES, 30)).values, _unscaled(30)]
    several = [
        gain(_from(partial(procedure_2, scaling=how), named_plant("avis", 0.0), 60, 50)).values
        for how in ("none", "each")
    ]
    return [
        row(f"estimates with inputs scaled to their limits over those without, {name}", "[M] (13)", 1.0,
            float((a / b)[np.argmax(np.abs(a / b - 1))]), 1e-10,
            "the largest difference over all iterations from one start, without noise; rounding only.",
            kind="statement")
        for name, (a, b) in (("Procedure 1", single), ("Procedure 2", several))
    ]  # fmt: skip


def _unscaled(iterations: int) -> np.ndarray:
    """gamma_1 of [M] (6) by Procedure 1 as it stands, u+ = T Delta u, with the dense matrix."""
    u = np.random.default_rng(0).standard_normal((SAMPLES, 1))
    matrix, values = hankel(PLAIN.impulse_response(SAMPLES)[::-1, 0, 0]), []
    for _ in range(iterations):
        x = matrix @ u
        values.append(float(np.vdot(u, x) / np.vdot(u, u)))
        u = x
    return np.array(values)


def _response() -> dict[str, Any]:
    plant = named_plant("avis", 0.01)
    trace = traced(multisine, plant, 2000, 40, 5)
    found = frequency_response(trace)
    size = np.linalg.norm(found.response, 2, axis=(1, 2))
    k = int(np.argmax(size))
    return row("frequency response by experiments: its peak", "[M] Fig. 4, on a synthetic plant built to its numbers",
        None, float(size[k]), None,
        f"at {found.omega[k] / (2 * np.pi * plant.dt):.1f} Hz, on lines of {1 / (2000 * plant.dt):.2g} Hz ([M]: 1.95 at 296 Hz on a "
        f"coarser grid; the norm of the plant is {finite_norm(plant, 2000):.4f}); the plant was built to show it.")  # fmt: skip


def _map() -> list[dict[str, Any]]:
    plant, N = named_plant("reference", 0.0), 300
    trace = _from(power_iterations, plant, N, 60, seed=3)
    sizes = np.array([np.linalg.norm(r.y) for r in trace.records])
    ratios = [_amplified(plant, r.y[::-1]) for r in (trace.records[0], trace.records[-1])]
    return [
        row("the output grows with every iteration", "[M] Sec. V-B, below (15)", "59 of 59",
            f"{int(np.sum(np.diff(sizes) > 0))} of 59", None,
            f"reference plant, N = {N}, 60 iterations without noise; inputs of one size.",
            bool((np.diff(sizes) > 0).all()), "statement"),
        row("the map (15) is no contraction", "[M] Sec. V-B", "a small difference grows",
            f"{ratios[0]:.3f} times at the first iteration, {ratios[1]:.3f} at the last", None,
            "largest singular value of the map's derivative, by experiments with small differences: above 1 at a white input. "
            "Towards the limit it falls to 1 and below, which the text does not say: there the iteration converges.",
            bool(ratios[0] > 1), "statement"),
    ]  # fmt: skip


def _amplified(plant: Plant, reversed_output: np.ndarray) -> float:
    """Largest singular value of d w+ / d w for w+ = Delta T w / ||T w||, by differences in every sample."""
    w = reversed_output / np.sqrt(len(reversed_output))  # (15) is for inputs of norm 1; these have power 1
    step = 1e-6 * float(np.linalg.norm(w))
    after = lambda x: plant.simulate(x / np.linalg.norm(x))[:, 0]
    rows_ = [
        (after(w + step * e[:, None]) - after(w - step * e[:, None])) / (2 * step) for e in np.eye(len(w))
    ]
    return float(np.linalg.norm(np.array(rows_), 2))
