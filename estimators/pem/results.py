"""From the optimum to the result: covariance, noise, figures of merit, in the user's units."""

import numpy as np
from numpy.typing import NDArray

from estimators.pem.fit import Fit
from estimators.pem.predictors.of_structure import Structure
from estimators.pem.search.confirmation import Standing, over_ordered, standing
from estimators.pem.search.extras import robust_factor, unweighted
from estimators.pem.search.levenberg_marquardt import FLAT, SINGULAR, Optimum, Point
from estimators.pem.search.problem import Problem
from estimators.residual.measures import fit_percent
from oed.data import Record
from oed.errors import NotIdentifiable, Status
from oed.inspection import excitation_order
from oed.models.model import Model, Polynomial, StateSpace
from oed.models.structures import ORDERS


def result(
    problem: Problem, optimum: Optimum, records: list[Record], offset: bool, initial: str,
    robust: str | None = None, normals: NDArray | None = None, spread: NDArray | None = None,
) -> Fit:  # fmt: skip
    """A fit from the optimum that was found: normals (m, n + levels), spread (n + levels, n + levels)."""
    form, point, n = problem.structure, optimum.point, problem.structure.n
    ny, total = form.n_outputs, problem.n_observed
    n_states = problem.n_initial * len(records) if initial == "estimate" else 0
    free = np.ones(problem.n_parameters, bool)
    if problem.lower is not None and problem.upper is not None:
        free = problem.lower < problem.upper
        at_bound = (point.z <= problem.lower) | (point.z >= problem.upper)
    else:
        at_bound = np.zeros_like(free)
    estimated = int(free.sum()) + n_states
    moves = np.flatnonzero(free & ~at_bound)
    inner, status = _covariance(problem, point, optimum.status, moves, records)
    if normals is not None and len(normals):
        across = inner @ normals[:, moves].T
        inner = inner - across @ np.linalg.pinv(normals[:, moves] @ across) @ across.T
        estimated -= len(normals)
    kept = np.flatnonzero(free & ~at_bound)
    scaled = point.extra[1]
    freedom = total / max(total - estimated / ny, 1.0)
    noise = scaled * np.outer(problem.output_scale, problem.output_scale) * freedom
    if spread is None:
        spread = np.zeros((problem.n_parameters, problem.n_parameters))
        spread[kept[:, None], kept] = inner
        spread = spread * _level(problem, point, robust, freedom)
    spread = spread * np.outer(problem.scale, problem.scale)
    theta = point.z[:n] * problem.scale[:n]
    level, level_error = problem.output_level, np.zeros(ny)
    if offset:
        level = level + point.z[n:] * problem.scale[n:]
        level_error = np.sqrt(np.maximum(np.diag(spread)[n:], 0))
    model = Model(form, theta, noise, records[0].dt)
    residuals = unweighted(problem).residuals(point)
    if problem.variant == "missing":
        residuals = [np.where(np.isfinite(r.y), e, np.nan) for r, e in zip(records, residuals, strict=True)]
    names = np.array([*form.names, *[f"level{i + 1}" for i in range(ny)] * offset])
    notes = [f"{name} is at its bound; it has no standard error." for name in names[free & at_bound]]
    notes += [
        f"{name} is {value:.4g} with a standard error of {error:.4g}: its 95 % interval exceeds the estimate."
        for name, value, error in zip(
            form.names, theta, np.sqrt(np.maximum(np.diag(spread)[:n], 0)), strict=True
        )
        if 1.96 * error > abs(value) > 0
    ]
    notes = _too_high(problem, optimum) + notes
    if normals is not None and len(normals):
        notes.append(f"active constraints: {len(normals)}; the standard errors are those along them.")
    predicted = [r.y - e for r, e in zip(records, residuals, strict=True)]
    fit = fit_percent(np.concatenate([r.y for r in records]), np.concatenate(predicted))
    if status.ok and (form.kind == "ss" or "na" in ORDERS[form.kind]) and not model.stable:
        status = Status.UNSTABLE
    loss = float(np.linalg.det(noise / freedom))
    covariance = (spread[:n, :n] + spread[:n, :n].T) / 2
    return Fit(
        model, covariance, loss, total, estimated, fit, status, optimum.iterations, optimum.decrement,
        residuals, problem.input_level, level, level_error, initial, tuple(notes),
    )  # fmt: skip


