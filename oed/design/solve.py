"""The verb: solve_design."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.covariances import on_one_thread
from oed.criteria import Criterion
from oed.design.assembling import certified, told_apart
from oed.design.problem.budgets import power_budgets
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.design import Design
from oed.design.problem.grid import bands_of, denser, frequency_grid
from oed.design.problem.information_maps import information_map
from oed.design.problem.lines import Problem
from oed.design.solvers import elfving_barrier as directions
from oed.design.solvers.column_generation import Exchange, better, evaluated_bound, exchange, seed_columns
from oed.design.solvers.condition_number import condition_design
from oed.design.solvers.gain_scaling import peak_sinusoid
from oed.design.solvers.merging_lines import collapsed
from oed.errors import InputError


@on_one_thread
def solve_design(
    model: Any,
    criterion: str | Criterion = "D",
    *,
    input_power: float | None = None,
    output_power: float | None = None,
    channel_power: ArrayLike | None = None,
    rate_power: ArrayLike | None = None,
    band: Sequence[float] | Sequence[Sequence[float]] | None = None,
    points: int | ArrayLike = 400,
    prior: ArrayLike | None = None,
    solver: str = "newton",
    refine: bool = True,
    tolerance: float = 1e-7,
) -> Design:
    """The input spectrum that is optimal for a criterion, with its certificate.

    Minimises the loss of the Fisher information per sample over all spectra within the limits: lines at any
    frequency of the band, with a positive semidefinite power each.

    Parameters
    ----------
    model : Plant, Model, InformationMap or object
        What is to be identified; anything that `information_map` takes.
    criterion : str or Criterion
        "D", "A", "E", "modified-E", "hinf" (the peak gain), or another name of `oed.design.problem.criteria_by_name`.
    input_power : float, optional
        Limit on the input power summed over channels, squared input units; 1 where no power is limited.
    output_power : float, optional
        Limit on the power of the noise-free output, summed over channels.
    channel_power : array_like, optional
        (nu,) limit on the power of every input channel.
    rate_power : array_like, optional
        (nu,) limit on the mean square of every input channel's change from one sample to the next.
    band : (low, high) or sequence of them, optional
        Where lines are allowed, rad/sample; by default [0, pi].
    points : int or array_like
        Size of the uniform part of the first frequency grid, or frequencies for it; without `refine` lines lie
        on these only, and `certificate.elsewhere` tells whether other frequencies would do better.
    prior : array_like, optional
        (n, n) information of experiments already done, per sample of the new one.
    solver : {"newton", "clarabel"}
        Own column generation, or CVXPY with Clarabel on the whole grid.
    refine : bool
        Whether lines may lie between those of the grid.
    tolerance : float
        Relative gap to reach.

    Returns
    -------
    Design
        Status OK where the gap is within the tolerance; the bound holds whatever the status.

    Raises
    ------
    InputError
        If an argument breaks its rule.
    NotIdentifiable
        If no input in the band determines the parameters (the combinations are named).

    Notes
    -----
    Source: docs/theory/design.md; V. V. Fedorov, Theory of Optimal Experiments (1972),
    for the equivalence theorem; G. Elfving (1952) for singular designs. Twin: tests/oracles.
    """
    if solver not in ("newton", "clarabel"):
        raise InputError(f"the solver is {solver!r}; choose newton or clarabel.")
    if not 1e-14 < tolerance < 1:
        raise InputError(f"the tolerance is {tolerance}; a relative gap lies between 1e-14 and 1.")
    information = information_map(model)
    wanted = criterion_of(criterion, model, information, over_a_band=solver == "newton")
    if prior is not None:
        information = information.with_prior(prior)
    budgets = power_budgets(information, input_power, output_power, channel_power, rate_power)
    bands = bands_of(band)
    omega = frequency_grid(information, bands, points)
    if refine and np.ndim(points):
        # Given frequencies may miss a resonance, or part of the band: the certificate must not.
        omega = np.union1d(omega, frequency_grid(information, bands, 400))
    problem = Problem(information, wanted, budgets, omega, bands)
    if wanted.method == "ratio":
        if any(limit is not None for limit in (output_power, channel_power, rate_power)):
            raise InputError("modified-E knows a limit on the input power only; leave out the others.")
        return condition_design(problem, refine=refine, tolerance=tolerance)
    problem, in_own_parameters = told_apart(problem, criterion)
    family = problem.original.family
    if family is not None:
        from oed.design.solvers.worst_response import worst_response_design

        design = worst_response_design(problem, family, refine=refine, tolerance=tolerance)
    else:
        found = _first_found(problem, model, criterion, solver, refine, tolerance)
        if refine:
            found = _refined(found, problem, solver, tolerance)
        design = certified(found, tolerance=tolerance, solver=solver)
    design = in_own_parameters(design)
    return design if refine else _beside_the_grid(design, frequency_grid(information, bands, 400))


def _first_found(
    problem: Problem, model: Any, criterion: str | Criterion, solver: str, refine: bool, tolerance: float
) -> Exchange:
    """What the solver that suits the problem finds."""
    if solver == "clarabel":
        from oed.design.solvers.whole_grid import reference_exchange

        return reference_exchange(problem, refine=refine, tolerance=tolerance)
    known = peak_sinusoid(problem, model, criterion) if refine else None
    if known is not None and known.gap <= tolerance:
        return known
    by_directions = partial(directions.direction_exchange, problem, refine=refine, tolerance=0.3 * tolerance)
    applies = directions.applies(problem)
    if applies and problem.map.n_inputs > 1:
        return by_directions()
    finish = partial(collapsed, tolerance=tolerance) if refine else None
    found = exchange(problem, refine=refine, tolerance=tolerance, finish=finish)
    # One input has no directions to find, and columns are the faster way to most of its designs.
    return better(found, by_directions()) if applies and abs(found.gap) > tolerance else found


def _refined(found: Exchange, problem: Problem, solver: str, tolerance: float) -> Exchange:
    """The lines merged, and their certificate looked at again, between the lines too; where it fails, the search goes on."""
    finish = partial(collapsed, tolerance=tolerance)
    if found.gap > tolerance or len(found.columns) > found.problem.map.n:
        found = finish(found)
    for _ in range(2):
        found = _looked_at_again(found)
        if found.gap <= tolerance or solver != "newton":
            break
        before = found.gap
        again = exchange(
            found.problem, columns=found.columns + seed_columns(problem), tolerance=tolerance,
            max_rounds=10, accuracy=min(1e-4, 0.1 * before), finish=finish,
        )  # fmt: skip
        found = finish(better(found, again))
        if found.gap > 0.1 * before:
            break  # rounding, not a missing line, is what holds the gap up
    return found


def _beside_the_grid(design: Design, omega: NDArray[np.float64]) -> Design:
    """What the certificate of a fixed grid says about the frequencies that it leaves out."""
    prices = design.certificate.sensitivity(omega)
    top = int(np.argmax(prices))
    return replace(
        design,
        certificate=replace(
            design.certificate, elsewhere=max(1.0, float(prices[top])), elsewhere_frequency=float(omega[top])
        ),
    )


def _looked_at_again(found: Exchange) -> Exchange:
    """The certificate evaluated anew on a grid twice as fine, and much finer around the support."""
    problem = found.problem
    support = found.columns.omega
    problem = problem.extended(denser(problem.omega, problem.bands, support, problem.length_scale(support)))
    bound, price, frequency = evaluated_bound(problem, found.X, found.nu)
    return replace(
        found, problem=problem, nu=found.nu * price, bound=bound, price=max(found.price, price), frequency=frequency,
    )  # fmt: skip
