"""From clusters of neighbouring lines to one line each: merge, find the weights anew, polish, certify again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from oed.design.problem.lines import Columns, Problem
from oed.design.solvers.column_generation import Exchange, better, evaluated_bound, solve_weights
from oed.design.solvers.polishing import Polished, polish
from oed.errors import SolverFailure

LOW = 0.9
"""Maxima of the price below this share of a line's cost have no line of the support beside them."""
CLOSE = 0.5
"""Lines nearer than this, in units of the distance over which the plant changes, are one line."""
SPENT = 1e-4
"""Share of the largest power below which a line is what an interior point leaves everywhere."""
BALANCINGS = 3
"""Corrections of the weights; the first gains most."""
ENOUGH = 1e-10
"""Accuracy of the weights that Newton's method starts from."""
SPARE = 6.0
"""Standard deviations of a price by rounding: the most of the hundreds that are looked at."""
ALIKE = 1e-6
"""Ratio of the singular values of the prices' slopes below which two lines are one."""
UNSETTLED = 1e-4
"""Ratio of a part of the certificate to its slack: at accuracy 1e-8 what belongs to the optimum has 1e-2 and more, the
rest 1e-9 and less."""


def collapsed(found: Exchange, tolerance: float) -> Exchange:
    """One line per cluster, polished; what came in where that is worse by more than the tolerance."""
    best = replace(found, hints=None)
    for gathered in (_at_peaks, at_clusters):
        best = _polished(best, gathered, tolerance)
        if best.gap <= tolerance:
            return best
    return _balanced(best, tolerance) if best.hints is not None else best


def _balanced(found: Exchange, tolerance: float) -> Exchange:
    """The weights moved, each by a small share of itself, until M X is what the certificate's X says it must
    be. Where the price is flat there are many optimal spectra, of many lines, and an interior point stops at
    rounding; the certificate that Newton's method found is better than its weights."""
    problem, X = found.problem, found.X
    if problem.criterion.smooth or found.pair is None:
        return found
    columns, w = found.columns, found.w
    rise, _ = problem.criterion.log_numerator(X, False)
    moved = np.einsum("mnr,mrs->mns", columns.F, np.einsum("mnr,ns->mrs", columns.F, X)).reshape(len(w), -1)
    for _ in range(BALANCINGS):
        M = problem.constant + columns.information(w)
        size = 0.5 * float(np.sum(X * (M @ X)))
        left = np.concatenate([(moved * w[:, None]).T, -size * rise.reshape(-1, 1)], axis=1)
        share = np.linalg.lstsq(left, (size * rise - M @ X).ravel(), rcond=1e-12)[0][:-1]
        w = w * np.clip(1 + share, 0.5, 2.0)
        w = w / (columns.q.T @ w).max()
        best = replace(found, w=w, loss=problem.loss(columns, w))
        found = best if best.loss < found.loss else found
        if found.gap <= tolerance:
            break
    return found


def _polished(found: Exchange, gathered: Callable, tolerance: float) -> Exchange:
    problem = found.problem
    few = _merged(found, gathered)
    if few is None:
        return found
    columns, w, X, nu = few
    best = replace(found, columns=columns, w=w, loss=problem.loss(columns, w))
    polished = polish(problem, columns, w, X, nu) if best.gap > 1e-12 else None
    if polished is not None:
        for certificate in (polished.X, _given_way(problem, polished)):
            best = better(evaluated(best, polished.columns, polished.w, certificate, polished.nu), best)
        told = polished.columns
        best = replace(best, hints=told if found.hints is None else found.hints + told)
    best = replace(best, pair=found.pair)
    # A loss below the bound is of lines that do not tell all of what is asked.
    if best.bound * (1 - tolerance) <= best.loss <= max(found.loss, best.bound * (1 + tolerance)):
        return best
    return replace(best, columns=found.columns, w=found.w, loss=found.loss)


def _given_way(problem: Problem, polished: Polished) -> NDArray[np.float64]:
    """X moved as little as lowers the price of each line by what rounding may raise it: the bound pays for a line's share of the
    cost only, where without it the most uncertain line, of the least power, decides."""
    columns, X, nu = polished.columns, polished.X, polished.nu
    worth = np.einsum("mnr,mrs->mns", columns.F, np.einsum("mnr,ns->mrs", columns.F, X))
    price, unsure = problem.uncertain_prices(columns, X, nu)
    above = (columns.q @ nu) * (price - np.average(price, weights=polished.w) + SPARE * unsure)
    return X - np.linalg.lstsq(2 * worth.reshape(len(above), -1), above, rcond=ALIKE)[0].reshape(X.shape)


def evaluated(found: Exchange, columns: Columns, w: NDArray, X: NDArray, nu: NDArray) -> Exchange:
    """Loss and bound of a support and a certificate, from the beginning: w (m,)."""
    problem = found.problem
    bound, price, frequency = evaluated_bound(problem, X, nu)
    return replace(
        found, columns=columns, w=w, loss=problem.loss(columns, w), X=X, nu=nu * price, bound=bound, price=price,
        frequency=frequency,
    )  # fmt: skip