def _too_high(problem: Problem, optimum: Optimum) -> list[str]:
    """Why a search came to no end, or was ended on the way, where its orders are the reason."""
    if optimum.status is not Status.MAX_ITERATIONS and not (optimum.status.ok and optimum.decrement > FLAT):
        return []
    form = problem.structure
    if isinstance(form, Polynomial) and form.n_outputs == 1:
        above = standing(problem, optimum) is Standing.OVER_ORDERED
    else:
        above = form.n_outputs > 1 and over_ordered(problem, optimum.point)
    cancel = (
        "a mode is reached neither by the inputs nor by the noise"
        if isinstance(form, StateSpace)
        else "roots of B and F, or of C and D, cancel"
    )
    return [
        f"the orders are too high: {cancel} as far as the data tell, so that the loss falls on and on by "
        "what fits noise. Nothing is left in the residual: lower orders serve."
    ] * above


def _level(problem: Problem, point: Point, robust: str | None, freedom: float) -> float:
    """What the inverse of the Gauss-Newton matrix is multiplied by."""
    scaled = point.extra[1]
    if robust:
        return robust_factor(problem, point, robust) * freedom
    if problem.variant == "missing":  # the loss is the likelihood's, concentrated over a common factor
        return point.loss / problem.n_values * freedom
    # the weight of several outputs is the inverse of their residuals' moment
    return (float(scaled[0, 0]) if len(scaled) == 1 else 1.0) * freedom


def _covariance(
    problem: Problem, point: Point, status: Status, moves: NDArray, records: list[Record]
) -> tuple[NDArray, Status]:
    """Inverse of the Gauss-Newton matrix, or the names of what it does not determine."""
    hessian = point.hessian[moves[:, None], moves]
    if not moves.size:
        return hessian, status
    diagonal = np.diag(hessian)
    size = np.sqrt(np.maximum(diagonal, max(1e-16 * diagonal.max(), np.finfo(float).tiny)))
    values, vectors = np.linalg.eigh(hessian / np.outer(size, size))
    if values[0] <= SINGULAR * max(values[-1], 1.0):
        names = [*problem.structure.names, *(f"level{i + 1}" for i in range(problem.structure.n_outputs))]
        null = vectors[:, values <= SINGULAR * values[-1]] / size[:, None]
        null = np.abs(null).max(axis=1)
        guilty = [names[moves[k]] for k in range(len(null)) if null[k] > 1e-2 * null.max()]
        raise NotIdentifiable(
            f"the data do not determine a combination of {', '.join(guilty)}: the information matrix is singular "
            "(its smallest eigenvalue over the largest is "
            f"{max(values[0], 0) / values[-1]:.1e}); {_excitation(records, needed(problem.structure))}."
        )
    inverse = (vectors / values) @ vectors.T / np.outer(size, size)
    return inverse, status


def needed(form: Structure) -> int:
    """The order of persistent excitation that tells the parameters of G apart, for the entry with the most."""
    if isinstance(form, StateSpace):
        return 2 * form.order + form.feedthrough
    return int((form.nb + form.nf + form.na[:, None])[form.nb > 0].max(initial=0))


def _excitation(records: list[Record], most: int) -> str:
    """How far the inputs excite, in words."""
    names, reached, enough = records[0].input_names, [], True
    for j, name in enumerate(names):
        order = excitation_order([r.u[:, j] for r in records], most)
        reached.append(f"{name} of order {order}" + (" at least" if order == most else ""))
        enough &= order == most
    remedy = (
        "check that inputs and outputs are not swapped, and the delay"
        if enough
        else "excite more frequencies"
    )
    return f"persistently exciting are {', '.join(reached)}, and this structure has use for order {most}; lower the orders or {remedy}"
