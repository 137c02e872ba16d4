"""Whether an optimum of an output-error model needs no rival: nothing is left in its residual, and every mode is told.

1. The residual is white and does not depend on the input: regressed on its own past and on past inputs, N times the
   relative fall of its variance is chi-squared (Ljung 1999, section 16.6). So no other model fits better by more than
   that statistic can hide.
2. B and F have no root in common at any parameters that fit nearly as well: the smallest singular value of their
   Sylvester matrix is zero where they have one, and is many of its standard errors here. So the map from parameters to responses is one to one there.

A rival would have to fit as well with another response (1) or another pair of B and F for the same response (2).

Where nothing is left but B and F, or C and D, have a root in common as far as the data tell, the order is too high: the
optimum lies in a valley, and rivals differ by where a mode that is not there fits the noise best."""

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from estimators.pem.search.levenberg_marquardt import Optimum, units
from estimators.pem.search.problem import Problem
from estimators.pem.search.starts import lagged_gram, low_order_fits
from oed.errors import Status

LAGS = 20
"""Of the residual and of each input."""
SPREAD = 4.0
"""Standard deviations above its mean that the statistic may be."""
RADIUS = 20.0
"""Standard errors from a common root of B and F. Its square is more than the statistic can hide from 8 on; that is to first
order, and with 10 an optimum was seen whose likelihood a rival's exceeded by a factor of 3."""
COMMON = 5.0
"""Standard errors up to which two roots may be one: a mode that only fits noise is seldom told by more than 3."""


class Standing(Enum):
    """What is known of an optimum: whether rivals can be better, and whether that would mean anything."""

    CONFIRMED = "no rival fits better"
    OVER_ORDERED = "rivals differ by modes that the data do not tell from nothing"
    UNTOLD = (
        "nothing is left, so that a rival could only be another pair of B and F for much the same response"
    )
    OPEN = "another optimum may be better"


def _channels(problem: Problem) -> list[NDArray[np.float64]]:
    width = problem.data.shape[1] - 2
    return [d[:, [width, *range(width)]] for d in problem.records()]


def first_start(problem: Problem) -> NDArray[np.float64] | None:
    """The start by null-space fitting of one long ARX model: returns (n + levels,)."""
    form = problem.structure
    if form.na[0] or form.nc[0] or form.nd[0] or not form.nf.any() or problem.variant:
        return None
    if problem.lower is not None or problem.prior_precision is not None:
        return None
    present = [j for j in range(form.n_inputs) if form.nb[0, j]]
    if not _long_enough(problem) or max(form.nb.max(), form.nf.max()) >= LAGS:
        return None
    gram = lagged_gram(_channels(problem), LAGS + 1)
    bs, fs = low_order_fits(
        gram, LAGS, [int(form.nb[0, j]) for j in present], [int(form.nf[0, j]) for j in present]
    )
    z, place = np.zeros(problem.n_parameters), form.places()[0]
    for j, b, f in zip(present, bs, fs, strict=True):
        z[place["b"][j]], z[place["f"][j]] = b, f
    return z


def _long_enough(problem: Problem) -> bool:
    """Whether the records hold enough samples for the test of what is left."""
    channels = problem.data.shape[1] - 1  # all but the pulse
    return problem.n_samples >= 10 * LAGS * channels and min(problem.lengths) >= 3 * LAGS


def standing(problem: Problem, optimum: Optimum) -> Standing:
    """What is known of an optimum of one output, whose noise model is free of A."""
    point, form = optimum.point, problem.structure
    free = problem.lower is None and problem.prior_precision is None and not problem.variant
    # Where the order is too high the search may wander along a valley to its limit of steps: that must not hide it.
    ended = optimum.status.ok or optimum.status is Status.MAX_ITERATIONS
    if not ended or form.na[0] or not free or not _long_enough(problem):
        return Standing.OPEN
    scale = units(point.hessian)
    try:
        spread = np.linalg.inv(point.hessian * np.outer(scale, scale)) * np.outer(scale, scale)
    except np.linalg.LinAlgError:
        return Standing.OPEN
    place = form.places()[0]
    pairs = [(place["b"][j], place["f"][j], False) for j in range(form.n_inputs) if form.nb[0, j]]
    if form.nc[0] and form.nd[0]:
        pairs.append((place["c"][0], place["d"][0], True))
    spread = spread * (point.loss / problem.n_samples)
    told = [_told(point.z, spread, *pair) for pair in pairs]
    if not _nothing_left(problem, optimum):
        return Standing.OPEN
    if any(COMMON < t <= RADIUS for t in told):
        return Standing.UNTOLD
    if min(told, default=np.inf) <= COMMON:
        return Standing.OVER_ORDERED
    return Standing.OPEN if form.nc[0] or form.nd[0] or not optimum.status.ok else Standing.CONFIRMED


def confirmed(problem: Problem, optimum: Optimum) -> bool:
    """Whether an optimum needs no rival."""
    return standing(problem, optimum) is Standing.CONFIRMED


def _told(z: NDArray, spread: NDArray, top: slice, bottom: slice, monic: bool) -> float:
    """How many standard errors two polynomials are from a common root; infinite where one has no roots."""
    b, f = np.concatenate([[1.0] * monic, z[top]]), np.concatenate([[1.0], z[bottom]])
    nb, nf = len(b), len(f) - 1
    size = float(np.linalg.norm(b))
    if not size:
        return 0.0
    order = nf + nb - 1
    if not order:
        return np.inf
    sylvester = np.zeros((order, order))
    for k in range(nb - 1):
        sylvester[k, k : k + nf + 1] = f
    for k in range(nf):
        sylvester[nb - 1 + k, k : k + nb] = b / size
    left, singular, right = np.linalg.svd(sylvester)
    # Its change with a coefficient, to first order: that of u' S v for the smallest singular value's vectors.
    u, v = left[:, -1], right[-1]
    by_b = np.array([u[nb - 1 :] @ v[i : i + nf] for i in range(int(monic), nb)]) / size
    by_f = [u[: nb - 1] @ v[i : i + nb - 1] for i in range(1, nf + 1)]
    slope, at = np.concatenate([by_b, by_f]), np.r_[top, bottom]
    variance = float(slope @ spread[np.ix_(at, at)] @ slope)
    if variance == 0.0:  # no coefficient moves it
        return np.inf
    # Below zero the information is singular.
    return float(singular[-1] / np.sqrt(variance)) if variance > 0 else 0.0


def _nothing_left(problem: Problem, optimum: Optimum) -> bool:
    e = problem.residuals(optimum.point)
    channels = [
        np.column_stack([r / problem.output_scale, c[:, 1:]])
        for r, c in zip(e, _channels(problem), strict=True)
    ]
    gram = lagged_gram(channels, LAGS + 1)
    width = len(gram)
    flat = gram.reshape(width * (LAGS + 1), -1)
    index = np.r_[1 : LAGS + 1, LAGS + 1 : width * (LAGS + 1)]
    normal, right = flat[np.ix_(index, index)], flat[index, 0]
    size = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    try:
        step = np.linalg.solve(normal / np.outer(size, size), right / size)
    except np.linalg.LinAlgError:
        return False
    explained = problem.n_samples * float(step @ (right / size)) / float(gram[0, 0, 0, 0])
    return bool(explained < len(index) + SPREAD * np.sqrt(2 * len(index)))
