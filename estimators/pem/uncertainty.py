"""Uncertainty beyond the standard errors: misspecified models, profile likelihood, bands.

The covariance of a fit holds where the model can describe the data. Where it cannot, the sandwich
H^-1 M H^-1 does (Huber 1967; Ljung 1999, section 9.5): H the Hessian of the loss, M the long-run covariance of
its gradient. Profile intervals (Wilks 1938) need no quadratic loss. Bands are delta-method ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.pem.search.levenberg_marquardt import minimise
from estimators.pem.search.problem import Problem, prepare
from oed.data import Record
from oed.errors import InputError
from oed.files.objects import as_records

if TYPE_CHECKING:
    from estimators.pem.fit import Fit


@dataclass(frozen=True, eq=False)
class Band:
    """A curve with its standard errors. `x` (K,) frequencies in rad/sample, or samples; `value` (K, ny, nu);
    `standard_error` (K, ny, nu)."""

    x: NDArray[np.float64]
    value: NDArray[np.float64]
    standard_error: NDArray[np.float64]

    def interval(self, level: float = 0.95) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pointwise interval: returns (K, ny, nu)."""
        from scipy.special import ndtri

        half = float(ndtri((1 + level) / 2)) * self.standard_error
        return self.value - half, self.value + half


def _problem(fit: Fit, records: Record | Sequence[Record]) -> tuple[Problem, NDArray]:
    """The problem that a fit solved and where it ended, in scaled parameters."""
    if fit.regularisation is not None:
        raise InputError(
            "this fit is regularised: its covariance is the posterior's and its bias's, and neither a sandwich nor a profile of the "
            "squared loss belongs to it; fit without regularisation for these."
        )
    if fit.subspace is not None:
        raise InputError(
            "this fit is a subspace estimate, which minimises no loss: its covariance holds for coloured noise as it is; "
            'a profile or a sandwich belongs to a fit with method="pem".'
        )
    given = as_records(records)
    offset = bool(fit.output_level_errors.any())
    if not offset:
        given = [r.replace(u=r.u - fit.input_level, y=r.y - fit.output_level) for r in given]
    missing = not all(r.complete for r in given)
    problem = prepare(
        fit.model.structure, given, offset=offset, initial=fit.initial != "zero", missing=missing
    )
    z = np.concatenate([fit.theta, (fit.output_level - problem.output_level) * offset])[
        : problem.n_parameters
    ]
    if problem.structure.n_outputs > 1:
        scale = np.outer(problem.output_scale, problem.output_scale)
        if problem.noise is not None:
            problem = problem.with_noise(fit.noise_covariance / scale)
        else:
            problem = problem.replace(weight=np.linalg.inv(fit.noise_covariance / scale))
    return problem, z / problem.scale


def sandwich(fit: Fit, records: Record | Sequence[Record], *, lags: int | None = None) -> Fit:
    """The fit with a covariance that holds for a misspecified model too: H^-1 M H^-1. H is half the Hessian
    of the loss, by central differences of its exact gradient; M the long-run covariance of the gradient's
    terms: residuals over one minus their leverage, because fitted residuals are too small (MacKinnon, White
    1985: HC3), whitened by a vector autoregression of order 1, summed over lags with Bartlett's weights, and
    coloured again (Andrews, Monahan 1992). No covariance helps where the misspecified loss has its minimum
    far from the parameters in a part of the samples: output error in noise much larger than the signal, at
    low frequencies, fits a slow mode to the noise."""
    problem, z = _problem(fit, records)
    point = problem.evaluate(z)
    if point is None:
        raise InputError(
            "the loss of this fit is not finite on these records; give the records that were fitted."
        )
    n = problem.n_parameters
    errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(point.hessian, hermitian=True)), 0))
    steps = np.maximum(errors * np.sqrt(point.loss / problem.n_observed) * 1e-2, 1e-9)
    H = np.zeros((n, n))
    for k in range(n):
        shift = steps[k] * np.eye(n)[k]
        up, down = problem.evaluate(z + shift), problem.evaluate(z - shift)
        H[k] = (
            (up.gradient - down.gradient) / (2 * steps[k])
            if up is not None and down is not None
            else point.hessian[k]
        )
    H = (H + H.T) / 2
    lags = default_lags(problem.n_observed) if lags is None else lags
    initial, scores = point.extra[0], []
    for r, data in enumerate(problem.records()):
        states = np.zeros(0) if initial is None else initial[r]
        e, jacobian = problem.kernel.trace(data, np.concatenate([z, states]), True)
        if jacobian is not None:
            scores.append(_scores(e, jacobian[:, :, :n], problem.weight, point.hessian))
    M = long_run(scores, lags)
    inverse = np.linalg.inv(H)
    covariance = inverse @ M @ inverse * np.outer(problem.scale, problem.scale)
    m = len(fit.theta)
    return replace(
        fit,
        covariance=covariance[:m, :m],
        notes=(*fit.notes, f"Covariance robust to a misspecified model (sandwich, {lags} lags)."),
    )


