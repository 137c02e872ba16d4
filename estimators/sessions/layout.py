"""Where a method's N samples lie in what the rig sees: ramps, warm-up, periods, rest; and the way back.

From rest: the input is tapered by w over `ramp` samples at both ends, w symmetric in time. The method is given the
output tapered likewise, so that with the time reversal T it iterates on W G W, and T W G W is symmetric as T G is;
its norm is below that of G and tends to it as N grows. Without a ramp W is the identity.

Periodic: ramp in, warm-up periods, measured periods, ramp out; the measured periods are averaged, and their scatter
is the noise floor. The ramps lie outside the periods, so they change nothing once the transient has died out.

Either way a lead at the level may come first: it gives the resting output, which is taken off."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.sessions.settings import Settings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Measured:
    """What is left of a recorded output. `y` (N, ny) the measured part, averaged over the periods; `noise`
    (ny,) variance of the noise on one sample of y, from the scatter of the periods; NaN with one period."""

    y: Array
    noise: Array


def rig_samples(settings: Settings) -> int:
    """Rows of every input and output file."""
    around = settings.lead + settings.rest
    if not settings.periodic:
        return settings.samples + around
    return settings.samples * (settings.periods + settings.warm_up) + 2 * settings.ramp + around


def taper(settings: Settings) -> Array:
    """The weight w of every sample of an experiment from rest: returns (N, 1)."""
    w = np.ones((settings.samples, 1))
    if settings.ramp and not settings.periodic:
        rise = _rise(settings.ramp)
        w[: settings.ramp], w[-settings.ramp :] = rise, rise[::-1]
    return w


def _rise(ramp: int) -> Array:
    """Raised cosine from above 0 to below 1, (ramp, 1)."""
    return (0.5 - 0.5 * np.cos(np.pi * np.arange(1, ramp + 1) / (ramp + 1)))[:, None]


def placed(u: Array, settings: Settings) -> Array:
    """The whole input of an experiment as the rig sees it: u (N, nu)."""
    if settings.periodic:
        parts = [u] * (settings.periods + settings.warm_up)
        if settings.ramp:
            rise = _rise(settings.ramp)
            parts = [u[-settings.ramp :] * rise, *parts, u[: settings.ramp] * rise[::-1]]
    else:
        parts = [u * taper(settings)] if settings.ramp else [u]
    lead, rest = (np.zeros((n, u.shape[1])) for n in (settings.lead, settings.rest))
    whole = np.vstack([lead, *parts, rest])
    return whole + np.asarray(settings.level) if any(settings.level) else whole


def measured(y: Array, settings: Settings) -> Measured:
    """The measured part of a recorded output: warm-up discarded, periods averaged."""
    N, P = settings.samples, settings.periods
    if settings.lead:
        y, lead = y[settings.lead :], y[: settings.lead]
        y = y - lead[settings.lead // 2 :].mean(axis=0)
    if not settings.periodic:
        part, noise = y[:N], np.full(y.shape[1], np.nan)
    else:
        first = settings.ramp + settings.warm_up * N
        stack = y[first : first + P * N].reshape(P, N, y.shape[1])
        part = stack.mean(axis=0) if P > 1 else stack[0]
        noise = np.full(y.shape[1], np.nan)
        if P > 1:
            noise = np.sum((stack - part) ** 2, axis=(0, 1)) / (N * (P - 1)) / P
    return Measured(part - part.mean(axis=0) if settings.centre else part, noise)
