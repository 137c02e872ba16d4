"""Damped Gauss-Newton (Levenberg 1944, Marquardt 1963) with a secant correction where residuals are large.

V(z + d) is about V + 2 g'd + d'(H + S)d. H is the Gauss-Newton matrix; S, the second-order part that it leaves out,
starts at zero and is learned from differences of gradients (Dennis, Gay, Welsch 1981, ACM TOMS 7, 348: NL2SOL).
The model that foretold the last step better is used for the next."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from oed.errors import Status

WINDOW, NEGLIGIBLE = 10, 1e-8
"""Steps over which the loss has to fall by this share. An over-ordered model has a valley along which it falls for ever, by
less than noise can tell: N times the share is a squared distance in standard errors, 1e-4 at 10,000 samples."""
SINGULAR = 1e-15
"""Smallest eigenvalue of a scaled information matrix, as a share of the largest, that is not rounding."""
FLAT = 1e-6
"""What a further step may promise, as a share of the loss, where the search ends for having come nowhere."""


@dataclass(frozen=True, eq=False)
class Point:
    """The loss at some parameters and its Gauss-Newton model. `z` (n,) parameters; `loss` sum of weighted
    squares; `gradient, hessian` (n,) half the gradient, (n, n) Gauss-Newton matrix; `follow` d -> whatever
    `evaluate` needs to evaluate at z + d (initial states that go along); `extra` what the evaluation carries
    along."""

    z: NDArray[np.float64]
    loss: float
    gradient: NDArray[np.float64]
    hessian: NDArray[np.float64]
    follow: Callable[[NDArray[np.float64]], Any]
    extra: Any = None


@dataclass(frozen=True, eq=False)
class Optimum:
    """Where the search ended. `point` the last accepted point; `status` CONVERGED, MAX_ITERATIONS or
    INACCURATE; `iterations` accepted and rejected steps; `decrement` gradient' hessian^-1 gradient / loss at
    the end: the relative decrease still to be had."""

    point: Point
    status: Status
    iterations: int
    decrement: float


def units(hessian: NDArray) -> NDArray[np.float64]:
    """Units of the parameters in which the diagonal of a matrix is 1: hessian (n, n) -> (n,)."""
    diagonal = hessian.diagonal()
    return 1 / np.sqrt(np.maximum(diagonal, max(1e-14 * diagonal.max(), np.finfo(float).tiny)))


def determined(hessian: NDArray, least: float = SINGULAR) -> bool:
    """Whether a Gauss-Newton matrix (n, n) is positive definite as far as rounding tells: every parameter has an error."""
    scale = units(hessian)
    values = np.linalg.eigvalsh(hessian * np.outer(scale, scale))
    return bool(values[0] > least * values[-1])


def _solve(hessian: NDArray, damping: float, gradient: NDArray, scale: NDArray) -> NDArray | None:
    """-(hessian + damping diag)^-1 gradient in scaled variables; None where that is not positive definite."""
    matrix = hessian * (scale[:, None] * scale)
    matrix.flat[:: len(matrix) + 1] += damping
    _, step, failed = dposv(matrix, -gradient * scale)
    return None if failed else scale * step


def _secant(S: NDArray, step: NDArray, change: NDArray, remainder: NDArray) -> NDArray:
    """Symmetric update after which S step = remainder; `change` is the difference of gradients."""
    curvature = float(change @ step)
    if curvature <= 0:
        return S
    own = S @ step
    size = abs(float(step @ own))
    if size > 0:  # sizing: an S learned where residuals were larger must not stay too large
        S = S * min(1.0, abs(float(step @ remainder)) / size)
        own = S @ step
    missed = remainder - own
    cross = np.outer(missed, change)
    return S + (cross + cross.T) / curvature - float(missed @ step) / curvature**2 * np.outer(change, change)


def _held(point: Point, bounds: tuple[NDArray, NDArray] | None) -> NDArray[np.bool_]:
    """Which parameters sit at a bound that the gradient pushes them against."""
    if bounds is None:
        return np.zeros(len(point.z), bool)
    lower, upper = bounds
    return (point.z <= lower) & (point.gradient >= 0) | (point.z >= upper) & (point.gradient <= 0)


def _along(normals: NDArray, point: Point, moves: NDArray) -> NDArray:
    """(n, k) orthonormal basis of the directions along the walls that the Gauss-Newton step would cross."""
    n = len(moves)
    if not len(normals):
        return np.eye(n)
    hessian, gradient = point.hessian[moves[:, None], moves], point.gradient[moves]
    inner = _solve(hessian, 1e-9, gradient, units(hessian))
    outward = normals[normals @ (inner if inner is not None else -gradient) > 0]
    if not len(outward):
        return np.eye(n)
    _, singular, right = np.linalg.svd(outward)
    return right[int(np.sum(singular > 1e-9 * singular[0])) :].T


def _settled(
    losses: list[float], point: Point, decrement: float, enough: Callable[[Point, float], bool] | None
) -> bool:
    """Whether a search that still promises something has come to where going on means nothing: losses of the points so far, the last
    of which is this one."""
    steps = len(losses) - 1
    if steps < WINDOW:
        return False
    before = losses[-1 - WINDOW]
    if before * (1 - NEGLIGIBLE) <= point.loss and decrement < FLAT:
        return True
    return enough is not None and steps % WINDOW == 0 and enough(point, before / max(point.loss, 1e-300) - 1)


def minimise(
    evaluate: Callable[[NDArray, Any], Point | None], start: Point, *, tolerance: float = 1e-16,
    max_iterations: int = 100, free: NDArray | None = None, project: Callable[[NDArray], NDArray] | None = None,
    clip: Callable[[NDArray], NDArray] | None = None, walls: Callable[[NDArray], NDArray] | None = None,
    bounds: tuple[NDArray, NDArray] | None = None, enough: Callable[[Point, float], bool] | None = None,
) -> Optimum:  # fmt: skip
    """Minimise a sum of squares from a point: evaluate (z, extra), free (n,); enough (point, share by which the loss has fallen over
    WINDOW steps) -> whether to end there, asked once in as many steps."""
    point, damping = start, 0.0
    allowed = np.ones(len(start.z), bool) if free is None else np.asarray(free)
    S, corrected = np.zeros((len(start.z), len(start.z))), False
    decrement, stalled, identity = np.inf, 0, np.eye(len(start.z))
    losses: list[float] = []
    for iteration in range(max_iterations):
        losses.append(point.loss)
        moves = np.flatnonzero(allowed & ~_held(point, bounds))
        if not moves.size:
            return Optimum(point, Status.CONVERGED, iteration, 0.0)
        edges = identity[:0] if walls is None else walls(point.z)
        along = None
        gradient, hessian, learned = point.gradient, point.hessian, S
        if len(edges) or len(moves) < len(identity):
            along = identity[:, moves]
            along = along @ _along(edges[:, moves], point, moves) if len(edges) else along
            gradient, hessian = along.T @ gradient, along.T @ hessian @ along
            learned = along.T @ S @ along
        scale = units(hessian)
        newton = _solve(hessian, 1e-14, gradient, scale)
        newton = _solve(hessian, 1e-9, gradient, scale) if newton is None else newton
        decrement = np.inf if newton is None else float(-gradient @ newton) / max(point.loss, 1e-300)
        if decrement <= tolerance or _settled(losses, point, decrement, enough):
            return Optimum(point, Status.CONVERGED, iteration, decrement)
        inner = newton if not corrected and damping == 0 else None
        while inner is None and damping <= 1e12:
            inner = _solve(hessian + learned if corrected else hessian, damping, gradient, scale)
            if inner is None:
                damping, corrected = max(4 * damping, 1e-6), corrected and damping < 1
        if inner is None:  # no curvature at all, or none that is finite
            return Optimum(point, Status.INACCURATE, iteration + 1, decrement)
        step = inner if along is None else along @ inner
        linear, plain, bent = 2 * gradient @ inner, inner @ hessian @ inner, inner @ learned @ inner
        predicted = -(linear + plain + (bent if corrected else 0.0))
        wanted = point.z + step
        if project is not None:
            step = project(wanted) - point.z
        trial = evaluate(point.z + step, point.follow(step))
        if clip is not None and (trial is None or trial.loss > point.loss):
            edge = clip(wanted) - point.z
            if (edge != step).any():
                other = evaluate(point.z + edge, point.follow(edge))
                if other is not None and other.loss <= point.loss:
                    step, trial = edge, other
        if trial is not None and trial.loss <= point.loss:
            fall = point.loss - trial.loss
            gain = fall / max(predicted, 1e-30 * point.loss, 1e-300)
            stalled = stalled + 1 if fall <= 1e-15 * point.loss else 0
            change = trial.gradient - point.gradient
            S = _secant(S, step, change, change - trial.hessian @ step)
            corrected = abs(fall + linear + plain + bent) < abs(fall + linear + plain)
            point = trial
            damping *= 0.1 if gain > 0.75 else (4.0 if gain < 0.25 else 1.0)
            damping = 0.0 if damping < 1e-7 else damping
        else:
            stalled += predicted <= 1e-14 * point.loss
            damping = max(damping * 8, 1e-3)
            if damping > 1e3:
                corrected = False
        if stalled >= 3 or damping > 1e12:
            status = Status.CONVERGED if decrement < 1e-9 else Status.INACCURATE
            return Optimum(point, status, iteration + 1, decrement)
    return Optimum(point, Status.MAX_ITERATIONS, max_iterations, decrement)
