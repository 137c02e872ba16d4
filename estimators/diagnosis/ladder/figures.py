"""Errors on data not used with their intervals: those of the same record, measured again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.result.report import ErrorFigure
from estimators.residual.algebra import mean_error
from oed.covariances import NORMAL

Array = NDArray[Any]
LONGEST = 300.0
"""Of the logarithm of an interval's half width: what is known so badly has every value, and exp must not overflow."""


def root(e: Array) -> float:
    """Root mean square of errors (N, ny), their squares added over the outputs."""
    return float(np.sqrt(np.mean(np.sum(e**2, axis=1))))


def moves(e: Array, noise: Array) -> Array:
    """(N,) what each sample's noise adds to the root mean square of errors (N, ny), to first order, times N.

    What a model makes of the inputs stays as it is when a record is measured again: errors e are e - noise, and `noise` anew.
    """
    return ((e - noise / 2.0) * noise).sum(axis=1) / max(root(e), 1e-300)


def root_figure(e: Array, noise: Array) -> ErrorFigure:
    """Root mean square of errors (N, ny), with an interval that is even in its logarithm: that of the same record, measured again."""
    value = root(e)
    wide = float(np.exp(min(NORMAL * mean_error(moves(e, noise)) / max(value, 1e-300), LONGEST)))
    return ErrorFigure(value, value / wide, value * wide)


def together(errors: Sequence[Array], noises: Sequence[Array]) -> ErrorFigure:
    """The same of several outputs: errors and noises (N,) of each, NaN where they do not count; where no noise is known, from the
    errors alone."""
    counted = np.isfinite(np.column_stack(errors))
    if any(np.any(np.isinf(e)) for e in errors):
        return ErrorFigure(np.inf, np.inf, np.inf)
    rows = counted.any(axis=1)

    def weighted(series: Sequence[Array]) -> Array:
        return np.where(counted, np.column_stack(series), 0.0)[rows] / np.sqrt(
            counted[rows].sum(axis=1, keepdims=True)
        )

    known = not any(np.any(np.isinf(e)) for e in noises)
    return root_figure(weighted(errors), weighted(noises if known else errors))


def difference_figure(first: Array, second: Array) -> ErrorFigure:
    """The difference of two such roots; the noise is what the second leaves."""
    return about(root(first) - root(second), mean_error(moves(first, second) - moves(second, second)))


def about(value: float, error: float) -> ErrorFigure:
    """A value with a standard error."""
    return ErrorFigure(value, value - NORMAL * error, value + NORMAL * error)