def _scores(e: NDArray, jacobian: NDArray, weight: NDArray, hessian: NDArray) -> NDArray[np.float64]:
    """J' W (I - L)^-1 e at every time, (N, n), with the leverage L = J H^-1 J' W."""
    across = jacobian @ np.linalg.pinv(hessian, hermitian=True)
    kept = np.eye(e.shape[1]) - across @ jacobian.transpose(0, 2, 1) @ weight
    return np.einsum("tji,jk,tk->ti", jacobian, weight, np.linalg.solve(kept, e[:, :, None])[:, :, 0])


def default_lags(samples: int) -> int:
    """How many lags a long-run covariance takes: 4 (N / 100)^(2/9) (Newey, West 1994)."""
    return int(np.ceil(4 * (samples / 100) ** (2 / 9)))


def long_run(scores: list[NDArray], lags: int) -> NDArray[np.float64]:
    """Sum over all pairs of times of the covariance of a series: whitened, weighted by Bartlett, coloured
    again; scores (N, n) -> (n, n)."""
    n = scores[0].shape[1]
    recolour = np.eye(n)
    if lags:
        before = np.concatenate([s[:-1] for s in scores])
        A = np.linalg.lstsq(before, np.concatenate([s[1:] for s in scores]), rcond=None)[0].T
        left, size, right = np.linalg.svd(A)
        A = (left * np.minimum(size, 0.97)) @ right  # as Andrews and Monahan advise
        scores = [s - np.vstack([np.zeros(n), s[:-1]]) @ A.T for s in scores]
        recolour = np.linalg.inv(np.eye(n) - A)
    M = np.zeros((n, n))
    for s in scores:
        for k in range(min(lags, len(s) - 1) + 1):
            term = s[k:].T @ s[: len(s) - k]
            M += (1 - k / (lags + 1)) * (term if k == 0 else term + term.T)
    return recolour @ M @ recolour.T


def profile_interval(
    fit: Fit, records: Record | Sequence[Record], name: str, *, level: float = 0.95
) -> tuple[float, float]:
    """Profile-likelihood interval of a parameter: where the other parameters' best fit is not too much worse.
    N log(V(theta_k) / V) <= the chi-squared quantile with one degree of freedom."""
    from scipy.optimize import brentq
    from scipy.special import chdtri

    if name not in fit.names:
        raise InputError(f"there is no parameter {name!r}; the model has {', '.join(fit.names)}.")
    problem, z = _problem(fit, records)
    k = fit.names.index(name)
    free = np.arange(problem.n_parameters) != k
    best = problem.evaluate(z)
    if best is None:
        raise InputError(
            "the loss of this fit is not finite on these records; give the records that were fitted."
        )
    limit = float(chdtri(1, 1 - level))
    error = fit.standard_errors[k] / problem.scale[k]
    several = problem.structure.n_outputs > 1

    def excess(value: float) -> float:
        away = value - z[k]
        tilt = np.linalg.lstsq(best.hessian[np.ix_(free, free)], best.hessian[free, k], rcond=None)[0]
        start = z.copy()
        start[k] = value
        start[free] -= tilt * away
        point = problem.evaluate(problem.projected(start))
        if point is None or point.z[k] != value:
            shifted = z.copy()
            shifted[k] = value
            point = problem.evaluate(shifted)
        if point is None:
            return np.inf
        loss = minimise(problem.evaluate, point, free=free, tolerance=1e-10).point.loss
        return (loss - best.loss if several else problem.n_observed * np.log(loss / best.loss)) - limit

    ends = []
    for side in (-1.0, 1.0):
        inner, outer = z[k], z[k] + side * 2 * error
        for _ in range(12):
            if excess(outer) > 0:
                break
            inner, outer = outer, z[k] + 1.7 * (outer - z[k])
        else:
            ends.append(side * np.inf)
            continue
        far = outer
        while not np.isfinite(excess(far)) and abs(far - inner) > 1e-6 * error:
            far = (inner + far) / 2
        root = brentq(excess, inner, far, xtol=1e-5 * error) if excess(far) > 0 else far
        ends.append(float(np.asarray(root) * problem.scale[k]))
    return ends[0], ends[1]


