"""Physical layouts: where in a plant an effect acts, as continuous-time states integrated exactly between samples."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.catalogue import Clock

__all__ = ["CHANGES", "COEFFICIENTS", "LAYOUTS", "allowed", "changed_states", "layout_matrices", "states"]

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
COEFFICIENTS = 19  # of the nonlinear term inside a plant, see `simulate_feedback`
MOVING = (
    "oscillator",
    "driven",
    "sensed",
    "modes",
    "integrator",
)  # layouts whose velocity is not their position


DRIVEN = ("cascade", "driven")  # layouts whose last state follows the input and drives the others

CHANGES: dict[str, dict[str, tuple[float, ...]]] = {
    # how the logarithms of the rates move per unit of the change
    "timescale_change": {
        "first": (1,), "oscillator": (2, 1), "cascade": (1, 1), "driven": (2, 1, 0), "sensed": (2, 1, 0),
        "modes": (2, 1, 0, 0),
    },
    "damping_change": {"oscillator": (0, 1), "driven": (0, 1, 0), "sensed": (0, 1, 0), "modes": (0, 1, 0, 0)},
    "pole_change": {"cascade": (1, 0), "driven": (0, 0, 1), "sensed": (0, 0, 1)},
}  # fmt: skip


def layout_matrices(layout: str, r: Array) -> tuple[Array, Array, Array, Array, Array]:
    """A, B, E, position row, velocity row of a layout with rates r = log of positive rates.

    Parameters
    ----------
    layout : str
        Layout of the linear part.
    r : ndarray
        Logarithms of its rates.

    Returns
    -------
    tuple of ndarray
        A (n, n), B (n,), E (n,), and the rows that read position and velocity.
    """
    rate = np.exp(np.clip(r, -30, 5))
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


def states(
    layout: str, rates: Array, u: Array, c: Array, x0: Array | None = None, steps: int = STEPS
) -> Array:
    """States (N, order) of a layout driven by u with the feedback coefficients c.

    Parameters
    ----------
    layout : str
        Layout of the linear part.
    rates : ndarray
        Logarithms of its rates.
    u : ndarray
        (N,) input.
    c : ndarray
        (COEFFICIENTS,) feedback coefficients.
    x0 : ndarray, optional
        Initial state; at rest without it.
    steps : int
        Integration steps per sample.

    Returns
    -------
    ndarray
        (N, order).
    """
    from estimators.diagnosis.effects.plant_kernels import simulate_feedback

    steps = steps if c.any() else 1
    phi, gamma_u, gamma_w, position, velocity = _held(layout, tuple(rates), steps)
    x0 = np.zeros(len(phi)) if x0 is None else x0
    return simulate_feedback(np.ascontiguousarray(u), phi, gamma_u, gamma_w, position, velocity, c, x0, steps)


@lru_cache(maxsize=64)
def _held(layout: str, rates: tuple[float, ...], steps: int) -> tuple[Array, ...]:
    """Transition and held responses over one step; kept, since most derivatives are by other parameters."""
    from estimators.diagnosis.effects.plant_kernels import held_response

    A, B, E, position, velocity = layout_matrices(layout, np.array(rates))
    phi, gamma = held_response(A, np.stack((B, E), axis=1), 1.0 / steps)
    return phi, gamma[:, 0].copy(), gamma[:, 1].copy(), position, velocity


def allowed(key: str, layout: str) -> bool:
    """Whether an effect can sit in a layout: changes need a rate that they change, moving parts a velocity.

    Parameters
    ----------
    key : str
        Key of the effect in the catalogue.
    layout : str
        Layout of the linear part.

    Returns
    -------
    bool
        False where it makes no sense.
    """
    if key in ("position_damping", "hysteretic_spring", "end_stop"):
        return layout in MOVING
    if key == "bilinear_driven":
        return layout in DRIVEN
    return key not in CHANGES or layout in CHANGES[key]


def changed_states(
    layout: str, rates: Array, u: Array, c: Array, key: str, q: Array, clock: Clock, x0: Array
) -> Array:
    """States of a layout whose rates change at one time; the time is no integer, so two switches are blended.

    Parameters
    ----------
    layout : str
        Layout of the linear part.
    rates : ndarray
        Logarithms of the rates before the change.
    u : ndarray
        (N,) input.
    c : ndarray
        (COEFFICIENTS,) feedback coefficients.
    key : str
        Which rates change.
    q : ndarray
        Size of the change and its time in samples.
    clock : Clock
        Time of the record's samples.
    x0 : ndarray
        Initial state.

    Returns
    -------
    ndarray
        (N, order).
    """
    after = rates + np.array(CHANGES[key][layout]) * np.clip(q[0], -3.0, 3.0)
    at = q[1] - clock.k[0]
    if at <= 0:
        return states(layout, after, u, c, x0)
    if at >= len(u) - 1:
        return states(layout, rates, u, c, x0)
    whole = int(np.floor(at))
    early = states(layout, rates, u[: whole + 2], c, x0)
    runs = []
    for t in (whole, whole + 1):
        later = states(layout, after, u[t:], c, early[t].copy())
        runs.append(np.concatenate((early[:t], later)))
    with np.errstate(invalid="ignore"):  # states that diverge are infinite, and 0 times that is no number
        return (1.0 - (at - whole)) * runs[0] + (at - whole) * runs[1]
