"""The verb `identify`: records in, a fitted model with its uncertainty out."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.pem.checks import check_records, structure_for
from estimators.pem.constraints import Constraints, constrained
from estimators.pem.fit import Fit
from estimators.pem.predictors.of_structure import Structure
from estimators.pem.predictors.statespace import state_space_of_armax, subspace_candidates
from estimators.pem.regularised.marginal_likelihood import check_regularisation, regularised
from estimators.pem.results import result
from estimators.pem.search.extras import (
    Settings,
    bridged,
    filtered_record,
    robust_scale,
    robustly,
    with_limits,
    with_prior,
    without_outliers,
)
from estimators.pem.search.global_search import best_optimum
from estimators.pem.search.joint_fit import fit_together
from estimators.pem.search.levenberg_marquardt import Optimum, determined
from estimators.pem.search.problem import Problem, determining, prepare
from estimators.pem.search.starts import reflected
from estimators.pem.subspace.subspace_fit import by_subspace, check_subspace
from oed.covariances import on_one_thread
from oed.data import Record
from oed.errors import InputError, Status
from oed.files.objects import as_records
from oed.models.model import Polynomial, StateSpace, polynomial

_CHOICES: dict[str, tuple] = {
    "initial": ("zero", "estimate", "backcast"), "offset": (True, False, "mean"),
    "search": ("auto", "quick", "thorough"), "robust": (None, "huber", "student"),
}  # fmt: skip


@on_one_thread
def identify(
    records: Any,
    structure: str | Polynomial | StateSpace = "oe",
    orders: Any = (2, 2),
    delay: Any = 1,
    *,
    diagonal: bool = False,
    offset: bool | str = True,
    initial: str | None = None,
    start: ArrayLike | None = None,
    search: str = "auto",
    fixed: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    constraints: Constraints | None = None,
    robust: str | None = None,
    prefilter: tuple[ArrayLike, ArrayLike] | None = None,
    missing: bool = False,
    regularisation: str | None = None,
    disturbance: str | None = None,
    method: str = "pem",
    horizon: int | None = None,
    max_iterations: int = 100,
    tolerance: float = 1e-16,
) -> Fit:
    """Prediction-error estimate of a model: the parameters that minimise the one-step prediction errors.

    One output: V(theta) = mean e(t, theta)^2. Several: the determinant of their second moment, the
    Gaussian maximum likelihood.

    Parameters
    ----------
    records : Record or DataFrame or Dataset or TimeResponseData, or a sequence of them
        One experiment, or several that share the model (`oed.files.objects.as_records` says how others than
        `oed.Record` are read).
    structure : str or Polynomial or StateSpace
        fir, arx, armax, oe, bj, ss; or a structure, whose orders and delays then count.
    orders : sequence of int
        fir nb; arx na nb; armax na nb nc; oe nb nf; bj nb nc nd nf; ss n. See `oed.models.model.polynomial`. "auto": by
        the error on blocks left out.
    delay : int or array_like
        nk in samples, a number or (ny, nu); "auto": the one under which the model fits best.
    diagonal : bool
        Whether input i drives output i alone.
    offset : bool or "mean"
        Whether signals are deviations from unknown levels: the inputs' means, and output levels that are
        estimated (True, as for measured data) or also taken as the means ("mean"). With False the signals are
        deviations already, as in a simulated experiment from rest.
    initial : {"zero", "estimate", "backcast"}, optional
        At rest before the first sample; or initial states estimated for every record, counted as parameters
        (estimate) or not (backcast: the best ones at every theta, held while the parameters move). By default
        estimated, and without an offset zero.
    start : array_like, optional
        (n,) parameters to start from; by default several starts are made from the data.
    search : {"auto", "quick", "thorough"}
        How hard the global optimum is looked for: quick tries the starts got by linear algebra; auto also moves
        modes to other frequencies, where there are more than two (on up to 400 samples always) and up to 30000
        samples, and on up to 3000 samples draws random starts; thorough always does, with four times as many. Where the
        orders are seen to be too high (nothing is left in the residual, and modes cancel as far as the data tell), auto
        moves modes once and coarsely: other optima only fit the noise better.
    fixed : mapping of str to float, optional
        Known parameters by name: {"f1": -0.9}.
    bounds : mapping of str to tuple, optional
        Lower and upper bound by name.
    prior : mapping of str to tuple, optional
        Mean and standard deviation by name: regularisation by what was known before.
    constraints : callable, optional
        Takes a mapping of parameter names to CasADi symbols in the user's units, gives an expression or a list of
        them that must not be positive, as in ``lambda p: p["b1"] + p["b2"] - 0.4 * (1 + p["f1"] + p["f2"])``, a static
        gain of at most 0.4; by IPOPT. The covariance is that along the active ones.
    robust : {"huber", "student"}, optional
        A loss that outliers cannot dominate: Huber's (1.345 standard deviations) or Student's t (4 degrees of
        freedom).
    prefilter : tuple of array_like, optional
        (num, den) of a filter for inputs and outputs: the frequencies it passes count.
    missing : bool
        Whether NaN in the outputs marks missing samples, which a Kalman filter bridges.
    regularisation : {"tc", "dc", "ss"}, optional
        Of fir: the taps are expected to decay and to be smooth, as the kernel says, and its hyperparameters are found
        by marginal likelihood; take more taps than the response is long. See `estimators.pem.regularised.impulse_priors`.
    disturbance : {"ar1", "walk"}, optional
        With a regularisation, a slow disturbance beside the white noise: a stationary first-order autoregression,
        or a random walk. The model then has the noise model H = (1 + c z^-1) / (1 + d z^-1).
    method : {"pem", "moesp", "n4sid", "cva"}
        Prediction errors; or, of ss, a subspace method, which needs no search and no start. Its model has no noise
        model and minimises no loss; `Fit.subspace` holds its singular values and horizons.
    horizon : int, optional
        With a subspace method, the block rows; by default chosen from the data.
    max_iterations : int
        Most Gauss-Newton steps from each start.
    tolerance : float
        Stop once a further step promises less than this relative decrease of the loss.

    Returns
    -------
    Fit
        Model, covariance, figures of merit, residuals, status.

    Raises
    ------
    InputError
        If the records or orders break a rule.
    NotIdentifiable
        If the information matrix is singular; the parameters in its null space are named.
    """
    asked = dict(locals())
    if isinstance(orders, str) or isinstance(delay, str):
        from estimators.pem.choice import automatic

        return automatic(**asked)
    experiments = as_records(records, missing=missing)
    form = structure_for(structure, orders, delay, diagonal, experiments)
    initial = initial or ("estimate" if offset else "zero")
    for name, known in _CHOICES.items():
        if (value := (asked | {"initial": initial})[name]) not in known:
            raise InputError(f"{name} is {value!r}; choose one of {', '.join(map(str, known))}.")
    if max_iterations < 1:
        raise InputError(f"max_iterations is {max_iterations}; the search takes at least 1 step.")
    if missing and robust:
        raise InputError("missing samples are bridged with the squared loss; take the robust loss off.")
    if prefilter is not None:
        experiments = [filtered_record(r, *prefilter) for r in experiments]
    means, fitted = offset == "mean", tuple(experiments)
    if means:
        experiments, levels = _about_means(experiments)
    restored: Callable[[Fit], Fit] = lambda fit: replace(
        fit, records=fitted, **({"input_level": levels[0], "output_level": levels[1]} if means else {})
    )
    offset = bool(offset) and not means
    missing = missing and not all(r.complete for r in experiments)
    given = {
        "start": start is not None, "fixed": bool(fixed), "bounds": bool(bounds), "prior": bool(prior),
        "constraints": constraints is not None, "robust": robust is not None, "missing": missing,
        'initial="backcast"': initial == "backcast",
    }  # fmt: skip
    kernel = regularisation is not None or disturbance is not None
    states = None
    if method != "pem" or horizon is not None:
        form = states = check_subspace(form, method, horizon, given | {"a kernel": kernel})
    check_records(experiments, form, offset or means, missing, regularisation is not None)
    if states is not None:
        return restored(
            by_subspace(
                states, experiments, method, horizon, offset=offset, centred=offset or means, initial=initial
            )
        )
    if kernel:
        fir = check_regularisation(form, regularisation, disturbance, given)
        return restored(regularised(
            fir, experiments, str(regularisation), disturbance,
            offset=offset, unknown=initial != "zero", max_iterations=max_iterations,
        ))  # fmt: skip
    how = Settings(offset, initial != "zero", missing, search, max_iterations, tolerance)
    joint = prepare(form, experiments, offset=offset, initial=how.unknown, missing=missing)
    limits = fixed or {}, bounds or {}
    joint = with_limits(joint, *limits)
    begin = None if start is None else _scaled_start(start, joint)
    problem, optimum = _fitted(form, experiments, joint, begin, how)
    if prior:
        problem, optimum = with_prior(problem, optimum, prior, how)
    normals = None
    if constraints is not None:
        if robust or missing or prior:
            raise InputError("constraints go with the squared loss, without priors and missing samples.")
        optimum, normals = constrained(problem, optimum, constraints, how)
    if robust:
        problem, optimum = _withstanding(problem, optimum, robust, experiments, begin, how, limits)
    return restored(result(problem, optimum, experiments, offset, initial, robust, normals))


def _withstanding(
    problem: Problem, optimum: Optimum, loss: str, records: list[Record], begin: NDArray | None, how: Settings,
    limits: tuple[Mapping[str, float], Mapping[str, tuple[float, float]]],
) -> tuple[Problem, Optimum]:  # fmt: skip
    """The optimum of a loss that withstands outliers, begun where the squared loss has its own."""
    ends = [robustly(problem, optimum, loss, how)]
    if begin is None:  # outliers may have led the squared loss to a wrong optimum: once more without them
        cleaned = without_outliers(records, problem.residuals(optimum.point))
        again = prepare(problem.structure, cleaned, offset=how.offset, initial=how.unknown)
        z = _fitted(problem.structure, cleaned, with_limits(again, *limits), None, how)[1].point.z
        for point in problem.points([z * again.scale / problem.scale]):
            begun = Optimum(point, Status.OK, optimum.iterations, np.inf)
            ends.append(robustly(problem, begun, loss, how))
    return min(ends, key=lambda end: robust_scale(*end))


def _fitted(
    form: Structure, records: list[Record], joint: Problem, begin: NDArray | None, how: Settings
) -> tuple[Problem, Optimum]:
    """The optimum of all outputs together."""
    if joint.noise is not None:
        return _fit_with_gaps(form, records, joint, begin, how)
    if isinstance(form, StateSpace):
        found = [_fit_state_space(form, records, joint, begin, how)]
        z = found[0].point.z
    else:
        found = [_fit_row(form, i, records, joint, begin, how) for i in range(form.n_outputs)]
        theta = [f.point.z[: len(f.point.z) - how.offset] for f in found]
        z = np.concatenate([*theta, *([f.point.z[-1]] for f in found if how.offset)])
    if form.n_outputs == 1:
        return joint, found[0]
    iterations = max(f.iterations for f in found)
    if how.missing:  # the outputs one by one: where some are missing their joint weight changes in time
        diagonal = np.diag([1 / f.point.extra[1][0, 0] for f in found])
        joint = joint.replace(weight=diagonal)
        point = joint.evaluate(z) or found[0].point
        worst = max(found, key=lambda f: f.decrement)
        return joint, Optimum(point, worst.status, iterations, worst.decrement)
    return fit_together(joint, z, iterations, how)


def _fit_with_gaps(
    form: Structure, records: list[Record], joint: Problem, begin: NDArray | None, how: Settings
) -> tuple[Problem, Optimum]:
    """State-space models of several outputs with missing samples: the parameters and the innovations' covariance, on
    which the Kalman filter then depends, in turn; begun where the interpolated records lead."""
    from scipy.optimize import minimize

    ny, complete = form.n_outputs, replace(how, missing=False)
    whole = prepare(
        form, [bridged(r) for r in records], offset=how.offset, initial=how.unknown,
        scales=(joint.input_scale, joint.output_scale),
    ).replace(lower=joint.lower, upper=joint.upper)  # fmt: skip
    posed, optimum = _fitted(form, records, whole, begin, complete)
    z, noise = optimum.point.z.copy(), optimum.point.extra[1]
    if how.offset:
        z[form.n :] += (whole.output_level - joint.output_level) / joint.output_scale
    factor, iterations, before = np.linalg.cholesky(noise), optimum.iterations, np.inf
    at = np.tril_indices(ny)
    for _ in range(30):
        posed = joint.with_noise(factor @ factor.T)
        point = posed.evaluate(z)
        if point is None:
            raise InputError("no start of the state-space model has a stable predictor; try another order.")
        optimum = posed.descend(point, max_iterations=how.max_iterations, tolerance=how.tolerance)
        z, iterations = optimum.point.z, iterations + optimum.iterations
        if optimum.point.loss > before * (1 - 1e-9):
            break
        before = optimum.point.loss

        def log_loss(change: NDArray, base: NDArray = factor, held: NDArray = z) -> float:
            move = np.zeros((ny, ny))
            move[at] = np.concatenate([[0.0], change])  # the factor common to all is the likelihood's own
            root = base @ (np.eye(ny) + move)
            there = joint.with_noise(root @ root.T).evaluate(held)
            return np.inf if there is None else float(np.log(there.loss))

        best = minimize(log_loss, np.zeros(len(at[0]) - 1), method="BFGS", options={"gtol": 1e-7})
        move = np.zeros((ny, ny))
        move[at] = np.concatenate([[0.0], best.x])
        factor = factor @ (np.eye(ny) + move)
    return posed, Optimum(optimum.point, optimum.status, iterations, optimum.decrement)


def _about_means(records: list[Record]) -> tuple[list[Record], tuple[NDArray, NDArray]]:
    def mean(signals: list[NDArray]) -> NDArray:
        x = np.concatenate(signals)
        known = np.isfinite(x)
        return np.sum(x, axis=0, where=known) / np.maximum(known.sum(axis=0), 1)

    u, y = mean([r.u for r in records]), mean([r.y for r in records])
    return [r.replace(u=r.u - u, y=r.y - y) for r in records], (u, y)


def _scaled_start(start: ArrayLike, problem: Problem) -> NDArray:
    n = problem.structure.n
    values = np.asarray(start, dtype=float)
    if values.shape != (n,) or not np.isfinite(values).all():
        raise InputError(f"start has the shape {values.shape}; it must be {n} finite numbers.")
    z = np.zeros(problem.n_parameters)
    z[:n] = values / problem.scale[:n]
    return z


def _fit_row(
    form: Polynomial, i: int, records: list[Record], joint: Problem, begin: NDArray | None, how: Settings
) -> Optimum:
    """The best optimum of output i alone."""
    if form.n_outputs == 1:
        problem, own, rows = joint, begin, records
    else:
        rows = [r.replace(y=r.y[:, [i]], output_names=(), output_units=()) for r in records]
        scales = joint.input_scale, joint.output_scale[i : i + 1]
        problem = prepare(
            form.row(i), rows, offset=how.offset, initial=how.unknown, scales=scales, missing=how.missing
        )
        at = np.r_[_row_slice(form, i), [form.n + i] * how.offset].astype(int)
        if joint.lower is not None and joint.upper is not None:
            problem = problem.replace(lower=joint.lower[at], upper=joint.upper[at])
        own = None if begin is None else begin[at]
    if how.missing and own is None:
        whole = prepare(
            problem.structure, [bridged(r) for r in rows], offset=how.offset, initial=how.unknown,
            scales=(problem.input_scale, problem.output_scale),
        ).replace(lower=problem.lower, upper=problem.upper)  # fmt: skip
        own = best_optimum(whole, None, how).point.z
        if how.offset:
            own[-1] += (whole.output_level[0] - problem.output_level[0]) / problem.output_scale[0]
    return best_optimum(problem, own, how)


def _fit_state_space(
    form: StateSpace, records: list[Record], joint: Problem, begin: NDArray | None, how: Settings
) -> Optimum:
    """One output: the ARMAX model of the same order is the same model. Several: subspace starts."""
    if begin is not None:
        starts = [begin]
    elif form.n_outputs == 1:
        starts = [_by_armax(form, records, joint, how)]
        if joint.evaluate(starts[0]) is None:  # a zero of C on the circle: rounding puts it outside
            starts.append(_by_armax(form, records, joint, how, 1 - 1e-5))
    else:
        starts = subspace_candidates(form, joint)
    points = [p for z in starts if (p := joint.evaluate(z)) is not None]
    if not points:
        raise InputError("no start of the state-space model has a stable predictor; try another order.")
    points.sort(key=lambda p: np.linalg.slogdet(p.extra[1])[1])
    found = []
    for point in points[:4]:
        whitened = joint.replace(weight=np.linalg.inv(point.extra[1])) if form.n_outputs > 1 else joint
        at = whitened.evaluate(point.z, point.extra[0])
        if at is not None:
            most, near = (10, 1e-5) if form.n_outputs > 1 else (how.max_iterations, how.tolerance)
            posed = determining(whitened.evaluate, at)
            found.append(whitened.descend(at, max_iterations=most, tolerance=near, evaluate=posed))
    # A model that nothing determines is no answer, however low its loss.
    return min(found, key=lambda f: (not determined(f.point.hessian), np.linalg.slogdet(f.point.extra[1])[1]))


def _by_armax(
    form: StateSpace, records: list[Record], joint: Problem, how: Settings, most: float = 1.0
) -> NDArray:
    n, nu, direct = form.order, form.n_inputs, int(form.feedthrough)
    twin = polynomial("armax", [n, n + direct, n], 1 - direct, n_inputs=nu)
    scales = joint.input_scale, joint.output_scale
    problem = prepare(
        twin, records, offset=how.offset, initial=how.unknown, scales=scales, missing=how.missing
    )
    z = _fit_row(twin, 0, records, problem, None, how).point.z
    if most < 1:
        at = twin.places()[0]["c"][0]
        z[at] = reflected(z[at], most)
    return np.concatenate([state_space_of_armax(form, twin, z[: twin.n]), z[twin.n :]])


def _row_slice(form: Polynomial, i: int) -> slice:
    before = sum(form.row(k).n for k in range(i) if _has_parameters(form, k))
    return slice(before, before + form.row(i).n)


def _has_parameters(form: Polynomial, i: int) -> bool:
    return bool(form.na[i] + form.nb[i].sum() + form.nc[i] + form.nd[i])
