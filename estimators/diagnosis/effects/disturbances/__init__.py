"""What is no part of the plant: signals that are added or act beside the input, and noise and faults of a measurement."""

from estimators.diagnosis.effects.disturbances.added import ADDED, NOISE
from estimators.diagnosis.effects.disturbances.stepwise import STEPWISE

__all__ = ["ADDED", "NOISE", "STEPWISE"]
