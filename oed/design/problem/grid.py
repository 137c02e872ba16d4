"""Frequency grids that follow the poles."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.design.problem.information_maps import InformationMap
from oed.errors import InputError

HALVINGS = 30
"""Of an interval of the grid: a billionth of it resolves poles within 1e-11 of the circle."""
TURN = 0.15
"""Distance of a factor from the straight line between its neighbours, relative: a turn of 1.1 rad between them."""
SMALL = 1e-3
"""Of an entry's root mean square over the grid: below it, it turns unseen."""
MOST = 20_000
"""Intervals halved at once: more are noise in the response."""
_OFFSETS = np.concatenate([[0.0], *(side * np.geomspace(0.03, 30, 24) for side in (-1, 1))])

MOST_POINTS = 100_000
"""Of the first grid: lines lie between them anyway, and the information at each takes memory."""


def bands_of(band: Sequence[float] | Sequence[Sequence[float]] | None) -> tuple[tuple[float, float], ...]:
    """Bands in increasing order, checked: band (low, high) -> (float, float)."""
    if band is None:
        return ((0.0, float(np.pi)),)
    array = np.asarray(band, dtype=float)
    rows = np.atleast_2d(array)
    if rows.shape[1:] != (2,) or not np.isfinite(rows).all():
        raise InputError(f"the band is {band!r}; give (low, high) in rad/sample, or several such pairs.")
    rows = rows[np.argsort(rows[:, 0])]
    if (rows[:, 0] > rows[:, 1]).any() or rows.min() < 0 or rows.max() > np.pi + 1e-12:
        raise InputError(
            f"the band {rows.tolist()} must have 0 <= low <= high <= pi (rad/sample; f Hz are 2 pi f dt)."
        )
    if (rows[1:, 0] <= rows[:-1, 1]).any():
        raise InputError(f"the bands {rows.tolist()} overlap; give disjoint ones.")
    return tuple((float(low), float(high)) for low, high in rows)


def within(points: NDArray[np.float64], bands: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
    """Those of some frequencies that lie in the bands."""
    return points[np.any([(points >= low) & (points <= high) for low, high in bands], axis=0)]


def denser(
    omega: NDArray, bands: tuple[tuple[float, float], ...], support: NDArray, scale: NDArray
) -> NDArray[np.float64]:
    """Points between those of a grid and, much closer, around a support (m,); scale (m,) over which the plant changes there."""
    offsets = np.concatenate([side * np.geomspace(1e-3, 0.3, 8) for side in (-1, 1)])
    near = (support[:, None] + scale[:, None] * offsets).ravel()
    return np.unique(within(np.concatenate([near, (omega[1:] + omega[:-1]) / 2]), bands))


def frequency_grid(
    information: InformationMap, bands: tuple[tuple[float, float], ...], points: int | ArrayLike
) -> NDArray[np.float64]:
    """Grid in the bands: uniform, and fine near the resonances; or the frequencies that were given; bands
    (float, float) -> (K,)."""
    if np.ndim(points):
        omega = np.unique(np.asarray(points, dtype=float))
        if not np.isfinite(omega).all() or omega[0] < 0 or omega[-1] > np.pi + 1e-12:
            raise InputError("the grid must hold finite frequencies in [0, pi] rad/sample.")
        inside = [omega[(omega >= low) & (omega <= high)] for low, high in bands]
    else:
        count = int(points)  # type: ignore[arg-type]
        if not 8 <= count <= MOST_POINTS:
            raise InputError(
                f"the grid has {count} points; at least 8 are needed, 400 are usual, {MOST_POINTS} are the most."
            )
        whole = np.concatenate(
            [np.linspace(0, np.pi, count), *(w + width * _OFFSETS for w, width in information.resonances)]
        )
        inside = []
        for low, high in bands:
            own = (
                np.linspace(low, high, max(3, int(np.ceil(count * (high - low) / np.pi))))
                if high > low
                else [low]
            )
            inside.append(np.concatenate([own, whole[(whole >= low) & (whole <= high)]]))
    omega = np.unique(np.concatenate(inside))
    if not np.ndim(points) and len(omega) > 1:
        omega = _resolved(information, omega, bands)
    if not len(omega):
        raise InputError(f"no grid frequency lies in the bands {bands}; widen them or give more points.")
    return omega


def _resolved(
    information: InformationMap, omega: NDArray[np.float64], bands: tuple[tuple[float, float], ...]
) -> NDArray[np.float64]:
    """The grid, halved wherever the information's factors turn too fast for it: poles that were not stated, long delays."""
    D = information.factor(omega)
    size = np.maximum(np.sqrt(np.mean(np.abs(D) ** 2, axis=0)), 1e-300)
    low, high, D = omega[:-1], omega[1:], D / size
    left, right, found = D[:-1], D[1:], [omega]
    starts = [band[0] for band in bands]
    inside = np.searchsorted(starts, low, side="right") == np.searchsorted(starts, high, side="right")
    low, high, left, right = low[inside], high[inside], left[inside], right[inside]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        between = information.factor(middle) / size
        off = np.abs(between - (left + right) / 2)
        length = np.maximum(np.maximum(np.abs(left), np.abs(right)), np.abs(between))
        # Entries that are small everywhere near matter little to any price.
        coarse = off > TURN * np.maximum(length, SMALL)
        again = coarse.reshape(len(middle), -1).any(axis=1)
        if not again.any() or len(middle) > MOST:
            break
        found.append(middle[again])
        low, middle, high = low[again], middle[again], high[again]
        left, between, right = left[again], between[again], right[again]
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
        left, right = np.concatenate([left, between]), np.concatenate([between, right])
    return np.unique(np.concatenate(found))
