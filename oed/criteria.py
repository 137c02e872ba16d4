"""Criteria of optimal design: what an information matrix is worth. Numpy only.

Every criterion is a loss of V' M^-1 V, where M (n, n) is the Fisher information and V (n, s) says which
combinations of the parameters matter:

    D   det(V' M^-1 V)^(1/s)      V = identity: D-optimality; selected columns: D_s
    A   trace(V' M^-1 V)          V = identity: A; V V' = W: A(W), also called L; s = 1: c-optimality
    E   largest eigenvalue        V = identity: E
    G   max_k trace(V_k' M^-1 V_k)  V of shape (K, n, s): the worst of several
    W   max_k det(V_k' M^-1 V_k)^(1/s)  V of shape (K, n, s): the worst of several D
    K   condition number of V' M^-1 V: modified E (its certificate is a ratio of two: `oed.design.solvers.condition_number`)

and has the lower bound, valid for every X (n, s), also where M is singular (Cauchy-Schwarz):

    loss(M) >= numerator(X) / trace(X' M X),
    numerator:  D  s det(V'X)^(2/s),   A  trace(V'X)^2,   E  |V'X|_F^2,   G  sum_k trace(V_k'X_k)^2,
                W  s sum_k det(V_k'X_k)^(2/s)

so that one number, the largest trace(X' M X) over all admissible spectra, bounds the loss of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.covariances import covariance_of, covariance_of_factor, diagonal_blocks, solved
from oed.data import frozen
from oed.errors import InputError

if TYPE_CHECKING:
    from oed.design.problem.families import Family

__all__ = [
    "Criterion",
    "a_criterion",
    "c_criterion",
    "condition_criterion",
    "d_criterion",
    "e_criterion",
    "g_criterion",
    "worst_d_criterion",
]


@dataclass(frozen=True, eq=False)
class Criterion:
    """A loss of the information matrix.

    `kind` which function of V' M^-1 V; `V` (n, s), or (K, n, s) for G and W; `name` what it is called in
    tables; `family` G: V is a sample of it, which bounds the loss from below; the loss is the maximum over
    all of it.
    """

    kind: str
    V: NDArray[np.float64]
    name: str = ""
    family: Family | None = None

    def __post_init__(self) -> None:
        V = np.array(self.V, dtype=float)
        axes = 3 if self.kind in ("G", "W") else 2
        if self.kind not in ("D", "A", "E", "G", "W", "K"):
            raise InputError(f"the criterion is of kind {self.kind!r}; choose D, A, E, G, W or K.")
        if V.ndim != axes or not np.isfinite(V).all() or not np.any(V):
            raise InputError(
                f"the combinations V of a {self.kind} criterion have the shape {V.shape}; "
                f"they must be a finite, nonzero array of {axes} axes."
            )
        object.__setattr__(self, "V", frozen(V))
        object.__setattr__(self, "name", self.name or self.kind)

    @property
    def n(self) -> int:
        """Number of parameters."""
        return self.V.shape[-2]

    @property
    def columns(self) -> NDArray[np.float64]:
        """All combinations side by side, (n, s) or (n, K s)."""
        return self.V if self.V.ndim == 2 else np.concatenate(list(self.V), axis=1)

    def loss(self, information: ArrayLike) -> float:
        """Loss of an information matrix; infinite where it does not determine what is asked.

        Shapes: information (n, n).
        """
        if self.family is not None:
            return self.family.worst(np.asarray(information, dtype=float))
        covariance = covariance_of(np.asarray(information, dtype=float), self.columns)
        return self._of_covariance(covariance) if covariance is not None else np.inf

    def loss_of_factor(self, factor: NDArray[np.float64]) -> float:
        """Loss of the information factor factor', with twice the digits of `loss` where that is singular.

        Shapes: factor (n, k).
        """
        if self.family is not None:
            return self.family.worst(factor @ factor.T)
        covariance = covariance_of_factor(factor, self.columns)
        return self._of_covariance(covariance) if covariance is not None else np.inf

    def _of_covariance(self, covariance: NDArray[np.float64]) -> float:
        if self.kind == "D":
            sign, logdet = np.linalg.slogdet(covariance)
            return float(np.exp(logdet / len(covariance))) if sign > 0 else 0.0
        if self.kind == "A":
            return float(np.trace(covariance))
        if self.kind == "E":
            return float(np.linalg.eigvalsh(covariance)[-1])
        if self.kind == "K":
            values = np.linalg.eigvalsh(covariance)
            return float(values[-1] / values[0]) if values[0] > 0 else np.inf
        if self.kind == "W":
            own = diagonal_blocks(covariance, len(self.V))
            sign, logdet = np.linalg.slogdet(own)
            return float(np.where(sign > 0, np.exp(logdet / own.shape[1]), 0.0).max())
        return float(np.diag(covariance).reshape(self.V.shape[0], -1).sum(axis=1).max())

    def numerator(self, X: NDArray[np.float64]) -> float:
        """Numerator of the lower bound: loss(M) >= numerator(X) / trace(X' M X) for every M."""
        if self.kind == "G":
            parts = X.reshape(len(X), self.V.shape[0], -1)
            return float(np.sum(np.einsum("kns,nks->k", self.V, parts) ** 2))
        if self.kind == "W":
            parts = X.reshape(len(X), self.V.shape[0], -1)
            sign, logdet = np.linalg.slogdet(np.einsum("kns,nkt->kst", self.V, parts))
            size = self.V.shape[2]
            return float(size * np.sum(np.where(sign != 0, np.exp(2 * logdet / size), 0.0)))
        if self.kind == "K":
            raise InputError("a condition number has no bound by one direction; see `condition_design`.")
        product = self.V.T @ X
        if self.kind == "D":
            sign, logdet = np.linalg.slogdet(product)
            return float(len(product) * np.exp(2 * logdet / len(product))) if sign != 0 else 0.0
        return float(np.trace(product) ** 2 if self.kind == "A" else np.sum(product**2))

    def direction(
        self, information: NDArray[np.float64], weight: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """The X that makes the bound tight at a nonsingular optimum: Z = X X' is minus a subgradient.

        Shapes: information (n, n).
        """
        Y = solved(information, self.columns)
        covariance = self.columns.T @ Y
        if self.kind == "D":
            return Y @ np.linalg.inv(np.linalg.cholesky(covariance)).T
        if self.kind == "A":
            return Y
        if self.kind == "E":
            if weight is None:
                worst = np.linalg.eigh(covariance)[1][:, -1:]
                weight = worst @ worst.T
            values, vectors = np.linalg.eigh(weight)
            return Y @ (vectors * np.sqrt(np.clip(values, 0, None))) @ vectors.T
        K, s = self.V.shape[0], self.V.shape[2]
        if self.kind == "W":
            own = diagonal_blocks(covariance, K)
            worst = np.eye(K)[np.argmax(np.linalg.slogdet(own)[1])]
            roots = np.linalg.inv(np.linalg.cholesky(own)).swapaxes(1, 2)
            Y = np.einsum("nks,kst->nkt", Y.reshape(len(Y), K, s), roots).reshape(len(Y), -1)
        else:
            worst = np.eye(K)[np.argmax(np.diag(covariance).reshape(K, s).sum(axis=1))]
        return Y * np.repeat(np.sqrt(np.clip(worst if weight is None else weight, 0, None)), s)

    @property
    def smooth(self) -> bool:
        """Whether the loss has two derivatives wherever it is finite: D and A of combinations of full rank."""
        return self.kind in ("D", "A") and self.V.shape[1] >= self.n

    def second(
        self, information: NDArray[np.float64], X: NDArray[np.float64], turned: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Second derivatives of a smooth criterion (D: of its logarithm times n) along changes dM of the information.

        Shapes: turned (p, n, s), dM X of each, X being `direction`; returns (p, p).
        """
        from scipy.linalg import solve_triangular

        L = np.linalg.cholesky(information)
        flat = np.moveaxis(turned, 1, 0).reshape(self.n, -1)
        half = solve_triangular(L, flat, lower=True).reshape(self.n, len(turned), -1).swapaxes(0, 1)
        half = half.reshape(len(turned), -1)
        H = 2 * half @ half.T
        if self.kind == "D":
            own = np.tensordot(turned, X, (1, 0)).reshape(len(turned), -1)
            H -= own @ own.T
        return H

    def log_numerator(
        self, X: NDArray[np.float64], second: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Gradient (n, s) and second derivatives (n s, n s) of log numerator(X).

        D and W are sums of det(V_k'X_k)^(2/s), A and G of trace(V_k'X_k)^2, of one term or several.
        """
        n, size = X.shape
        if self.kind == "E":
            rise = self.V @ (self.V.T @ X)
            total = float(np.sum(X * rise))
            rise *= 2 / total
            bend = np.kron((2 / total) * self.V @ self.V.T, np.eye(size)) if second else None
        else:
            V = self.V[None] if self.V.ndim == 2 else self.V
            K, _, s = V.shape
            own = np.einsum("kns,nkt->kst", V, X.reshape(n, K, s))
            if self.kind in ("D", "W"):
                W = V @ np.linalg.inv(own).swapaxes(1, 2)
                share = np.exp((2 / s) * np.linalg.slogdet(own)[1])
                outer, crossed = 4 / s**2, 2 / s
            else:
                trace = np.einsum("kss->k", own)
                W, share, outer, crossed = V / np.where(trace, trace, 1.0)[:, None, None], trace**2, 2.0, 0.0
            share = share / share.sum()
            rise = (2 / s if crossed else 2.0) * np.moveaxis(W * share[:, None, None], 0, 1).reshape(n, size)
            bend = np.zeros((n, K, s, n, K, s) if second else (0,) * 6)
            for k in range(K if second else 0):
                bend[:, k, :, :, k, :] = share[k] * (
                    outer * np.einsum("ia,jb->iajb", W[k], W[k])
                    - crossed * np.einsum("ib,ja->iajb", W[k], W[k])
                )
            bend = bend.reshape(X.size, X.size) if second else None
        return rise, None if bend is None else bend - np.outer(rise, rise)

    def transformed(self, R: NDArray[np.float64]) -> tuple[Criterion, float]:
        """The same criterion for parameters R theta, and the factor between the losses.

        Shapes: R (n, n).
        """
        from scipy.linalg import solve_triangular

        columns = solve_triangular(R, self.columns, trans=1)
        if self.kind in ("G", "W"):
            V = np.swapaxes(columns.reshape(self.n, self.V.shape[0], -1), 0, 1)
            scale = np.sqrt(np.sum(V**2, axis=(1, 2)).max())
            return Criterion(self.kind, V / scale, self.name), scale**2
        if self.kind == "D":
            Q, T = np.linalg.qr(columns)
            logdet = np.sum(np.log(np.abs(np.diag(T)))) if np.all(np.diag(T)) else -np.inf
            return Criterion("D", Q, self.name), float(np.exp(2 * logdet / columns.shape[1]))
        scale = np.linalg.norm(columns)
        return Criterion(self.kind, columns / scale, self.name), float(scale**2)

    def __repr__(self) -> str:
        return (
            f"Criterion {self.name} ({self.kind}, {self.n} parameters, {self.columns.shape[1]} combinations)"
        )


def d_criterion(n: int, columns: ArrayLike | None = None, *, name: str = "") -> Criterion:
    """D-optimality, det(M^-1)^(1/n); with columns D_s, the same of the named parameters' covariance."""
    return Criterion("D", _combinations(n, columns), name or ("D" if columns is None else "Ds"))


def a_criterion(n: int, weight: ArrayLike | None = None, *, name: str = "") -> Criterion:
    """A-optimality, trace(W M^-1)."""
    if weight is None:
        return Criterion("A", np.eye(n), name or "A")
    W = np.asarray(weight, dtype=float)
    if W.shape != (n, n) or not np.allclose(W, W.T, rtol=1e-10, atol=1e-12 * np.abs(W).max()):
        raise InputError(f"the weight W has the shape {W.shape}; it must be a symmetric {n} x {n} matrix.")
    # In units of its own diagonal, so that small entries keep their digits beside large ones.
    scale = np.sqrt(np.abs(np.diag(W)))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(W / np.outer(scale, scale))
    if values[0] < -1e-10 * abs(values[-1]):
        raise InputError(
            f"the weight W has the eigenvalue {np.linalg.eigvalsh(W)[0]:g}; it must be positive semidefinite."
        )
    keep = values > 1e-14 * values[-1]
    return Criterion("A", scale[:, None] * vectors[:, keep] * np.sqrt(values[keep]), name or "L")


def c_criterion(c: ArrayLike, *, name: str = "") -> Criterion:
    """c-optimality: the variance c' M^-1 c of one combination c' theta.

    Shapes: c (n,).
    """
    return Criterion("A", np.asarray(c, dtype=float).reshape(-1, 1), name or "c")


def e_criterion(n: int, columns: ArrayLike | None = None, *, name: str = "") -> Criterion:
    """E-optimality: the largest eigenvalue of V' M^-1 V, by default of M^-1."""
    return Criterion("E", _combinations(n, columns), name or "E")


def g_criterion(combinations: ArrayLike, *, name: str = "") -> Criterion:
    """The worst of several: max_k trace(V_k' M^-1 V_k)."""
    V = np.asarray(combinations, dtype=float)
    return Criterion("G", V[:, :, None] if V.ndim == 2 else V, name or "G")


def worst_d_criterion(combinations: ArrayLike, *, name: str = "") -> Criterion:
    """The worst of several D: max_k det(V_k' M^-1 V_k)^(1/s)."""
    return Criterion("W", np.asarray(combinations, dtype=float), name or "W")


def condition_criterion(n: int, lengths: ArrayLike | None = None, *, name: str = "") -> Criterion:
    """Modified E: the condition number of M, the parameters in given units.

    Shapes: lengths (n,).
    """
    unit = np.ones(n) if lengths is None else np.asarray(lengths, dtype=float)
    if unit.shape != (n,) or not (np.isfinite(unit) & (unit > 0)).all():
        raise InputError(f"the units of the parameters are {unit}; give {n} positive numbers.")
    return Criterion("K", np.diag(1 / unit), name or "modified-E")


def _combinations(n: int, columns: ArrayLike | None) -> NDArray[np.float64]:
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
