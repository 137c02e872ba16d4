"""The worst of several: G, max_k trace(V_k' M^-1 V_k), and W, max_k det(V_k' M^-1 V_k)^(1/s); V (K, n, s).

Numerators sum_k trace(V_k'X_k)^2 and s sum_k det(V_k'X_k)^(2/s)."""

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from oed.covariances import diagonal_blocks
from oed.criteria.criterion import Array, Criterion, Derivatives


class WorstTrace(Criterion):
    """The largest of several sums of variances."""

    kind: ClassVar[str] = "G"
    axes: ClassVar[int] = 3
    method: ClassVar[str] = "minimax"

    def of_covariance(self, covariance: Array) -> float:
        """The largest trace of a diagonal block."""
        return float(np.diag(covariance).reshape(len(self.V), -1).sum(axis=1).max())

    def numerator(self, X: Array) -> float:
        """The sum of the parts' own."""
        return float(np.sum(np.einsum("kii->k", _products(self.V, X)) ** 2))

    def turned(self, Y: Array, covariance: Array, weight: Array | None) -> Array:
        """The parts weighted by their multipliers (K,), or the worst alone."""
        size = np.diag(covariance).reshape(len(self.V), -1).sum(axis=1)
        return _weighted(Y, size, self.V.shape[2], weight)

    def log_numerator(self, X: Array, second: bool = True) -> Derivatives:
        """Of a sum of squared traces."""
        trace = np.einsum("kss->k", _products(self.V, X))
        W, share = self.V / np.where(trace, trace, 1.0)[:, None, None], trace**2
        return _log_sum(W, share / share.sum(), 2.0, (2.0, 0.0), second)

    def scaled(self, columns: Array) -> tuple[Criterion, float]:
        """The largest part of unit norm."""
        return _scaled(self, columns)

    def conic(self, cp: Any, M: Any, V: Any, square: Any) -> tuple[Any, Any] | None:
        """None here: the interior-point method solves it."""
        return None


class WorstDeterminant(Criterion):
    """The largest of several geometric means."""

    kind: ClassVar[str] = "W"
    axes: ClassVar[int] = 3
    method: ClassVar[str] = "minimax"

    def of_covariance(self, covariance: Array) -> float:
        """The largest mean of a diagonal block."""
        own = diagonal_blocks(covariance, len(self.V))
        sign, logdet = np.linalg.slogdet(own)
        return float(np.where(sign > 0, np.exp(logdet / own.shape[1]), 0.0).max())

    def numerator(self, X: Array) -> float:
        """The sum of the parts' own."""
        size = self.V.shape[2]
        sign, logdet = np.linalg.slogdet(_products(self.V, X))
        return float(size * np.sum(np.where(sign != 0, np.exp(2 * logdet / size), 0.0)))

    def turned(self, Y: Array, covariance: Array, weight: Array | None) -> Array:
        """The parts, each as of its determinant, weighted by their multipliers (K,), or the worst alone."""
        K, s = len(self.V), self.V.shape[2]
        own = diagonal_blocks(covariance, K)
        roots = np.linalg.inv(np.linalg.cholesky(own)).swapaxes(1, 2)
        Y = np.einsum("nks,kst->nkt", Y.reshape(len(Y), K, s), roots).reshape(len(Y), -1)
        return _weighted(Y, np.linalg.slogdet(own)[1], s, weight)

    def log_numerator(self, X: Array, second: bool = True) -> Derivatives:
        """Of a sum of powers of determinants."""
        own, s = _products(self.V, X), self.V.shape[2]
        share = np.exp((2 / s) * np.linalg.slogdet(own)[1])
        W = self.V @ np.linalg.inv(own).swapaxes(1, 2)
        return _log_sum(W, share / share.sum(), 2 / s, (4 / s**2, 2 / s), second)

    def scaled(self, columns: Array) -> tuple[Criterion, float]:
        """The largest part of unit norm."""
        return _scaled(self, columns)

    def conic(self, cp: Any, M: Any, V: Any, square: Any) -> tuple[Any, Any] | None:
        """None here: the interior-point method solves it."""
        return None


def g_criterion(combinations: ArrayLike, *, name: str = "") -> WorstTrace:
    """The worst of several: max_k trace(V_k' M^-1 V_k)."""
    V = np.asarray(combinations, dtype=float)
    return WorstTrace(V[:, :, None] if V.ndim == 2 else V, name or "G")


def worst_d_criterion(combinations: ArrayLike, *, name: str = "") -> WorstDeterminant:
    """The worst of several D: max_k det(V_k' M^-1 V_k)^(1/s)."""
    return WorstDeterminant(np.asarray(combinations, dtype=float), name or "W")


def _products(V: Array, X: Array) -> Array:
    """V_k' X_k of every part, (K, s, s)."""
    return np.einsum("kns,nkt->kst", V, X.reshape(len(X), len(V), -1))


def _weighted(Y: Array, size: Array, s: int, weight: Array | None) -> Array:
    """The parts of Y by the roots of their weights; without weights the largest alone."""
    part = np.eye(len(size))[np.argmax(size)] if weight is None else weight
    return Y * np.repeat(np.sqrt(np.clip(part, 0, None)), s)


def _scaled(criterion: Criterion, columns: Array) -> tuple[Criterion, float]:
    V = np.swapaxes(columns.reshape(criterion.n, len(criterion.V), -1), 0, 1)
    scale = np.sqrt(np.sum(V**2, axis=(1, 2)).max())
    return replace(criterion, V=V / scale, family=None), float(scale**2)


def _log_sum(W: Array, share: Array, slope: float, bends: tuple[float, float], second: bool) -> Derivatives:
    """Gradient and second derivatives of the logarithm of a sum whose parts have the slopes `slope` W_k and the
    second derivatives bends[0] W_k W_k - bends[1] W_k' W_k, relative to themselves; `share` is what each part is of it.
    """
    K, n, s = W.shape
    rise = slope * np.moveaxis(W * share[:, None, None], 0, 1).reshape(n, K * s)
    if not second:
        return rise, None
    bend = np.zeros((n, K, s, n, K, s))
    for k in range(K):
        bend[:, k, :, :, k, :] = share[k] * (
            bends[0] * np.einsum("ia,jb->iajb", W[k], W[k]) - bends[1] * np.einsum("ib,ja->iajb", W[k], W[k])
        )
    return rise, bend.reshape(n * K * s, -1) - np.outer(rise, rise)
