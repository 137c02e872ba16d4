"""Whether a simulated run tells anything that a linear predictor does not know: a test that linear records pass.

Unused blocks of a short record may be simulated better by luck, by an echo of the controller, or because the best linear
model of the search is not the best there is. The one-step errors of a long linear predictor of a linear record are noise
that nothing foretells, in a loop or not, whatever the noise's colour: what is predicted with the help of a run is either no
better, or the run knows something that is not linear (forecast encompassing, as Harvey, Leybourne and Newbold, JBES 1998).
Where what is missing is slow beside the sampling, the output's own past foretells it as well: then the same is asked of what
the inputs alone foretell, where no input answers the noise, with the error's own colour in the standard error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.share.feedback import autoregression, whitened
from estimators.residual.algebra import delayed, sum_error, thin_svd
from oed.data import Record

Array = NDArray[np.float64]

LAGS = 60
"""Lags of all outputs and inputs that the predictor knows: with 10 to 40, poles of several plants in one output and slow noise
were news to it on linear records."""
OWN = 10
"""Lags of the linear model's simulated outputs beside them: what few of the record's own lags express badly, slow poles."""
NEWS = 1.645
"""Standard errors from which on it is news: one-sided 5 %, since other thresholds guard the claim too; of records whose true
effect was known all but one had more than 2.7, simulated linear ones at most 2.8."""
FREE, STRETCHES = 4.0, 20
"""Standard errors where the inputs alone foretell, and the stretches of the records that they come from: noise may be slow. Of curves
fitted to such noise of 370 samples (a memory of 50) that seemed to gain something, one in forty has more, of 1000 none in 67."""
SLOWER = 0.25
"""Longest time constant, of a record's length, of the inputs through lags (each twice as slow as the one before, from LAGS / 2
samples on) that are beside their last samples where these alone foretell: dynamics that the linear model lacks may be slow."""
COLUMNS = 1 / 3
"""Columns at most, as a share of the samples: the rest says how large the errors are."""
SINGULAR = 1e-7
"""Size of a direction, of the largest's, below which it is rounding: the simulated output of a record without noise is one."""


