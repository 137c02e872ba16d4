"""The noise of many replicates at once, by the compiled loops of the Monte-Carlo engine."""

import numpy as np
from numpy.typing import NDArray


def noise_of_replicates(
    key: tuple[int, int], first: int, experiments: int, samples: int, n_outputs: int = 1
) -> NDArray[np.float64]:
    """Standard normal noise of B successive replicates, bit by bit that of `oed.signals.noise.noise_series`,
    compiled: returns (B, experiments, samples, n_outputs)."""
    from estimators.montecarlo.noise_kernels import B, normal_block

    k0, k1 = (np.uint64(k) for k in key)
    found, x = np.empty((B, experiments, samples, n_outputs)), np.empty(samples * B)
    for m in range(experiments):
        for i in range(n_outputs):
            normal_block(k0, k1, samples, i, m, first, x)
            found[:, m, :, i] = x.reshape(samples, B).T
    return found
