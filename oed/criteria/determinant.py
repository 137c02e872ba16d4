"""D: det(V' M^-1 V)^(1/s); V = identity: D-optimality, selected columns: D_s. Numerator s det(V'X)^(2/s)."""

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from oed.criteria.criterion import Array, Criterion, Derivatives, combinations


class Determinant(Criterion):
    """The geometric mean of the covariance's eigenvalues."""

    kind: ClassVar[str] = "D"
    named: ClassVar[str] = "D"
    logarithmic: ClassVar[bool] = True
    curvature: ClassVar[float | None] = 1.0

    def of_covariance(self, covariance: Array) -> float:
        """Of no size where the covariance is singular."""
        sign, logdet = np.linalg.slogdet(covariance)
        return float(np.exp(logdet / len(covariance))) if sign > 0 else 0.0

    def numerator(self, X: Array) -> float:
        """The arithmetic mean is not below the geometric one."""
        product = self.V.T @ X
        sign, logdet = np.linalg.slogdet(product)
        return float(len(product) * np.exp(2 * logdet / len(product))) if sign != 0 else 0.0

    def turned(self, Y: Array, covariance: Array, weight: Array | None) -> Array:
        """Of the logarithm times s."""
        return Y @ np.linalg.inv(np.linalg.cholesky(covariance)).T

    def log_numerator(self, X: Array, second: bool = True) -> Derivatives:
        """2/s times those of log det(V'X)."""
        n, s = X.shape
        W = self.V @ np.linalg.inv(self.V.T @ X).T
        bend = -(2 / s) * np.einsum("ib,ja->iajb", W, W).reshape(n * s, n * s) if second else None
        return (2 / s) * W, bend

    def scaled(self, columns: Array) -> tuple[Criterion, float]:
        """An orthonormal basis of the columns: a determinant does not see which."""
        Q, T = np.linalg.qr(columns)
        # The determinant of a triangle is its diagonal's, to rounding; QR's has lost a digit for each of its condition.
        T = columns if columns.shape == T.shape and not np.triu(columns, 1).any() else T
        logdet = np.sum(np.log(np.abs(np.diag(T)))) if np.all(np.diag(T)) else -np.inf
        return replace(self, V=Q), float(np.exp(2 * logdet / columns.shape[1]))

    def conic(self, cp: Any, M: Any, V: Any, square: Any) -> tuple[Any, Any] | None:
        """Of all parameters only."""
        return (cp.Maximize(cp.log_det(M)), None) if self.V.shape[1] == self.n else None


def d_criterion(n: int, columns: ArrayLike | None = None, *, name: str = "") -> Determinant:
    """D-optimality, det(M^-1)^(1/n); with columns D_s, the same of the named parameters' covariance."""
    return Determinant(combinations(n, columns), name or ("D" if columns is None else "Ds"))
