"""[S] Fig. 3: estimated gain during the iterations, N = 1000, 1000 realisations, variances 1, 4, 9."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.tables.reproduced import row
from estimators.montecarlo.engine import batches, monte_carlo
from oed.plants.named import named_plant
from oed.theory.finite import finite_moments, finite_norm

SOURCE = "[S] Fig. 3 and (14)"


def rows() -> Iterator[dict[str, Any]]:
    """The campaign of Fig. 3 against what the text reads from it, and against the finite-sample theory."""
    samples, iterations, runs = 1000, 50, 1000
    norm = finite_norm(named_plant("reference"), samples)
    means = []
    for variance in (1.0, 4.0, 9.0):
        plant = named_plant("reference", variance)
        campaign = monte_carlo(plant, samples, iterations, runs, seed=0)
        mean, error = campaign.gain_mean[1:], campaign.error("gain")[1:]
        means.append(mean[-1])
        yield row(f"mean gain strictly below the finite-time norm, variance {variance:g}", SOURCE,
                  f"below {norm:.8g} at every iteration",
                  f"largest mean {mean.max():.5f} +- {error[np.argmax(mean)]:.5f}", None,
                  "the mean must lie below by 4 of its standard errors at every iteration.",
                  bool((mean + 4 * error < norm).all()), "statement")  # fmt: skip
        square = campaign.mean["gain_square"][-1]
        predicted = finite_moments(plant, samples, iterations, effect="random-mu").beta2[-1]
        spread = campaign.error("gain_square")[-1]
        yield row(f"mean of beta_2^2 at iteration 50, variance {variance:g}",
                  "[S] Lemma 11 at finite N (theory: edges and random mu)", float(predicted), float(square),
                  float(4 * spread + 0.02 * variance**2 / samples),
                  "4 standard errors of 1000 runs, and 0.02 variance^2 / N for the third-order effect left out.")  # fmt: skip
    yield row("the bias grows with the noise", "[S] Fig. 3 right", "mean gain at variance 1 > 4 > 9",
              " > ".join(f"{m:.4f}" for m in means), None,
              "an ordering; the differences are hundreds of standard errors.", bool(means[0] > means[1] > means[2]),
              "statement")  # fmt: skip
    yield _single()


def _single() -> dict[str, Any]:
    """Fig. 3 left: one realisation at variance 9 beside the average of 1000 and the finite-time norm."""
    plant, samples, iterations = named_plant("reference", 9.0), 1000, 50
    squares = np.concatenate(
        [b.gain_squares for b in batches(plant, samples=samples, iterations=iterations, replicates=1000)]
    )
    gains = np.sqrt(np.maximum(squares[:, 9:], 0.0))  # from iteration 10 on the transient is over
    one, mean, spread = gains[0], gains.mean(axis=0), gains.std(axis=0)
    inside = float(np.mean(np.abs(one - mean) < 4 * spread))
    noise = float(np.std(one - mean) / np.median(spread))
    return row("one realisation is noisy, the average smooth, both below the norm, variance 9", "[S] Fig. 3 left",
        "one run scatters about the mean, which lies below the norm",
        f"scatter {noise:.2f} of that between runs, {inside:.0%} within 4 of it; mean {mean[-1]:.4f} of {finite_norm(plant, samples):.4f}",
        None,
        "scatter along one run within a factor of two of that between runs (its iterations depend on each other), and over 10 "
        "times that of the average.",
        bool(0.5 < noise < 2 and inside > 0.95 and np.std(np.diff(mean)) < 0.1 * np.std(np.diff(one))), "statement")  # fmt: skip
