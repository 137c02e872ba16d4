"""The ladder of models: steps from any stage, compared on blocks not used, and the verdict that they allow."""

from estimators.diagnosis.ladder.steps import Gain, Kind, Ladder, Rung, Step, climb, paired_gain

__all__ = ["Gain", "Kind", "Ladder", "Rung", "Step", "climb", "paired_gain"]
