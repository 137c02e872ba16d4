"""A delay between two samples: the input shifted by any fraction, and the fraction that fits best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oed.data import Record
from oed.errors import InputError
from oed.files.objects import as_records

if TYPE_CHECKING:
    from estimators.pem.fit import Fit

HALF = 24
"""Samples on each side of the interpolation kernel, a sinc under a Kaiser window: exact to 1e-4 up to 0.9 pi."""


@dataclass(frozen=True, eq=False)
class FractionalDelay:
    """A delay in samples, not a whole number. `delay` total delay of the first numerator coefficient, in
    samples; `standard_error` from the curvature of the profile likelihood; `fit` the model of the input
    shifted by the fraction, with the whole part as its nk; the covariance of its parameters includes what the
    uncertainty of the delay adds; `fraction` shift of the input, in samples."""

    delay: float
    standard_error: float
    fit: Fit
    fraction: float

    def __repr__(self) -> str:
        return f"delay {self.delay:.4f} +- {self.standard_error:.2g} samples\n{self.fit!r}"


def shifted(signal: NDArray, fraction: float) -> NDArray[np.float64]:
    """A band-limited signal later by a fraction of a sample: signal (N, n_channels) -> (N, n_channels)."""
    if abs(fraction) > 4:
        raise InputError(f"the shift is {fraction} samples; it must lie between -4 and 4: the rest is nk's.")
    if fraction == 0:
        return np.array(signal, dtype=float)
    whole = round(fraction)
    rest, k = fraction - whole, np.arange(-HALF, HALF + 1)
    window = np.i0(8.0 * np.sqrt(np.maximum(1 - ((k - rest) / (HALF + 1)) ** 2, 0))) / np.i0(8.0)
    kernel = np.sinc(k - rest) * window
    kernel = kernel / kernel.sum()
    signal = np.asarray(signal, dtype=float)
    padded = np.pad(signal, ((HALF + 4, HALF + 4), (0, 0)), mode="edge")
    at = slice(4 - whole, 4 - whole + len(signal))
    return np.column_stack([np.convolve(column, kernel, "valid")[at] for column in padded.T])


def estimate_fractional_delay(
    records: Record | Sequence[Record],
    structure: str = "oe",
    orders: Any = (1, 1),
    delay: int = 1,
    **options: Any,
) -> FractionalDelay:
    """The delay within one sample of nk under which a model fits best, with its standard error. The inputs
    are taken as band-limited. A second numerator coefficient imitates a fraction of a delay; with one the
    fraction is well determined."""
    from scipy.optimize import minimize_scalar

    from estimators.pem import identify

    given = as_records(records)
    total = sum(map(len, given))

    def fitted(fraction: float, **more: Any) -> Fit:
        moved = [r.replace(u=shifted(r.u, float(fraction))) for r in given]
        return identify(moved, structure, orders, delay, **{**more, **options})

    coarse = np.linspace(-1, 1, 9)
    fits = [fitted(x) for x in coarse]
    best = int(np.argmin([fit.loss for fit in fits]))
    near = {"start": fits[best].theta}  # from there on the optimum moves little
    low, high = coarse[max(best - 1, 0)], coarse[min(best + 1, 8)]
    log_loss = lambda fraction: float(np.log(fitted(fraction, **near).loss))
    found = minimize_scalar(log_loss, bounds=(low, high), method="bounded", options={"xatol": 1e-5})
    fraction = float(found.x)
    h, here = 0.02, fitted(fraction, **near)
    later, earlier = fitted(fraction + h, **near), fitted(fraction - h, **near)
    curvature = float(np.log(later.loss) + np.log(earlier.loss) - 2 * np.log(here.loss)) / h**2
    error = float(np.sqrt(2 / (total * curvature))) if curvature > 0 else float("inf")
    if np.isfinite(error):  # the parameters follow the delay, and so they share its uncertainty
        follow = (later.theta - earlier.theta) / (2 * h)
        here = replace(here, covariance=here.covariance + error**2 * np.outer(follow, follow))
    return FractionalDelay(delay + fraction, error, here, fraction)
