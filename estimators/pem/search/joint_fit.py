"""All outputs fitted together, weighted by the inverse of their residual covariance."""

import numpy as np
from numpy.typing import NDArray

from estimators.pem.search.extras import Settings
from estimators.pem.search.levenberg_marquardt import FLAT, NEGLIGIBLE, Optimum, determined
from estimators.pem.search.problem import Problem
from oed.errors import InputError, Status

ROUNDS = 4
"""Rounds of new weights over which the determinant has to fall, as the loss has to in a search of one output."""


def fit_together(problem: Problem, z: NDArray, iterations: int, how: Settings) -> tuple[Problem, Optimum]:
    """All outputs together, weighted by the inverse of their residual covariance until that settles."""
    ny = problem.structure.n_outputs
    point = problem.evaluate(z)
    if point is None:
        raise InputError("the loss is not finite at the single outputs' optima; this should not happen.")
    optimum = Optimum(point, Status.MAX_ITERATIONS, iterations, np.inf)
    sizes: list[float] = []
    for _ in range(max(how.max_iterations, 1)):
        covariance = point.extra[1]
        sizes.append(float(np.linalg.slogdet(covariance)[1]))
        if len(sizes) > ROUNDS and sizes[-1] > sizes[-1 - ROUNDS] - NEGLIGIBLE:
            status = Status.CONVERGED if optimum.decrement < FLAT else Status.INACCURATE
            optimum = Optimum(point, status, iterations, optimum.decrement)
            break
        floor = 1e-12 * np.trace(covariance) / ny * np.eye(ny)
        problem = problem.replace(weight=np.linalg.inv(covariance + floor))
        before = problem.evaluate(point.z, point.extra[0])
        if before is None:
            break
        further = problem.descend(before, max_iterations=4, tolerance=how.tolerance)
        if determined(before.hessian) and not determined(further.point.hessian):
            break  # into a valley of orders too high, where nothing determines the parameters
        optimum = further
        iterations += optimum.iterations
        moved = optimum.point.z - before.z
        point = optimum.point
        if optimum.status is Status.CONVERGED and float(moved @ point.hessian @ moved) < 1e-10:
            break
    return problem, Optimum(point, optimum.status, iterations, optimum.decrement)
