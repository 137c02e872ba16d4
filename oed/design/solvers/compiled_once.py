"""Designs in a loop that compile once: the reference problem with its data as parameters (disciplined parametrised).

A sequential experiment designs anew after every fit, with the same structure and other numbers. CVXPY then only
replaces the numbers: information of the lines, prior, combinations and budgets are parameters of one problem."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.criteria import Criterion
from oed.design.assembling import certified
from oed.design.problem.budgets import power_budgets
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.design import Design
from oed.design.problem.information_maps import information_map
from oed.design.problem.lines import Problem
from oed.design.solvers.column_generation import Exchange, evaluated_bound
from oed.design.solvers.whole_grid import solve_cvxpy
from oed.errors import InputError


class RepeatedDesign:
    """One design problem on a fixed grid, for many plants of the same structure and one input.

    Parameters
    ----------
    omega : array_like
        (K,) frequencies in [0, pi] where lines are allowed.
    criterion : str
        As for `solve_design`, of kind D (all parameters), A or E with combinations of full rank.
    accuracy : float
        Clarabel's tolerances.

    Notes
    -----
    The certificate is computed here as for every design, for spectra on the grid. `problem` is CVXPY's, and
    `compilations` counts how often it was made.
    """

    def __init__(self, omega: ArrayLike, criterion: str = "D", *, accuracy: float = 1e-9) -> None:
        self.omega = np.unique(np.asarray(omega, dtype=float))
        if not len(self.omega) or self.omega[0] < 0 or self.omega[-1] > np.pi + 1e-12:
            raise InputError("the grid must hold finite frequencies in [0, pi] rad/sample.")
        self.criterion, self.accuracy = criterion, accuracy
        self.compilations = 0
        self.problem: Any = None
        self._parts: dict[str, Any] = {}
        self._shape: tuple[int, ...] = ()

    def design(
        self, model: Any, *, input_power: float = 1.0, prior: ArrayLike | None = None, tolerance: float = 1e-6
    ) -> Design:
        """The design for one plant; the first call compiles, and so does a plant of another size.

        Parameters
        ----------
        model : Plant, Model or InformationMap
            One input.
        input_power : float
            Limit on the input power.
        prior : array_like, optional
            (n, n) information of experiments already done, per sample of the new one.
        tolerance : float
            Relative gap for the status OK.

        Returns
        -------
        Design
            Lines on the grid, with its certificate.
        """
        information = information_map(model)
        if information.n_inputs != 1:
            raise InputError(f"repeated designs are for one input; the plant has {information.n_inputs}.")
        wanted = criterion_of(self.criterion, model, information)
        if prior is not None:
            information = information.with_prior(prior)
        problem = Problem(information, wanted, power_budgets(information, input_power), self.omega)
        columns = problem.columns(self.omega, np.ones((len(self.omega), 1), dtype=complex))
        scaled = problem.criterion
        if (len(columns), *scaled.columns.shape) != self._shape:
            self._compile(scaled, len(columns))
        parts = self._parts
        atoms = columns.F @ np.swapaxes(columns.F, 1, 2)
        parts["atoms"].value = atoms.reshape(len(columns), -1)
        parts["constant"].value = problem.constant
        parts["share"].value = columns.q[:, 0]
        parts["V"].value = scaled.columns
        parts["square"].value = scaled.columns @ scaled.columns.T
        status = solve_cvxpy(self.problem, self.accuracy)
        w = np.maximum(np.asarray(parts["w"].value, dtype=float), 0.0)
        w = w / (columns.q.T @ w).max()
        M = problem.constant + columns.information(w)
        X = scaled.direction(M) if parts["largest"] is None else _root(parts["largest"].dual_value)
        nu = np.array([max(float(columns.prices(X, np.ones(1)).max()), 1e-300)])
        bound, price, frequency = evaluated_bound(problem, X, nu, refine=False)
        found = Exchange(
            columns, w, problem.loss(columns, w), X, nu * price, bound, price, frequency, 1, status, problem
        )
        return certified(found, tolerance=tolerance, solver="clarabel")

    def _compile(self, scaled: Criterion, m: int) -> None:
        import cvxpy as cp

        n = scaled.n
        w = cp.Variable(m, nonneg=True)
        atoms, constant = cp.Parameter((m, n * n)), cp.Parameter((n, n), symmetric=True)
        share, V = cp.Parameter(m, nonneg=True), cp.Parameter(scaled.columns.shape)
        square = cp.Parameter((n, n), symmetric=True)
        M = cp.reshape(atoms.T @ w, (n, n), order="C") + constant
        M = (M + M.T) / 2
        stated = scaled.conic(cp, M, V, square) if scaled.whole else None
        if stated is None:
            raise InputError(
                f"the criterion {scaled.name} has no repeated form; use D, A or E of all parameters, or solve_design."
            )
        objective, largest = stated
        budget = share @ w <= 1
        self.problem = cp.Problem(objective, [budget] if largest is None else [budget, largest])
        self.compilations += 1
        self._parts = {
            "w": w,
            "atoms": atoms,
            "constant": constant,
            "share": share,
            "V": V,
            "square": square,
            "largest": largest,
        }
        self._shape = (m, *scaled.columns.shape)


def _root(Z: NDArray[np.float64]) -> NDArray[np.float64]:
    values, vectors = np.linalg.eigh((Z + Z.T) / 2)
    return vectors * np.sqrt(np.clip(values, 0, None))
