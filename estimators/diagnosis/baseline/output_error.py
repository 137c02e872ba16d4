"""Output-error fits: a model's free run brought close to the outputs by Gauss-Newton, from a model that is near."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.baseline.regression import Arx, lagged_inputs
from estimators.residual.algebra import thin_svd
from oed.data import Record

Array = NDArray[Any]

DAMPING = (1e-6, 10.0, 1e6)
"""Levenberg's first damping in units of each parameter's information, its factor, and where a search gives up."""
STILL, ENOUGH = 1e-4, 0.0
"""Relative decrease of the loss below which a search has arrived: a tenth of what the choice between models can tell; and the least
damping, in units of each parameter's information."""
PATIENT = 1e-6, 1e-11
"""The same of a patient search: poles near one another at a quick sampling make valleys in which steps of 1e-4 still lead to half the
error; and in so many steps parameters of which the record tells nothing make a singular matrix without damping."""


class Problem(Protocol):
    """What a descent needs: the model of some parameters, their loss on rows (N,) per record with its derivatives, and the radius
    below which its poles stay."""

    @property
    def limit(self) -> float:
        """Radius below which the poles stay."""
        ...

    def model(self, theta: Array) -> LinearModel:
        """The model of these parameters."""
        ...

    def local(self, theta: Array, rows: Sequence[NDArray[np.bool_]]) -> tuple[float, Array, Array]:
        """Mean square, half its negative gradient and the Gauss-Newton matrix."""
        ...


def descended(
    problem: Problem,
    theta: Array,
    rows: Sequence[NDArray[np.bool_]],
    steps: int,
    ends: tuple[float, float] = (STILL, ENOUGH),
) -> tuple[Array, float]:
    """The best parameters within so many Gauss-Newton steps, and their mean square; every model on the way keeps to the limit."""
    loss, gradient, hessian = problem.local(theta, rows)
    damping, factor, most = DAMPING
    for _ in range(steps):
        scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
        while damping < most:
            H = hessian / np.outer(scale, scale) + damping * np.eye(len(theta))
            step = np.linalg.solve(H, gradient / scale) / scale
            if problem.model(theta + step).radius < problem.limit:
                new = problem.local(theta + step, rows)
                if new[0] < loss:
                    break
            damping *= factor
        else:
            break
        gained = loss - new[0]
        theta, (loss, gradient, hessian) = theta + step, new
        damping = max(damping / factor, ends[1])
        if gained < ends[0] * loss:
            break
    return theta, loss


