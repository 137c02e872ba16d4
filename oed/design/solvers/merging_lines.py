"""From clusters of neighbouring lines to one line each: merge, find the weights anew, polish, certify again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from oed.design.problem.lines import Columns, Problem
from oed.design.solvers.column_generation import Exchange, evaluated_bound, solve_weights
from oed.design.solvers.polishing import polish
from oed.errors import SolverFailure

__all__ = ["better", "collapsed", "evaluated"]


def better(one: Exchange, other: Exchange) -> Exchange:
    """The smaller loss and the larger bound of two outcomes."""
    weights = one if one.loss <= other.loss else other
    proof = one if one.bound >= other.bound else other
    return replace(
        weights,
        X=proof.X,
        nu=proof.nu,
        bound=proof.bound,
        price=proof.price,
        frequency=proof.frequency,
        rounds=max(one.rounds, other.rounds),
        problem=one.problem if len(one.problem.omega) >= len(other.problem.omega) else other.problem,
    )


def collapsed(found: Exchange, tolerance: float) -> Exchange:
    """One line per cluster, polished; what came in where that is worse by more than the tolerance."""
    problem = found.problem
    few = _merged(problem, found)
    if few is None:
        return found
    columns, w = few
    loss = problem.loss(columns, w)
    best = replace(found, columns=columns, w=w, loss=loss)
    polished = polish(problem, columns, w, found.X, found.nu) if best.gap > 1e-12 else None
    if polished is not None:
        best = better(evaluated(best, polished.columns, polished.w, polished.X, polished.nu), best)
    if best.loss <= max(found.loss, best.bound * (1 + tolerance)):
        return best
    return replace(found, X=best.X, nu=best.nu, bound=best.bound, price=best.price, frequency=best.frequency)


def evaluated(found: Exchange, columns: Columns, w: NDArray, X: NDArray, nu: NDArray) -> Exchange:
    """Loss and bound of a support and a certificate, from the beginning.

    Shapes: w (m,).
    """
    problem = found.problem
    bound, price, frequency = evaluated_bound(problem, X, nu)
    return replace(
        found,
        columns=columns,
        w=w,
        loss=problem.loss(columns, w),
        X=X,
        nu=nu * price,
        bound=bound,
        price=price,
        frequency=frequency,
    )


def _merged(problem: Problem, found: Exchange) -> tuple[Columns, NDArray[np.float64]] | None:
    """One line (and few directions) per peak of the price; every line goes to the peak nearest to it."""
    prices = problem.prices(found.X, found.nu)
    peaks, at_peaks = problem.refined_maxima(prices, found.X, found.nu, 0.9)
    high = at_peaks.ratio > 1 - 1e-3
    if not high.any():
        return None
    peaks, tops = peaks[high], at_peaks.direction[high]
    used = found.w > 1e-6 * found.w.max()
    near = np.argmin(np.abs(found.columns.omega[used][:, None] - peaks), axis=1)
    keep = np.unique(near)
    if problem.map.n_inputs == 1:
        columns = problem.columns(peaks[keep], tops[keep])
    else:
        columns = _directions(problem, found, peaks, near, used)
    try:
        w = _weights_at_support(problem, columns, found)
    except (np.linalg.LinAlgError, SolverFailure):
        return None
    if w is None:
        return None
    stay = w > 1e-7 * w.max()
    return columns.take(stay), w[stay] / (columns.q[stay].T @ w[stay]).max()


def _directions(problem: Problem, found: Exchange, peaks: NDArray, near: NDArray, used: NDArray) -> Columns:
    """Principal directions of the power that gathers at each peak."""
    v, w = found.columns.direction[used], found.w[used]
    omega, directions = [], []
    for k in np.unique(near):
        own = near == k
        P = np.einsum("m,mq,mr->qr", w[own], v[own], v[own].conj())
        values, vectors = np.linalg.eigh(P.real if peaks[k] < 1e-9 or peaks[k] > np.pi - 1e-9 else P)
        for value, vector in zip(values, vectors.T, strict=True):
            if value > 1e-4 * values[-1]:
                omega.append(peaks[k])
                directions.append(vector.astype(complex))
    return problem.columns(np.array(omega), np.array(directions))


def _weights_at_support(problem: Problem, columns: Columns, found: Exchange) -> NDArray[np.float64] | None:
    """Weights on the lines of the support alone."""
    criterion = problem.criterion
    if criterion.kind == "A" and criterion.columns.shape[1] < criterion.n:
        # The information may be singular there: M X = V holds at the optimum with the dual's own X.
        from scipy.optimize import nnls

        moved = np.einsum("mnr,mrs->nsm", columns.F, np.einsum("mnr,ns->mrs", columns.F, found.X))
        target = criterion.columns - problem.constant @ found.X
        w, _ = nnls(moved.reshape(-1, len(columns)), target.ravel())
    else:
        w = solve_weights(problem, columns, None).w
    most = float((columns.q.T @ w).max())
    return w / most if most > 0 else None
