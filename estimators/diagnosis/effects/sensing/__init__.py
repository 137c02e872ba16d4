"""What a sensor makes of its signal, in which samples and by which clock."""

from estimators.diagnosis.effects.sensing.curves import CURVES
from estimators.diagnosis.effects.sensing.extremes import EXTREMES
from estimators.diagnosis.effects.sensing.gains import CARRIED, LEVELLED
from estimators.diagnosis.effects.sensing.jumps import LOST
from estimators.diagnosis.effects.sensing.losses import LOST_IN_MOTION
from estimators.diagnosis.effects.sensing.misread import MISREAD
from estimators.diagnosis.effects.sensing.ranges import AUTORANGE, RANGES
from estimators.diagnosis.effects.sensing.rates import TRAILING
from estimators.diagnosis.effects.sensing.reports import REPORTING
from estimators.diagnosis.effects.sensing.sensors import BANDED, PACED, SINE, SLIPPED, SWUNG, TREADS
from estimators.diagnosis.effects.sensing.turns import TURNS

__all__ = ["REPORTING", "SENSORS"]

SENSORS = (
    *CURVES, RANGES, AUTORANGE, SINE, *REPORTING, PACED, TREADS, BANDED, TURNS, LEVELLED, CARRIED, SWUNG, SLIPPED, TRAILING, LOST, LOST_IN_MOTION, *MISREAD.values(), *EXTREMES,
)  # fmt: skip
