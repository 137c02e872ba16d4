"""Rigs of two inputs that act together before a plant: on one supply, one or the other, in a mixture."""

from __future__ import annotations

import numpy as np

from tests.estimators.diagnosis.case_parts import FINE, linear

__all__ = ["SEVERAL"]


def _served(u, a, supply=4.0, weight=1.3):
    """(N, 2) what two get that draw on one store, each filled again by the next sample: both go on until it is empty."""
    out = np.empty_like(u)
    for k, asked in enumerate(u):
        left, got = supply if a else np.inf, np.zeros(2)
        for piece in np.tile(asked / FINE, (FINE, 1)):
            needs = abs(piece[0]) + weight * abs(piece[1])
            part = min(1.0, left / needs) if needs > 0.0 else 1.0
            left, got = max(left - needs, 0.0), got + part * piece
        out[k] = got
    return out


def two_pumps(u, a):
    """Two pumps on one header that fill a vessel, whose level swings."""
    got = _served(u, a)
    return linear(got[:, 0]) + 0.6 * linear(got[:, 1])


def its_neighbour(u, a):
    """A motor on the battery of another one, both of which run either way; only one is seen."""
    return linear(_served(u, a, 1.2, 0.7)[:, 0])


def capped(u, a):
    """A pump that gives no more than so much, beside one that does."""
    return linear(np.minimum(u[:, 0], 2.2) if a else u[:, 0]) + 0.6 * linear(u[:, 1])


def cross_limited(u, a):
    """A boiler whose firing is the lesser of what is asked for and what its air allows."""
    return linear(np.minimum(u[:, 0], 1.1 * u[:, 1] - 0.3) if a else u[:, 0])


def overridden(u, a):
    """A fan that the larger of two controllers runs, the second of which also opens a damper."""
    return linear(np.maximum(u[:, 0], 0.8 * u[:, 1] + 0.2) if a else u[:, 0]) - 0.4 * linear(u[:, 1])


def diluted(u, a):
    """Brine that water dilutes, a third heavier by the meters' units, ahead of a probe; or two streams that add up."""
    if not a:
        return linear(u[:, 0]) - 0.4 * linear(u[:, 1])
    return linear(9.0 * u[:, 0] / (u[:, 0] + 1.3 * u[:, 1]))


def burner(u, a):
    """A burner whose oxygen goes with its air over its fuel, and whose fan is heard besides."""
    return linear(4.0 * u[:, 0] / u[:, 1] if a else -u[:, 1]) + 0.3 * linear(u[:, 0])


def _meeting(u, rates, slope, x=0.0, start=None):
    """(N,) at the start of each sample, of states that two lags at these rates, or none, drive by slope(x, w, v)."""
    w, v = u[0]
    while start is None and abs(slope(x, w, v)) > 1e-9:
        x += slope(x, w, v)
    out = np.empty(len(u))
    for k, (one, two) in enumerate(u):
        out[k] = x
        for _ in range(FINE):
            w, v = w + rates[0] * (one - w) / FINE, v + rates[1] * (two - v) / FINE
            x += slope(x, w, v) / FINE
    return out


def rudder(u, a):
    """A force by the angle of a rudder, behind a servo, and the square of a speed, behind a run-up."""
    square = lambda v: (1.0 + 0.4 * (v - 3.0)) ** 2 if a else 1.0
    return _meeting(u, (0.4, 0.07), lambda x, w, v: 0.2 * (w * square(v) + (0.0 if a else 0.3 * v) - x))


def furnace(u, a):
    """Light that grows exponentially with a lagged temperature, and in proportion to a shutter that needs none."""
    bright = lambda v: np.exp(0.5 * (v - 3.0)) if a else 1.0
    return _meeting(u, (8.0, 0.12), lambda x, w, v: 0.3 * (w * bright(v) + (0.0 if a else 0.5 * v) - x))


def reactor(u, a):
    """What a reaction leaves of its feed, the faster the hotter it is, behind the lag of a jacket; cold, a blend."""
    consumed = lambda x, v: 0.06 * np.exp(0.6 * (v - 3.0)) * x if a else 0.03 * v
    return _meeting(u, (8.0, 0.09), lambda x, w, v: 0.08 * (w - x) - consumed(x, v))


def aircraft(u, a):
    """A turn by a flap, behind a servo, damped with the speed and driven with its square, behind an engine's lag."""
    speed = lambda v: 1.0 + 0.3 * (v - 3.0) if a else 1.0
    return _meeting(
        u, (0.5, 0.05), lambda x, w, v: 0.12 * (speed(v) ** 2 * w - speed(v) * x + (0.0 if a else 0.2 * v))
    )


SEVERAL = {
    # effect: maker, order of the linear model, form of the inputs
    "shared_limit": (two_pumps, 2, {"mean": 2.0, "size": 0.9, "inputs": 2}), "shared_limit of a neighbour": (its_neighbour, 2, {"inputs": 2}),
    "select_low": (cross_limited, 2, {"mean": 2.0, "size": 0.9, "inputs": 2}), "select_high": (overridden, 2, {"mean": 2.0, "size": 0.9, "inputs": 2}),
    "share": (diluted, 2, {"mean": 3.0, "size": 1.2, "inputs": 2}), "share of a burner": (burner, 2, {"mean": 3.0, "inputs": 2}),
    "product_of_lags": (rudder, 3, {"mean": 3.0, "size": 0.7, "hold": 12, "inputs": 2}), "product_of_lags of a lamp": (furnace, 2, {"mean": 3.0, "size": 0.8, "hold": 12, "inputs": 2}),
    "loss_by_lag": (reactor, 2, {"mean": 3.0, "size": 0.8, "hold": 12, "inputs": 2}), "loss_by_lag of an aircraft": (aircraft, 3, {"mean": 3.0, "size": 0.8, "hold": 12, "inputs": 2}),
    "saturation_upper of two": (capped, 2, {"mean": 2.0, "size": 0.9, "inputs": 2}),
}  # fmt: skip
