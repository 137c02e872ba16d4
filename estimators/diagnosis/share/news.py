"""Whether a simulated run tells anything that a linear one-step predictor does not know: a test that linear records pass.

Unused blocks of a short record may be simulated better by luck, by an echo of the controller, or because the best linear
model of the search is not the best there is. The one-step errors of a long linear predictor of a linear record are noise
that nothing foretells, in a loop or not, whatever the noise's colour: what is predicted with the help of a run is either no
better, or the run knows something that is not linear (forecast encompassing, as Harvey, Leybourne and Newbold, JBES 1998).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.share.feedback import autoregression, whitened
from estimators.residual.algebra import delayed
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
COLUMNS = 1 / 3
"""Columns at most, as a share of the samples: the rest says how large the errors are."""
SINGULAR = 1e-7
"""Size of a direction, of the largest's, below which it is rounding: the simulated output of a record without noise is one."""


@dataclass(frozen=True, eq=False)
class Predictor:
    """A long linear one-step predictor of one output: what is left of the output, and the directions that are taken out."""

    counted: tuple[NDArray[np.bool_], ...]  # per record (N,)
    rows: tuple[NDArray[np.bool_], ...]  # of them, those with all lags
    measured: tuple[Array, ...]  # (N,)
    basis: Array  # (M, p) orthonormal
    left: Array  # (M,)

    @classmethod
    def of(
        cls, records: Sequence[Record], simulated: Sequence[Array], output: int, counted: Sequence[NDArray[np.bool_]]
    ) -> Predictor:  # fmt: skip
        """From records, the linear model's simulated outputs (N, ny) and the samples (N,) that count."""
        first = records[0]
        most = COLUMNS * sum(int(np.sum(c)) for c in counted) - OWN * first.n_outputs
        lags = int(np.clip(most // (first.n_outputs + first.n_inputs), 1, LAGS))
        tables, rows = [], []
        for r, y, use in zip(records, simulated, counted, strict=True):
            # A missing sample must not take all that look back on it.
            known = np.where(np.isfinite(r.y), r.y, y)
            signals = [*((x, range(1, lags + 1)) for x in known.T), *((x, range(lags + 1)) for x in r.u.T)]
            signals += [(x, range(OWN)) for x in y.T]
            table = np.concatenate([delayed(x[:, None], every) for x, every in signals], axis=1)
            begun = np.arange(len(r)) >= max(lags, OWN - 1)
            rows.append(use & begun & np.isfinite(table).all(axis=1))
            tables.append(table[rows[-1]])
        columns = np.concatenate(tables)
        columns = columns - columns.mean(axis=0)
        size = np.sqrt(np.mean(columns**2, axis=0))
        columns = np.column_stack((np.ones(len(columns)), columns / np.where(size > 0, size, 1.0)))
        basis, values, _ = np.linalg.svd(columns, full_matrices=False)
        basis = basis[:, values > SINGULAR * values[0]]
        measured = tuple(np.nan_to_num(r.y[:, output]) for r in records)
        target = np.concatenate([y[k] for y, k in zip(measured, rows, strict=True)])
        return cls(tuple(counted), tuple(rows), measured, basis, target - basis @ (basis.T @ target))

    def news(self, runs: Sequence[Array]) -> float:
        """Standard errors by which the one-step prediction with runs (N,) of unused blocks belongs beside the linear one.

        That prediction is the run and what an autoregression foretells of its error; only a positive weight is news.
        Infinite where the samples are too few to tell.
        """
        if len(self.left) < 2 * self.basis.shape[1]:
            return np.inf
        uses = [c & np.isfinite(run) for c, run in zip(self.counted, runs, strict=True)]
        errors = [
            np.where(use, y - np.nan_to_num(run), 0.0) for y, run, use in zip(self.measured, runs, uses, strict=True)
        ]  # fmt: skip
        noise = autoregression(errors, uses)
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
        return float(self.left @ told) / (float(np.sqrt(freedom * np.sum(rest**2))) + 1e-300)
