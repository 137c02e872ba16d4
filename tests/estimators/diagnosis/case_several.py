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


SEVERAL = {
    # effect: maker, order of the linear model, form of the inputs
    "shared_limit": (two_pumps, 2, {"mean": 2.0, "size": 0.9, "inputs": 2}), "shared_limit of a neighbour": (its_neighbour, 2, {"inputs": 2}),
    "select_low": (cross_limited, 2, {"mean": 2.0, "size": 0.9, "inputs": 2}), "select_high": (overridden, 2, {"mean": 2.0, "size": 0.9, "inputs": 2}),
    "share": (diluted, 2, {"mean": 3.0, "size": 1.2, "inputs": 2}), "share of a burner": (burner, 2, {"mean": 3.0, "inputs": 2}),
    "saturation_upper of two": (capped, 2, {"mean": 2.0, "size": 0.9, "inputs": 2}),
}  # fmt: skip
