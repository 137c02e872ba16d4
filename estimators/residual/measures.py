"""How well a model fits, as one number."""

import math

import numpy as np
from numpy.typing import NDArray


def window_of(initial: str, skip: int) -> int:
    """Samples that set the state of a simulation where `skip` are not judged: none of a model fitted from rest."""
    return 0 if initial == "zero" else skip


def fit_percent(y: NDArray, y_hat: NDArray) -> float:
    """100 (1 - |y - y_hat| / |y - mean y|), the mean over outputs: y, y_hat (N, ny), measured and modelled;
    rows with NaN in y are left out. 100 is perfect, 0 no better than the mean."""
    values = []
    for i in range(y.shape[1]):
        known, error = y[:, i], y[:, i] - y_hat[:, i]
        if np.isnan(known).any():
            error, known = error[np.isfinite(known)], known[np.isfinite(known)]
        about = known - known.sum() / max(len(known), 1)
        size = float(about @ about)
        if size > 0:
            values.append(100 * (1 - np.sqrt(float(error @ error) / size)))
    return float(np.mean(values)) if values else float("nan")


def in_ranges(lags: NDArray[np.int64]) -> str:
    """Whole numbers (n,) in order, those that follow each other as a range: "1 to 5, 9"."""
    runs = np.split(lags, np.flatnonzero(np.diff(lags) != 1) + 1) if lags.size else []
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)


PLAIN = 1e-4, 1e6
"""Sizes of numbers that are printed without an exponent."""


def per(over: str, under: str) -> str:
    """A unit over another: (l/min)/V."""
    return "/".join(f"({unit})" if "/" in unit else unit for unit in (over, under))


def stated(value: float, error: float) -> str:
    """A value and its standard error to two digits of the error, which is not known of a threshold between samples: no
    derivative tells it."""
    if not math.isfinite(error):
        return f"{value:.4g} +- unknown"
    if not PLAIN[0] <= error <= max(abs(value), error) < PLAIN[1]:
        return f"{value:.4g} +- {error:.2g}"
    decimals = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{decimals}f} +- {error:.{decimals}f}"


def p_stated(p: float, digits: int = 2) -> str:
    """A p-value as it is printed: "p = 0.03"; what has left the range of doubles is not called 0."""
    return f"p = {p:.{digits}g}" if p else "p < 1e-300"
