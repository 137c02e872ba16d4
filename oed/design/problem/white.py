"""White noise as the yardstick: its information, to rounding, by a mean over the circle, and its root on a grid."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from oed.covariances import real_gram, root_in_own_units
from oed.design.problem.information_maps import InformationMap
from oed.errors import InfeasibleDesign, NotIdentifiable
from oed.information import null_directions
from oed.theory.quadrature import graded_edges, panel_nodes, resolved_edges

NODES = 1e-10
"""Accuracy of the integrals on which the panels are chosen, relative to each."""


def information_nodes(
    information: InformationMap,
    beside: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    width: float = np.pi,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes (K,) on [0, pi] and weights of sum 1 that integrate the information to 1e-9. `beside` (K, m),
    real, is resolved too, jumps included; no panel is wider than `width`."""

    def resolved(omega: NDArray) -> NDArray[np.float64]:
        told = np.sum(np.abs(information.factor(omega)) ** 2, axis=(2, 3))
        return told if beside is None else np.concatenate([told, beside(omega)], axis=1)

    even = np.linspace(0, np.pi, int(np.ceil(np.pi / width)) + 1)
    edges = resolved_edges(resolved, graded_edges(0.0, np.pi, information.resonances, even), NODES)
    omega, weight = panel_nodes(edges[:-1], edges[1:])
    return omega.ravel(), weight.ravel() / np.pi


def mean_information(information: InformationMap) -> NDArray[np.float64]:
    """Information (n, n) of white noise of unit power in every channel, without the constant part."""
    omega, weight = information_nodes(information)
    flat = np.moveaxis(information.factor(omega) * np.sqrt(weight)[:, None, None, None], 1, 0)
    return real_gram(flat.reshape(information.n, -1))


def white_information(
    information: InformationMap, limits: Mapping[str, float], power: float
) -> NDArray[np.float64]:
    """Information of white noise of a total power, equal on all channels, with the constant part: returns (n, n)."""
    total = limits.get("input power", power)
    return information.constant + mean_information(information) * total / information.n_inputs


def told_together(rows: NDArray[np.float64]) -> NDArray[np.int64]:
    """The group (n,) of every parameter: those of different groups have no row (m, n) together, directly or through others."""
    from scipy.sparse.csgraph import connected_components

    present = (rows != 0).astype(float)
    return connected_components(present.T @ present > 0, directed=False)[1]


def white_root(information: InformationMap, D: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Triangular R with R'R = constant + mean over the grid of the information of unit power in every
    channel: D (K, n, ..) -> (n, n)."""
    n = information.n
    flat = np.moveaxis(D, 1, 0).reshape(n, -1) / np.sqrt(len(D))
    rows = np.concatenate([flat.real.T, flat.imag.T, root_in_own_units(information.constant)[0].T])
    scale = np.linalg.norm(rows, axis=0)
    if not np.isfinite(rows).all():
        raise InfeasibleDesign("the plant's response is not finite on the grid; it has a pole there.")
    dead = scale == 0
    few = len(rows) < n or dead.any()
    R = None if few else np.linalg.qr(rows / scale, mode="r")
    if R is None or np.abs(np.diag(R)).min() < 1e-13:
        M = rows.T @ rows
        combinations = null_directions(M, information.names) or ["some combination of the parameters"]
        raise NotIdentifiable(
            f"no input in the band tells anything about {'; '.join(combinations)}: fix one of these parameters, "
            "widen the band, or add prior information."
        )
    # What nothing tells of together has no rounding in common either.
    group = told_together(rows)
    return np.where(group[:, None] == group, R * scale, 0.0)
