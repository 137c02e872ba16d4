"""Modified E: the condition number of V' M^-1 V. Its certificate is a ratio of two: `oed.design.solvers.condition_number`."""

from typing import Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from oed.criteria.criterion import Array, Criterion, Derivatives
from oed.criteria.eigenvalue import LargestEigenvalue
from oed.errors import InputError

NO_BOUND = "a condition number has no bound by one direction; see `condition_design`."


class ConditionNumber(Criterion):
    """The ratio of the covariance's largest and smallest eigenvalue."""

    kind: ClassVar[str] = "K"
    named: ClassVar[str] = "modified-E"
    method: ClassVar[str] = "ratio"

    def of_covariance(self, covariance: Array) -> float:
        """Infinite where it is singular."""
        values = np.linalg.eigvalsh(covariance)
        return float(values[-1] / values[0]) if values[0] > 0 else np.inf

    def numerator(self, X: Array) -> NoReturn:
        """There is none."""
        raise InputError(NO_BOUND)

    def turned(self, Y: Array, covariance: Array, weight: Array | None) -> NoReturn:
        """There is none."""
        raise InputError(NO_BOUND)

    def log_numerator(self, X: Array, second: bool = True) -> Derivatives:
        """Of either of the two traces: the quadratic form of the eigenvalue's."""
        return LargestEigenvalue(self.V).log_numerator(X, second)

    def scaled(self, columns: Array) -> tuple[Criterion, float]:
        """Of unit norm, which it does not see."""
        return self.of_unit_norm(columns)[0], 1.0

    def conic(self, cp: Any, M: Any, V: Any, square: Any) -> tuple[Any, Any] | None:
        """None: it is a fraction."""
        return None


def condition_criterion(n: int, lengths: ArrayLike | None = None, *, name: str = "") -> ConditionNumber:
    """Modified E: the condition number of M, the parameters in given units; lengths (n,)."""
    unit = np.ones(n) if lengths is None else np.asarray(lengths, dtype=float)
    if unit.shape != (n,) or not (np.isfinite(unit) & (unit > 0)).all():
        raise InputError(f"the units of the parameters are {unit}; give {n} positive numbers.")
    return ConditionNumber(np.diag(1 / unit), name or "modified-E")
