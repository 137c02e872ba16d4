"""Output error the plain CasADi way: one expression over the whole record, minimised by IPOPT.

It is what users write first, and the slow, obvious twin of the fast path; constraints of any kind go here."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import Record

QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}


def plain_output_error(
    record: Record,
    order: int,
    *,
    constraints: Callable[[Any], list[tuple[Any, float, float]]] | None = None,
    options: dict[str, Any] | None = None,
) -> Callable[[ArrayLike], tuple[NDArray[np.float64], float]]:
    """A solver for y = (B / F) u + e with nb = nf = order and nk = 1, from rest."""
    import casadi as ca

    theta = ca.SX.sym("theta", 2 * order)
    b, f = theta[:order], theta[order:]
    x, u = ca.SX.sym("x", order), ca.SX.sym("u")
    A = ca.vertcat(ca.horzcat(-f, ca.vertcat(ca.SX.eye(order - 1), ca.SX(1, order - 1))))
    step = ca.Function("step", [x, u, theta], [A @ x + b * u, x[0]])
    n = len(record)
    p = ca.MX.sym("p", 2 * order)
    _, y_hat = step.mapaccum("simulate", n)(np.zeros(order), record.u.T, ca.repmat(p, 1, n))
    loss = ca.sumsqr(record.y.T - y_hat) / n
    problem: dict[str, Any] = {"x": p, "f": loss}
    limits: dict[str, Any] = {}
    if constraints is not None:
        rows = constraints(theta)
        g = ca.Function("g", [theta], [ca.vertcat(*(row[0] for row in rows))])
        problem["g"] = g(p)
        limits = {"lbg": [row[1] for row in rows], "ubg": [row[2] for row in rows]}
    solver = ca.nlpsol("solver", "ipopt", problem, {**QUIET, **(options or {})})

    def solve(start: ArrayLike) -> tuple[NDArray[np.float64], float]:
        found = solver(x0=np.asarray(start, dtype=float), **limits)
        return np.array(found["x"]).ravel(), float(found["f"])

    return solve
