"""A: trace(V' M^-1 V); V = identity: A-optimality, V V' = W: A(W), also called L; s = 1: c. Numerator trace(V'X)^2."""

from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from oed.covariances import root_in_own_units
from oed.criteria.criterion import Array, Criterion, Derivatives
from oed.errors import InputError


class Trace(Criterion):
    """The sum of the combinations' variances."""

    kind: ClassVar[str] = "A"
    named: ClassVar[str] = "A"
    curvature: ClassVar[float | None] = 0.0

    def of_covariance(self, covariance: Array) -> float:
        """The trace itself."""
        return float(np.trace(covariance))

    def numerator(self, X: Array) -> float:
        """Cauchy-Schwarz."""
        return float(np.trace(self.V.T @ X) ** 2)

    def turned(self, Y: Array, covariance: Array, weight: Array | None) -> Array:
        """M^-1 V itself."""
        return Y

    def log_numerator(self, X: Array, second: bool = True) -> Derivatives:
        """2 V / trace(V'X), and half its square with the sign turned."""
        trace = float(np.trace(self.V.T @ X))
        rise = 2 * self.V / (trace if trace else 1.0)
        return rise, -np.outer(rise, rise) / 2 if second else None

    def scaled(self, columns: Array) -> tuple[Criterion, float]:
        """Of unit norm."""
        return self.of_unit_norm(columns)

    def conic(self, cp: Any, M: Any, V: Any, square: Any) -> tuple[Any, Any] | None:
        """A matrix fraction."""
        return cp.Minimize(cp.matrix_frac(V, M)), None


def a_criterion(n: int, weight: ArrayLike | None = None, *, name: str = "") -> Trace:
    """A-optimality, trace(W M^-1)."""
    if weight is None:
        return Trace(np.eye(n), name or "A")
    W = np.asarray(weight, dtype=float)
    if W.shape != (n, n) or not np.allclose(W, W.T, rtol=1e-10, atol=1e-12 * np.abs(W).max()):
        raise InputError(f"the weight W has the shape {W.shape}; it must be a symmetric {n} x {n} matrix.")
    V, least = root_in_own_units(W)
    if least < -1e-10:
        raise InputError(
            f"the weight W has the eigenvalue {np.linalg.eigvalsh(W)[0]:g}; it must be positive semidefinite and not "
            "zero."
        )
    return Trace(V, name or "L")


def c_criterion(c: ArrayLike, *, name: str = "") -> Trace:
    """c-optimality: the variance c' M^-1 c of one combination c' theta; c (n,)."""
    return Trace(np.asarray(c, dtype=float).reshape(-1, 1), name or "c")
