"""The catalogue of effects that a linear model can lack, one file for each place where they act.

These files import the rooms of the model and the search inside functions only, as those import the effects.
"""

from estimators.diagnosis.effects.disturbances import ADDED, NOISE, STEPWISE
from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Sizes, Slot
from estimators.diagnosis.effects.fed import PRODUCT, SEVERAL
from estimators.diagnosis.effects.input import INPUT
from estimators.diagnosis.effects.input.capacities import CAPACITIES
from estimators.diagnosis.effects.input.meeting import MEETING
from estimators.diagnosis.effects.loops import LOOPS
from estimators.diagnosis.effects.loops.ageing import AGED
from estimators.diagnosis.effects.output import OUTPUT, TIMING
from estimators.diagnosis.effects.path import PATH, STORE
from estimators.diagnosis.effects.plant import MODULATED, PLANT
from estimators.diagnosis.effects.process import PROCESS
from estimators.diagnosis.effects.profiled import PROFILED
from estimators.diagnosis.effects.rotation import ROTATION
from estimators.diagnosis.effects.sensing import SENSORS
from estimators.diagnosis.effects.sensing.folding import FOLDING
from oed.errors import InputError

__all__ = ["CATALOGUE", "Clock", "Effect", "Nature", "Sizes", "Slot", "named"]

CATALOGUE: tuple[Effect, ...] = (
    *INPUT, *PROFILED, *LOOPS, *PROCESS, *CAPACITIES, *SEVERAL, *MEETING, *PLANT, *ROTATION, *MODULATED, *AGED, *PATH, PRODUCT, *STORE, *OUTPUT, *FOLDING, *SENSORS, *TIMING, *ADDED, *STEPWISE, *NOISE,
)  # fmt: skip
"""Every effect that the diagnosis knows; hand in more with `diagnose(..., effects=[*CATALOGUE, mine])`."""


def named(key: str, among: tuple[Effect, ...] = CATALOGUE) -> Effect:
    """The effect of a key, for example "saturation".

    Parameters
    ----------
    key : str
        Name of the variant.
    among : tuple of Effect
        Where to look; the catalogue without it.

    Returns
    -------
    Effect
        The effect.

    Raises
    ------
    InputError
        If there is none of that name.

    Examples
    --------
    >>> named("saturation").cause
    'input_saturation'
    """
    for effect in among:
        if effect.key == key:
            return effect
    raise InputError(f"there is no effect {key!r}; there are {', '.join(sorted(e.key for e in among))}.")
