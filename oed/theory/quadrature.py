"""Quadrature over [0, pi] that resolves peaks of any sharpness: panels shrink towards chosen frequencies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

POINTS = 16
"""Gauss-Legendre nodes per panel: a pole half a panel away is resolved to rounding."""
SMALLEST = 1e-15
"""Distance in rad/sample from a centre at which the panels stop shrinking, unless narrower peaks are to be resolved."""

PANEL_POINTS = 10
"""Gauss-Legendre nodes per panel: exact for polynomials of degree 19; a pole one panel away costs 1e-10."""
MOST_PANELS = 20_000
"""Panels halved at once: more are noise in the integrand, which halving does not resolve."""
ROUNDING = 1e-13
"""Entries smaller than this share of the largest are taken for its rounding."""
DEEPEST = 60
"""Halvings of a panel: below 1e-18 of it a float has no frequencies left, whatever the integrand."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Nodes of a quadrature, kept relative to the nearest centre so that tiny distances are exact. `centre`
    (K,) frequency of the centre that a node belongs to; `offset` (K,) distance from it: omega = centre +
    offset; `weight` (K,) weights; sum(weight * f) = (1/pi) * integral of f over [0, pi]."""

    centre: NDArray[np.float64]
    offset: NDArray[np.float64]
    weight: NDArray[np.float64]

    @property
    def omega(self) -> NDArray[np.float64]:
        """Frequencies of the nodes in rad/sample."""
        return self.centre + self.offset


def graded_nodes(centres: Sequence[float], smallest: float = SMALLEST) -> Nodes:
    """Gauss-Legendre nodes on panels that halve towards every centre, down to a distance of `smallest`."""
    points = np.unique(np.concatenate([[0.0, np.pi], np.asarray(centres, dtype=float)]))
    points = points[np.concatenate([[True], np.diff(points) > 1e-12])]
    x, w = np.polynomial.legendre.leggauss(POINTS)
    centre, offset, weight = [], [], []
    for left, right in pairwise(points):
        half = (right - left) / 2
        levels = max(int(np.ceil(np.log2(half / smallest))), 1)
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


def panel_nodes(low: NDArray, high: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes and weights (panels, PANEL_POINTS) of Gauss and Legendre on the panels from low to high, both (panels,)."""
    x, w = np.polynomial.legendre.leggauss(PANEL_POINTS)
    half = (high - low)[:, None] / 2
    return (low + high)[:, None] / 2 + half * x, half * w


def graded_edges(low: float, high: float, resonances: NDArray, inner: ArrayLike = ()) -> NDArray[np.float64]:
    """Edges of panels in [low, high] whose widths double away from every resonance, (R, 2) frequency and half width."""
    edges = [np.linspace(low, high, 9), np.asarray(inner, dtype=float)]
    for centre, width in resonances:
        steps = width * 2.0 ** np.arange(0, max(1, np.ceil(np.log2(np.pi / width))))
        edges.append(centre + np.concatenate([-steps, [0.0], steps]))
    flat = np.concatenate(edges)
    flat = np.unique(flat[(flat >= low) & (flat <= high)])
    # Two resonances closer than a thousandth of their width share a panel.
    return flat[np.concatenate([[True], np.diff(flat) > 1e-14 * np.pi])]


def integral(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    edges: NDArray[np.float64],
    tolerance: float = 1e-12,
) -> NDArray[np.float64]:
    """Integral of a real function omega (K,) -> (K, ..) over the panels between edges. A panel is halved
    until its two halves together agree with it to `tolerance` of the integral of the absolute value, entry by
    entry: kinks and jumps are closed in on, at one panel per halving."""
    return _adapted(function, edges, tolerance)[0]


def resolved_edges(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    edges: NDArray[np.float64],
    tolerance: float = 1e-12,
) -> NDArray[np.float64]:
    """The edges with which `integral` ends, so that other integrals may share them."""
    return _adapted(function, edges, tolerance)[1]


def _adapted(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]], edges: NDArray, tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The integral, and the edges of the panels on which it was found."""

    def panels(low: NDArray, high: NDArray) -> NDArray[np.float64]:
        omega, weight = panel_nodes(low, high)
        values = function(omega.ravel())
        lift = (...,) + (None,) * (values.ndim - 1)
        parts = values.reshape(*omega.shape, *values.shape[1:]) * weight[lift]
        return np.stack([parts.sum(axis=1), np.abs(parts).sum(axis=1)])

    low, high = edges[:-1], edges[1:]
    value, size = panels(low, high)
    done, scale, found = np.zeros(value.shape[1:]), size.sum(axis=0), [edges]
    for _ in range(DEEPEST):
        middle = (low + high) / 2
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
        halves, size = panels(low, high)
        together = halves[: len(middle)] + halves[len(middle) :]
        scale = np.maximum(scale, size.sum(axis=0))
        level = tolerance * np.maximum(scale, ROUNDING * scale.max())
        unsettled = (np.abs(together - value) > level).reshape(len(middle), -1).any(axis=1)
        done = done + together[~unsettled].sum(axis=0)
        if not unsettled.any() or len(middle) > MOST_PANELS:
            done = done + together[unsettled].sum(axis=0)
            break
        found.append(middle[unsettled])
        again = np.concatenate([unsettled, unsettled])
        low, high, value = low[again], high[again], halves[again]
    else:
        done = done + value.sum(axis=0)
    return done, np.unique(np.concatenate(found))
