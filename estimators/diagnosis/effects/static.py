"""Static and time-dependent maps of the catalogue, as plain NumPy (twins of the CasADi terms)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "absolute",
    "arctangent",
    "clip",
    "dead_zone",
    "hyperbolic",
    "polynomial",
    "ramp_gain",
    "smooth_step",
]

Array = NDArray[Any]


def clip(signal: Array, low: float, high: float) -> Array:
    """Limit a signal to [low, high].

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    low : float
        Lower limit.
    high : float
        Upper limit.

    Returns
    -------
    ndarray
        (N,).
    """
    return np.minimum(np.maximum(signal, low), high)


def dead_zone(signal: Array, low: float, high: float) -> Array:
    """Zero between low <= 0 and high >= 0, the excess outside.

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    low : float
        Lower limit.
    high : float
        Upper limit.

    Returns
    -------
    ndarray
        (N,).
    """
    return np.maximum(signal - high, 0.0) + np.minimum(signal - low, 0.0)


def polynomial(signal: Array, c2: float, c3: float) -> Array:
    """x + c2 x^2 + c3 x^3.

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    c2 : float
        Coefficient of the square.
    c3 : float
        Coefficient of the cube.

    Returns
    -------
    ndarray
        (N,).
    """
    return signal * (1.0 + signal * (c2 + c3 * signal))


def absolute(signal: Array, c: float) -> Array:
    """x + c |x|: another gain for each sign.

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    c : float
        Difference of the gains.

    Returns
    -------
    ndarray
        (N,).
    """
    return signal + c * np.abs(signal)


def arctangent(signal: Array, c: float) -> Array:
    """atan(c x)/c, the identity for small c.

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    c : float
        Sharpness.

    Returns
    -------
    ndarray
        (N,).
    """
    return signal if abs(c) < 1e-9 else np.arctan(c * signal) / c


def hyperbolic(signal: Array, c: float) -> Array:
    """tanh(c x)/c, the identity for small c.

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    c : float
        Sharpness.

    Returns
    -------
    ndarray
        (N,).
    """
    return signal if abs(c) < 1e-9 else np.tanh(c * signal) / c


def ramp_gain(signal: Array, clock: Array, slope: float) -> Array:
    """(1 + slope t) x, with t in units of the training record.

    Parameters
    ----------
    signal : ndarray
        (N,) the signal.
    clock : ndarray
        (N,) time, in units of the training record's length.
    slope : float
        Relative change of the gain over the training record.

    Returns
    -------
    ndarray
        (N,).
    """
    return (1.0 + slope * clock) * signal


def smooth_step(clock: Array, at: float, width: float) -> Array:
    """0 before `at`, 1 after, linear over one sample of `width`.

    Parameters
    ----------
    clock : ndarray
        (N,) time, in units of the training record's length.
    at : float
        When the step happens, in the clock's units.
    width : float
        Length of one sample, in the clock's units.

    Returns
    -------
    ndarray
        (N,).
    """
    return np.clip((clock - at) / width, 0.0, 1.0)
