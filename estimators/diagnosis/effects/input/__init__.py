"""Effects at the input: what happens to it before it reaches the linear part of a plant."""

from estimators.diagnosis.effects.input.acting import (
    AWAY,
    DELAY,
    LEAST,
    LINES,
    SANDWICH,
    after,
    any_linear,
    aside,
    banked,
    broken_line,
    dead_zone,
    exponential,
    kept,
    moved,
    odd,
    quantiles,
    told_beside,
    zones,
)
from estimators.diagnosis.effects.input.acting import INPUT as _INPUT
from estimators.diagnosis.effects.input.phase_angle import PHASE_ANGLE
from estimators.diagnosis.effects.input.polynomial import POLYNOMIAL

__all__ = [
    "AWAY", "DELAY", "INPUT", "LEAST", "LINES", "PHASE_ANGLE", "SANDWICH", "after", "any_linear", "aside", "banked", "broken_line", "dead_zone",
    "exponential", "kept", "moved", "odd", "quantiles", "told_beside", "zones",
]  # fmt: skip

INPUT = (*_INPUT, POLYNOMIAL, *PHASE_ANGLE)
