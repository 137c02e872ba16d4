"""Densities within masks: on panels that resolve them, each found by a price, and where they jump."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from oed.covariances import real_gram
from oed.design.problem.families import local_maxima, maxima_between
from oed.design.problem.lines import Problem
from oed.design.problem.masks import Masks, hermitian_root
from oed.theory.quadrature import graded_edges, panel_nodes, resolved_edges

ROUNDED = 1e-12
"""Excess of a worth over its cost, relative, that is rounding: where the price is flat its sign changes without end."""
MOST_JUMPS = 200
"""Jumps of a density: its price is a rational function and has no more; more are rounding, where it is flat."""
CUTS = 60
"""Times that the bracket of a jump is cut: a double has no more digits, and secants take about eight."""
HALVED = 3
"""Of so many cuts one halves the bracket, however little the secants gain."""
TINY = np.finfo(float).tiny
SOUGHT = 7
"""Times that the brackets of a peak between two nodes are cut to a quarter."""


@dataclass(frozen=True, eq=False)
class Panels:
    """Nodes and weights of the quadrature, (K,), and the masks there: R and B of `Masks.at`."""

    edges: NDArray[np.float64]
    omega: NDArray[np.float64]
    weight: NDArray[np.float64]
    R: NDArray[np.complex128]
    B: NDArray[np.complex128] | None

    @classmethod
    def on(cls, masks: Masks, edges: NDArray[np.float64]) -> Panels:
        """Panels between edges."""
        omega, weight = (part.ravel() for part in panel_nodes(edges[:-1], edges[1:]))
        return cls(edges, omega, weight / np.pi, *masks.at(omega))

    @classmethod
    def of(cls, masks: Masks, accuracy: float) -> Panels:
        """Panels that resolve masks and information."""
        information = masks.information

        def resolved(omega: NDArray) -> NDArray[np.float64]:
            R, B = masks.at(omega)
            told = np.sum(np.abs(information.factor(omega) @ R[:, None]) ** 2, axis=(2, 3))
            traces = [
                np.einsum("kii->k", part).real
                for part in (R @ R.conj().swapaxes(1, 2), B)
                if part is not None
            ]
            return np.column_stack([told, *traces])

        start = graded_edges(0.0, np.pi, information.resonances)
        return cls.on(masks, resolved_edges(resolved, start, accuracy))


@dataclass(frozen=True, eq=False)
class Density:
    """The density that a certificate (X, nu) finds worth most, as a function of frequency."""

    X: NDArray[np.float64]
    nu: float

    def worth(self, D: NDArray[np.complex128], limit: float) -> NDArray[np.complex128]:
        """T = S - nu I / P (K, nu, nu) from the scaled factors D (K, n, r, nu)."""
        K, n, r, q = D.shape
        E = (self.X.T @ np.moveaxis(D, 1, 0).reshape(n, K * r * q)).reshape(self.X.shape[1], K, r, q)
        E = E.swapaxes(0, 1).reshape(K, self.X.shape[1] * r, q)
        return E.conj().swapaxes(1, 2) @ E - self.nu / limit * np.eye(q)


class Pricing:
    """What densities of a problem under masks are worth, and their information, at the nodes of panels."""

    def __init__(self, problem: Problem, masks: Masks, limit: float) -> None:
        self.problem, self.masks, self.limit = problem, masks, limit
        self.last: tuple[Panels, NDArray[np.complex128]] | None = None
        self.found: dict[Density, tuple[NDArray[np.complex128], NDArray[np.float64]]] = {}

    def factor(self, panels: Panels) -> NDArray[np.complex128]:
        """Scaled factors at the nodes, kept while the panels stay."""
        if self.last is None or self.last[0] is not panels:
            self.last, self.found = (panels, self.problem.scaled_factor(panels.omega)), {}
        return self.last[1]

    def at(self, panels: Panels, one: Density) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
        """The density (K, nu, nu) at the nodes and a bound (K,) on the worth of every other, kept while the panels stay."""
        factor = self.factor(panels)  # forgets what was found on other panels
        if one not in self.found:
            self.found[one] = self.masks.most(panels.R, panels.B, one.worth(factor, self.limit))
        return self.found[one]

    def told(self, panels: Panels, phi: NDArray) -> NDArray[np.float64]:
        """Information (n, n) of a density at the nodes."""
        half = self.factor(panels) @ (hermitian_root(phi) * np.sqrt(panels.weight)[:, None, None])[:, None]
        return self.problem.constant + real_gram(np.moveaxis(half, 1, 0).reshape(half.shape[1], -1))

    def used(self, panels: Panels, phi: NDArray) -> float:
        """Share of the power of a density at the nodes."""
        return float(np.einsum("kii,k->", phi, panels.weight).real) / self.limit

    def within(self, omega: NDArray[np.float64], one: Density) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """The worth within the mask at some frequencies: D R (K, n, ny, q), R, and the eigenvalues (K, q) and -vectors of R^* T R."""
        R, D = self.masks.at(omega)[0], self.problem.scaled_factor(omega)
        T = one.worth(D, self.limit)
        values, vectors = np.linalg.eigh(R.conj().swapaxes(1, 2) @ T @ R)
        return D @ R[:, None], R, values, vectors

    def worth(self, omega: NDArray[np.float64], one: Density) -> tuple[NDArray, NDArray]:
        """R and the eigenvalues (K, q) alone, which is most of what is asked and a third of the work."""
        R = self.masks.at(omega)[0]
        T = one.worth(self.problem.scaled_factor(omega), self.limit)
        return R, np.linalg.eigvalsh(R.conj().swapaxes(1, 2) @ T @ R)

    def cut(self, panels: Panels, one: Density) -> Panels:
        """Panels with edges where the density jumps."""
        return panels if panels.B is not None else self.cut_at(panels, self.jumps(panels, one))

    def resolved(self, panels: Panels, one: Density, accuracy: float) -> Panels:
        """Panels with edges where the density jumps, that resolve it: of several inputs its directions turn between them."""

        def told(omega: NDArray) -> NDArray[np.float64]:
            DR, R, values, vectors = self.within(omega, one)
            above = vectors * (values > 0)[:, None]
            return np.column_stack([
                np.sum(np.abs(DR @ above[:, None]) ** 2, axis=(2, 3)), np.sum(np.abs(R @ above) ** 2, axis=(1, 2)),
            ])  # fmt: skip

        panels = self.cut(panels, one)
        return Panels.on(self.masks, resolved_edges(told, panels.edges, accuracy))

    def cut_at(self, panels: Panels, jumps: NDArray[np.float64]) -> Panels:
        """Panels with more edges."""
        edges = np.union1d(panels.edges, jumps)
        edges = edges[np.concatenate([[True], np.diff(edges) > 1e-15])]
        return Panels.on(self.masks, edges) if len(edges) > len(panels.edges) else panels

    def jumps(self, panels: Panels, one: Density) -> NDArray[np.float64]:
        """Where the number of positive eigenvalues of a density's worth changes."""

        def worth(omega: NDArray) -> NDArray[np.float64]:
            R, values = self.worth(omega, one)
            cost = one.nu * np.sum(np.abs(R) ** 2, axis=(1, 2)) / self.limit
            return values - ROUNDED * cost[:, None]

        points = np.union1d(panels.omega, panels.edges)
        values = worth(points)
        # A peak that is above 0 between two nodes only is nearly a line, and may be all of the density.
        for k, sign in product(range(values.shape[1]), (1.0, -1.0)):
            side = sign * values[:, k]
            at = local_maxima(side)
            left, right = np.maximum(at - 1, 0), np.minimum(at + 1, len(points) - 1)
            # Between nodes that resolve it a peak rises by less than it falls towards the next.
            near = (side[at] < 0) & (2 * side[at] > np.minimum(side[left], side[right]))
            if not near.any():
                continue
            low, high = points[left[near]], points[right[near]]
            peaks = maxima_between(lambda omega, k=k, sign=sign: sign * worth(omega)[:, k], low, high, SOUGHT)
            points = np.union1d(points, peaks)
            values = worth(points)
        count = np.count_nonzero(values > 0, axis=1)
        at = np.flatnonzero(count[1:] != count[:-1])
        at = at[: len(at) if len(at) <= MOST_JUMPS else 0]
        # The eigenvalue that changes its sign, or the first of those that do.
        which = values.shape[1] - np.maximum(count[at], count[at + 1])
        own = lambda omega, k: worth(omega)[np.arange(len(k)), which[k]]
        return changes_of_sign(own, (points[at], points[at + 1]), (values[at, which], values[at + 1, which]))


