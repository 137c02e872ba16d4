"""State-space models by subspace methods: linear algebra, no search, no starting values.

The future outputs, once the part due to the future inputs is taken off, lie in the range of the extended observability
matrix [C; CA; CA^2; ...]. The past inputs and outputs are the instruments that tell this range from noise. A and C come
from the range (shift invariance); B, D, the levels and the initial states then are linear in the simulated output, and
minimise its error (Van Overschee, De Moor 1996, Subspace Identification for Linear Systems, chapter 4; Verhaegen
1994, Automatica 30, 61: PO-MOESP; Larimore 1990: CVA)."""

from bisect import bisect_left
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimators.pem.fit import Fit
from estimators.pem.predictors.of_structure import Structure
from estimators.pem.results import result
from estimators.pem.search.levenberg_marquardt import Optimum, Point
from estimators.pem.search.problem import Problem, prepare
from estimators.pem.subspace.errors import covariance, influence, linear_entries
from estimators.pem.subspace.hankel import Factor, autoregressive_order, factored
from estimators.pem.subspace.observability import Range, Subspace, range_of
from oed.data import Record
from oed.errors import InputError, Status
from oed.models.model import StateSpace

METHODS = ("moesp", "n4sid", "cva")
TRIED, MOST_TRIED = 6, 41
"""Horizons that are compared, and those that are where none of the first gives a model. Of 200 records five and seven gave
models as good as 41 did (ratio of errors 1.006 and 1.005 +- .008)."""


def check_subspace(form: Structure, method: str, horizon: int | None, given: dict[str, bool]) -> StateSpace:
    """Refuse what does not go with a subspace method."""
    if method == "pem":
        raise InputError(f"a horizon of {horizon} is for a subspace method: choose {', '.join(METHODS)}.")
    if method not in METHODS:
        raise InputError(f"method is {method!r}; choose pem, {', '.join(METHODS)}.")
    if not isinstance(form, StateSpace):
        raise InputError(
            f'{method} gives state-space models; take the structure "ss" instead of {form.kind}.'
        )
    if horizon is not None and not (isinstance(horizon, int | np.integer) and horizon > 0):
        raise InputError(
            f"the horizon is {horizon!r}; give a whole number of block rows, above {form.order // form.n_outputs}."
        )
    wrong = [name for name, asked in given.items() if asked]
    if wrong:
        raise InputError(
            f'{", ".join(wrong)} cannot go with {method}, which is linear algebra on complete records; take method="pem".'
        )
    return StateSpace(form.blocks, form.n_inputs, form.feedthrough, noise=False)


def by_subspace(
    form: StateSpace, records: list[Record], method: str, horizon: int | None, *,
    offset: bool, centred: bool, initial: str,
) -> Fit:  # fmt: skip
    """Subspace estimate of a state-space model without a noise model."""
    problem = prepare(form, records, offset=offset, initial=initial != "zero")
    nu, ny = form.n_inputs, form.n_outputs
    signals = [(d[:, :nu], d[:, nu : nu + ny]) for d in problem.records()]
    candidates = [horizon] if horizon is not None else _horizons(form, signals, centred)
    _check(form, signals, candidates)
    tried = {}
    longest = factored(signals, candidates[-1], centred)
    if len(candidates) > 1:
        tried = _errors_by_horizon(form, problem, longest, method, candidates)
    ranking = sorted(tried, key=lambda i: tried[i]) or candidates
    found, point = _first_model(form, problem, signals, longest, method, ranking, centred)
    best = found.factor.horizon
    if ny > 1:
        moment = point.extra[1]
        problem = problem.replace(weight=np.linalg.inv(moment + 1e-12 * np.trace(moment) * np.eye(ny)))
        point = _completed(form, problem, found)
    step = np.linalg.lstsq(point.hessian, point.gradient, rcond=1e-12)[0]
    decrement = float(point.gradient @ step) / max(point.loss, 1e-300)
    terms = influence(form, problem, point, found, signals)
    size = problem.output_scale
    residuals = [e / size for e in problem.residuals(point)]
    spread = covariance(problem, residuals, terms, best)
    fit = result(problem, Optimum(point, Status.OK, 0, decrement), records, offset, initial, spread=spread)
    in_units = [kappa * problem.scale / size[:, None] for kappa in terms]
    tried = tried or {best: _relative_error(point)}
    return replace(fit, subspace=Subspace(method, best, found.singular_values, tried, in_units))


