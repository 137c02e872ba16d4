"""White noise as the yardstick: its information, to rounding, by a mean over the circle, and its root on a grid."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from oed.design.problem.information_maps import InformationMap
from oed.errors import InfeasibleDesign, NotIdentifiable
from oed.information import null_directions

__all__ = ["white_information", "white_root"]


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


def white_root(information: InformationMap, D: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Triangular R with R'R = constant + mean over the grid of the information of unit power in every channel.

    Parameters
    ----------
    information : InformationMap
        The model.
    D : ndarray
        (K, n, ..) factors of the information on the grid.

    Returns
    -------
    ndarray
        (n, n).

    Raises
    ------
    InfeasibleDesign
        The response is not finite on the grid.
    NotIdentifiable
        No input tells some combination of the parameters.
    """
    n = information.n
    flat = np.moveaxis(D, 1, 0).reshape(n, -1) / np.sqrt(len(D))
    values, vectors = np.linalg.eigh(information.constant)
    prior = (vectors * np.sqrt(np.clip(values, 0, None))).T
    rows = np.concatenate([flat.real.T, flat.imag.T, prior])
    scale = np.linalg.norm(rows, axis=0)
    if not np.isfinite(rows).all():
        raise InfeasibleDesign(
            "the plant's response is not finite on the frequency grid; it has a pole there."
        )
    dead = scale == 0
    R = np.linalg.qr(rows / np.where(dead, 1.0, scale), mode="r") if not dead.any() else None
    if R is None or np.abs(np.diag(R)).min() < 1e-13:
        M = rows.T @ rows
        combinations = null_directions(M, information.names) or ["some combination of the parameters"]
        raise NotIdentifiable(
            f"no input in the band tells anything about {'; '.join(combinations)}: fix one of these parameters, "
            "widen the band, or add prior information."
        )
    return R * scale
