"""Flows with inertia: that fill a store and cannot turn back, a diode's, a check valve's, a freewheel's; and a long pipe's to a turbine."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.input import kept
from estimators.diagnosis.effects.loops.limited import NEAR, PACES, shaped

Array = NDArray[Any]
DAMPINGS, OWN = (0.1, 0.3, 0.7), (0.15, 0.5, 0.85)
"""Damping ratios of the flow and what it fills, and the share of the damping that is the flow's own: the rest leaks."""
ENDS = (0.1, 0.2, 0.35)
"""Of the range that the flow would have without an end, where its end may be: nearer, it is hardly met, further, it is always."""
SLOWEST = 1e-6
"""Natural frequency, in radians per sample, below which nothing flows."""


def of_flow(p: Array, way: float) -> tuple[Array, float, Array]:
    """Frequency, resistance and leak; the least of the flow that goes the way; and how far off its rest it and the level begin."""
    return np.maximum(np.abs(p[:3]), (SLOWEST, 0.0, 0.0)), way * float(p[3]), way * p[4:6]


def _flowed(way: float) -> Any:
    def run(x: Array, p: Array, clock: Clock) -> Array:
        from estimators.diagnosis.effects.kernels.loop_kernels import flowing

        def flow(x: Array, p: Array) -> Array:
            plant, least, begun = of_flow(p, way)
            return way * flowing(way * x, plant, way * level_before(x), least, begun, clock.lead)

        return kept(flow, x, p, (way, clock.lead))

    return run


def _turning(way: float) -> Any:
    def shapes(slowest: float, u: Array) -> Iterator[list[float]]:
        from estimators.diagnosis.effects.kernels.loop_kernels import flowing

        drive = way * u
        for faster, damping, own in product(PACES, DAMPINGS, OWN):
            w = faster * slowest
            plant = np.array([w, 2.0 * damping * w * own, 2.0 * damping * w * (1.0 - own)])
            level = flowing(drive, plant, way * level_before(u), -np.inf, np.zeros(2), 0)
            flow = (np.gradient(level) + plant[2] * level) / w
            if np.all(np.isfinite(flow)):
                yield from ([*plant, way * (flow.min() + end * np.ptp(flow)), 0.0, 0.0] for end in ENDS)

    return shapes


def _flow(key: str, way: float) -> Effect:
    parameters = {
        "frequency": "rad/sample",
        "resistance": "1/sample",
        "leak": "1/sample",
        "least_flow": "u",
        "start_flow": "u",
        "start_level": "u",
    }
    effect = Effect(
        key=key, cause="state_saturation", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=_flowed(way), parameters=parameters,
        sentence="the input drives a flow with inertia that fills a store, and the flow cannot turn back: a diode, a check valve, a freewheel",
        search=shaped(
            lambda: effect, _turning(way), lambda slowest, su: [*[slowest] * 3, *[su] * 3], NEAR, np.eye(len(parameters))[:4], 2
        ),
    )  # fmt: skip
    return effect


FLOWS: dict[Effect, float] = {_flow("flow_up", 1.0): 1.0, _flow("flow_down", -1.0): -1.0}
"""The effects, and which way they flow: up with the input, or down."""

PACE, LOSS, IDLE, GATE = (0.3, 0.6, 1.2, 2.4, 5.0, 10.0), (0.02, 0.15), (0.03, 0.15), (0.3, 1.0, 3.0)
"""Of what the head gives the flow in the time of the linear model's slowest pole, of its mean; of the head, what the mean flow loses; of
the mean flow, what a turbine idles at; and lags of the gate in samples, that are tried."""
TIGHT = 1e-3  # of its mean, that a gate is open at least: through a shut one no head drives anything


def of_penstock(p: Array) -> Array:
    """Acceleration by the whole head, loss, idling flow, lag of the gate."""
    return np.maximum(np.abs(p), (0.0, 0.0, 0.0, QUICK_GATE))


QUICK_GATE = 0.1  # samples, about one step of the integration


def _turbined(x: Array, p: Array) -> Array:
    from estimators.diagnosis.effects.kernels.loop_kernels import headed

    open_ = min(float(x.min()), level_before(x)) > TIGHT * abs(float(np.mean(x)))
    return headed(x, of_penstock(p), level_before(x)) if open_ else np.full(len(x), np.inf)


def _penstocks(slowest: float, u: Array) -> Iterator[list[float]]:
    mean = abs(float(np.mean(u))) + 1e-300
    for pace, loss, idle, lag in product(PACE, LOSS, IDLE, GATE):
        yield [pace * slowest * mean, loss / mean**2, idle * mean, lag]


PENSTOCK: Effect = Effect(
    key="water_column", cause="water_column", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=lambda x, p, clock: kept(_turbined, x, p),
    sentence="the input is a gate at the foot of a long pipe, whose head falls while the water is still slow: a turbine's power, q (q / g)^2",
    parameters={"acceleration": "u/sample", "loss": "1/u^2", "idle": "u", "lag": "sample"},
    search=shaped(lambda: PENSTOCK, _penstocks, lambda slowest, su: [slowest * su, 0.1 / su**2, su, 1.0], NEAR, np.eye(4)),
)  # fmt: skip
