"""What every criterion is: a loss of V' M^-1 V with a bound from below, for whichever solver asks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.covariances import covariance_of, covariance_of_factor, solved, solved_below
from oed.data import frozen
from oed.errors import InputError

if TYPE_CHECKING:
    from oed.design.problem.families import Family

Array = NDArray[np.float64]
DIFFERENCE = 1e-6
"""Step of a central difference, relative to the largest entry: rounding and curvature are then about equally small."""
Derivatives = tuple[Array, Array | None]
"""Gradient (n, s) of a numerator's logarithm, and its second derivatives (n s, n s) where they were asked for."""


@dataclass(frozen=True, eq=False)
class Criterion(ABC):
    """A loss of the information matrix. `V` (n, s), or (K, n, s) where it is the worst of several; `name`
    what it is called in tables; `family` V is a sample of it, which bounds the loss from below; the loss is
    the maximum over all of it."""

    V: Array
    name: str = ""
    family: Family | None = None

    kind: ClassVar[str]
    """Its letter, as in tables."""
    named: ClassVar[str] = ""
    """What it is called on the command line where it is of all parameters; empty where it needs more than that."""
    axes: ClassVar[int] = 2
    """Axes of V."""
    method: ClassVar[str] = "smooth"
    """Which programme finds the weights: "smooth", "eigenvalue", "minimax" or "ratio"."""
    logarithmic: ClassVar[bool] = False
    """Whether the programme is convex in the loss's logarithm, which has no unit."""
    curvature: ClassVar[float | None] = None
    """c in the second derivative 2 tr(A_k P A_l Y) - c tr(A_k P A_l P) along A_k and A_l, Y = M^-1 and P = X X';
    None where it has another form: c = 0 is then taken for a majorant."""

    def __post_init__(self) -> None:
        V = np.array(self.V, dtype=float)
        if V.ndim != self.axes or not np.isfinite(V).all() or not np.any(V):
            raise InputError(
                f"the combinations V of a {self.kind} criterion have the shape {V.shape}; "
                f"they must be a finite, nonzero array of {self.axes} axes."
            )
        object.__setattr__(self, "V", frozen(V))
        object.__setattr__(self, "name", self.name or self.kind)

    @abstractmethod
    def of_covariance(self, covariance: Array) -> float:
        """The loss of the covariance V' M^-1 V of all combinations side by side."""

    @abstractmethod
    def numerator(self, X: Array) -> float:
        """Numerator of the lower bound: loss(M) >= numerator(X) / trace(X' M X) for every M and every X (n, s)."""

    @abstractmethod
    def turned(self, Y: Array, covariance: Array, weight: Array | None) -> Array:
        """The X that makes the bound tight, from Y = M^-1 V and V' Y; `weight` the worst's multipliers, if known."""

    @abstractmethod
    def log_numerator(self, X: Array, second: bool = True) -> Derivatives:
        """Gradient (n, s) and second derivatives (n s, n s), or None, of log numerator(X)."""

    def log_derivatives(self, X: Array) -> tuple[Array, Array]:
        """Both derivatives; the second by central differences of the first where the criterion does not give them."""
        rise, bend = self.log_numerator(X)
        if bend is None:
            steps = DIFFERENCE * np.abs(X).max() * np.eye(X.size).reshape(-1, *X.shape)
            apart = [self.log_numerator(X + h, False)[0] - self.log_numerator(X - h, False)[0] for h in steps]
            bend = np.reshape(apart, (X.size, X.size)) / (2 * steps.max())
            bend = (bend + bend.T) / 2
        return rise, bend

    @abstractmethod
    def scaled(self, columns: Array) -> tuple[Criterion, float]:
        """The criterion of other columns, of unit size, and the factor between the losses."""

    @abstractmethod
    def conic(self, cp: Any, M: Any, V: Any, square: Any) -> tuple[Any, Any] | None:
        """Objective, and constraint whose dual is X X', over an expression M in CVXPY (`cp`); None where it
        has none: the interior-point method solves it. `V` and `square` = V V' are arrays or parameters."""

    @property
    def n(self) -> int:
        """Number of parameters."""
        return self.V.shape[-2]

    @property
    def columns(self) -> Array:
        """All combinations side by side, (n, s) or (n, K s)."""
        return self.V if self.V.ndim == 2 else np.concatenate(list(self.V), axis=1)

    @property
    def whole(self) -> bool:
        """Whether the combinations determine every parameter: the optimal information is then regular."""
        return self.columns.shape[1] >= self.n

    @property
    def smooth(self) -> bool:
        """Whether the loss has two known derivatives wherever it is finite."""
        return self.curvature is not None and self.whole

    def loss(self, information: ArrayLike) -> float:
        """Loss of an information matrix; infinite where it does not determine what is asked; information (n,
        n)."""
        M = np.asarray(information, dtype=float)
        if self.family is not None:
            return self.family.worst(M)
        covariance = covariance_of(M, self.columns)
        return self.of_covariance(covariance) if covariance is not None else np.inf

    def loss_of_factor(self, factor: Array, alike: bool = False) -> float:
        """Loss of the information factor factor', with twice the digits of `loss` where that is singular:
        factor (n, k); alike as `covariance_of_factor` has it."""
        if self.family is not None:
            return self.family.worst(factor @ factor.T)
        covariance = covariance_of_factor(factor, self.columns, alike)
        return self.of_covariance(covariance) if covariance is not None else np.inf

    def direction(self, information: Array, weight: Array | None = None) -> Array:
        """The X that makes the bound tight at a nonsingular optimum: Z = X X' is minus a subgradient;
        information (n, n)."""
        Y = solved(information, self.columns)
        return self.turned(Y, self.columns.T @ Y, weight)

    def second(self, information: Array, X: Array, turned: Array) -> Array:
        """Second derivatives of a smooth criterion (D: of its logarithm times n) along changes dM of the
        information; turned (p, n, s), dM X of each, X being `direction`; returns (p, p)."""
        from scipy.linalg import solve_triangular

        L = np.linalg.cholesky(information)
        flat = np.moveaxis(turned, 1, 0).reshape(self.n, -1)
        half = solve_triangular(L, flat, lower=True).reshape(self.n, len(turned), -1).swapaxes(0, 1)
        half = half.reshape(len(turned), -1)
        H = 2 * half @ half.T
        if self.curvature:
            own = np.tensordot(turned, X, (1, 0)).reshape(len(turned), -1)
            H -= self.curvature * own @ own.T
        return H

    def transformed(self, R: Array, finely: bool = False) -> tuple[Criterion, float]:
        """The same criterion for parameters R theta, and the factor between the losses: R (n, n), an upper triangle;
        finely: in extended precision."""
        return self.scaled(solved_below(R, self.columns, finely))

    def of_unit_norm(self, columns: Array) -> tuple[Criterion, float]:
        """`scaled` of a loss that grows with the square of its columns."""
        scale = np.linalg.norm(columns)
        return replace(self, V=columns / scale), float(scale**2)

    def __repr__(self) -> str:
        return (
            f"Criterion {self.name} ({self.kind}, {self.n} parameters, {self.columns.shape[1]} combinations)"
        )


def combinations(n: int, columns: ArrayLike | None) -> Array:
    """V of all parameters, of those of some indices, or as given."""
    if columns is None:
        return np.eye(n)
    chosen = np.asarray(columns)
    if chosen.ndim == 1 and np.issubdtype(chosen.dtype, np.integer):
        if len(set(chosen.tolist())) != len(chosen) or chosen.min() < 0 or chosen.max() >= n:
            raise InputError(
                f"the parameters {chosen.tolist()} were chosen of {n}; give each index of 0 to {n - 1} once."
            )
        return np.eye(n)[:, chosen]
    return chosen.astype(float)
