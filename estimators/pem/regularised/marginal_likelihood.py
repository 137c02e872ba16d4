"""Impulse responses under a kernel, the hyperparameters by marginal likelihood.

y = X g + level + tau + d + e with g ~ N(0, K) is normal; minus twice its log-likelihood, the levels integrated out
under a flat prior (restricted likelihood) and the variance of e concentrated, is

    N log(y' Z^-1 y / N) + log det Z + log det(1' Z^-1 1),   Z = X K X' + T + V in units of var e

(Chen, Ohlsson, Ljung 2012; the taps' covariance has beside the posterior's what the
hyperparameters' errors and the prior's own bias make). With K = M M' and V
tridiagonal up to differences, all of it follows from moments of the size of the taps: O(N n^2) once per V, O(n^3) per K.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.pem.fit import Fit
from estimators.pem.regularised.impulse_priors import KERNELS, SlowNoise, kernel_factor
from estimators.pem.regularised.regularisation import Regularisation, lagged, transient_factor
from estimators.residual.measures import fit_percent
from oed.data import Record, frozen
from oed.errors import InputError, Status
from oed.models.model import Model, Polynomial, polynomial

FAR = 30.0
"""Bound of every transformed hyperparameter: logarithms, logits."""
STEP = 1e-4
"""Of central differences in transformed hyperparameters: the likelihood's rounding is 1e-12 of thousands."""


@dataclass(frozen=True, eq=False)
class _Row:
    """One output in scaled units: columns taps, level (or none), output, of each record."""

    form: Polynomial
    i: int
    columns: list[NDArray[np.float64]]
    levels: int
    kernel: str
    disturbance: str | None
    unknown: bool

    @property
    def names(self) -> list[str]:
        per_input = ["log scale", "logit decay", *(["logit correlation"] * (self.kernel == "dc"))]
        names = [f"{x}{j + 1}" for j in self.inputs for x in per_input]
        names += ["log transient"] * self.unknown
        return names + {"ar1": ["log q", "logit phi"], "walk": ["log q"]}.get(self.disturbance or "", [])

    @property
    def inputs(self) -> list[int]:
        return [j for j in range(self.form.n_inputs) if self.form.nb[self.i, j]]

    def noise(self, x: NDArray) -> SlowNoise:
        if self.disturbance == "walk":
            return SlowNoise(1.0, float(np.exp(x[-1])))
        if self.disturbance == "ar1":
            return SlowNoise(_share(x[-1]), float(np.exp(x[-2])))
        return SlowNoise()

    def factors(self, x: NDArray) -> list[NDArray[np.float64]]:
        each, found = 2 + (self.kernel == "dc"), []
        for k, j in enumerate(self.inputs):
            log_scale, *shape = x[k * each : (k + 1) * each]
            M = kernel_factor(self.kernel, self.form.nb[self.i, j], *map(_share, shape))
            found.append(np.exp(log_scale / 2) * M)
        return found


@dataclass(frozen=True, eq=False)
class _State:
    """The likelihood at given hyperparameters and what follows from it, per unit of the variance of e."""

    value: float
    variance: float
    taps: NDArray[np.float64]
    covariance: NDArray[np.float64]
    bias: NDArray[np.float64]
    level: float
    level_variance: float
    freedom: float


def _share(x: float) -> float:
    return float(1 / (1 + np.exp(-x)))


def _moments(row: _Row) -> Callable[[SlowNoise], tuple[float, list[tuple[NDArray, NDArray, NDArray]]]]:
    """log det V; of every record X' V^-1 X, the first rows of V^-1 X, and the first block of V^-1."""
    nk, nb = row.form.nk[row.i], row.form.nb[row.i]
    reach = int((nk + nb - 1)[nb > 0].max(initial=0)) if row.unknown else 0

    @lru_cache(maxsize=4)
    def of(noise: SlowNoise) -> tuple[float, list[tuple[NDArray, NDArray, NDArray]]]:
        total, parts = 0.0, []
        for X in row.columns:
            rows = min(reach, len(X))
            W, log_det = noise.weighed(X)
            head = noise.weighed(np.eye(len(X), rows))[0][:rows] if rows else np.zeros((0, 0))
            total += log_det
            parts.append((X.T @ W, W[:rows], head))
        return total, parts

    return of


