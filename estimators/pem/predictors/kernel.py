"""What runs a predictor over records, and the general one: any recursion that is given as CasADi expressions.

CasADi evaluates the step of the recursion, mapped over blocks of 500 samples, so that memory and the time to build do
not depend on the record's length and rounding errors do not grow with it. Nothing is compiled for a model of its own;
the structures that are met daily have loops that are compiled once for all of them (`compiled`)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.pem.predictors.recursion import Recursion

_BLOCK = 500


@dataclass(frozen=True, eq=False)
class Sums:
    """What a pass over the records leaves behind, one row per record. `loss` (R,) sum e' W e; `gradient` (R,
    n) sum J' W e, half the gradient of the loss; `hessian` (R, n, n) sum J' W J; `covariance` (R, ny, ny) sum
    e e'; `log_variance` (R, 1 + n) sum of the log variances and its gradient; None where they are constant."""

    loss: NDArray[np.float64]
    gradient: NDArray[np.float64]
    hessian: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_variance: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Kernel:
    """A predictor ready to run. `sums` (data (N, nd) of all records, lengths (R,), parameters (R, n), weight
    (ny, ny)) -> Sums; `trace` (data of one record, parameters, with_jacobian) -> residuals (N, ny), jacobian
    (N, ny, n) or None; `n` number of parameters."""

    sums: Callable[[NDArray, NDArray, NDArray, NDArray], Sums]
    trace: Callable[[NDArray, NDArray, bool], tuple[NDArray, NDArray | None]]
    n: int


def summed(trace: Callable[[NDArray, NDArray], tuple[NDArray, ...]]) -> Callable[..., Sums]:
    """Sums of what a trace gives: residuals, sensitivities, and log variances with their gradients if there are any; by loops
    of NumPy's own, which wake no threads."""

    def run(data: NDArray, lengths: NDArray, parameters: NDArray, weight: NDArray) -> Sums:
        rows, ends = [], np.cumsum(lengths)
        for start, end, p in zip(ends - lengths, ends, parameters, strict=True):
            e, J, *more = trace(data[start:end], p)
            heavy, heavy_e = np.einsum("ij,tjk->tik", weight, J), e @ weight
            slope, hessian = np.einsum("tik,ti->k", heavy, e), np.einsum("tik,tim->km", heavy, J)
            found = np.sum(e * heavy_e), slope, hessian, np.einsum("ti,tj->ij", e, e)
            rows.append((*found, *(part.sum(axis=0) for part in more)))
        return Sums(*(np.array(part) for part in zip(*rows, strict=True)))

    return run


def kernel_of(recursion: Recursion) -> Kernel:
    """Make a recursion ready to run, by CasADi's virtual machine."""
    import casadi as ca

    r, n, ny = recursion, recursion.parameters.numel(), recursion.residual.numel()
    outputs = [ca.densify(r.next_state), ca.vertcat(r.residual, ca.vec(ca.densify(r.jacobian.T)))]
    if r.log_variance is not None:
        outputs[1] = ca.densify(ca.vertcat(outputs[1], r.log_variance, r.log_gradient.T))
    step = ca.Function("trace", [r.state, r.sample, r.parameters], outputs, {"cse": True})
    blocks = {k: step.mapaccum(f"trace{k}", k) if k > 1 else step for k in (1, 20, _BLOCK)}

    def split(data: NDArray, parameters: NDArray) -> tuple[NDArray, ...]:
        state, at, rows = np.zeros(r.state.numel()), 0, []
        while at < len(data):
            length = max(k for k in blocks if k <= len(data) - at)
            states, part = blocks[length](
                state, data[at : at + length].T, np.repeat(parameters[:, None], length, axis=1)
            )
            state = np.array(states)[:, -1] if states.numel() else state
            rows.append(np.array(part).T)
            at += length
        flat = np.concatenate(rows)
        found = flat[:, :ny], flat[:, ny : ny + ny * n].reshape(-1, ny, n)
        return found if r.log_variance is None else (*found, flat[:, ny + ny * n :])

    def trace(data: NDArray, parameters: NDArray, with_jacobian: bool) -> tuple[NDArray, NDArray | None]:
        e, jacobian, *_ = split(data, parameters)
        return np.ascontiguousarray(e), jacobian if with_jacobian else None

    return Kernel(summed(split), trace, n)