def _propagated(fit: Fit, function: Callable[[NDArray], NDArray]) -> tuple[NDArray, NDArray]:
    """Value and standard error of a function of the parameters, its derivatives by central differences."""
    value = function(fit.theta)
    h = 1e-4 * np.maximum(fit.standard_errors, 1e-8)
    slope = np.stack(
        [(function(fit.theta + s) - function(fit.theta - s)) / (2 * s.sum()) for s in np.diag(h)], axis=-1
    )
    variance = np.einsum("...i,ij,...j->...", slope, fit.covariance, slope)
    return value, np.sqrt(np.maximum(variance, 0.0))


def bode_band(fit: Fit, omega: ArrayLike) -> tuple[Band, Band]:
    """Gain and phase of G with their standard errors: omega (K,)."""
    omega = np.atleast_1d(np.asarray(omega, dtype=float))
    g, dg = fit.model.response(omega)
    relative = dg / np.where(np.abs(g) > 0, g, 1.0)[:, None]
    spread = lambda part: np.sqrt(np.maximum(np.einsum("knij,nm,kmij->kij", part, fit.covariance, part), 0.0))
    size = np.abs(g)
    return (
        Band(omega, size, size * spread(relative.real)),
        Band(omega, np.unwrap(np.angle(g), axis=0), spread(relative.imag)),
    )


def step_band(fit: Fit, samples: int = 100) -> Band:
    """Step response with its standard errors: returns (samples, ny, nu)."""
    structure = fit.model.structure
    steps = [np.outer(np.ones(samples), row) for row in np.eye(structure.n_inputs)]

    def response(theta: NDArray) -> NDArray:
        return np.stack([structure.simulate(theta, u) for u in steps], axis=-1)

    return Band(np.arange(samples, dtype=float), *_propagated(fit, response))


def pole_covariances(fit: Fit) -> list[tuple[complex, NDArray[np.float64]]]:
    """Poles of G with the covariance of their real and imaginary parts."""
    structure, h = fit.model.structure, 1e-4 * np.maximum(fit.standard_errors, 1e-8)
    here = np.concatenate([np.zeros(0), *structure.poles(fit.theta)])
    slope = np.zeros((len(here), len(h)), complex)
    for k in range(len(h)):
        shift = np.zeros(len(h))
        shift[k] = h[k]
        up, down = (
            _matched(here, np.concatenate([np.zeros(0), *structure.poles(fit.theta + s * shift)]))
            for s in (1, -1)
        )
        slope[:, k] = (up - down) / (2 * h[k])
    found = []
    for pole, row in zip(here, slope, strict=True):
        both = np.stack([row.real, row.imag])
        found.append((complex(pole), both @ fit.covariance @ both.T))
    return found


def _matched(here: NDArray, other: NDArray) -> NDArray:
    """The other poles in the order of these: each takes the nearest one left."""
    left, out = list(other), []
    for pole in here:
        k = int(np.argmin([abs(pole - x) for x in left]))
        out.append(left.pop(k))
    return np.array(out)
