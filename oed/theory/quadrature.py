"""Quadrature over [0, pi] that resolves peaks of any sharpness: panels shrink towards chosen frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

__all__ = ["Nodes", "graded_nodes"]

POINTS = 16
"""Gauss-Legendre nodes per panel: a pole half a panel away is resolved to rounding."""
SMALLEST = 1e-15
"""Distance in rad/sample from a centre at which the panels stop shrinking."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Nodes of a quadrature, kept relative to the nearest centre so that tiny distances are exact.

    Attributes
    ----------
    centre : ndarray
        (K,) frequency of the centre that a node belongs to.
    offset : ndarray
        (K,) distance from it: omega = centre + offset.
    weight : ndarray
        (K,) weights; sum(weight * f) = (1/pi) * integral of f over [0, pi].
    """

    centre: NDArray[np.float64]
    offset: NDArray[np.float64]
    weight: NDArray[np.float64]

    @property
    def omega(self) -> NDArray[np.float64]:
        """Frequencies of the nodes in rad/sample."""
        return self.centre + self.offset


def graded_nodes(centres: Sequence[float]) -> Nodes:
    """Gauss-Legendre nodes on panels that halve towards every centre.

    Parameters
    ----------
    centres : sequence of float
        Frequencies in [0, pi] at or near which an integrand may have features of any width.

    Returns
    -------
    Nodes
        For integrals over [0, pi], which are half of those over (-pi, pi].
    """
    points = np.unique(np.concatenate([[0.0, np.pi], np.asarray(centres, dtype=float)]))
    points = points[np.concatenate([[True], np.diff(points) > 1e-12])]
    x, w = np.polynomial.legendre.leggauss(POINTS)
    centre, offset, weight = [], [], []
    for left, right in pairwise(points):
        half = (right - left) / 2
        levels = max(int(np.ceil(np.log2(half / SMALLEST))), 1)
        edges = np.concatenate([[0.0], half * 0.5 ** np.arange(levels, -1, -1.0)])
        middle, radius = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
        t = (middle[:, None] + radius[:, None] * x).ravel()
        wt = (radius[:, None] * w).ravel() / np.pi
        for start, sign in ((left, 1.0), (right, -1.0)):
            centre.append(np.full(t.size, start))
            offset.append(sign * t)
            weight.append(wt)
    order = np.argsort(np.concatenate(centre) + np.concatenate(offset), kind="stable")
    return Nodes(np.concatenate(centre)[order], np.concatenate(offset)[order], np.concatenate(weight)[order])
