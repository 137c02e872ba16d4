"""Combinations of the parameters that vary with frequency: what G maximises over a band, between its lines too."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CHUNK = 4096
"""Frequencies evaluated together."""


@dataclass(frozen=True, eq=False)
class Family:
    """V(w) over a band. `at` omega (K,) -> V (K, n, s), real; `grid` (K,) increasing frequencies between
    which trace(V' C V) has at most one maximum for every C."""

    at: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    grid: NDArray[np.float64]

    def values(self, omega: NDArray[np.float64], root: NDArray[np.float64]) -> NDArray[np.float64]:
        """trace(V' C V) with C = root' root, root (m, n); (K,)."""
        parts = np.array_split(omega, max(1, len(omega) // CHUNK))
        return np.concatenate([np.sum((root @ self.at(part)) ** 2, axis=(1, 2)) for part in parts])

    def maxima(self, root: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where trace(V' C V) has its local maxima of at least half the largest, between the lines, and its values there."""
        on_grid = self.values(self.grid, root)
        at = local_maxima(on_grid)
        at = at[on_grid[at] >= 0.5 * on_grid.max()]
        left, right = self.grid[np.maximum(at - 1, 0)], self.grid[np.minimum(at + 1, len(self.grid) - 1)]
        omega = maxima_between(lambda omega: self.values(omega, root), left, right)
        return omega, self.values(omega, root)

    def worst(self, information: NDArray[np.float64]) -> float:
        """max over the band of trace(V' M^-1 V); infinite where M is singular."""
        scale = np.sqrt(np.clip(np.diag(information), 0, None))
        if not np.isfinite(scale).all() or not scale.all():
            return np.inf
        try:
            L = np.linalg.cholesky(information / np.outer(scale, scale))
        except np.linalg.LinAlgError:
            return np.inf
        return float(self.maxima(np.linalg.inv(L) / scale)[1].max())


def local_maxima(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the local maxima of values over a sorted grid, the ends included; of a plateau the first."""
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    return np.flatnonzero((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]))


def maxima_between(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    divisions: int = 13,
) -> NDArray[np.float64]:
    """Where a function of frequency is largest in each bracket, (m,); every division cuts the brackets to a quarter."""
    rows, steps = np.arange(len(low)), np.linspace(0, 1, 9)
    trial, top = low[:, None] + (high - low)[:, None] * steps, np.zeros(len(low), dtype=np.int64)
    for _ in range(divisions if len(low) else 0):
        trial = low[:, None] + (high - low)[:, None] * steps
        top = np.argmax(function(trial.ravel()).reshape(trial.shape), axis=1)
        low, high = trial[rows, np.maximum(top - 1, 0)], trial[rows, np.minimum(top + 1, 8)]
    return trial[rows, top]
