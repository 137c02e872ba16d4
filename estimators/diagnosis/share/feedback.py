"""Whether the input knows the noise: feedback, under which a regression on inputs would explain noise by its own echo."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chi2

from oed.data import Record

__all__ = ["autoregression", "delayed", "has_feedback", "whitened"]

Array = NDArray[np.float64]

ORDER = 10
"""Of the autoregressions that whiten: a noise that needs more is slow, and slow noise is no innovation."""
LEADS = 20
"""Samples by which an input may answer the noise."""
ALPHA = 1e-3
"""False-alarm rate: with feedback only what improves the one-step prediction counts, a hard demand elsewhere."""


def autoregression(signals: Sequence[Array], uses: Sequence[NDArray[np.bool_]]) -> Array:
    """(ORDER + 1,) whitening filter, leading 1, by least squares over records (N,) on the samples in use."""
    rows, targets = [], []
    for x, use in zip(signals, uses, strict=True):
        x = np.where(use, x, 0.0)
        lags = np.stack([np.concatenate((np.zeros(i), x[:-i])) for i in range(1, ORDER + 1)], axis=1)
        rows.append(lags[use])
        targets.append(x[use])
    A, b = np.concatenate(rows), np.concatenate(targets)
    ridge = 1e-9 * (float(b @ b) + 1e-300) * np.eye(ORDER)
    return np.concatenate(([1.0], -np.linalg.solve(A.T @ A + ridge, A.T @ b)))


def whitened(filter_: Array, x: Array) -> Array:
    """(N,) or (N, p) signals through a whitening filter, at rest at the first sample's level."""
    return np.asarray(lfilter(filter_, [1.0], x - x[0], axis=0)) + filter_.sum() * x[0]


def delayed(record: Record) -> Record:
    """The record with its inputs one sample late: under feedback the present input may hold the present noise."""
    return record.replace(u=np.concatenate((record.u[:1], record.u[:-1])))


def has_feedback(
    records: Sequence[Record], residual: Sequence[Array], uses: Sequence[NDArray[np.bool_]]
) -> bool:
    """Whether whitened residuals correlate with later whitened inputs, which no cause in the plant can bring about.

    N times the sum of squared correlations at LEADS leads of all inputs is chi-square without feedback.
    """
    noise = autoregression(residual, uses)
    whole = [np.ones(len(r), dtype=bool) for r in records]
    statistic, degrees = 0.0, 0
    for j in range(records[0].n_inputs):
        u = [r.u[:, j] - r.u[:, j].mean() for r in records]
        own = autoregression(u, whole)
        products, sizes, count = np.zeros(LEADS), np.zeros(2), 0
        for x, e, use in zip(u, residual, uses, strict=True):
            a, v = whitened(noise, np.where(use, e, 0.0)) * use, whitened(own, x)
            sizes, count = sizes + np.array([a @ a, v @ v]), count + int(use.sum())
            products += np.array([a[:-lead] @ v[lead:] for lead in range(1, LEADS + 1)])
        statistic += count * float(np.sum(products**2)) / max(float(np.prod(sizes)), 1e-300)
        degrees += LEADS
    return bool(chi2.sf(statistic, degrees) < ALPHA)
