"""Designs under frequency-wise limits: the spectral density of the input or output may not exceed a mask.

On a fixed grid of cells the mask is a cap on every line's power, w_k <= cap_k. The certificate is the linear
programme over that set, solved by hand: for any nu >= 0 no admissible spectrum has more than

    h(nu) = nu + sum_k cap_k max(S_k - nu, 0),   S_k the price of cell k per unit of power (power limit 1),

(weak duality; the least h is the fractional knapsack), so loss >= numerator(X) / (tr X' M_0 X + min h).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.data import Spectrum
from oed.design.parametrisations.masked_mimo import masked_mimo_design
from oed.design.problem.budgets import power_budgets
from oed.design.problem.certificate import Certificate
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.design import Design
from oed.design.problem.information_maps import information_map
from oed.design.problem.lines import Columns, Problem
from oed.design.solvers.column_generation import solve_weights
from oed.errors import InfeasibleDesign, InputError, Status

__all__ = ["knapsack", "masked_design"]

Mask = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def knapsack(worth: NDArray[np.float64], cap: NDArray[np.float64]) -> tuple[float, float]:
    """max sum w_k S_k over 0 <= w <= cap, sum w <= 1, and the multiplier nu of the sum.

    Parameters
    ----------
    worth : ndarray
        (K,) S_k, at least 0.
    cap : ndarray
        (K,) caps, at least 0.

    Returns
    -------
    value, nu : float
        The maximum, which h(nu) attains.
    """
    order = np.argsort(-worth)
    before = np.concatenate([[0.0], np.cumsum(cap[order])[:-1]])
    w = np.clip(1 - before, 0, cap[order])
    full = np.flatnonzero(before + cap[order] >= 1)
    nu = float(worth[order[full[0]]]) if len(full) else 0.0
    return float(w @ worth[order]), nu


def masked_design(
    model: Any,
    criterion: str | Criterion = "D",
    *,
    input_mask: Mask | None = None,
    output_mask: Mask | None = None,
    input_power: float = 1.0,
    cells: int | None = None,
    tolerance: float = 1e-6,
) -> Design:
    """The optimal spectrum whose density stays below a mask, on a grid of cells.

    Parameters
    ----------
    model : Plant, Model or InformationMap
        One input or several.
    criterion : str or Criterion
        As for `solve_design`.
    input_mask, output_mask : callable, optional
        omega (K,) -> largest two-sided density of the input, of the noise-free output; (1/2pi) times its
        integral over the circle is a power. With several inputs (K, nu, nu) and (K, ny, ny) Hermitian matrices.
    input_power : float
        Limit on the input power.
    cells : int, optional
        Number of cells of equal width on [0, pi]; the density is constant in each. By default 300 for one input
        and 40 for several.
    tolerance : float
        Relative gap to reach.

    Returns
    -------
    Design
        Its certificate holds for spectra on these cells.

    Raises
    ------
    InputError
        If a mask is negative, complex or of the wrong shape; with several inputs, if it is not Hermitian or not
        positive semidefinite.
    InfeasibleDesign
        If the masks leave no power at any frequency.
    """
    information = information_map(model)
    wanted = criterion_of(criterion, model, information)
    if information.n_inputs != 1:
        return masked_mimo_design(
            information,
            wanted,
            input_mask=input_mask,
            output_mask=output_mask,
            input_power=input_power,
            cells=cells or 40,
            tolerance=tolerance,
        )
    cells = cells or 300
    omega = (np.arange(cells) + 0.5) * np.pi / cells
    cap = np.full(cells, np.inf)
    if input_mask is not None:
        cap = np.minimum(cap, _values(input_mask, omega, "input mask") / cells)
    open_to_input = cap > 0
    if output_mask is not None:
        gain = np.sum(np.abs(information.gain(omega)) ** 2, axis=(1, 2))
        with np.errstate(divide="ignore"):
            cap = np.minimum(
                cap, np.where(gain > 0, _values(output_mask, omega, "output mask") / cells / gain, np.inf)
            )
    if not cap.any():
        if input_mask is not None and output_mask is not None and open_to_input.any():
            at = omega[open_to_input]
            raise InfeasibleDesign(
                f"the input mask clashes with the output mask: the input may have power between {at[0]:.4g} and "
                f"{at[-1]:.4g} rad/sample only, and there the output mask is 0; raise one where the other is open."
            )
        which = "input" if not open_to_input.any() else "output"
        raise InfeasibleDesign(
            f"the {which} mask is 0 at every frequency, so no input satisfies it; raise it somewhere."
        )
    open_cells = cap > 0
    budgets = power_budgets(information, input_power)
    problem = Problem(information, wanted, budgets, omega[open_cells])
    share = np.minimum(cap[open_cells] / budgets[0].limit, 1.0)
    columns = problem.columns(problem.omega, np.ones((len(share), 1), dtype=complex))
    limit = budgets[0].limit
    capped = Columns(
        columns.omega,
        columns.direction,
        columns.F * np.sqrt(limit),
        np.concatenate([np.ones((len(share), 1)), np.diag(1 / share)[:, share < 1]], axis=1),
    )
    weights = solve_weights(problem, capped, None, 1e-12)
    w = np.minimum(weights.w, share)
    w = w / max(1.0, float(w.sum()))
    worth = np.sum(np.einsum("mnr,ns->mrs", capped.F, weights.X) ** 2, axis=(1, 2))
    most, nu = knapsack(worth, share)
    fixed = float(np.sum(weights.X * (problem.constant @ weights.X)))
    bound = problem.criterion.numerator(weights.X) / (fixed + most) * problem.scale
    spectrum = Spectrum(problem.omega, w * limit)
    loss = problem.loss(columns, w * limit) * problem.scale
    X = np.asarray(np.linalg.solve(problem.R, weights.X), dtype=np.float64)
    numerator = problem.original.numerator(X)
    unit = np.array([max(nu, 1e-300)])
    return Design(
        spectrum=spectrum,
        criterion=wanted,
        loss=loss,
        bound=bound,
        certificate=Certificate(
            X=X,
            multipliers={"input power": nu},
            numerator=numerator,
            value=numerator / bound,
            bound=bound,
            largest_price=float(worth.max() / unit[0]),
            frequency=float(problem.omega[np.argmax(worth)]),
            price=lambda frequencies: problem.prices_at(frequencies, weights.X, unit).ratio,
        ),
        status=Status.OK if loss - bound <= tolerance * bound else Status.INACCURATE,
        information=information.of_spectrum(spectrum),
        map=information,
        power_used={"input power": spectrum.total_power},
        limits={"input power": limit},
        solver="newton",
        rounds=1,
    )


def _values(mask: Mask, omega: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    values = np.asarray(mask(omega))
    if np.iscomplexobj(values) or values.shape != omega.shape or np.isnan(values).any() or (values < 0).any():
        raise InputError(
            f"the {name} has the shape {values.shape} and values from {values.min()} on; for one input it must be "
            f"real, at least 0 and of shape {omega.shape}."
        )
    return values.astype(float)
