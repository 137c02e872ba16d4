"""A drive that moves a load through an elastic gear with play: neither its own poles nor the load's are the linear model's."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.input import kept
from estimators.diagnosis.effects.loops.limited import NEAR, shaped

Array = NDArray[Any]
OWN, DAMPED, RATIOS = (0.8, 1.5), (0.5, 1.0), (0.1, 0.4)
"""Of the linear model's slowest pole, how fast a servo is taken to be; its damping ratio; the load's share of its inertia."""
STIFF, CONTACTS, LOSSES, PLAYS = (1.5, 4.0), (0.3, 1.2), (0.1, 0.6), (0.05, 0.2)
"""The gear's natural frequency and the load's friction, of the drive's pace; damping in contact, of that frequency; half the play, of the
standard deviation of what drives it."""
TWISTING = (0.15, 0.4)
"""Natural frequencies of a gear behind a torque, radians per sample: slower ones are poles of their own, quicker ones are stiff."""
LEAST = 1e-6
"""Of a parameter's size, below which it is none: a gear without stiffness moves nothing."""


def of_drive(p: Array, torque: bool) -> Array:
    """The parameters as the recursion takes them: a torque has no frequency of its own."""
    p = np.maximum(np.abs(p), LEAST)
    return np.concatenate(([1.0], p)) if torque else p


def _runs(torque: bool, seen: int) -> Any:
    def run(x: Array, p: Array) -> Array:
        from estimators.diagnosis.effects.kernels.loop_kernels import geared

        return geared(x, of_drive(p, torque), level_before(x), torque, seen)

    return lambda x, p, clock: kept(run, x, p)


def _servos(slowest: float, u: Array) -> Iterator[list[float]]:
    for own, damped, *rest in product(OWN, DAMPED, RATIOS, STIFF, CONTACTS, LOSSES, PLAYS):
        w, (reaction, stiff, contact, loss, play) = own * slowest, rest
        yield [
            w,
            2.0 * damped * w,
            reaction,
            stiff * w,
            contact * stiff * w,
            loss * w,
            play * float(np.std(u)),
        ]


def _motors(slowest: float, u: Array) -> Iterator[list[float]]:
    """Drives that slow down by themselves with the linear model's slowest pole, whose play is turned through in a gear's time."""
    for ratio, w, contact, loss, play in product(RATIOS, TWISTING, CONTACTS, LOSSES, PLAYS):
        yield [slowest, ratio, w, contact * w, loss * slowest, play * float(np.std(u)) / w]


SERVO = {"servo_frequency": "rad/sample"}
GEAR = {
    "drive_damping": "1/sample", "inertia_ratio": "1", "gear_frequency": "rad/sample", "gear_damping": "1/sample", "load_friction": "1/sample",
}  # fmt: skip


def _geared(key: str, sentence: str, torque: bool, seen: int) -> Effect:
    parameters = ({} if torque else SERVO) | GEAR | {"half_play": "u sample" if torque else "u"}
    effect = Effect(
        key=key, cause="backlash", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=_runs(torque, seen), sentence=sentence,
        parameters=parameters,
        search=shaped(
            lambda: effect, _motors if torque else _servos,
            lambda slowest, su: [*[slowest] * (1 + (not torque)), 1.0, *[slowest] * 3, su / slowest if torque else su],
            NEAR, np.eye(len(parameters)), 2 if torque else 3,
        ),
    )  # fmt: skip
    return effect


WORDS = "{} moves a load through an elastic gear with play, and feels it; {} is seen"
GEARED: dict[Effect, tuple[bool, int]] = {
    _geared(key, WORDS.format(drive, what), torque, seen): (torque, seen)
    for key, drive, what, torque, seen in (
        ("geared_servo", "a servo", "the load", False, 2),
        ("geared_load", "a torque", "the load's speed", True, 3),
        ("geared_motor", "a torque", "the motor's speed", True, 1),
    )
}
"""The effects, whether a torque drives it, and which state is seen."""
