"""Physical layouts: where in a plant an effect acts, as continuous-time states integrated exactly between samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock

Array = NDArray[Any]

LAYOUTS: dict[str, tuple[int, int]] = {
    # name: (order, number of rate parameters)
    "first": (1, 1),
    "oscillator": (2, 2),
    "cascade": (2, 2),
    "chain": (2, 2),
    "driven": (3, 3),
    "sensed": (3, 3),
    "modes": (4, 4),
    "integrator": (2, 1),
    "tanks": (2, 10),
}
STEPS = 5
RATES = (-30.0, 5.0)
"""Of the logarithms of rates per sample: below, nothing moves in any record; above, all has settled within a sample."""


@dataclass(frozen=True, eq=False)
class Inside:
    """What acts inside a plant: forces, each with its parameters and signals, and elements with memory.

    A force's signals are None, (N,) the one that modulates it, or (N, 2) with its own input beside that. `elements` are
    fields of `plant_kernels.Elements`, `steps` integration steps per sample.
    """

    forces: tuple[tuple[Callable[..., Any], Array, Array | None], ...] = ()
    elements: Mapping[str, float] = field(default_factory=dict)
    steps: int = STEPS

    def __bool__(self) -> bool:
        return bool(self.forces or self.elements)

    @property
    def mark(self) -> tuple[Any, ...]:
        """Tells two of them apart, for keeping states."""
        signals = tuple(None if s is None else s.tobytes() for _, _, s in self.forces)
        return tuple((f, c.tobytes()) for f, c, _ in self.forces), signals, tuple(self.elements.items())

    def between(self, start: int, stop: int | None) -> Inside:
        """The same on a stretch of the record."""
        cut = tuple((f, c, None if s is None else s[start:stop]) for f, c, s in self.forces)
        return replace(self, forces=cut)


NOTHING = Inside()


def layout_matrices(layout: str, r: Array) -> tuple[Array, Array, Array, Array, Array]:
    """A (n, n), B (n,), E (n,), position row and velocity row of a layout with rates r = log of positive rates.

    What follows the rates in r are columns by which further inputs enter.
    """
    rate = np.exp(np.clip(r[: LAYOUTS[layout][1]], *RATES))
    if layout == "first":
        a = rate[0]
        return np.array([[-a]]), np.array([a]), np.array([a]), np.ones(1), np.ones(1)
    if layout == "oscillator":
        a0, a1 = rate
        A = np.array([[0.0, 1.0], [-a0, -a1]])
        return A, np.array([0.0, a0]), np.array([0.0, a0]), np.array([1.0, 0.0]), np.array([0.0, 1.0])
    if layout == "cascade":  # the current follows u, the speed follows the current
        a, b = rate
        A = np.array([[-a, a], [0.0, -b]])
        return A, np.array([0.0, b]), np.array([a, 0.0]), np.array([1.0, 0.0]), np.array([1.0, 0.0])
    if layout == "chain":  # the first lag carries the effect, the second only filters
        a, b = rate
        A = np.array([[-a, 0.0], [b, -b]])
        return A, np.array([a, 0.0]), np.array([a, 0.0]), np.array([1.0, 0.0]), np.array([1.0, 0.0])
    if layout == "integrator":
        A = np.array([[0.0, 1.0], [0.0, -rate[0]]])
        return (
            A,
            np.array([0.0, rate[0]]),
            np.array([0.0, rate[0]]),
            np.array([1.0, 0.0]),
            np.array([0.0, 1.0]),
        )
    if layout in ("driven", "sensed"):
        a0, a1, b = rate
        A = np.array([[0.0, 1.0, 0.0], [-a0, -a1, 0.0], [0.0, 0.0, -b]])
        E, B = np.array([0.0, a0, 0.0]), np.zeros(3)
        if layout == "driven":
            A[1, 2], B[2] = a0, b
        else:
            A[2, 0], B[1] = b, a0
        return A, B, E, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    a0, a1, b0, b1 = rate
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1, :2], A[3, 2:] = (-a0, -a1), (-b0, -b1)
    B, E = np.array([0.0, a0, 0.0, b0]), np.array([0.0, a0, 0.0, 0.0])
    return A, B, E, np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0])


def states(layout: str, rates: Array, u: Array, inside: Inside = NOTHING, x0: Array | None = None) -> Array:
    """States (N, order) of a layout driven by u, (N,) or (N, inputs), at rest without x0.

    `rates` logarithms of the rates, then for every further input the (order,) column by which it enters.
    """
    from estimators.diagnosis.effects.kernels.plant_kernels import (
        MOST_FORCES,
        Elements,
        pointer,
        simulate_feedback,
    )

    steps = inside.steps if inside else 1  # linear dynamics are exact in one
    held = held_plant(layout, tuple(rates), steps)
    x0 = np.zeros(len(held.phi)) if x0 is None else x0
    U = u.reshape(len(u), -1)
    nu = U.shape[1]
    drive = np.zeros((len(u), nu + 2 * MOST_FORCES))
    drive[:, :nu], drive[:, nu + 1 :: 2] = U, U[:, :1]
    c = np.zeros((len(inside.forces), max((len(q) for _, q, _ in inside.forces), default=0)))
    for i, (_, q, s) in enumerate(inside.forces):
        c[i, : len(q)] = q
        if s is not None:
            s = s.reshape(len(u), -1)
            drive[:, nu + 2 * i : nu + 2 * i + s.shape[1]] = s
    forces = [pointer(f) for f, _, _ in inside.forces]
    forces += [0] * (MOST_FORCES - len(forces))
    return simulate_feedback(drive, held, Elements(**inside.elements), x0, steps, c, *forces)


@lru_cache(maxsize=64)
def held_plant(layout: str, rates: tuple[float, ...], steps: int) -> Any:
    """Transition and held responses over one step; kept, since most derivatives are by other parameters."""
    from estimators.diagnosis.effects.kernels.plant_kernels import Held, held_response

    A, B, E, position, velocity = layout_matrices(layout, np.array(rates))
    further = np.array(rates[LAYOUTS[layout][1] :]).reshape(-1, len(A))
    phi, gamma = held_response(A, np.stack((B, *further, E), axis=1), 1.0 / steps)
    return Held(phi, gamma[:, :-1].copy(), gamma[:, -1].copy(), position, velocity)


DRIVING = {"cascade": 1, "driven": 2}
"""The state by which the input drives the plant, where it is not the input itself."""


def changed_states(
    layout: str, rates: Array, u: Array, inside: Inside, change: tuple[float, ...], q: Array, clock: Clock, x0: Array
) -> Array:  # fmt: skip
    """States of a layout whose rates change at one time; the time is no integer, so two switches are blended.

    `change`: how the logarithms of the rates move per unit of q[0], and that of what drives the plant where it is one more than the
    rates; q[1] is the time in samples.
    """
    size = float(np.clip(q[0], -3.0, 3.0))
    shifted = rates + np.array(change[: len(rates)]) * size
    scale = float(np.exp(sum(change[len(rates) :]) * size))
    driving = np.where(np.arange(len(x0)) == DRIVING.get(layout, -1), scale, 1.0)
    driven = scale * u
    if layout == "modes" and scale != 1.0:  # of two modes side by side, the second is driven as before
        shifted = np.concatenate((shifted, [0.0, 0.0, 0.0, np.exp(np.clip(rates[2], *RATES))]))
        driven = np.stack((driven, u - driven), axis=1)
    at = q[1] - clock.k[0]
    if at <= 0:
        return states(layout, shifted, driven, inside, x0)
    if at >= len(u) - 1:
        return states(layout, rates, u, inside, x0)
    whole = int(np.floor(at))
    early = states(layout, rates, u[: whole + 2], inside.between(0, whole + 2), x0)
    runs = []
    for t in (whole, whole + 1):
        later = states(layout, shifted, driven[t:], inside.between(t, None), driving * early[t])
        runs.append(np.concatenate((early[:t], later)))
    with np.errstate(invalid="ignore"):  # states that diverge are infinite, and 0 times that is no number
        return (1.0 - (at - whole)) * runs[0] + (at - whole) * runs[1]
