"""A curve of the input's integral beside the linear part: a store whose charge is read through a curve."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot

__all__ = ["STORE"]

Array = NDArray[Any]
BENDS = ((4.0, 8.0), (8.0, 14.0), (12.0, 18.0), (16.0, 25.0), (8.0, 25.0), (16.0, 12.0))
"""Rates of the two exponentials, in ranges of the charge that the record covers, that are tried."""
POLES = (0.0, 0.8, 0.9, 0.95, 0.98)
"""Of the linear part beside the store, which a model with an integrator has lost."""
LEAST_RANGE = (
    0.8  # of the charge's travel that is net: a store is filled or emptied, it does not swing about a level
)
STEEPEST = 40.0  # exponent at which an exponential is cut: outside the record's range it says nothing


def _charge(u: Array, scale: float) -> Array:
    """Integral of the input up to each sample, in ranges of the training record."""
    return np.concatenate(([0.0], np.cumsum(u)[:-1])) / scale


def _curved(u: Array, p: Array, clock: Clock) -> Array:
    """slope x + first (exp(-a x) - 1) + last (exp(b (x - 1)) - exp(-b)): a store is full at one end and empty at the other."""
    slope, first, a, last, b, scale = p
    if scale == 0.0 or a < 0.0 or b < 0.0:
        return np.full(len(u), np.inf)
    x = _charge(u, scale)
    low = np.expm1(np.clip(-a * x, -STEEPEST, STEEPEST))
    high = np.exp(np.clip(b * (x - 1.0), -STEEPEST, STEEPEST)) - np.exp(-b)
    return slope * x + first * low + last * high


def _stores(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Least squares of the curve and of a linear part without an integrator, for several bends and poles; the best are fitted."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Part

    s, j, keep = base.structure, base.structure.inputs[0], channel.keep
    charge = np.cumsum(channel.u[:, j])
    scale = float(charge[-1])
    if (
        s.layout != "tf"
        or s.effects
        or len(s.inputs) != 1
        or abs(scale) < LEAST_RANGE * float(np.ptp(charge))
    ):
        return
    size = float(np.std(channel.y)) + 1e-300
    new = s.adding(Part(STORE_CURVE, j))
    at = new.slices()[-1].start
    linear = [i for i in range(s.order, new.size) if i < at] + [at, at + 1, at + 3]
    scales = np.concatenate(
        (base.scales, [size, size, 10.0, size, 10.0, 0.0])
    )  # the range only names the units
    scales[s.order : s.plant_size] = size / (float(np.std(channel.u[:, j])) + 1e-300)
    found = []
    for pole in POLES:
        for bend in BENDS:
            p = np.zeros(new.size)
            p[: s.order] = np.real(np.poly([pole] + [0.0] * (s.order - 1)))[1:]
            p[[at + 2, at + 4, at + 5]] = *bend, scale
            still = simulate(new, p, channel.u, channel.clock)
            X = np.zeros((len(channel), len(linear)))
            for i, where in enumerate(linear):  # the output is linear in these
                q = p.copy()
                q[where] = 1.0
                X[:, i] = simulate(new, q, channel.u, channel.clock) - still
            norm = np.sqrt(np.mean(X**2, axis=0)) + 1e-300
            theta = np.linalg.lstsq(X[keep] / norm, (channel.y - still)[keep], rcond=1e-9)[0] / norm
            p[linear] = theta
            found.append((float(np.sum((channel.y - still - X @ theta)[keep] ** 2)), p))
    quick = []
    for _, p in sorted(found, key=lambda entry: entry[0])[:3]:
        quick.append(fit(channel, new, p, scales, iterations=8, colour=False))
    best = min(quick, key=lambda f: f.deviance)
    if np.isfinite(best.deviance):
        yield fit(channel, new, best.p, scales, noise=base.noise, iterations=30)


STORE_CURVE = Effect(
    key="integral_curve", cause="integrated_input_curve", nature=Nature.OUTPUT_STATIC, slot=Slot.PATH, trials=20,
    sentence="a curve of the integral of the input is added: a store, as a battery's voltage over its state of charge",
    parameters={"slope": "y", "first": "y", "first_rate": "1", "last": "y", "last_rate": "1", "range": "u sample"},
    shape=lambda size, order: list(STORE_CURVE.parameters.items()), apply=_curved, search=_stores,
)  # fmt: skip

STORE = (STORE_CURVE,)