@dataclass(frozen=True, eq=False)
class Predictor:
    """A long linear predictor of one output: what is left of the output, and the directions that are taken out."""

    counted: tuple[NDArray[np.bool_], ...]  # per record (N,)
    rows: tuple[NDArray[np.bool_], ...]  # of them, those with all lags
    measured: tuple[Array, ...]  # (N,)
    basis: Array  # (M, p) orthonormal
    left: Array  # (M,)
    past: bool = True  # whether it knows past outputs: one step ahead; else it knows the inputs alone

    @classmethod
    def of(
        cls, records: Sequence[Record], simulated: Sequence[Array], output: int, counted: Sequence[NDArray[np.bool_]],
        *, past: bool = True,
    ) -> Predictor:  # fmt: skip
        """From records, the linear model's simulated outputs (N, ny) and the samples (N,) that count."""
        first = records[0]
        most = COLUMNS * sum(int(np.sum(c)) for c in counted) - OWN * first.n_outputs
        lags = int(np.clip(most // (first.n_outputs + first.n_inputs), 1, LAGS))
        tables, rows = [], []
        for r, y, use in zip(records, simulated, counted, strict=True):
            # A missing sample must not take all that look back on it.
            known = np.where(np.isfinite(r.y), r.y, y)
            signals = [(x, range(1, lags + 1)) for x in known.T] if past else [(x, (0,)) for x in _slow(r.u)]
            signals += [(x, range(lags + 1)) for x in r.u.T] + [(x, range(OWN)) for x in y.T]
            table = np.concatenate([delayed(x[:, None], every) for x, every in signals], axis=1)
            begun = np.arange(len(r)) >= max(lags, OWN - 1)
            rows.append(use & begun & np.isfinite(table).all(axis=1))
            tables.append(table[rows[-1]])
        columns = np.concatenate(tables)
        columns = sized(columns - columns.mean(axis=0))
        basis = directions(np.column_stack((np.ones(len(columns)), columns)))
        measured = tuple(np.nan_to_num(r.y[:, output]) for r in records)
        target = np.concatenate([y[k] for y, k in zip(measured, rows, strict=True)])
        left = target - basis @ (basis.T @ target)
        return cls(tuple(counted), tuple(rows), measured, basis, left, past)

    def beside(self, signals: Sequence[Array]) -> Predictor:
        """The same that knows the last samples of a signal (N,) of each record too."""
        tables = [delayed(x[:, None], range(OWN)) for x in signals]
        more = sized(np.concatenate([t[k] for t, k in zip(tables, self.rows, strict=True)]))
        more = directions(more - self.basis @ (self.basis.T @ more), float(np.sqrt(len(more))))
        basis, left = np.hstack((self.basis, more)), self.left - more @ (more.T @ self.left)
        return replace(self, basis=basis, left=left)

    def news(self, runs: Sequence[Array]) -> float:
        """Standard errors by which a prediction with runs (N,) of unused blocks belongs beside the linear one.

        One step ahead that prediction is the run and what an autoregression foretells of its error, else the run itself; only
        a positive weight is news. Infinite where the samples are too few to tell.
        """
        if len(self.left) < 2 * self.basis.shape[1]:
            return np.inf
        uses = [c & np.isfinite(run) for c, run in zip(self.counted, runs, strict=True)]
        errors = [
            np.where(use, y - np.nan_to_num(run), 0.0) for y, run, use in zip(self.measured, runs, uses, strict=True)
        ]  # fmt: skip
        noise = autoregression(errors, uses) if self.past else np.ones(1)
        told = np.concatenate(
            [
                (y - whitened(noise, e))[k]
                for y, e, k in zip(self.measured, errors, self.rows, strict=True)
            ]
        )  # fmt: skip
        told = told - self.basis @ (self.basis.T @ told)
        weight = float(self.left @ told) / (float(told @ told) + 1e-300)
        rest = (self.left - weight * told) * told
        freedom = len(rest) / max(1, len(rest) - self.basis.shape[1])
        if self.past:
            error = float(np.sqrt(np.sum(rest**2)))
        else:  # the larger of what stretches show and what two signals that know nothing of one another would
            stretches = [float(part.sum()) for part in np.array_split(rest, STRETCHES)]
            error = max(sum_error(np.array(stretches)), _by_chance(self.left - weight * told, told))
        return float(self.left @ told) / (float(np.sqrt(freedom)) * error + 1e-300)


def _by_chance(first: Array, second: Array) -> float:
    """Standard deviation of the sum of products of two stationary signals (N,), from their autocovariances (Bartlett)."""
    n = 2 * len(first)
    a, b = (np.fft.irfft(np.abs(np.fft.rfft(x, n)) ** 2, n) for x in (first, second))
    return float(np.sqrt(max(float(a @ b), 0.0) / len(first)))


def sized(columns: Array) -> Array:
    """The columns (M, p) at mean squares of one."""
    size = np.sqrt(np.mean(columns**2, axis=0))
    return columns / np.where(size > 0, size, 1.0)


def directions(columns: Array, whole: float = 0.0) -> Array:
    """(M, p) orthonormal directions of columns, but for what is rounding beside the largest of them or beside a `whole`."""
    basis, values, _ = thin_svd(columns)
    return basis[:, values > SINGULAR * max(values[0], whole)]


def _slow(u: Array) -> list[Array]:
    """The inputs (N, nu) through lags that remember longer than their last samples do."""
    count = max(0, int(np.log2(max(1.0, 2.0 * SLOWER * len(u) / LAGS))) + 1)
    keep = np.exp(-1.0 / (0.5 * LAGS * 2.0 ** np.arange(count)))
    return [np.asarray(lfilter([1.0 - k], [1.0, -k], x - x[0])) for k in keep for x in u.T]
