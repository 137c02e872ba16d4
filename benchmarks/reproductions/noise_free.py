"""Without noise: every iteration against the dense matrix, how slowly the norm is neared, what Krylov saves."""

from functools import partial
from typing import Any

import numpy as np

from benchmarks.tables.reproduced import row, traced
from estimators.norm.gains import gain
from estimators.rules.krylov import lanczos, ritz
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from oed.plants.named import NAMES, named_plant
from oed.theory.finite import dense

SAMPLES, ITERATIONS, NEAR = 200, 24, 1e-6


def rows() -> list[dict[str, Any]]:
    """Two rows per named plant."""
    return [each for name in NAMES for each in _plant(name)]


def _plant(name: str) -> list[dict[str, Any]]:
    plant, N, M = named_plant(name, 0.0), SAMPLES, ITERATIONS
    p, q = plant.n_outputs, plant.n_inputs
    single, rng = p * q == 1, np.random.default_rng(17)
    start, each = rng.standard_normal((N, q)), 1 if single else 1 + p * q
    record = lambda rule: traced(partial(rule, start=start), plant, N, M * each, rng)
    values = gain(record(power_iterations if single else procedure_2)).values
    krylov = ritz(record(lanczos)).values
    d, shares = _coordinates(plant, start)
    matrix = np.array([_gain(d, shares, m, single) for m in range(M)])
    found, expected = (values[1:], matrix[:-1]) if single else (values, matrix)
    norm = float(d[0])
    closer = int(np.argmax(krylov >= values[-1])) + 1
    close = krylov >= norm * (1 - NEAR)
    steps = _steps(d, shares, single)
    return [
        row(f"every gain is that of the dense-matrix power iteration, {name}",
            "[S] Algorithm 1 and (7), [M] Procedure 2 and (12)", 0.0, float(np.abs(found / expected - 1).max()), 1e-9,
            f"largest relative difference over {M} iterations from one start, N = {N}, by the singular value "
            "decomposition of the Toeplitz matrix; rounding only.",
            kind="statement"),
        row(f"how slowly the finite-time norm is neared, and what Krylov saves, {name}",
            "[S] Remark 5: singular values in pairs of nearly equal size", None,
            f"{1 - values[-1] / norm:.1e} left after {M * each} experiments; to {NEAR:g} it takes {steps * each}. "
            f"Krylov is as near after {closer * each}" + (f" and at {NEAR:g} after {(int(np.argmax(close)) + 1) * each}" if close.any() else ""),
            None,
            f"relative to ||G_N||_2 = {norm:.9g}, whose next different singular value is {1 - d[2] / norm:.1e} below it; "
            "an illustration: Krylov's estimate is the largest over all that the iterations span."),
    ]  # fmt: skip


def _coordinates(plant: Any, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Singular values of the block Toeplitz matrix, and the start's squared coordinates in its right vectors."""
    _, d, vectors = np.linalg.svd(dense(plant, SAMPLES), full_matrices=False)
    return d, (vectors @ start.ravel()) ** 2


def _gain(d: np.ndarray, shares: np.ndarray, m: float, single: bool) -> float:
    """Root of the Rayleigh quotient of G' G after m iterations, each G for one channel and G' G for several."""
    weights = shares * (d / d[0]) ** ((2 if single else 4) * m)
    return float(np.sqrt(weights @ d**2 / weights.sum()))


def _steps(d: np.ndarray, shares: np.ndarray, single: bool) -> int:
    """Iterations until the gain is within NEAR of the norm: it rises with every one."""
    low, high = 0, 1
    while _gain(d, shares, high, single) < d[0] * (1 - NEAR):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _gain(d, shares, middle, single) < d[0] * (1 - NEAR) else (low, middle)
    return high + 1
