"""The least input power that reaches a demanded accuracy, and the ellipsoid form of application-oriented design."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from oed.covariances import on_one_thread, root_in_own_units
from oed.criteria import Criterion, e_criterion
from oed.design.problem.design import Design
from oed.design.problem.information_maps import information_map
from oed.errors import InfeasibleDesign, InputError


def application_criterion(required: ArrayLike, *, name: str = "application") -> Criterion:
    """The criterion whose loss is at most 1 exactly where M >= required (as matrices).

    Parameters
    ----------
    required : array_like
        (n, n) information that the application needs: kappa(alpha, n) gamma / 2 times the Hessian of its cost,
        over the number of samples, so that the confidence ellipsoid lies within the performance set.
    name : str
        What it is called in tables.

    Returns
    -------
    Criterion
        Of kind E with V V' = required.

    Notes
    -----
    Source: H. Hjalmarsson, "System identification of complex and structured systems", European Journal of
    Control 15 (2009) 275-310; MOOSE2 calls it an application constraint.
    """
    R = np.asarray(required, dtype=float)
    if R.ndim != 2 or R.shape[0] != R.shape[1] or not np.allclose(R, R.T):
        raise InputError(f"the required information is {R.shape}; it must be symmetric and square.")
    V, least = root_in_own_units(R)
    if least < -1e-10:
        values = np.linalg.eigvalsh(R)
        raise InputError(
            f"the required information has the eigenvalues {values[0]:g} to {values[-1]:g}; it must be positive "
            "semidefinite and not zero."
        )
    return e_criterion(len(R), V, name=name)


@on_one_thread
def least_power_design(
    model: Any,
    criterion: str | Criterion,
    demand: float,
    *,
    max_power: float = np.inf,
    prior: ArrayLike | None = None,
    **options: Any,
) -> Design:
    """The design of least input power whose loss is at most the demand.

    Parameters
    ----------
    model : Plant, Model or InformationMap
        What is to be identified.
    criterion : str or Criterion
        Any; with `application_criterion(R)` and the demand 1 it is M >= R.
    demand : float
        Largest loss per sample that is accepted.
    max_power : float
        Input power that is there.
    prior : array_like, optional
        (n, n) information of experiments already done, per sample.
    **options : object
        As for `solve_design`, except powers: band, points, tolerance, ...

    Returns
    -------
    Design
        With the least `spectrum.total_power`. Without prior the loss is inversely proportional to the power, so
        one design is enough and its gap is the power's; with a prior the power is found by bisection.

    Raises
    ------
    InfeasibleDesign
        If what is known already meets the demand, so that no input is needed, or if the demand needs more than
        `max_power`.
    """
    from oed.design.solve import solve_design

    if not (np.isfinite(demand) and demand > 0):
        raise InputError(f"the demanded loss is {demand}; it must be positive and finite.")
    at = lambda power: solve_design(model, criterion, input_power=power, prior=prior, **options)
    if np.isfinite(max_power):
        most = at(max_power)
        if most.bound > demand:
            raise InfeasibleDesign(
                f"the demand clashes with the input power: with a power of {max_power:g} every input has a loss of at "
                f"least {most.bound:.6g}, and {demand:g} is demanded; allow more power, or demand less."
            )
    base, design = information_map(model), at(1.0)
    if prior is None and not np.any(base.constant):
        return at(design.loss / demand)
    known = base if prior is None else base.with_prior(prior)
    if design.criterion.loss(known.constant) <= demand:
        raise InfeasibleDesign(
            f"what is known already has the loss {design.criterion.loss(known.constant):g}, within the demand "
            f"{demand:g}: no input is needed; demand more."
        )
    low = high = 1.0
    while design.loss > demand:
        low, high = high, 4 * high
        design = at(high)
    while low == 1.0 and at(low).loss <= demand:
        low, high = low / 4, low
        if at(low).loss > demand:
            break
        low = 1.0 if high < 1e-12 else low
    for _ in range(60):
        middle = float(np.sqrt(low * high))
        trial = at(middle)
        if trial.loss <= demand:
            high, design = middle, trial
        else:
            low = middle
        if high / low < 1 + 1e-9:
            break
    return design