def changes_of_sign(
    function: Callable[[NDArray[np.float64], NDArray[np.int64]], NDArray[np.float64]], ends: tuple[NDArray, NDArray],
    values: tuple[NDArray, NDArray],
) -> NDArray[np.float64]:  # fmt: skip
    """Where each of several functions changes its sign between two ends (K,), to the last digits, by secants; the function takes one
    point each for some of them, and which."""
    low, high, below, above = (np.array(part, dtype=float) for part in (*ends, *values))
    for k in range(CUTS):
        least = 2 * np.finfo(float).eps * high
        open_ones = np.flatnonzero(high - low > 2 * least)
        if not len(open_ones):
            break
        a, b, fa, fb, least = (part[open_ones] for part in (low, high, below, above, least))
        # A step beside the end that is nearly right goes past the change of sign, and closes the bracket.
        near = np.minimum(least / (b - a), 0.5)
        share = np.full(len(a), 0.5) if k % HALVED == HALVED - 1 else fa / (fa - fb)
        middle = a + (b - a) * np.clip(share, near, 1 - near)
        value = function(middle, open_ones)
        # An end at 0 is on the side that is not positive, and keeps a sign for the secant.
        value = np.where(value == 0, -TINY, value)
        left = (value > 0) == (fa > 0)
        low[open_ones], high[open_ones] = np.where(left, middle, a), np.where(left, b, middle)
        below[open_ones], above[open_ones] = np.where(left, value, 0.5 * fa), np.where(left, 0.5 * fb, value)
    return high
