"""[S] Theorem 7 (one fixed point) and Remark 4 (the matrices of Algorithm 1 and of two experiments have one norm)."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import hankel, toeplitz

from benchmarks.tables.reproduced import row, traced
from estimators.norm.gains import gain
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from oed.plants.named import NAMES, named_plant
from oed.plants.plant import Plant

LINES, SAMPLES = 200, 200


def rows() -> Iterator[dict[str, Any]]:
    """Uniqueness by the eigenvectors of H_d; two matrices and two algorithms."""
    plants = [p for p in map(named_plant, NAMES) if p.n_inputs * p.n_outputs == 1]
    counts = [_fixed_points(plant.replace(noise_variance=v)) for plant in plants for v in (0.1, 1.0, 9.0)]
    yield row("fixed points of (8) that are spectra", "[S] Theorem 7", "1 in every case",
              f"{min(counts)} to {max(counts)} in {len(counts)} cases", None,
              f"eigenvectors of the dense H_d on {LINES} lines without a change of sign, and so the candidates for (9): "
              f"{len(plants)} plants, variances .1, 1 and 9.",
              set(counts) == {1}, "statement")  # fmt: skip
    g = named_plant("reference", 0.0).impulse_response(SAMPLES)[:, 0, 0]
    G = toeplitz(g, np.zeros(SAMPLES))
    squares = np.sort(np.linalg.eigvalsh(hankel(g[::-1])) ** 2)
    yield row("eigenvalues of G' G less those of (T G)^2, over the largest", "[S] Remark 4", 0.0,
              float(np.abs(np.sort(np.linalg.eigvalsh(G.T @ G)) - squares).max() / squares[-1]), 1e-13,
              f"reference plant, N = {SAMPLES}; rounding only.", kind="statement")  # fmt: skip
    plain = Plant([0.5, 1.0, 0.3], [1.0, -0.2], noise_covariance=0.0, name="few-taps")
    start = np.random.default_rng(0).standard_normal((12, 1))
    one, two = (
        gain(traced(partial(rule, start=start), plain, 12, count)).last
        for rule, count in ((power_iterations, 4000), (procedure_2, 8000))
    )
    yield row("gain by one experiment a step and by two, n to infinity, noise-free", "[S] Remark 4", two, one, 1e-12,
              "estimator (7) after 4000 experiments, [M] (12) after 4000 pairs; 12 samples.", kind="statement")  # fmt: skip


def _fixed_points(plant: Plant) -> int:
    """Real eigenvectors of H_d, [S] Sec. 5, of one sign: Phi and the 1 below it are positive."""
    omega = (np.arange(LINES) + 0.5) * np.pi / LINES
    gain2, noise = np.abs(plant.transfer(omega)[:, 0, 0]) ** 2, float(plant.noise_covariance[0, 0])
    H = np.zeros((LINES + 1, LINES + 1))
    H[:LINES, :LINES] = np.diag(gain2)
    H[:LINES, -1] = H[-1, -1] = noise
    H[-1, :LINES] = gain2 / LINES
    vectors = np.linalg.eig(H)[1]
    real = vectors[:, np.abs(vectors.imag).max(axis=0) < 1e-12].real
    return int(np.sum((real > 0).all(axis=0) | (real < 0).all(axis=0)))
