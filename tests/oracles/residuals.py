"""Residual tests by relabelling: what the statistic would have been, had the residual come in any other order."""

from __future__ import annotations

import numpy as np


def autocorrelations(e, lags: int) -> np.ndarray:
    """r_1 .. r_lags of the residual about zero, over r_0."""
    return np.array([e[lag:] @ e[: len(e) - lag] for lag in range(1, lags + 1)]) / (e @ e)


def cross_correlations(e, u, lags) -> np.ndarray:
    """Sum over t of e_t u_{t-l}, over the product of their norms; lags may be negative."""
    n = len(e)
    values = [e[max(lag, 0) : n + min(lag, 0)] @ u[max(-lag, 0) : n - max(lag, 0)] for lag in lags]
    return np.array(values) / np.sqrt((e @ e) * (u @ u))


def whiteness_p_value(e, lags: int, rng, permutations: int = 2000) -> float:
    """Share of permutations of e whose sum of squared autocorrelations is at least the observed one."""
    observed = np.sum(autocorrelations(e, lags) ** 2)
    count = sum(
        np.sum(autocorrelations(rng.permutation(e), lags) ** 2) >= observed for _ in range(permutations)
    )
    return (count + 1) / (permutations + 1)


def independence_p_value(e, u, lags, rng, permutations: int = 2000) -> float:
    """The same for the squared cross-correlations with u, weighted by the inverse correlation of u at these lags.

    Under permutation of e the vector of sums over t of e_t u_{t-l} has covariance var(e) times the Gram matrix of the lagged u.
    """
    lags = list(lags)
    n = len(e)
    shifted = np.zeros((n, len(lags)))
    for k, lag in enumerate(lags):
        shifted[max(lag, 0) : n + min(lag, 0), k] = u[max(-lag, 0) : n - max(lag, 0)]
    inverse = np.linalg.pinv(shifted.T @ shifted)

    def statistic(values):
        r = shifted.T @ values
        return r @ inverse @ r

    observed = statistic(e)
    count = sum(statistic(rng.permutation(e)) >= observed for _ in range(permutations))
    return (count + 1) / (permutations + 1)
