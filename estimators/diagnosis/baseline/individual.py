"""Linear models in which every input has poles of its own: y = sum_j B_j / F_j u_j + c.

With poles in common the order is the sum of all, and numerators must cancel what an input does not have: on records of some
hundred samples such a fit ends far from the noise, and whatever mends it looks like an effect.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.baseline.output_error import realised
from estimators.diagnosis.baseline.regression import Arx, lagged_inputs
from oed.data import Record

Array = NDArray[Any]

UNDRIVEN = 0.5
"""Pole of an input whose response is too small to have one, and of what a zero cancels."""


@dataclass(frozen=True, eq=False)
class Individual:
    """Fits of one form to one output of some records.

    `form` orders of each input's own part: of F, of B, delays, offset; `prior` of the outputs before each record.
    """

    records: Sequence[Record]
    output: int
    form: Arx
    prior: Prior
    limit: float = 1.0

    @property
    def size(self) -> int:
        """Number of parameters of the model."""
        f = self.form
        return (f.na + f.nb) * len(f.delay) + f.offset

    @property
    def common(self) -> Arx:
        """The form of the same model over one denominator."""
        f, more = self.form, (len(self.form.delay) - 1) * self.form.na
        return Arx(f.na + more, f.nb + more, f.delay, f.offset)

    def start(self, model: LinearModel, lags: int) -> Array:
        """(p,) parameters near a model: its responses to each input reduced to few poles, at rest before each record."""
        f, theta = self.form, []
        for j, delay in enumerate(f.delay):
            alone = LinearModel(model.den, model.num[j : j + 1])
            part = realised(alone, Arx(f.na, f.nb, (delay,), False), lags)
            if part is None:
                part = LinearModel(np.poly(np.full(f.na, UNDRIVEN)), np.zeros((1, delay + f.nb)))
            theta += [part.den[1:], part.num[0, delay : delay + f.nb]]
        level = model.constant / model.den.sum() if model.radius < 1.0 else self.prior.mean
        states = 0 if self.prior.rest else f.na * len(f.delay) * len(self.records)
        return np.concatenate((*theta, [level] * f.offset, np.zeros(states)))

    def grown(self, theta: Array) -> Array:
        """(p,) parameters of the same model as one with a pole less for each input: a zero cancels each further pole."""
        f, extra = self.form, np.array([1.0, -UNDRIVEN])
        fewer = Individual(self.records, self.output, replace(f, na=f.na - 1, nb=f.nb - 1), self.prior)
        parts = [
            np.concatenate((np.convolve(den, extra)[1:], np.convolve(b, extra)))
            for den, b in fewer._split(theta)
        ]
        states = 0 if self.prior.rest else f.na * len(f.delay) * len(self.records)
        return np.concatenate((*parts, theta[fewer.size - f.offset : fewer.size], np.zeros(states)))

    def _split(self, theta: Array) -> list[tuple[Array, Array]]:
        """Denominator and numerator of each input."""
        n, each = self.form.na, self.form.na + self.form.nb
        rows = theta[: each * len(self.form.delay)].reshape(-1, each)
        return [(np.concatenate(([1.0], row[:n])), row[n:]) for row in rows]

    def model(self, theta: Array) -> LinearModel:
        """The model of all inputs, over one denominator."""
        f, parts = self.form, self._split(theta)
        num = np.zeros((len(parts), max(f.delay) + self.common.nb))
        for j, ((_, b), delay) in enumerate(zip(parts, f.delay, strict=True)):
            row = reduce(np.convolve, [den for i, (den, _) in enumerate(parts) if i != j], b)
            num[j, delay : delay + len(row)] = row
        den = reduce(np.convolve, [den for den, _ in parts])
        level = float(theta[self.size - 1] * den.sum()) if f.offset else 0.0
        return LinearModel(den, num, level, np.std(np.concatenate([r.u for r in self.records]), axis=0))

    def local(self, theta: Array, rows: Sequence[NDArray[np.bool_]]) -> tuple[float, Array, Array]:
        """Mean square, half its negative gradient and the Gauss-Newton matrix."""
        f, parts = self.form, self._split(theta)
        gram, count = np.zeros((len(theta) + 1, len(theta) + 1)), 0
        for k, (record, used) in enumerate(zip(self.records, rows, strict=True)):
            n, states, columns, run, free = len(record), [], [], np.zeros(len(record)), f.na * len(parts)
            X = lagged_inputs(record, f, self.prior.rest)
            for j, (den, b) in enumerate(parts):
                W = _settled(den, X[:, j * f.nb : (j + 1) * f.nb])
                y = W @ b
                v = _settled(den, y[:, None])[:, 0]
                columns += [-np.concatenate((np.full(i, v[0]), v[: n - i])) for i in range(1, f.na + 1)]
                columns += list(W.T)
                run += y
                if not self.prior.rest:
                    states += list(lfilter([1.0], den, np.eye(f.na, n), axis=1))
            columns += [np.ones(n)] if f.offset else []
            at = self.size + k * free
            if states:
                run += theta[at : at + free] @ np.array(states)
            run += theta[self.size - 1] if f.offset else 0.0
            e = record.y[:, self.output] - run
            keep = used & np.isfinite(e)
            Z = np.stack([*columns, *states, e], axis=1)[keep]
            count += len(Z)
            where = np.concatenate((np.arange(self.size), np.arange(at, at + len(states)), [len(theta)]))
            gram[np.ix_(where, where)] += Z.T @ Z  # pyright: ignore[reportCallIssue]
        loss, gradient, hessian = gram[-1, -1], gram[:-1, -1].copy(), gram[:-1, :-1]
        extra = np.arange(
            self.size, len(theta)
        )  # a record starts settled, as far as the output's spread allows
        weight = loss / max(count, 1) / max(float(self.prior.covariance[0]), 1e-300)
        hessian[extra, extra] += weight
        gradient[extra] -= weight * theta[extra]
        return loss / max(count, 1), gradient, hessian


def _settled(den: Array, X: Array) -> Array:
    """Columns (N, p) through 1/den, settled under their first values before."""
    return X[:1] / den.sum() + np.asarray(lfilter([1.0], den, X - X[:1], axis=0))
