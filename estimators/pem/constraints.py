"""Constraints that the user gives as CasADi expressions of the parameters: each step is solved by IPOPT.

At every point the loss is replaced by its Gauss-Newton model, which IPOPT minimises over the step under the
constraints as they are, not linearised (sequential quadratic programming with exact constraints): so every point from
the second on obeys them, and where the steps end the Karush-Kuhn-Tucker conditions of the loss itself hold."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.pem.search.extras import Settings
from estimators.pem.search.levenberg_marquardt import Optimum
from estimators.pem.search.problem import Problem
from oed.errors import InputError, SolverFailure, Status

Constraints = Callable[[Mapping[str, Any]], Any]
"""{name: casadi.SX} in the user's units -> one expression, or a list of them, that must not be positive."""

SLACK = 1e-8
"""A constraint is active where it lies within this of zero."""


def constrained(
    problem: Problem, optimum: Optimum, constraints: Constraints, how: Settings
) -> tuple[Optimum, NDArray[np.float64]]:
    """The optimum under constraints, from the one without them: returns (m, n + levels)."""
    import casadi as ca

    n, width, names = problem.structure.n, problem.n_parameters, problem.structure.names
    z0, d = ca.SX.sym("z", width), ca.SX.sym("d", width)
    by_name = {name: (z0 + d)[k] * float(problem.scale[k]) for k, name in enumerate(names[:n])}
    try:
        given = constraints(by_name)
        g = ca.vertcat(*[ca.SX(x) for x in (given if isinstance(given, list | tuple) else [given])])
        inside = ca.Function("g", [z0, d], [g, ca.jacobian(g, d)])
    except KeyError as error:
        raise InputError(
            f"there is no parameter {error}; the constraints may use {', '.join(names)}."
        ) from None
    except (TypeError, RuntimeError) as error:
        raise InputError(
            f"the constraints do not give CasADi expressions ({str(error).splitlines()[0]}); return one, or a list of "
            "them, that must not be positive."
        ) from None
    gradient, hessian = ca.SX.sym("gradient", width), ca.SX.sym("hessian", width, width)
    cost = ca.dot(gradient, d) + ca.dot(d, hessian @ d) / 2
    model = {"x": d, "f": cost, "g": g, "p": ca.vertcat(z0, gradient, ca.vec(hessian))}
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": 1e-11}
    solver = ca.nlpsol("step", "ipopt", model, quiet | {"ipopt.acceptable_tol": 1e-11})
    lower = np.full(width, -np.inf) if problem.lower is None else problem.lower
    upper = np.full(width, np.inf) if problem.upper is None else problem.upper
    obeyed = lambda z: bool(np.all(np.array(inside(z, 0)[0]) <= SLACK))
    point, damping, feasible, count = optimum.point, 0.0, obeyed(optimum.point.z), 0
    if feasible:
        return optimum, np.zeros((0, width))
    status = Status.MAX_ITERATIONS
    for _ in range(max(how.max_iterations, 20)):
        count += 1
        size = float(point.loss)
        curved = point.hessian + damping * np.diag(np.diag(point.hessian))
        parts = np.concatenate([point.z, point.gradient / size, (curved / size).ravel(order="F")])
        found = solver(x0=0, p=parts, lbx=lower - point.z, ubx=upper - point.z, ubg=0, lbg=-np.inf)
        step = np.array(found["x"]).ravel()
        if not solver.stats()["success"] and not obeyed(point.z + step):
            raise InputError(
                f"IPOPT finds no parameters that obey the constraints ({solver.stats()['return_status']}); loosen "
                "them, or lower the orders."
            )
        trial = problem.evaluate(point.z + step, point.follow(step))
        if trial is None or (feasible and trial.loss > point.loss * (1 + 1e-14)):
            damping = max(10 * damping, 1e-3)
            if damping > 1e10:
                break
            continue
        moved = float(step @ point.hessian @ step) / size
        fell = point.loss - trial.loss
        was, feasible, point = feasible, True, trial
        damping = damping / 10 if damping > 1e-6 else 0.0
        if was and (moved < 1e-14 or (damping == 0 and 0 <= fell < 1e-14 * size)):
            status = Status.CONVERGED
            break
    if not feasible:
        raise SolverFailure("the predictor is unstable at all parameters tried that obey the constraints.")
    value, slope = (np.array(v) for v in inside(point.z, 0))
    active = np.atleast_2d(slope)[value.ravel() > -1e-6 * (1 + np.abs(value).max())]
    return Optimum(point, status, optimum.iterations + count, 0.0), active
