"""All outputs fitted together: the determinant of their residuals' second moment, the Gaussian likelihood, as one sum of squares.

With M the moment of the residuals, N ny det(M)^(1/ny) is the sum of e' W e for the weight W = M^-1 det(M)^(1/ny), and its gradient is
that of this sum with W held. So the search of one output finds its optimum too, with one damping and one secant correction all the
way; weights that are held for a few steps and then found anew forget both at every change."""

import numpy as np
from numpy.typing import NDArray

from estimators.pem.search.confirmation import over_ordered
from estimators.pem.search.extras import Settings
from estimators.pem.search.levenberg_marquardt import Optimum, Point
from estimators.pem.search.problem import Evaluation, Problem, determining
from oed.errors import InputError

UNTOLD = 0.25
"""Fall of -2 log likelihood over some steps that no data tell: half a standard error, all parameters together."""
FLOOR = 1e-12
"""Of the moment's mean eigenvalue, added to it: outputs without noise have a moment that is singular."""


def determinant(problem: Problem) -> Evaluation:
    """The determinant as the loss of a problem: the weight follows the residuals' moment."""

    def evaluate(z: NDArray, initial: NDArray | None) -> Point | None:
        moment = problem.moment(z, initial)
        if moment is None:
            return None
        inverse, size = _inverse(moment)
        return problem.replace(weight=inverse * size).evaluate(z, initial)

    return evaluate


def _inverse(moment: NDArray) -> tuple[NDArray, float]:
    """The inverse of a moment and the geometric mean of its eigenvalues."""
    ny = len(moment)
    moment = moment + FLOOR * np.trace(moment) / ny * np.eye(ny)
    return np.linalg.inv(moment), float(np.exp(np.linalg.slogdet(moment)[1] / ny))


def fit_together(problem: Problem, z: NDArray, iterations: int, how: Settings) -> tuple[Problem, Optimum]:
    """All outputs together, from where each alone has its optimum."""
    start = problem.evaluate(z)
    if start is None:
        raise InputError("the loss is not finite at the single outputs' optima; this should not happen.")
    evaluate = determinant(problem)
    point = evaluate(z, start.extra[0])
    if point is None:
        raise InputError(
            "the residuals are not finite at the single outputs' optima; this should not happen."
        )
    told = problem.n_samples * problem.structure.n_outputs

    def enough(at: Point, fallen: float) -> bool:
        return fallen * told < UNTOLD and over_ordered(problem, at)

    found = problem.descend(
        point, max_iterations=how.max_iterations, tolerance=how.tolerance, enough=enough,
        evaluate=determining(evaluate, point),
    )  # fmt: skip
    problem = problem.replace(weight=_inverse(found.point.extra[1])[0])
    end = problem.evaluate(found.point.z, found.point.extra[0]) or found.point
    return problem, Optimum(end, found.status, iterations + found.iterations, found.decrement)
