"""[S] Sec. 4: mu against beta_2 as an estimator, Lemma 13 and its limit, and what the iterations are worth."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.tables.reproduced import row
from estimators.montecarlo.additivity import additivity_by_monte_carlo
from estimators.montecarlo.engine import batches
from estimators.rules.power import power_iterations
from oed.data import Spectrum
from oed.information import information_of_spectrum
from oed.plants.named import named_plant
from oed.plants.norms import gain_gradient, peak
from oed.plants.plant import Plant
from oed.theory.limit import limit_spectrum
from oed.theory.limit_on_grid import spectra_of_iterations

SAMPLES, ITERATIONS, RUNS = 4000, 60, 200
COUNTS = (250, 500, 1000)
EFFICIENCIES = ((0.01, 0.99810), (1.0, 0.81125), (9.0, 0.08693))
"""Noise variance, and the c-efficiency of the limit spectrum in the theory's table."""


def rows() -> list[dict[str, Any]]:
    """What Sec. 4 states beyond its bias formulas."""
    return [*(_bias(v) for v in (0.1, 1.0)), *_lemma_13(), *_claim()]


def _bias(variance: float) -> dict[str, Any]:
    plant = named_plant("reference", variance)
    gamma = peak(plant).value
    parts = list(batches(plant, samples=SAMPLES, iterations=ITERATIONS, replicates=RUNS, seed=4))
    late = slice(ITERATIONS // 2, None)
    mean = lambda name: np.concatenate(
        [np.sqrt(np.maximum(getattr(b, name)[:, late], 0)).mean(axis=1) for b in parts]
    )
    beta, mu = mean("gain_squares") - gamma, mean("mu_squares") - gamma
    error = lambda x: float(x.std(ddof=1) / np.sqrt(len(x)))
    return row(f"mu has less bias than beta_2 at little noise, variance {variance:g}", "[S] after Theorem 12",
        "|bias of mu| < |bias of beta_2|",
        f"{mu.mean():+.5f} +- {error(mu):.5f} and {beta.mean():+.5f} +- {error(beta):.5f}", None,
        f"{RUNS} runs, iterations {ITERATIONS // 2} to {ITERATIONS}, N = {SAMPLES}; by 4 standard errors. What is left of mu's "
        "is the transient.",
        bool(abs(mu.mean()) + 4 * (error(mu) + error(beta)) < abs(beta.mean())), "statement")  # fmt: skip


def _lemma_13() -> Iterator[dict[str, Any]]:
    plant = named_plant("reference", 4.0)
    check = additivity_by_monte_carlo(plant, power_iterations, samples=100, experiments=5, replicates=400)
    yield row("the information of adaptive experiments adds up", "[S] Lemma 13, (19)", "scores follow their joint law",
              f"smallest p-value {check.discrepancy:.2g}", None, f"variance 4; {check.message}.", check.holds,
              "statement")  # fmt: skip
    nodes, Phi, _ = spectra_of_iterations(plant, COUNTS[-1])
    of = lambda density: information_of_spectrum(plant, Spectrum(nodes.omega, nodes.weight * density))
    limit = of(limit_spectrum(plant).density(nodes.omega))
    off = [float(np.linalg.norm(of(Phi[:n].mean(axis=0)) - limit) / np.linalg.norm(limit)) for n in COUNTS]
    yield row("order in n of I_theta / n less its limit", "[S] after Lemma 13", -1.0,
              float(np.polyfit(np.log(COUNTS), np.log(off), 1)[0]), 0.01,
              f"a Cesaro sum whose terms converge exponentially; variance 4, n = {COUNTS[0]} to {COUNTS[-1]}, where "
              f"{off[-1]:.2%} is left.",
              kind="statement")  # fmt: skip


def _claim() -> Iterator[dict[str, Any]]:
    loss = lambda variance: _efficiency(named_plant("reference", variance))
    yield row("loss of the limit spectrum for the peak gain, over the noise variance, as both vanish",
              "[S] Sec. 4.2: optimal as lambda_e -> 0", 1.0, (1 - loss(1e-3)) / (1 - loss(1e-4)) / 10, 0.02,
              f"the efficiency tends to 1 in proportion to the noise: {loss(1e-4):.6f} at variance 1e-4.",
              kind="statement")  # fmt: skip
    for variance, other in EFFICIENCIES:
        yield row(f"efficiency of the limit spectrum for the peak gain, variance {variance:g}",
                  "theory, section 4: the claim of [S] Sec. 4.2 away from its limit", other, loss(variance), 1e-5,
                  "lambda_e / (c' I^-1 c) against one sinusoid at the peak; to the digits of the table.")  # fmt: skip


def _efficiency(plant: Plant) -> float:
    c = gain_gradient(plant)
    information = information_of_spectrum(plant, limit_spectrum(plant).spectrum)
    return float(plant.noise_covariance[0, 0] / (c @ np.linalg.solve(information, c)))