@dataclass(frozen=True, eq=False)
class OutputError:
    """Fits of one form to one output of some records.

    `records` the data, inputs of this output only; `output` which output; `form` orders: of A, of B, delays,
    offset; `prior` of the outputs before each record; `limit` radius below which the poles stay.
    """

    records: Sequence[Record]
    output: int
    form: Arx
    prior: Prior
    limit: float = 1.0

    def fit(
        self,
        start: LinearModel,
        rows: Sequence[NDArray[np.bool_]],
        steps: int,
        ends: tuple[float, float] = (STILL, ENOUGH),
    ) -> tuple[LinearModel, float]:
        """The best model within so many steps of `start` and its mean square on the rows, (N,) per record."""
        theta, loss = descended(self, self._vector(start), rows, steps, ends)
        return self.model(theta), loss

    def _vector(self, model: LinearModel) -> Array:
        """(p,) parameters: a, b by input, c, then the outputs before each record."""
        f = self.form
        num = np.zeros((len(f.delay), max(f.delay) + f.nb))
        m = min(num.shape[1], model.num.shape[1])
        num[:, :m] = model.num[:, :m]
        b = [row[d : d + f.nb] for row, d in zip(num, f.delay, strict=True)]
        past = []
        if not self.prior.rest:
            for r in self.records:
                few = slice(0, 20 * f.na + 20)
                run = model.free_run(self.prior, r.u[few], r.y[few, self.output], 20)
                past.append(np.full(f.na, run[0]))
        return np.concatenate((model.den[1:], *b, [model.constant] if f.offset else [], *past))

    def model(self, theta: Array) -> LinearModel:
        """The model of these parameters."""
        return self.form.model(theta)

    @cached_property
    def _data(self) -> list[tuple[Array, Array]]:
        """Output and lagged inputs of each record."""
        rest = self.prior.rest
        return [(r.y[:, self.output].copy(), lagged_inputs(r, self.form, rest)) for r in self.records]

    def local(self, theta: Array, rows: Sequence[NDArray[np.bool_]]) -> tuple[float, Array, Array]:
        """Mean square, half its negative gradient and the Gauss-Newton matrix."""
        from estimators.diagnosis.baseline.linear_kernels import sensed

        f, n, states = self.form, self.form.na, not self.prior.rest
        later = np.tile(np.arange(f.nb) > 0, len(f.delay))
        later = np.append(later, False) if f.offset else later
        gram = np.zeros((len(theta) + 1, len(theta) + 1))
        count = 0
        for k, ((y, X), used) in enumerate(zip(self._data, rows, strict=True)):
            at = f.size + k * n
            past = theta[at : at + n] if states else np.zeros(n)
            Z = sensed(y, X, later, theta[n : f.size], theta[:n], past, states)
            keep = used & np.isfinite(Z[-1])
            Z = Z if keep.all() else Z[:, keep]
            count += Z.shape[1]
            where = np.concatenate((np.arange(f.size), np.arange(at, at + len(Z) - 1 - f.size), [len(theta)]))
            gram[np.ix_(where, where)] += Z @ Z.T  # pyright: ignore[reportCallIssue]
        loss, gradient, hessian = gram[-1, -1], gram[:-1, -1].copy(), gram[:-1, :-1]
        if n and not self.prior.rest:  # the outputs before the record, as the prior has them
            weight = max(loss, 1e-300) / max(count, 1) * np.linalg.pinv(toeplitz(self.prior.covariance[:n]))
            for k in range(len(self.records)):
                sl = slice(f.size + k * n, f.size + (k + 1) * n)
                hessian[sl, sl] += weight
                gradient[sl] -= weight @ (theta[sl] - self.prior.mean)
        return loss / max(count, 1), gradient, hessian


def realised(model: LinearModel, form: Arx, lags: int) -> LinearModel | None:
    """A model of the orders of `form` with nearly the impulse responses of another, by Ho and Kalman's realisation.

    None where the responses do not bear so many states, or its poles are not stable.
    """
    n, delay = form.na, form.delay
    length = 2 * lags + 1
    pulses = np.stack(
        [_pulse(model, j, d, length) for j, d in enumerate(delay)]
    )  # (nu, length), from its delay on
    later = 1 if form.nb > n else 0  # B of n + 1 coefficients leaves the first sample to itself
    H = np.concatenate([toeplitz_rows(p[later:], lags) for p in pulses], axis=1)
    left, size, _ = thin_svd(H)
    if n == 0 or len(size) < n or size[n - 1] <= 1e-10 * size[0]:
        return None
    O = left[:, :n] * np.sqrt(size[:n])
    den = np.real(np.poly(np.linalg.eigvals(np.linalg.lstsq(O[:-1], O[1:], rcond=None)[0])))
    if np.abs(np.roots(den)).max() >= 1.0:
        return None
    num = np.zeros((len(delay), max(delay) + form.nb))
    for j, (p, d) in enumerate(zip(pulses, delay, strict=True)):
        G = np.asarray(lfilter([1.0], den, np.eye(length, form.nb), axis=0))
        num[j, d : d + form.nb] = np.linalg.lstsq(G, p, rcond=None)[0]
    level = model.level(np.zeros(len(delay))) if model.radius < 1.0 else 0.0
    return LinearModel(den, num, float(level * den.sum()) if form.offset else 0.0)


def _pulse(model: LinearModel, j: int, delay: int, length: int) -> Array:
    return np.asarray(lfilter(model.num[j], model.den, np.eye(1, delay + length)[0]))[delay:]


def toeplitz_rows(pulse: Array, rows: int) -> Array:
    """Hankel matrix of an impulse response."""
    return np.lib.stride_tricks.sliding_window_view(pulse, rows)[:rows]
