"""A plant of whatever describes a system: python-control, scipy.signal, an identified model, a name or a file."""

from pathlib import Path
from typing import Any

from oed.errors import InputError
from oed.files.objects import kinds_of
from oed.models.model import Model
from oed.plants.plant import Plant

WANTED = (
    "give an oed.Plant, a python-control TransferFunction or StateSpace, a scipy.signal dlti, an identified model, the "
    "name of a plant, or a JSON file"
)


def as_plant(system: Any) -> Plant:
    """The plant of a system; what is a plant already is returned as it is.

    Parameters
    ----------
    system : Plant or Model or Fit or control.TransferFunction or control.StateSpace or scipy.signal.dlti or str
        Discrete time; a continuous-time system is sampled first, see `Plant.from_control`.

    Returns
    -------
    Plant
        With unit noise variance where the system has no noise model.

    Raises
    ------
    InputError
        If it is none of these, in continuous time, improper or unstable.

    Examples
    --------
    >>> import scipy.signal
    >>> as_plant(scipy.signal.dlti([0.5], [1, -0.5], dt=0.1)).dt
    0.1
    """
    if isinstance(system, Plant):
        return system
    if isinstance(system, Model):
        return system.to_plant()
    if isinstance(system, str | Path):
        from oed.plants.json import plant_from_json
        from oed.plants.named import NAMES, named_plant

        bare = not Path(system).suffix and not Path(system).exists()
        return named_plant(str(system)) if bare or str(system) in NAMES else plant_from_json(system)
    kinds = kinds_of(system)
    if kinds & {("control", "TransferFunction"), ("control", "StateSpace")}:
        return Plant.from_control(system)
    if ("control", "FrequencyResponseData") in kinds:
        raise InputError(
            "a FrequencyResponseData is given where a plant is needed; its gain between the lines is not known: identify a "
            "model of it first (estimators.pem.identify_response)."
        )
    if ("scipy", "dlti") in kinds:
        import control

        if ("scipy", "StateSpace") in kinds:
            return Plant.from_control(control.StateSpace(system.A, system.B, system.C, system.D, system.dt))
        given = system.to_tf()
        return Plant.from_control(control.TransferFunction(given.num, given.den, given.dt))
    if ("scipy", "lti") in kinds:
        raise InputError(
            "a continuous-time scipy.signal.lti is given; sample it first, for example system.to_discrete(0.01)."
        )
    if kinds & {("estimators", "Fit"), ("estimators", "ResponseFit")}:
        return system.to_plant()
    raise InputError(f"a system is given as {type(system).__name__}; {WANTED}.")
