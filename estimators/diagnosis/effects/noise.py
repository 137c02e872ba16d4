"""What is seen in the residual and not simulated: the noise and the faults of a measurement."""

from __future__ import annotations

from estimators.diagnosis.effects.effect import Effect, Nature, Slot


def _seen(key: str, cause: str, nature: Nature, sentence: str, trials: float = 1.0) -> Effect:
    return Effect(key=key, cause=cause, nature=nature, slot=Slot.NOISE, sentence=sentence, trials=trials)


NOISE = (
    _seen("coloured", "coloured_noise", Nature.NOISE, "the noise is correlated in time", 3),
    _seen("feedback", "closed_loop", Nature.NOISE, "the input follows the noise: feedback"),
    _seen("outliers", "outliers", Nature.NOISE, "single samples are far off"),
    _seen("quantised", "quantisation", Nature.SAMPLING, "the output is rounded"),
    _seen("held", "dropouts", Nature.SAMPLING, "samples are lost and the last one is repeated"),
)
