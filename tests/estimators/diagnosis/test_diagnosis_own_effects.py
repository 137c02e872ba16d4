"""An effect as an object: what it must say of itself, names that are its own, and effects of one's own."""

import numpy as np
import pytest

from estimators import diagnose
from estimators.diagnosis.effects import CATALOGUE, Effect, Nature, Slot, named
from estimators.diagnosis.loop import Setting
from estimators.diagnosis.policy import Effort
from oed.data import Record
from oed.errors import InputError

RIVALS = tuple(
    map(named, ("pendulum", "position_periodic", "stiffness_cubic", "stiffness_square", "coulomb", "drag"))
)
COMPLETE = {"key": "mine", "cause": "mine", "nature": Nature.DYNAMIC, "sentence": "it acts"}


@pytest.mark.parametrize(
    "fields, lack",
    [
        ({"slot": Slot.INPUT, "starts": len, "parameters": {"a": "u"}}, "apply"),
        ({"slot": Slot.PLANT, "starts": len, "parameters": {"a": "u"}}, "a force"),
        ({"slot": Slot.OUTPUT, "apply": len, "parameters": {"a": "u"}}, "starts"),
        ({"slot": Slot.PLANT, "force": len, "starts": len}, "names and units"),
        ({"slot": Slot.PATH, "search": len}, "shape"),
        ({"slot": Slot.ADDED, "apply": len, "starts": len, "parameters": {"a": "y"}, "amplitude": 1}, "linear amplitude"),
        ({"slot": Slot.NOISE, "trials": 0}, "price"),
        ({"slot": Slot.NOISE, "key": ""}, "a key"),
        ({"slot": Slot.NOISE, "signal": len}, "the force"),
    ],
)  # fmt: skip
def test_an_effect_that_lacks_what_its_slot_needs_cannot_be_made(fields, lack):
    with pytest.raises(InputError, match=lack):
        Effect(**(COMPLETE | fields))


def test_keys_are_unique_and_siblings_and_relatives_exist():
    keys = [e.key for e in CATALOGUE]
    assert len(set(keys)) == len(keys)
    for e in CATALOGUE:
        assert {*e.refines, *([e.extends] if e.extends else [])} <= set(keys)
        assert not e.family or sum(other.family == e.family for other in CATALOGUE) > 1


def _pendulum(u, level):
    """x'' = 0.06 (u - x - level sin(2 x)) - 0.1 x', by small steps."""
    x, v, y = 0.0, 0.0, []
    for value in u:
        y.append(x)
        for _ in range(40):
            v += (0.06 * (value - x - level * np.sin(2 * x)) - 0.1 * v) / 40
            x += v / 40
    return np.array(y)


@pytest.mark.parametrize("level", [0.6, 0.0])
def test_an_effect_of_ones_own_is_found_and_only_where_it_is(level):
    mine = Effect(
        key="ripple", cause="ripple", nature=Nature.DYNAMIC, slot=Slot.PLANT, sentence="a force a sin(2 x)",
        parameters={"a": "u"}, force=lambda p, v, u, q, s, c: c[0] * np.sin(2.0 * p), against="position",
        starts=lambda s: ([[f * s.su] for f in (0.1, 0.4, -0.1)], [s.su]),
    )  # fmt: skip
    rng = np.random.default_rng(4)
    u = np.repeat(rng.uniform(-1.5, 1.5, 150), 8)
    y = _pendulum(u, level) + 0.01 * rng.standard_normal(len(u))
    result = diagnose(Record(u[:800], y[:800], 1.0), Record(u[800:], y[800:], 1.0, t0=900.0),
                      Setting(orders=(2,), effort=Effort.QUICK), effects=[*RIVALS, mine])  # fmt: skip
    if level:
        assert result.effect == "ripple"
        value, error, unit = result.parameters["ripple.a"]
        assert unit == "u"
        assert abs(value - level) < 0.05
        assert 0 < error < 0.05
    else:
        assert not result.detected
