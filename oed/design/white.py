"""White noise as the yardstick: its information, to rounding, by a mean over the circle."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from oed.design.maps import InformationMap

__all__ = ["white_information"]


def mean_information(information: InformationMap) -> NDArray[np.float64]:
    """Information of white noise of unit power in every channel, without the constant part.

    Parameters
    ----------
    information : InformationMap
        The model.

    Returns
    -------
    ndarray
        (n, n); midpoint rule on a grid that doubles until it no longer changes.
    """
    previous = None
    for points in 2 ** np.arange(8, 18):
        omega = (np.arange(points) + 0.5) * np.pi / points
        value = np.zeros((information.n,) * 2)
        for part in np.array_split(omega, max(1, points // 4096)):
            flat = np.moveaxis(information.factor(part), 1, 0).reshape(information.n, -1)
            value += (flat.real @ flat.real.T + flat.imag @ flat.imag.T) / points
        if previous is not None and np.abs(value - previous).max() <= 1e-12 * np.abs(value).max():
            break
        previous = value
    return value


def white_information(
    information: InformationMap, limits: Mapping[str, float], used: Mapping[str, float], power: float
) -> NDArray[np.float64]:
    """Information of white noise of a given total power, equal on all channels, with the constant part.

    Parameters
    ----------
    information : InformationMap
        The model.
    limits : mapping
        Budget name -> limit; the input power where it is limited.
    used : mapping
        Budget name -> what the design uses.
    power : float
        Total power where the limits do not state it.

    Returns
    -------
    ndarray
        (n, n).
    """
    total = limits.get("input power", power)
    return information.constant + mean_information(information) * total / information.n_inputs
