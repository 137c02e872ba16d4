"""What rides on wheels: on struts, whose damper resists one way more than the other, and on tyres, whose side force saturates with their slip."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.input import kept
from estimators.diagnosis.effects.loops.limited import NEAR, shaped

Array = NDArray[Any]
FASTER, DAMPINGS, WAYS, LAGS = (0.5, 0.8, 1.2, 2.0), (0.1, 0.3), (0.15, 0.4, 2.5, 7.0), (0.5, 2.0)
"""Natural frequencies, of the linear model's slowest pole, damping ratios of the harder way, the other way over it or under it, and lags of
the base in samples, that are tried."""
GRIPS, TURNS, LIMITS = (0.3, 0.6, 1.2), (1.0, 3.0, 9.0), (0.2, 0.6, 2.0)
"""Of the linear model's slowest pole, both axles' stiffness and how far yaw slips an axle, and over the input's standard deviation a tyre's
`B`, that are tried; levers alike, a gyration of their size, and Pacejka's usual shape, from where a fit finds the way."""
SETTLED = 400  # samples of a constant steering before a record that does not begin straight on
SHAPE, STEERED_IN = 1.4, 1.0  # Pacejka's C of side forces; lag of the steering in samples
LEAST, STIFFEST, QUICKEST = 1e-6, 2.0, 0.1
"""Of a frequency, in radians per sample, below which nothing moves, and above which the steps within a sample are too coarse; and the
least lag of the base in samples, about one such step."""


def of_strut(p: Array) -> Array:
    """Frequency, damping each way, lag of the base."""
    return np.clip(np.abs(p), (LEAST, 0.0, 0.0, QUICKEST), (STIFFEST, STIFFEST, STIFFEST, np.inf))


def _run(x: Array, p: Array) -> Array:
    from estimators.diagnosis.effects.kernels.loop_kernels import carried

    return carried(x, of_strut(p), level_before(x))


def _apply(x: Array, p: Array, clock: Clock) -> Array:
    return kept(_run, x, p)


def _struts(slowest: float, u: Array) -> Iterator[list[float]]:
    for faster, damping, way, lag in product(FASTER, DAMPINGS, WAYS, LAGS):
        w = faster * slowest
        hard = 2.0 * damping * w
        yield [w, hard * min(1.0, 1.0 / way), hard * min(1.0, way), lag]


CARRIED_BY: Effect = Effect(
    key="strut", cause="asymmetric_damping", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=_apply,
    sentence="it rides on a moved base by a spring and a damper, which resists one way more than the other: a strut, a shock absorber",
    parameters={"frequency": "rad/sample", "bump": "1/sample", "rebound": "1/sample", "lag": "sample"},
    search=shaped(lambda: CARRIED_BY, _struts, lambda slowest, su: [*[slowest] * 3, 1.0], NEAR, np.eye(4), 2),
)  # fmt: skip


def of_tyres(p: Array) -> Array:
    """Stiffness of front and rear, how far yaw slips, levers, gyration, B and C of the tyres, lag of the steering."""
    least = (LEAST, LEAST, 0.0, LEAST, LEAST, LEAST, LEAST, QUICKEST)
    return np.clip(np.abs(p), least, (*[STIFFEST] * 2, np.inf, *[np.inf] * 3, 2.0, np.inf))


def at_rest(steer: float, p: Array) -> Array:
    """Side slip and yaw rate (2,) that have settled under a constant steering."""
    from estimators.diagnosis.effects.kernels.loop_kernels import cornered

    none = np.zeros(2)
    return none if steer == 0.0 else cornered(np.full(SETTLED, steer), p, steer, none)[-1]


def _turn(x: Array, p: Array) -> Array:
    from estimators.diagnosis.effects.kernels.loop_kernels import cornered

    known, start = of_tyres(p), level_before(x)
    return cornered(x, known, start, at_rest(start, known))[:, 1]


def _tyres(slowest: float, u: Array) -> Iterator[list[float]]:
    size = float(np.std(u)) + 1e-300
    for grip, turn, limit in product(GRIPS, TURNS, LIMITS):
        yield [*[grip * slowest] * 2, turn * slowest, 1.0, 1.0, limit / size, SHAPE, STEERED_IN]


TYRES: Effect = Effect(
    key="tyre_slip", cause="tyre_slip", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=lambda x, p, clock: kept(_turn, x, p),
    sentence="it is steered by tyres whose side force saturates with their slip angle, as sin(C atan(B slip)) (Pacejka): a vehicle's yaw",
    parameters={"front": "1/sample", "rear": "1/sample", "turn": "1/sample", "lever": "1", "gyration": "1", "slope": "1/u", "shape": "1", "lag": "sample"},
    search=shaped(lambda: TYRES, _tyres, lambda slowest, su: [*[slowest] * 3, 1.0, 1.0, 1.0 / su, 1.0, 1.0], NEAR, np.eye(8), 2),
)  # fmt: skip
