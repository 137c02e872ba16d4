"""Hidden loops between the input and the linear part, and what remembers there."""

from estimators.diagnosis.effects.loops.exposure import EXPOSURES
from estimators.diagnosis.effects.loops.flows import FLOWS, PENSTOCK
from estimators.diagnosis.effects.loops.geared import GEARED
from estimators.diagnosis.effects.loops.limited import (
    ACROSS,
    COURSED,
    PACES,
    RELAY,
    STEERED,
    STEERING,
    WINDUP,
    slowest_rate,
)
from estimators.diagnosis.effects.loops.recycled import RECYCLE
from estimators.diagnosis.effects.loops.remembering import (
    PLAYED,
    SIDE_BY_SIDE,
    SLIDING,
    STAGED,
    STICTION,
    play_widths,
)
from estimators.diagnosis.effects.loops.scanned import SCANNED
from estimators.diagnosis.effects.loops.servos import SERVOS
from estimators.diagnosis.effects.loops.stores import CLEARED, STORES
from estimators.diagnosis.effects.loops.switching import SWITCHING, THREE_POINT
from estimators.diagnosis.effects.loops.triggered import TRIGGERED
from estimators.diagnosis.effects.loops.vehicles import CARRIED_BY, TYRES

__all__ = ["ACROSS", "FLOWS", "LOOPS", "PACES", "STORES", "play_widths", "slowest_rate"]

LOOPS = (
    SCANNED,
    STICTION,
    SLIDING,
    WINDUP,
    STEERED,
    STEERING,
    COURSED,
    RELAY,
    STAGED,
    SIDE_BY_SIDE,
    PLAYED,
    RECYCLE,
    *EXPOSURES,
    THREE_POINT,
    *SWITCHING.values(),
    *SERVOS,
    *GEARED,
    *STORES,
    *FLOWS,
    PENSTOCK,
    CLEARED,
    CARRIED_BY,
    TYRES,
    *TRIGGERED,
)
