"""E: the largest eigenvalue of V' M^-1 V; V = identity: E-optimality. Numerator |V'X|_F^2."""

from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from oed.criteria.criterion import Array, Criterion, Derivatives, combinations


class LargestEigenvalue(Criterion):
    """The variance of the worst direction."""

    kind: ClassVar[str] = "E"
    named: ClassVar[str] = "E"
    method: ClassVar[str] = "eigenvalue"

    def of_covariance(self, covariance: Array) -> float:
        """The eigenvalue itself."""
        return float(np.linalg.eigvalsh(covariance)[-1])

    def numerator(self, X: Array) -> float:
        """Cauchy-Schwarz, direction by direction."""
        return float(np.sum((self.V.T @ X) ** 2))

    def turned(self, Y: Array, covariance: Array, weight: Array | None) -> Array:
        """The worst directions, weighted by a (s, s) matrix where the eigenvalue is multiple."""
        if weight is None:
            worst = np.linalg.eigh(covariance)[1][:, -1:]
            weight = worst @ worst.T
        values, vectors = np.linalg.eigh(weight)
        return Y @ (vectors * np.sqrt(np.clip(values, 0, None))) @ vectors.T

    def log_numerator(self, X: Array, second: bool = True) -> Derivatives:
        """Of a quadratic form."""
        square = self.V @ self.V.T
        rise = square @ X
        total = float(np.sum(X * rise))
        rise *= 2 / total
        bend = np.kron((2 / total) * square, np.eye(X.shape[1])) - np.outer(rise, rise) if second else None
        return rise, bend

    def scaled(self, columns: Array) -> tuple[Criterion, float]:
        """Of unit norm."""
        return self.of_unit_norm(columns)

    def conic(self, cp: Any, M: Any, V: Any, square: Any) -> tuple[Any, Any] | None:
        """M - t V V' positive semidefinite; its dual is the certificate."""
        t = cp.Variable()
        return cp.Maximize(t), M - t * square >> 0


def e_criterion(n: int, columns: ArrayLike | None = None, *, name: str = "") -> LargestEigenvalue:
    """E-optimality: the largest eigenvalue of V' M^-1 V, by default of M^-1."""
    return LargestEigenvalue(combinations(n, columns), name or "E")