def _state(row: _Row, moments: Callable, x: NDArray, whole: bool = False) -> _State:
    from scipy.linalg import block_diag, cho_solve, cholesky, solve_triangular

    factors, noise = row.factors(x), row.noise(x)
    log_det, parts = moments(noise)
    size = parts[0][0].shape[0]
    G = np.zeros((size, size))
    for (gram, top, head), X in zip(parts, row.columns, strict=True):
        G += gram
        if row.unknown:
            ratio = np.exp(x[len(row.inputs) * (2 + (row.kernel == "dc"))] / 2)
            M = ratio * transient_factor(row.form, row.i, factors, len(X))
            L = cholesky(np.eye(M.shape[1]) + M.T @ head @ M, lower=True, check_finite=False)
            C = solve_triangular(L, M.T @ top, lower=True, check_finite=False)
            G -= C.T @ C
            log_det += 2 * float(np.log(np.diag(L)).sum())
    n = size - 1 - row.levels
    across = G[n] / G[n, n] if row.levels else np.zeros(size)
    level_information = float(G[n, n])
    if row.levels:
        log_det += float(np.log(G[n, n]))
        G = G - np.outer(G[n], across)
    M = np.asarray(block_diag(*factors))
    A = M.T @ G[:n, :n] @ M
    L = cholesky(np.eye(len(A)) + A, lower=True, check_finite=False)
    f = M.T @ G[:n, -1]
    v = solve_triangular(L, f, lower=True, check_finite=False)
    total = sum(map(len, row.columns)) - row.levels
    rest = max(float(G[-1, -1] - v @ v), 1e-300)
    value = total * np.log(rest / total) + log_det + 2 * float(np.log(np.diag(L)).sum())
    none = np.zeros(0)
    if not whole:
        return _State(value, rest / total, none, none, none, 0.0, 0.0, 0.0)
    half = solve_triangular(L, M.T, lower=True)
    # The prior keeps (I + A)^-1 of a response M z from it; z itself was kept from as much, which the second term puts back.
    z = cho_solve((L, True), f)
    kept = cho_solve((L, True), z)
    covariance, taps, bias = half.T @ half, M @ z, M @ (kept + cho_solve((L, True), kept))
    freedom = len(A) - float(np.trace(cho_solve((L, True), np.eye(len(A))))) + row.levels
    level, spread = 0.0, 0.0
    if row.levels:
        level = float(across[-1] - across[:n] @ taps)
        spread = 1 / level_information + float(across[:n] @ covariance @ across[:n])
    return _State(value, rest / total, taps, covariance, bias, level, spread, freedom)


def _starts(row: _Row) -> list[NDArray[np.float64]]:
    """A fast and a slow impulse response, with a fast and a slow disturbance."""
    found = []
    for decay, q, phi in ((0.8, 0.1, 0.95), (0.95, 0.1, 0.995)):
        logit = np.log(decay / (1 - decay))
        shape = [np.log(10 * (1 - decay)), logit, *([logit] * (row.kernel == "dc"))]
        if row.kernel == "ss":
            shape[0] += np.log(6.0)
        x = shape * len(row.inputs) + [np.log(1 / (1 - decay))] * row.unknown
        x += {"ar1": [np.log(q), np.log(phi / (1 - phi))], "walk": [np.log(q)]}.get(row.disturbance or "", [])
        found.append(np.array(x))
    return found


def _slope(value: Callable[[NDArray], Any], x: NDArray) -> NDArray[np.float64]:
    steps = STEP * np.eye(len(x))
    return np.array([(value(x + s) - value(x - s)) / (2 * STEP) for s in steps])


