"""The Monte-Carlo covariance of PEM is the inverse Fisher information, on four inputs ([S] Sec. 4.2)."""

import numpy as np
import pytest

from benchmarks.campaign.registry import method_for
from estimators.pem import identify
from oed.experiments import simulated
from oed.information import information_of_records
from oed.plants.named import named_plant

REFERENCE = named_plant("reference")
REPLICATES = 250


def worst(z: np.ndarray) -> float:
    """Largest entry of the sample second moment of z minus I, in its own standard errors (z normal, (R, n))."""
    n = z.shape[1]
    moment = z.T @ z / len(z) - np.eye(n)
    se = np.sqrt((1 + np.eye(n)) / len(z))
    return float(np.abs(moment / se).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["white", "multisine", "oracle-D", "power"])
def test_covariance_of_the_estimates(name):
    """Standardised errors have the identity as covariance: 10 entries, threshold for a false-alarm rate of 1e-3.

    The information is that of each run's own input (it varies with the noise for the power iterations). The seed
    is fixed. Beside it the negative control: the same errors held against an information 1.5 times too large.
    """
    plant = REFERENCE.replace(noise_variance=0.25)
    method = method_for(name, plant)
    z = []
    for replicate in range(REPLICATES):
        rng = np.random.default_rng([7, replicate])
        trace = method(simulated(plant, seed=7, replicate=replicate), samples=500, iterations=2, rng=rng)
        fit = identify(list(trace.records), "oe", (2, 2), delay=1, offset=False)
        information = information_of_records(plant, [r.u for r in trace.records])
        order = [fit.names.index(p) for p in ("b1", "b2", "f1", "f2")]
        z.append(np.linalg.cholesky(information).T @ (fit.theta[order] - plant.theta))
    z = np.array(z)
    threshold = 3.9  # normal quantile at 1e-3 / 20, two-sided over ten entries
    assert worst(z) < threshold
    assert worst(np.sqrt(1.5) * z) > threshold
