"""The one function that makes a Design of what a solver found, with its certificate; and the coordinates in which it is found."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.data import Spectrum
from oed.design.problem.certificate import Certificate
from oed.design.problem.criteria_by_name import criterion_in, of_the_model
from oed.design.problem.design import Design
from oed.design.problem.lines import Problem
from oed.design.solvers.column_generation import Exchange
from oed.errors import Status

TRIFLES = (1e-9, 1e-12, 1e-15, 0.0)
"""Shares of the power below which a line is left out, the first at which the loss does not tell."""

UNTOLD = 1e-9
"""Relative rise of the loss that is not told."""


def certified(found: Exchange, *, tolerance: float, solver: str) -> Design:
    """Make a Design of the outcome of the loop, in the model's own units."""
    problem = found.problem
    found = _without_trifles(found)
    spectrum = spectrum_of_lines(found.columns.omega, found.columns.direction, found.w)
    loss, bound = found.loss * problem.scale, found.bound * problem.scale
    X = np.asarray(np.linalg.solve(problem.R, found.X), dtype=np.float64)
    numerator = problem.original.numerator(X)
    used = found.columns.q.T @ found.w
    certificate = Certificate(
        X=X, multipliers={b.name: float(v) for b, v in zip(problem.budgets, found.nu, strict=True)},
        numerator=numerator, value=numerator / bound, bound=bound, largest_price=found.price,
        frequency=found.frequency, price=lambda omega: problem.prices_at(omega, found.X, found.nu).ratio,
        rounding=problem.rounding(found.columns, found.w),
    )  # fmt: skip
    power = {b.name: float(v * b.limit) for b, v in zip(problem.budgets, used, strict=True)}
    return assembled(
        problem, spectrum, certificate, loss, used=power, tolerance=tolerance, solver=solver, rounds=found.rounds,
    )  # fmt: skip


def assembled(
    problem: Problem, spectrum: Spectrum, certificate: Certificate, loss: float, *,
    used: dict[str, float], tolerance: float, solver: str, rounds: int,
) -> Design:  # fmt: skip
    """A Design of a spectrum and its certificate, both in the model's own units."""
    bound = certificate.bound
    # No spectrum is better than a bound: where rounding says so, the truth is taken to lie between the two.
    if loss < bound:
        certificate = replace(certificate, bound=loss, value=certificate.numerator / loss)
        bound, loss = loss, bound
    closed = abs(loss - bound) <= tolerance * bound and certificate.rounding <= tolerance
    return Design(
        spectrum=spectrum, criterion=problem.original, loss=loss, bound=bound, certificate=certificate,
        status=Status.OK if closed else Status.INACCURATE,
        information=problem.map.of_spectrum(spectrum), map=problem.map, power_used=used,
        limits={b.name: b.limit for b in problem.budgets}, solver=solver, rounds=rounds,
    )  # fmt: skip


def told_apart(problem: Problem, criterion: str | Criterion) -> tuple[Problem, Callable[[Design], Design]]:
    """The same problem in coordinates that tell its parameters apart, where double precision does not and they are known; and what
    makes a Design that is found there one of the model's own parameters."""
    information, wanted = problem.map, problem.original
    needed = problem.finely and information.coordinates and not np.any(information.constant)
    basis = information.coordinates(problem.omega) if needed and information.coordinates else None
    if basis is None:
        return problem, lambda design: design
    told = replace(information, factor=basis.factor, finer=None, coordinates=None, alike=True)
    other, factor = criterion_in(basis, criterion, wanted, told)

    def in_own_parameters(design: Design) -> Design:
        # What follows from the model has no combinations but those that the certificate's direction belongs to.
        V = basis.times(design.criterion.V, "T") if of_the_model(criterion) else wanted.V
        found = design.certificate
        certificate = replace(
            found,
            X=basis.times(found.X, "turned"),
            numerator=found.numerator * factor,
            bound=found.bound * factor,
        )
        return replace(
            design, criterion=replace(wanted, V=V), loss=design.loss * factor, bound=design.bound * factor,
            certificate=certificate, information=information.of_spectrum(design.spectrum), map=information,
        )  # fmt: skip

    return Problem(told, other, problem.budgets, problem.omega, problem.bands), in_own_parameters


def _without_trifles(found: Exchange) -> Exchange:
    """Without the lines of so little power that the loss does not tell; its loss is that of the lines that
    are left. Beside a resonance of radius .9999 a billionth of the power may be all that a parameter is known
    by."""
    if found.problem.original.family is not None:  # what the problem holds of it is a sample, and tells less
        keep = found.w > 0
        return replace(found, columns=found.columns.take(keep), w=found.w[keep])
    for threshold in TRIFLES:
        keep = found.w > threshold * found.w.sum()
        columns, w = found.columns.take(keep), found.w[keep]
        w = w / (columns.q.T @ w).max()
        loss = found.problem.loss(columns, w)
        if loss <= found.loss * (1 + UNTOLD):
            return replace(found, columns=columns, w=w, loss=loss)
    return found


def spectrum_of_lines(omega: NDArray, direction: NDArray, w: NDArray[np.float64]) -> Spectrum:
    """Lines of weights (m,), equal frequencies together: omega (m,), direction (m, nu)."""
    lines, where = np.unique(omega, return_inverse=True)
    power = np.zeros((len(lines), *direction.shape[1:] * 2), dtype=complex)
    np.add.at(power, where, w[:, None, None] * np.einsum("mq,mr->mqr", direction, direction.conj()))
    return Spectrum(lines, power)
