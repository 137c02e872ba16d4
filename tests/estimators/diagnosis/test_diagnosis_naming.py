"""Names say no more than a fit shows: curves, losses, folds that a record hardly reaches."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.model.fitting import Channel
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.search.naming import FOLDED, as_shown

CHANNEL: Any = None


def _shown(
    key: str,
    p: list[float],
    first: int = 0,
    plant: tuple = (Structure(1), [-0.5, 1.0]),
    channel: Channel = CHANNEL,
):
    """The effect that is claimed where one was fitted, by default beside a pole at 0.5."""
    part = Part(named(key), 0, first=first)
    fit: Any = SimpleNamespace(structure=plant[0].adding(part), p=np.array([*plant[1], *p]))
    return as_shown(part, fit, channel).effect


def test_a_process_without_memory_and_a_curve_behind_the_plant_are_named_as_what_they_are() -> None:
    assert _shown("loss", [0.5, 0.1, 0.1]).key == "loss"
    assert _shown("loss", [4.5, 0.1, 0.1]).key == "input_polynomial"
    assert _shown("input_power", [0.4]).key == "input_power"
    assert _shown("input_power", [-0.2, 0.4], first=1).key == "input_power"
    assert _shown("input_power", [-0.9, 0.4], first=1).key == "sandwich"


def test_a_spring_where_nothing_can_swing_is_a_loss() -> None:
    for damping, cause in ((0.3, "duffing"), (1.9, "duffing"), (2.1, "nonlinear_loss")):
        plant = Structure(2, layout="oscillator"), np.log([1.0, damping]).tolist()
        effect = _shown("stiffness_cubic", [0.1], plant=plant)
        assert (effect.key, effect.cause) == ("stiffness_cubic", cause)


def test_a_fold_that_is_hardly_reached_is_a_curve() -> None:
    n = 2000
    u = np.linspace(0.0, 1.0, n)
    channel = Channel(u[:, None], u, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    for share, cause in ((0.8 * FOLDED, "output_nonlinearity"), (1.2 * FOLDED, "magnitude_sensor")):
        plant = Structure(1), [0.0, 1.0]
        assert _shown("squared", [-share], plant=plant, channel=channel).cause == cause
        assert _shown("squared", [share - 1.0], plant=plant, channel=channel).cause == cause