def _maximised(row: _Row, most: int) -> tuple[NDArray, _State, NDArray, bool, int]:
    """Hyperparameters, their state, the covariance of those that are not at a bound, and how the search ended."""
    from scipy.optimize import minimize

    moments = _moments(row)
    value = lambda x: _state(row, moments, x).value
    bounds = [(-FAR, FAR)] * len(row.names)
    ends = []
    for x in _starts(row):
        found = minimize(
            value, x, jac=lambda x: _slope(value, x), method="L-BFGS-B", bounds=bounds,
            options={"maxiter": most, "ftol": 1e-10, "gtol": 1e-3},
        )  # fmt: skip
        ends.append(found)
    best = min(ends, key=lambda r: r.fun)
    n, x = len(best.x), best.x
    H, h = np.zeros((n, n)), 1e-2
    for k, step in enumerate(h * np.eye(n)):
        H[k] = (_slope(value, x + step) - _slope(value, x - step)) / (4 * h)
    H = (H + H.T) / 2
    spread = np.zeros((n, n))
    inside = np.flatnonzero((np.abs(x) < FAR - 1e-6) & (np.diag(H) > 1e-3))
    block = H[inside[:, None], inside]
    if inside.size and np.linalg.eigvalsh(block)[0] > 0:
        spread[inside[:, None], inside] = np.linalg.inv(block)
    count = sum(int(r.nit) for r in ends)
    return x, _state(row, moments, x, True), spread, bool(best.success), count


def _beside_the_posterior(row: _Row, x: NDArray, state: _State, hyper: NDArray) -> NDArray[np.float64]:
    """Squared errors of the taps beside the posterior's, (n, n): what the hyperparameters' own errors make of them, and the square
    of what the prior takes from this response, which is more than from the average one where it rings."""
    moments = _moments(row)
    slope = _slope(lambda at: _state(row, moments, at, True).taps, x)
    return slope.T @ hyper @ slope + np.outer(state.bias, state.bias)