def _errors_by_horizon(
    form: StateSpace, problem: Problem, longest: Factor, method: str, candidates: list[int]
) -> dict[int, float]:
    """Simulation error for each horizon that gives a model, all from one factor, at the samples that the longest has."""
    tried, reason = {}, None
    few = np.unique(np.linspace(0, len(candidates) - 1, TRIED).round().astype(int))
    for chosen in ([candidates[k] for k in few], candidates):
        for i in chosen if not tried else ():
            try:
                found = range_of(longest.shorter(i), form.order, method, leading=longest.gram is not None)
                tried[i] = _foretold(form, problem, found)
            except InputError as error:
                reason = error
    if not tried:
        raise InputError(
            f"none of the horizons from {candidates[0]} to {candidates[-1]} gives a model; {reason}"
        )
    return tried


def _first_model(
    form: StateSpace,
    problem: Problem,
    signals: list,
    longest: Factor,
    method: str,
    ranking: list[int],
    centred: bool,
) -> tuple[Range, Point]:
    """The first horizon that gives a stable model with all the samples that it has."""
    for i in ranking:
        try:
            factor = longest if i == longest.horizon else factored(signals, i, centred)
            found = range_of(factor, form.order, method)
            return found, _completed(form, problem, found)
        except InputError:
            if i == ranking[-1]:
                raise
    raise InputError("no horizon to try; this should not happen.")


def _relative_error(point: Point) -> float:
    """Root mean square of the simulation error in scaled units."""
    moment = point.extra[1]
    return float(np.sqrt(np.trace(moment) / len(moment)))


def _check(form: StateSpace, signals: list, candidates: list[int]) -> None:
    """Refuse horizons that the order or the records do not allow."""
    least = -(-form.order // form.n_outputs) + 1
    most = _longest(form, signals)
    for i in (candidates[0], candidates[-1]):
        if not least <= i <= most:
            raise InputError(
                f"the horizon is {i} block rows; order {form.order} with {form.n_outputs} output(s) needs {least} or "
                f"more, and these records allow {most} at most (2 (nu + ny) rows of either half, twice as many samples): "
                + ("give longer records or lower the order." if most < least else "choose one between.")
            )


def _longest(form: StateSpace, signals: list) -> int:
    """The most block rows with twice as many columns in the Hankel matrices as rows."""
    channels, lengths = form.n_inputs + form.n_outputs, [len(u) for u, _ in signals]
    short = lambda i: sum(max(n - 2 * i + 1, 0) for n in lengths) < 4 * i * channels
    return bisect_left(range(1, max(lengths) // 2 + 1), True, key=short)


def _horizons(form: StateSpace, signals: list, centred: bool) -> list[int]:
    """Horizons worth trying: from twice the autoregression's order on."""
    most = _longest(form, signals)
    total = sum(len(u) for u, _ in signals)
    orders = max(1, min(round(10 * np.log10(max(total, 10))), most))
    back = autoregressive_order(signals, orders, centred)
    low = max(min(2 * back, most), -(-form.order // form.n_outputs) + 2)
    high = max(min(3 * low, most), low)
    return np.unique(np.linspace(low, high, MOST_TRIED).round().astype(int)).tolist()


def _begun(form: StateSpace, problem: Problem, found: Range) -> Point:
    """The loss with A and C alone."""
    n, nu, ny = form.order, form.n_inputs, form.n_outputs
    z = np.zeros(problem.n_parameters)
    z[: form.n] = form.theta_of(found.A, np.zeros((n, nu)), found.C, np.zeros((ny, nu)), np.zeros((n, ny)))
    point = problem.evaluate(z, affine=True)
    if point is None:
        pole = np.abs(np.linalg.eigvals(found.A)).max()
        raise InputError(
            f"with {found.factor.horizon} block rows the model is unstable (a pole of size {pole:.6g}); choose another "
            'horizon or order, or take method="pem".'
        )
    return point


def _solved(form: StateSpace, point: Point) -> tuple[NDArray, float]:
    """The best B, D and levels at given A and C, in which the residual is linear, and the loss they promise."""
    free = linear_entries(form, len(point.z))
    at, z = np.flatnonzero(free), point.z.copy()
    step = np.linalg.lstsq(point.hessian[at[:, None], at], point.gradient[free], rcond=1e-14)[0]
    z[free] -= step
    return z, max(point.loss - float(point.gradient[free] @ step), 0.0)


def _foretold(form: StateSpace, problem: Problem, found: Range) -> float:
    """Root mean square of the simulation error that B, D, levels and initial states will leave, in scaled units."""
    loss = _solved(form, _begun(form, problem, found))[1]
    return float(np.sqrt(loss / (problem.n_observed * form.n_outputs)))


def _completed(form: StateSpace, problem: Problem, found: Range) -> Point:
    """B, D, levels and initial states by least squares on the simulation error; the residual is linear in them."""
    point: Point | None = _begun(form, problem, found)
    for affine in (True, False):  # once more, for what the normal equations lose
        point = problem.evaluate(_solved(form, point)[0], affine=affine) if point is not None else None
    if point is None:
        raise InputError("the simulation error is not finite; check the units of the records.")
    return point
