"""Column generation: optimal weights on a few lines, prices over all frequencies, new lines where the price is high.

The loop that every discrete design runs through, whatever its criterion. It ends when the certificate's bound,
which counts frequencies between the grid lines too, meets the loss."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from oed.criteria.worst import WorstTrace
from oed.design.problem.families import local_maxima
from oed.design.problem.lines import Columns, Prices, Problem
from oed.design.solvers.weights_clarabel import largest_eigenvalue
from oed.design.solvers.weights_da import Weights, interior_point
from oed.design.solvers.weights_e import eigenvalue_weights
from oed.design.solvers.weights_gw import minimax_weights
from oed.errors import InputError, SolverFailure, Status

RIDGE = 1e-5
KEEP = 0.5
MANY = 200
PATIENCE = 6
MOST_NEW = 40
CONIC = 40_000
KINKED = 1e-8
"""Accuracy for E from the first round on: the rank of its X must show, and a looser X moves at random."""
NEARLY = 3e-2
"""Gap below which the support shows well enough to try Newton's method on it."""
AGAIN = 0.8
"""Share of the gap of the last trial at which the next is worth its time."""
Master = Callable[[Problem, Columns, NDArray[np.float64] | None, float], Weights]

Pair = tuple[Columns, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Exchange:
    """Outcome of the loop, in the scaled coordinates of the problem. `columns` the lines; `w` (m,) their
    weights, within the budgets; `loss` scaled loss of these weights; `X, nu` the certificate of the best
    bound, with the prices divided out: no price exceeds 1; `bound` scaled bound; `price` largest price in the
    last round before it was divided out; `frequency` where that was; `rounds` number of rounds; `status`
    CONVERGED, or why not; `problem` the problem on the grid as it has grown; `pair` lines, weights and
    certificate of one round: each shows which of the other's parts are spent; `hints` lines that Newton's
    method ended with, whatever they are worth by themselves."""

    columns: Columns
    w: NDArray[np.float64]
    loss: float
    X: NDArray[np.float64]
    nu: NDArray[np.float64]
    bound: float
    price: float
    frequency: float
    rounds: int
    status: Status
    problem: Problem
    pair: Pair | None = None
    hints: Columns | None = None

    @property
    def gap(self) -> float:
        """(loss - bound) / bound."""
        return (self.loss - self.bound) / self.bound


def solve_weights(
    problem: Problem,
    columns: Columns,
    start: NDArray[np.float64] | None,
    accuracy: float = 1e-13,
    ridge: float = RIDGE,
) -> Weights:
    """Optimal weights of some columns, by the method that suits the criterion: start (m,)."""
    criterion, constant = problem.criterion, problem.constant
    if criterion.method == "eigenvalue":
        return _eigenvalue(problem, columns, start, min(max(accuracy, 1e-12), KINKED))
    if criterion.method == "minimax":
        return minimax_weights(columns, criterion, constant, start=start, tolerance=max(accuracy, 1e-11))
    if not criterion.whole:
        constant = constant + ridge * np.eye(criterion.n)
    return interior_point(columns, criterion, constant, start=start, tolerance=accuracy)


def _eigenvalue(
    problem: Problem, columns: Columns, start: NDArray[np.float64] | None, accuracy: float
) -> Weights:
    """E by our interior-point method; where that stalls on few columns, by Clarabel if its gap is smaller."""
    criterion, constant = problem.criterion, problem.constant
    own = eigenvalue_weights(columns, criterion, constant, tolerance=accuracy)
    if own.status.ok or len(columns) * criterion.n**2 > CONIC:
        return own
    try:
        other = largest_eigenvalue(columns, criterion, constant)
    except SolverFailure:
        return own
    return min((own, other), key=lambda weights: _gap_within(problem, columns, weights))


def _gap_within(problem: Problem, columns: Columns, weights: Weights) -> float:
    """Relative gap if there were no other columns than these."""
    used = float((columns.q.T @ weights.w).max())
    bound = lower_bound(problem, weights.X, weights.nu, float(columns.prices(weights.X, weights.nu).max()))
    if not (used > 0 and bound > 0):
        return np.inf
    return problem.loss(columns, weights.w / used) / bound - 1


def exchange(
    problem: Problem, *, master: Master | None = None, columns: Columns | None = None, refine: bool = True,
    tolerance: float = 1e-9, max_rounds: int = 40, accuracy: float = 1e-4,
    finish: Callable[[Exchange], Exchange] | None = None,
) -> Exchange:  # fmt: skip
    """Run the loop; `finish` makes the last digits of an outcome that is nearly right, and is tried on the way."""
    master = master or solve_weights
    columns = seed_columns(problem) if columns is None else columns
    criterion, start = problem.criterion, None
    best, reference, own_reference, stalled, tried = None, np.inf, np.inf, 0, NEARLY
    status, rounds = Status.MAX_ITERATIONS, 0
    # A singular optimum leaves X free in many directions: what holds it there must not be dropped.
    free = criterion.method != "smooth" or not criterion.whole
    keep_above = KEEP if free and not isinstance(criterion, WorstTrace) else 0.99
    # Multipliers well inside their set move little from round to round; at a vertex of it they jump.
    centred = 0.1 if free else 1e-3
    while rounds < max(max_rounds, 1):
        rounds += 1
        weights = master(problem, columns, start, accuracy)
        used = float((columns.q.T @ weights.w).max())
        w = weights.w / used if used > 0 else weights.w
        prices = problem.prices(weights.X, weights.nu)
        omega, peaks = _maxima(problem, prices, weights, refine)
        price = float(peaks.ratio.max())
        here = Exchange(
            columns, w, problem.loss(columns, w), weights.X, weights.nu,
            lower_bound(problem, weights.X, weights.nu, price), price, float(omega[np.argmax(peaks.ratio)]), rounds,
            status, problem, (columns, w, weights.X, weights.nu),
        )  # fmt: skip
        best = here if best is None else better(best, here)
        hints = None
        if finish is not None and tolerance < best.gap < tried:
            best = finish(best)
            tried, hints = AGAIN * best.gap, best.hints
        # Where Newton's method has found a bound that the weights' own multipliers are still on the way to, they may pass it.
        gained = best.gap < 0.8 * reference or here.gap < 0.8 * own_reference
        stalled = 0 if gained else stalled + 1
        reference, own_reference = (
            (min(reference, best.gap), min(own_reference, here.gap)) if gained else (reference, own_reference)
        )
        if best.gap <= tolerance or stalled >= PATIENCE:
            # Bounds of early rounds may have missed a maximum that the grid did not show then.
            bound, price, frequency = evaluated_bound(problem, best.X, best.nu, refine=refine)
            best = replace(best, bound=bound, price=price, frequency=frequency)
            if best.gap <= tolerance or stalled >= PATIENCE:
                status = Status.CONVERGED if best.gap <= tolerance else Status.INACCURATE
                break
            best = better(best, here)
        accuracy = min(accuracy, max(centred * best.gap, 1e-2 * tolerance, 1e-13))
        own = columns.prices(weights.X, weights.nu)
        stay = (w > 1e-7 * w.max()) | (own > (keep_above if len(w) < MANY else 0.9))
        new = peaks.ratio > max(1 + 0.02 * tolerance, _level_of(peaks.ratio, MOST_NEW))
        if refine and new.any():
            problem = problem.extended(_around(problem, omega[new]))
        columns, w = columns.take(stay), w[stay]
        fresh = problem.columns(omega[new], peaks.direction[new])
        columns, start = _with_new(columns, w, fresh if hints is None else fresh + hints)
    if best is None:  # not reached: the first round sets it
        raise InputError("the design was given no columns to begin with.")
    bound, price, frequency = evaluated_bound(problem, best.X, best.nu, refine=refine)
    return replace(
        best, nu=best.nu * price, bound=bound, price=price, frequency=frequency, rounds=rounds, status=status,
        problem=problem,
    )  # fmt: skip


def better(one: Exchange, other: Exchange) -> Exchange:
    """The larger bound of two outcomes and the loss that is nearest to it: one below it is rounding."""
    proof = one if one.bound >= other.bound else other
    weights = min(one, other, key=lambda found: abs(found.loss - proof.bound))
    return replace(
        weights, X=proof.X, nu=proof.nu, bound=proof.bound, price=proof.price, frequency=proof.frequency,
        rounds=max(one.rounds, other.rounds),
        problem=one.problem if len(one.problem.omega) >= len(other.problem.omega) else other.problem,
        pair=other.pair,
    )  # fmt: skip


def _level_of(values: NDArray[np.float64], count: int) -> float:
    """What only the largest few of some values exceed."""
    return float(np.sort(values)[-count - 1]) if len(values) > count else -np.inf


def lower_bound(problem: Problem, X: NDArray[np.float64], nu: NDArray[np.float64], price: float) -> float:
    """Bound on the scaled loss from a certificate and its largest price."""
    fixed = float(np.sum(X * (problem.constant @ X)))
    return problem.criterion.numerator(X) / (fixed + price * float(nu.sum()))


def evaluated_bound(
    problem: Problem, X: NDArray[np.float64], nu: NDArray[np.float64], *, refine: bool = True
) -> tuple[float, float, float]:
    """Bound of a certificate from the beginning: its largest price over the grid and between the lines."""
    prices = problem.prices(X, nu)
    top = int(np.argmax(prices.ratio))
    price, frequency = float(prices.ratio[top]), float(problem.omega[top])
    if refine:
        omega, peaks = problem.refined_maxima(prices, X, nu, 0.98 * price)
        best = int(np.argmax(peaks.ratio))
        if peaks.ratio[best] > price:
            price, frequency = float(peaks.ratio[best]), float(omega[best])
    return lower_bound(problem, X, nu, price), price, frequency


def _around(problem: Problem, omega: NDArray[np.float64]) -> NDArray[np.float64]:
    """New lines and points between them and the grid's, so that a second maximum beside one is seen."""
    at = np.clip(np.searchsorted(problem.omega, omega), 1, len(problem.omega) - 1)
    low, high = problem.omega[at - 1], problem.omega[at]
    points = np.concatenate([omega, *((1 - f) * omega + f * end for f in (0.1, 0.5) for end in (low, high))])
    inside = np.zeros(len(points), dtype=bool)
    for a, b in problem.bands:
        inside |= (points >= a) & (points <= b)
    return points[inside]


def _maxima(
    problem: Problem, prices: Prices, weights: Weights, refine: bool
) -> tuple[NDArray[np.float64], Prices]:
    """The candidates of this round: local maxima of the price, between grid lines if wanted."""
    level = 1.0 - 0.3 * max(0.0, min(1.0, float(prices.ratio.max()) - 1 + 0.1))
    if refine:
        # To 1e-4 of the grid's distance: the price is off by its square; what decides is evaluated anew at the end.
        omega, peaks = problem.refined_maxima(prices, weights.X, weights.nu, level, divisions=7)
        if len(omega) and peaks.ratio.max() >= prices.ratio.max() * (1 - 1e-12):
            return omega, peaks
    at = local_maxima(prices.ratio)
    at = at[prices.ratio[at] >= min(level, prices.ratio.max())]
    # The neighbours too: the next round's maximum is likely one of them.
    at = np.unique(np.clip(np.concatenate([at - 1, at, at + 1]), 0, len(problem.omega) - 1))
    return problem.omega[at], Prices(prices.ratio[at], prices.direction[at])


def _with_new(columns: Columns, w: NDArray, new: Columns) -> tuple[Columns, NDArray[np.float64]]:
    if not len(new):
        return columns, w
    return columns + new, np.concatenate([w, np.full(len(new), 0.1 * w.sum() / (len(w) + len(new)))])


def seed_columns(problem: Problem) -> Columns:
    """Lines to begin with: quantiles of the information of white noise, every channel by itself."""
    n, _, K, _, q = problem.grid.shape
    leverage = np.einsum("ncKrq->K", problem.grid**2)
    total = np.cumsum(leverage)
    wanted = (np.arange(2 * n + 10) + 0.5) / (2 * n + 10) * total[-1]
    at = np.unique(np.clip(np.searchsorted(total, wanted), 0, K - 1))
    omega = np.repeat(problem.omega[at], q)
    return problem.columns(omega, np.tile(np.eye(q, dtype=complex), (len(at), 1)))
