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

from estimators.pem.search.levenberg_marquardt import SINGULAR, Optimum, Point, units
from estimators.pem.search.problem import Problem
from estimators.pem.search.starts import lagged_gram, low_order_fits
from oed.models.model import StateSpace

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
    channels = _once(problem).size + problem.structure.n_outputs
    return problem.n_samples >= 10 * LAGS * channels and min(problem.lengths) >= 3 * LAGS


def standing(problem: Problem, optimum: Optimum) -> Standing:
    """What is known of an optimum of one output, whose noise model is free of A."""
    point, form = optimum.point, problem.structure
    free = problem.lower is None and problem.prior_precision is None and not problem.variant
    if form.na[0] or not free or not _long_enough(problem):
        return Standing.OPEN
    if not nothing_left(problem, point):
        return Standing.OPEN
    # Where the order is too high the search may end at its limit of steps, or where nothing determines the parameters: a residual
    # in which nothing is left tells as much there.
    told = _modes(problem, spread(problem, point), point.z)
    if any(COMMON < t <= RADIUS for t in told):
        return Standing.UNTOLD
    if min(told, default=np.inf) <= COMMON:
        return Standing.OVER_ORDERED
    return Standing.OPEN if form.nc[0] or form.nd[0] or not optimum.status.ok else Standing.CONFIRMED


def over_ordered(problem: Problem, point: Point) -> bool:
    """Whether nothing is left in the residuals of a model of several outputs, and it has a mode that the data do not tell from
    nothing. Any steps further go along the valley of where that mode fits the noise."""
    free = problem.lower is None and problem.prior_precision is None and not problem.variant
    if not free or not _long_enough(problem):
        return False
    told = min(_modes(problem, spread(problem, point), point.z), default=np.inf)
    return bool(told <= COMMON) and nothing_left(problem, point)


def spread(problem: Problem, point: Point) -> NDArray[np.float64]:
    """Covariance of the scaled parameters, (n, n), all but infinite along what nothing determines."""
    scale = units(point.hessian)
    values, vectors = np.linalg.eigh(point.hessian * np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, SINGULAR * values[-1])) @ vectors.T
    variance = point.loss / (problem.n_samples * problem.structure.n_outputs)
    return inverse * np.outer(scale, scale) * variance


def _modes(problem: Problem, covariance: NDArray, z: NDArray) -> list[float]:
    """How many standard errors the modes are from nothing: of a state-space model each, of polynomials each pair of them."""
    form = problem.structure
    if isinstance(form, StateSpace):
        return _controlled(form, z, covariance)
    told = []
    for i, place in enumerate(form.places()):
        pairs = [(place["b"][j], place["f"][j], False) for j in range(form.n_inputs) if form.nb[i, j]]
        if form.nc[i] and form.nd[i]:
            pairs.append((place["c"][0], place["d"][0], True))
        told += [_told(z, covariance, *pair) for pair in pairs]
    return told


def _controlled(form: StateSpace, z: NDArray, covariance: NDArray) -> list[float]:
    """How many standard errors each eigenvalue of A is from a mode that neither inputs nor noise reach: the smallest singular value
    of [A - lambda, B, K] is zero there (Popov, Belevitch, Hautus); its change with a coefficient, to first order, is that of u* S v."""
    m, found = form.matrices(z[: form.n]), []
    for pole in np.linalg.eigvals(m["A"]):
        left, singular, right = np.linalg.svd(np.hstack([m["A"] - pole * np.eye(form.order), m["B"], m["K"]]))
        u, v = left[:, -1].conj(), right[form.order - 1].conj()
        at = {"A": 0, "B": form.order, "K": form.order + form.n_inputs}
        slope = np.zeros(len(z))
        for k, (letter, i, j) in enumerate(form.entries()):
            slope[k] = (u[i] * v[at[letter] + j]).real if letter in at else 0.0
        variance = float(slope @ covariance @ slope)
        found.append(float(singular[-1]) / np.sqrt(variance) if variance > 0 else np.inf)
    return found


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


def nothing_left(problem: Problem, point: Point) -> bool:
    """Whether the residuals, made independent of each other at one time, tell nothing of themselves and are told nothing by the inputs."""
    ny = problem.structure.n_outputs
    e = [r / problem.output_scale for r in problem.residuals(point)]
    moment = sum((r.T @ r for r in e), np.zeros((ny, ny)))
    try:
        root = np.linalg.inv(np.linalg.cholesky(moment)).T
    except np.linalg.LinAlgError:
        return False
    once = _once(problem)
    channels = [np.column_stack([r @ root, d[:, once]]) for r, d in zip(e, problem.records(), strict=True)]
    gram = lagged_gram(channels, LAGS + 1)
    width = len(gram)
    flat = gram.reshape(width * (LAGS + 1), -1)
    now = np.arange(ny) * (LAGS + 1)
    index = np.setdiff1d(np.arange(len(flat)), now)
    normal, right = flat[np.ix_(index, index)], flat[np.ix_(index, now)]
    size = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    try:
        step = np.linalg.solve(normal / np.outer(size, size), right / size[:, None])
    except np.linalg.LinAlgError:
        return False
    explained = problem.n_samples * float(np.sum(step * (right / size[:, None]) / flat[now, now]))
    count = len(index) * ny
    return bool(explained < count + SPREAD * np.sqrt(2 * count))


def _once(problem: Problem) -> NDArray[np.int64]:
    """The columns of the inputs, delayed, each once: in several outputs they come again."""
    width = problem.data.shape[1] - 1 - problem.structure.n_outputs
    first: dict[bytes, int] = {}  # np.unique of columns makes a field of each sample: 10 ms for 4000 of them
    for j, column in enumerate(problem.data[:, :width].T):
        first.setdefault(column.tobytes(), j)
    return np.array(list(first.values()), dtype=np.int64)
