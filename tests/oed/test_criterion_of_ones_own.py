"""A criterion of one's own is one class: Kiefer's p-mean, between A (p = 1) and E (p infinite), with its certificate."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from oed import named_plant, solve_design
from oed.criteria import Criterion
from oed.data import Spectrum
from oed.information import information_of_spectrum

P = 4
DUAL = 2 * P / (P + 1)


class PMean(Criterion):
    """The p-mean of the covariance's eigenvalues."""

    kind: ClassVar[str] = "P"

    def of_covariance(self, covariance: NDArray[np.float64]) -> float:
        """The mean of powers."""
        return float(np.mean(np.linalg.eigvalsh(covariance) ** P) ** (1 / P))

    def numerator(self, X: NDArray[np.float64]) -> float:
        """Hoelder: the dual norm of the singular values."""
        values = np.linalg.svd(self.V.T @ X, compute_uv=False)
        return float(np.sum(values**DUAL) ** (2 / DUAL) * self.V.shape[1] ** (-1 / P))

    def turned(
        self, Y: NDArray[np.float64], covariance: NDArray[np.float64], weight: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Y by the root of the loss's gradient in the covariance."""
        values, vectors = np.linalg.eigh(covariance)
        slope = values ** (P - 1) / len(values) * self.of_covariance(covariance) ** (1 - P)
        return Y @ (vectors * np.sqrt(slope)) @ vectors.T

    def log_numerator(
        self, X: NDArray[np.float64], second: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """The gradient alone: the second derivatives are differences of it."""
        U, s, W = np.linalg.svd(self.V.T @ X, full_matrices=False)
        return 2 * self.V @ (U * (s ** (DUAL - 1) / np.sum(s**DUAL))) @ W, None

    def scaled(self, columns: NDArray[np.float64]) -> tuple[Criterion, float]:
        """Of unit norm."""
        return self.of_unit_norm(columns)

    def conic(self, cp: Any, M: Any, V: Any, square: Any) -> tuple[Any, Any] | None:
        """None here."""
        return None


def test_the_bound_is_one(rng):
    criterion = PMean(np.eye(4))
    for _ in range(100):
        B, Y = rng.standard_normal((4, 6)), rng.standard_normal((4, 4))
        M = B @ B.T
        X, loss = criterion.direction(M), criterion.loss(M)
        assert criterion.numerator(X) / np.trace(X.T @ M @ X) == pytest.approx(loss, rel=1e-9)
        assert criterion.numerator(Y) / np.trace(Y.T @ M @ Y) <= loss * (1 + 1e-12)


def test_its_design_is_certified_and_lies_between_those_of_a_and_e():
    plant = named_plant("reference")
    design = solve_design(plant, PMean(np.eye(4)))
    assert design.status.ok
    assert design.gap < 1e-9
    A, E = solve_design(plant, "A").loss, solve_design(plant, "E").loss
    assert A / 4 < design.loss < E
    # Weights on a grid by a plain optimiser, the loss by its formula: none is below the bound, the best nearly there.
    omega = np.union1d(np.linspace(0.05, 3.1, 80), design.spectrum.omega)
    lines = np.array([information_of_spectrum(plant, Spectrum([w], [[[1.0]]])) for w in omega])

    def loss(x):
        C = np.linalg.inv(np.einsum("k,kij->ij", x**2 / np.sum(x**2), lines))
        return float(np.mean(np.linalg.eigvalsh(C) ** P) ** (1 / P))

    found = minimize(loss, np.ones(len(omega)), method="L-BFGS-B", options={"maxiter": 2000, "maxfun": 10**6})
    assert design.bound * (1 - 1e-9) <= found.fun < 1.001 * design.loss
