"""[S] Lemmas 1 and 11, Theorem 2, Remarks 3 and 5, as runs of the algorithms."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import hankel

from benchmarks.tables.reproduced import row, traced
from estimators.montecarlo.engine import monte_carlo
from estimators.norm.gains import rayleigh
from estimators.rules.power import power_iterations
from oed.plants.named import named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.theory.finite import finite_norm, singular_values
from oed.theory.limit_on_grid import spectra_of_iterations


def rows() -> Iterator[dict[str, Any]]:
    """What the lemmas and remarks state."""
    plain = Plant([0.5, 1.0, 0.3], [1.0, -0.2], noise_covariance=0.0, name="few-taps")
    values = singular_values(plain, 12)
    start = np.random.default_rng(0).standard_normal((12, 1))
    trace = traced(partial(power_iterations, start=start), plain, 12, 4000)
    yield row("beta tends to the eigenvalue of T G of largest modulus", "[S] Lemma 1, with |lambda|", float(values[0]),
              abs(rayleigh(trace).last), 1e-9,
              f"12 samples, 4000 iterations; the two largest moduli are {values[0]:.6f} and {values[1]:.6f}.",
              kind="statement")  # fmt: skip
    plant = named_plant("reference", 0.0)
    top = peak(plant)
    sizes = np.array([500, 1000, 2000, 4000])
    off = np.array([1 - finite_norm(plant, int(n)) / top.value for n in sizes])
    yield row("order of ||G|| - ||G_N|| in N", "[S] Theorem 2 (the rate: theory, section 6)", -2.0,
              float(np.polyfit(np.log(sizes), np.log(off), 1)[0]), 0.03,
              "slope through N = 500 to 4000; the next order is 3 % at 500.", kind="statement")  # fmt: skip
    rule = partial(power_iterations, reversal=False)
    low = Plant([1.5, 0.4], [1.0, -0.3], noise_covariance=0.0, name="feedthrough")
    trace = traced(rule, low, 20, 4000, 1)
    yield row("without time reversal the iterations find g_0", "[S] Remark 3", 1.5, rayleigh(trace).last, 0.02,
              f"20 samples, 4000 iterations; the norm is {finite_norm(low, 20):.4f}. G is one Jordan block, so the "
              "error falls only as 1 / n.",
              kind="statement")  # fmt: skip
    g = plant.impulse_response(1000)[:, 0, 0]
    values = np.linalg.eigvalsh(hankel(g[::-1]))
    shares = (
        np.random.default_rng(0).standard_normal((4000, 1000)) ** 2 * (values / np.abs(values).max()) ** 118
    )
    first = lambda r: np.random.default_rng(r).standard_normal((1000, 1))
    ends = [traced(partial(power_iterations, start=first(r)), plant, 1000, 60) for r in range(40)]
    law, spread = shares @ values / shares.sum(axis=1), np.std([rayleigh(trace).last for trace in ends])
    yield row("spread of estimator (4) over starts, noise-free, iteration 60",
              "[S] Remark 5, understated there (theory, section 1: 0.94)", 0.94, float(law.std()), 0.03,
              f"4000 starts in the eigenvectors of T G, known to 0.01; 40 runs of the iterations give {spread:.2f}.")  # fmt: skip
    noisy = named_plant("reference", 1.0)
    nodes, Phi, _ = spectra_of_iterations(noisy, 9)
    gain2 = np.abs(noisy.transfer(nodes.omega)[:, 0, 0]) ** 2
    means = [monte_carlo(noisy, N, 10, 960, seed=3) for N in (2000, 4000)]
    short, long = (m.mean["gain_square"][-1] for m in means)
    error = np.hypot(2 * means[1].error("gain_square")[-1], means[0].error("gain_square")[-1])
    yield row("E beta_2^2 at experiment 10", "[S] Lemma 11 and Lemma 6", float(nodes.weight @ (gain2 * Phi[-1])),
              float(2 * long - short), float(4.5 * error),
              "960 runs at N = 2000 and 4000, extrapolated to N -> infinity; 4.5 standard errors.")  # fmt: skip
