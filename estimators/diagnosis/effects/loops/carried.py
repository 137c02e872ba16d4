"""What rides on a moved base by a spring and a damper that resists one way more than the other: a wheel's strut, a seat, a mount."""

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
