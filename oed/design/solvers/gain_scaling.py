"""The peak-gain design that the gain-scaling theorem names, offered to the certificate before any search.

docs/theory/design.md: where some x has sum_i x_i G'_i = G / gamma, the sinusoid at the peak is optimal and x is its
certificate. Whether it is, here, is decided by the certificate as for every other design."""

from typing import Any

import numpy as np

from oed.criteria import Criterion
from oed.design.problem.lines import Problem
from oed.design.solvers.column_generation import Exchange
from oed.design.solvers.merging_lines import evaluated
from oed.errors import Status
from oed.information import inverse_root
from oed.plants.norms import peak
from oed.plants.plant import Plant


def peak_sinusoid(problem: Problem, model: Any, criterion: str | Criterion) -> Exchange | None:
    """The sinusoid at the peak with the certificate of the theorem."""
    if not (isinstance(criterion, str) and criterion == "hinf" and isinstance(model, Plant)):
        return None
    if len(problem.budgets) > 1 or np.any(problem.constant):
        return None
    at = peak(model)
    if not any(low <= at.frequency <= high for low, high in problem.bands):
        return None
    columns = problem.columns(np.array([at.frequency]), at.input_direction[None, :].astype(complex))
    omega = problem.omega[:: max(1, len(problem.omega) // (4 * problem.map.n + 50))]
    # The noise weights both sides of G = sum x_i G'_i alike.
    D = np.moveaxis(problem.map.factor(omega), 1, 0).reshape(problem.map.n, -1)
    G = (inverse_root(model.noise_covariance) @ model.transfer(omega)).reshape(len(omega), -1)
    G = (G / model.noise_response(omega)[:, None]).ravel()
    scale = np.linalg.norm(D, axis=1)
    rows = np.concatenate([D.real, D.imag], axis=1).T / scale
    x = np.linalg.lstsq(rows, np.concatenate([G.real, G.imag]), rcond=None)[0] / scale
    X = (problem.R @ x)[:, None]
    w = 1 / columns.q[0]
    empty = Exchange(columns, w, np.inf, X, np.ones(1), 0.0, 1.0, at.frequency, 0, Status.CONVERGED, problem)
    return evaluated(empty, columns, w, X, np.ones(1))