def _merged(
    found: Exchange, gathered: Callable
) -> tuple[Columns, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None:
    """One line (and few directions) per cluster, their weights and the certificate."""
    problem = found.problem
    lines, weights, X, nu = found.pair or (found.columns, found.w, found.X, found.nu)
    used = weights > 1e-6 * weights.max()
    columns = gathered(problem, lines.take(used), weights[used], X, nu)
    if columns is None:
        return None
    X = _of_rank(problem, X, lines, weights)
    try:
        w = _weights_at_support(problem, columns, X)
    except (np.linalg.LinAlgError, SolverFailure):
        return None
    most = float((columns.q.T @ w).max())
    if not most > 0:
        return None
    stay = w > 1e-7 * w.max()
    return columns.take(stay), w[stay] / most, X, nu


def _at_peaks(problem: Problem, lines: Columns, w: NDArray, X: NDArray, nu: NDArray) -> Columns | None:
    """Every line goes to the peak of the price nearest to it, with the principal directions of the power there."""
    peaks, at_peaks = problem.refined_maxima(problem.prices(X, nu), X, nu, LOW)
    if not len(peaks):
        return None
    near = np.argmin(np.abs(lines.omega[:, None] - peaks), axis=1)
    if problem.map.n_inputs == 1:
        keep = np.unique(near)
        return problem.columns(peaks[keep], at_peaks.direction[keep])
    omega, directions = [], []
    for k in np.unique(near):
        v = lines.direction[near == k]
        P = np.einsum("m,mq,mr->qr", w[near == k], v, v.conj())
        values, vectors = np.linalg.eigh(P.real if peaks[k] < 1e-9 or peaks[k] > np.pi - 1e-9 else P)
        for value, vector in zip(values, vectors.T, strict=True):
            if value > 1e-4 * values[-1]:
                omega.append(peaks[k])
                directions.append(vector.astype(complex))
    return problem.columns(np.array(omega), np.array(directions))


def at_clusters(problem: Problem, lines: Columns, w: NDArray, *_: NDArray, spent: float = SPENT) -> Columns:
    """Neighbours of like direction at their centre of power: where the price is flat its peaks say nothing."""
    from scipy.sparse.csgraph import connected_components

    heavy = w > spent * w.max()
    lines, w = lines.take(heavy), w[heavy]
    close = np.abs(lines.omega[:, None] - lines.omega) < CLOSE * problem.length_scale(lines.omega)
    alike = np.abs(lines.direction.conj() @ lines.direction.T) ** 2 > 0.5
    count, label = connected_components(close & alike, directed=False)
    omega, directions = np.empty(count), np.empty((count, lines.direction.shape[1]), dtype=complex)
    for k in range(count):
        own, v = label == k, lines.direction[label == k]
        omega[k] = w[own] @ lines.omega[own] / w[own].sum()
        directions[k] = np.linalg.eigh(np.einsum("m,mq,mr->qr", w[own], v, v.conj()))[1][:, -1]
    return problem.columns(omega, directions)


def _of_rank(problem: Problem, X: NDArray, lines: Columns, w: NDArray) -> NDArray[np.float64]:
    """E: X without what an interior point leaves in it beside the multiplicity of the eigenvalue: its parts that
    are far smaller than their slack v'(M - t V V')v, both in units of t. Not the parts that are small: a millionth
    of the price can be what makes a parameter known at all."""
    criterion = problem.criterion
    if criterion.method != "eigenvalue":
        return X
    M = problem.constant + lines.information(w)
    values, vectors = np.linalg.eigh(X.T @ criterion.V @ criterion.V.T @ X)
    X = X @ vectors
    slack = criterion.loss(M) * np.sum(X * (M @ X), axis=0) / np.maximum(values, 1e-300) - 1
    return X[:, values > UNSETTLED * slack * values.sum()]


def _weights_at_support(problem: Problem, columns: Columns, X: NDArray) -> NDArray[np.float64]:
    """Weights on the lines of the support alone."""
    criterion = problem.criterion
    if criterion.smooth:
        return solve_weights(problem, columns, None, ENOUGH).w
    # The information may be singular there, or the loss have a kink: at the optimum M X is what the numerator's slope says.
    from scipy.optimize import nnls

    rise, _ = criterion.log_numerator(X, False)
    moved = np.einsum("mnr,mrs->nsm", columns.F, np.einsum("mnr,ns->mrs", columns.F, X))
    fixed = problem.constant @ X
    # X as a whole has no length: the slope is scaled so that the parts along X agree.
    used = float((columns.q.T @ np.ones(len(columns))).max())
    size = np.sum(X * moved.sum(axis=2)) / used + np.sum(X * fixed)
    return nnls(moved.reshape(-1, len(columns)), (0.5 * size * rise - fixed).ravel())[0]
