"""Samples that a converter has rounded: the likelihood of their intervals, and what rounding leaves of their information."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import ndtr

Array = NDArray[Any]
LEVELS = (0.35, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
"""Multiples of a guess of the noise level between which its best value is looked for."""
SURE_LEVEL = 1e-3
"""Of that value: a standard error follows it, and is told to two digits."""
PHASES = 32
"""Places of the output within a step at which its information is taken; between them it is smooth, a sine nearly."""
FINE = 10.0
"""Steps in a standard deviation of the noise from which on rounding only adds a twelfth of a step's square to it, the same everywhere."""
LEAST_TOLD = 1e-3
"""Least share of the most informative place: in the middle of a step of twenty standard deviations nothing is told, and samples are not
weighed by nothing."""


def expected(y: Array, simulated: Array, step: float, sigma: float) -> Array:
    """Expected unrounded output within the rounding interval, given the simulated one (truncated normal)."""
    a = (y - step / 2 - simulated) / sigma
    b = (y + step / 2 - simulated) / sigma
    mass = ndtr(b) - ndtr(a)
    density = (np.exp(-0.5 * np.clip(a, -30, 30) ** 2) - np.exp(-0.5 * np.clip(b, -30, 30) ** 2)) / np.sqrt(
        2 * np.pi
    )
    inside = simulated + sigma * density / np.maximum(mass, 1e-12)
    return np.where(
        mass > 1e-9,
        np.clip(inside, y - step / 2, y + step / 2),
        np.clip(simulated, y - step / 2, y + step / 2),
    )


def deviance_residual(y: Array, simulated: Array, step: float, sigma: float) -> Array:
    """Signed residual whose square is -2 log of the probability of the rounding interval."""
    gap = y - simulated
    mass = ndtr((gap + step / 2) / sigma) - ndtr((gap - step / 2) / sigma)
    far = (np.abs(gap) - step / 2) / sigma  # beyond the tails' precision, their leading term
    value = np.where(
        mass > 1e-12, -2.0 * np.log(np.maximum(mass, 1e-12)), 55.3 + np.maximum(far**2 - 47.0, 0.0)
    )
    return np.sign(gap) * np.sqrt(np.maximum(value, 0.0))


def rounded_deviance(y: Array, simulated: Array, step: float, sigma: float) -> tuple[float, float]:
    """-2 log-likelihood of rounded samples, on the scale of n log(variance), the noise level maximised over."""

    def deviance(size: float) -> float:
        s = sigma * float(np.exp(size))
        mass = ndtr((y + step / 2 - simulated) / s) - ndtr((y - step / 2 - simulated) / s)
        return -2.0 * float(np.sum(np.log(np.maximum(mass, 1e-40))))

    places = np.log(LEVELS)
    at = int(np.argmin([deviance(x) for x in places]))
    within = places[max(at - 1, 0)], places[min(at + 1, len(places) - 1)]
    found = minimize_scalar(deviance, bounds=within, method="bounded", options={"xatol": SURE_LEVEL})
    size = min((float(found.x), float(places[at])), key=deviance)
    n = len(y)
    return deviance(size) + n * (2.0 * np.log(step) - 1.0 - np.log(2 * np.pi)), (
        sigma * float(np.exp(size))
    ) ** 2


def told(r: Array, step: float, sigma: float) -> Array:
    """(N,) share of a sample's information that its rounding leaves: the mean square, over all that could have been read, of what is
    expected of the error, over the noise's. Of a step of three standard deviations it is .50 to .65 by where in a step the output is."""
    if sigma > FINE * step:
        return np.full(len(r), 1.0 / (1.0 + (step / sigma) ** 2 / 12.0))
    reach = int(np.ceil(8.0 * sigma / step)) + 1
    place = np.linspace(-0.5, 0.5, PHASES + 1)
    edges = (np.arange(-reach, reach + 1) + 0.5 - place[:, None]) * step / sigma
    density = np.exp(-0.5 * np.clip(edges, -30, 30) ** 2) / np.sqrt(2 * np.pi)
    low, high = edges[:, :-1], edges[:, 1:]
    mass = np.where(low > 0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low))  # tails are told below 0 only
    share = np.sum(np.diff(density, axis=1) ** 2 / np.maximum(mass, 1e-30), axis=1)
    share = np.maximum(share, LEAST_TOLD * share.max())
    off = -r / step
    return np.interp(off - np.round(off), place, share)
