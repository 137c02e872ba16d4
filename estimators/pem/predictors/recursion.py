"""A predictor in general, as one step in CasADi expressions: grey boxes and models with missing outputs."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False)
class Recursion:
    """A predictor as one step: (state, sample, parameters) -> (state, residual, sensitivities). `state,
    sample, parameters` symbols. The sample holds the inputs as delayed for each entry (all entries that are
    present, row by row), the outputs, and the pulse (1 at the first sample, else 0). The parameters are
    theta, one level per output (if asked), the initial state (if asked); `next_state, residual, jacobian`
    expressions; the residual is (ny, 1), the jacobian (ny, number of parameters); `log_variance,
    log_gradient` log of the variances by which the residuals have been divided, summed over outputs, and its
    (1, n) derivative; None where they are constant."""

    state: Any
    sample: Any
    parameters: Any
    next_state: Any
    residual: Any
    jacobian: Any
    log_variance: Any = None
    log_gradient: Any = None


def differentiated(
    state: Any, sample: Any, parameters: Any, next_state: Any, residual: Any, start: Any = None
) -> Recursion:
    """A predictor with its sensitivities, propagated forwards: S+ = f_x S + f_p, J = h_x S + h_p."""
    import casadi as ca

    nx, n = state.numel(), parameters.numel()
    S = ca.SX.sym("S", nx, n)
    x, at, slope = state, state, S
    if start is not None:
        pulse = sample[-1]
        at = state + pulse * start
        slope = S + pulse * ca.jacobian(start, parameters)
    f_x, f_p = ca.jacobian(next_state, x), ca.jacobian(next_state, parameters)
    h_x, h_p = ca.jacobian(residual, x), ca.jacobian(residual, parameters)
    function = ca.Function("parts", [x, sample, parameters], [next_state, residual, f_x, f_p, h_x, h_p])
    after, e, f_x, f_p, h_x, h_p = function(at, sample, parameters)
    return Recursion(
        state=ca.vertcat(x, ca.vec(S)),
        sample=sample,
        parameters=parameters,
        next_state=ca.vertcat(after, ca.vec(ca.densify(f_x @ slope + f_p))),
        residual=e,
        jacobian=h_x @ slope + h_p,
    )