def regularised(
    form: Polynomial, records: list[Record], kernel: str, disturbance: str | None, *,
    offset: bool, unknown: bool, max_iterations: int = 100,
) -> Fit:  # fmt: skip
    """The impulse responses of all entries under a kernel, output by output."""
    ny, nu, total = form.n_outputs, form.n_inputs, sum(map(len, records))
    mean = lambda signals: np.concatenate(signals).mean(axis=0)
    u_level = mean([r.u for r in records]) if offset else np.zeros(nu)
    y_level = mean([r.y for r in records]) if offset else np.zeros(ny)
    size = lambda signals, level: np.sqrt(mean([(s - level) ** 2 for s in signals]))
    su, sy = size([r.u for r in records], u_level), size([r.y for r in records], y_level)
    su, sy = np.where(su > 0, su, 1.0), np.where(sy > 0, sy, 1.0)
    coloured = disturbance is not None
    target = polynomial("bj", [form.nb, 1, 1, 0], form.nk, n_outputs=ny, n_inputs=nu) if coloured else form
    theta, (spread, beside) = np.zeros(target.n), np.zeros((2, target.n, target.n))
    level, level_error = np.array(y_level), np.zeros(ny)
    found = {x: np.zeros((ny, nu)) for x in ("scale", "decay", "correlation")}
    found |= {x: np.zeros(ny) for x in ("transient", "phi", "q", "noise")}
    innovation, errors, notes = np.zeros(ny), [], []
    freedom, likelihood, steps, converged, estimated = 0.0, 0.0, 0, True, 0
    for i, place in enumerate(target.places()):
        columns = []
        for r in records:
            ones, y = [np.ones(len(r))] * offset, (r.y - y_level)[:, i] / sy[i]
            columns.append(np.column_stack([lagged(form, i, (r.u - u_level) / su), *ones, y]))
        row = _Row(form, i, columns, int(offset), kernel, disturbance, unknown)
        x, state, hyper, done, count = _maximised(row, max_iterations)
        converged, steps = converged and done, steps + count
        freedom, likelihood = freedom + state.freedom, likelihood - state.value / 2
        estimated += len(x) + 1
        each, variance = 2 + (kernel == "dc"), state.variance * sy[i] ** 2
        for k, j in enumerate(row.inputs):
            log_scale, *shape = x[k * each : (k + 1) * each]
            found["scale"][i, j] = np.exp(log_scale) * variance / su[j] ** 2
            for name, v in zip(("decay", "correlation"), shape, strict=False):
                found[name][i, j] = _share(v)
        found["transient"][i] = np.exp(x[each * len(row.inputs)]) if unknown else 0.0
        noise = row.noise(x)
        found["phi"][i], found["q"][i], found["noise"][i] = noise.phi, noise.q, variance
        innovation[i] = variance * noise.innovation[0]
        taps = np.concatenate([np.arange(p.start, p.stop) for p in place["b"]])
        units = np.concatenate([np.full(form.nb[i, j], sy[i] / su[j]) for j in row.inputs])
        theta[taps] = state.taps * units
        spread[taps[:, None], taps] = state.covariance * state.variance * np.outer(units, units)
        beside[taps[:, None], taps] = _beside_the_posterior(row, x, state, hyper) * np.outer(units, units)
        if coloured:
            at = [place["c"][0].start, place["d"][0].start]
            theta[at] = noise.polynomials
            slope = _slope(lambda x, row=row: np.array(row.noise(x).polynomials), x)
            spread[np.ix_(at, at)] = slope.T @ hyper @ slope
        level[i] += state.level * sy[i]
        level_error[i] = np.sqrt(state.level_variance * variance)
        errors.append(dict(zip(row.names, np.sqrt(np.diag(hyper)).tolist(), strict=True)))
        which = f" of {records[0].output_names[i]}" if ny > 1 else ""
        notes += [
            f"{name}{which} is not told by the data: it has no standard error."
            for name, error in errors[-1].items()
            if error == 0
        ]
    chosen = Regularisation(
        kernel, disturbance, **{k: frozen(v) for k, v in found.items()}, input_scale=frozen(su),
        errors=tuple(errors), log_likelihood=likelihood, degrees_of_freedom=freedom, posterior=frozen(spread),
    )  # fmt: skip
    deviations, told = np.sqrt(innovation), spread + beside
    fit = Fit(
        Model(target, theta, np.diag(innovation), records[0].dt), (told + told.T) / 2, np.nan, total,
        estimated + int(np.ceil(freedom)), np.nan, Status.CONVERGED if converged else Status.MAX_ITERATIONS,
        steps, np.nan, [], u_level, level, level_error, "estimate" if unknown else "zero", tuple(notes), chosen,
    )  # fmt: skip
    residuals = [fit.residuals_of(r) for r in records]
    e = np.concatenate(residuals)
    moment = e.T @ e / total
    sizes = np.sqrt(np.diag(moment))
    unit = moment / np.outer(sizes, sizes)
    model = Model(target, theta, unit * np.outer(deviations, deviations), records[0].dt)
    y = np.concatenate([r.y for r in records])
    return replace(
        fit, model=model, residuals=residuals, loss=float(np.linalg.det(moment)),
        fit_percent=fit_percent(y, y - e),
    )  # fmt: skip


def check_regularisation(
    form: object, kernel: str | None, disturbance: str | None, refused: dict[str, bool]
) -> Polynomial:
    """What a kernel asks of a call to `identify`."""
    if kernel is None:
        raise InputError(f"disturbance={disturbance!r} goes with a regularisation; choose tc, dc or ss.")
    if kernel not in KERNELS:
        raise InputError(f"regularisation is {kernel!r}; choose tc, dc or ss, or None.")
    if disturbance not in (None, "ar1", "walk"):
        raise InputError(f"disturbance is {disturbance!r}; choose ar1, walk or None.")
    if not isinstance(form, Polynomial) or form.kind != "fir":
        raise InputError(
            f"regularisation={kernel!r} is of impulse responses; the structure is {form!r}: take fir."
        )
    if given := [name for name, is_given in refused.items() if is_given]:
        raise InputError(f"regularisation={kernel!r} does not go with {', '.join(given)}; leave them out.")
    return form
