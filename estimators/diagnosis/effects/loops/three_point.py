"""A motor without a speed of its own: it runs one way or the other, at one speed each, until it is near enough to its command."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.loops.limited import ACROSS
from estimators.diagnosis.effects.profiled import CROSSED, ended, firm, lean, nearer, profile

Array = NDArray[Any]
RATIOS, HALTS, ZONES = (0.7, 1.0, 1.4), (0.01, 0.03, 0.07, 0.15), (0.0, 0.05, 0.12)
"""Of the speed down to the speed up; of the input's range, the distance from the command at which the motor halts, and how much
farther off it starts, that are tried."""
NEAREST, ROUNDS = 3, 2
"""Shapes that are moved and fitted, and how often."""


def _run(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.loop_kernels import three_point

    up, down, halt, zone = (abs(float(v)) for v in p)
    return three_point(np.ascontiguousarray(x), up, down, halt, zone, level_before(x))


def _motors(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    from estimators.diagnosis.model.structure import Part

    for j in base.structure.inputs if base.structure.layout == "tf" else ():
        part, wide = Part(THREE_POINT, j), float(np.ptp(channel.u[:, j]))
        shapes = (
            [wide / m, q * wide / m, halt * wide, zone * wide]
            for m, q, halt, zone in product(ACROSS, RATIOS, HALTS, ZONES)
        )
        tried = profile(channel, base, part, shapes)[:NEAREST]
        if not tried or not firm(base, tried[0][0]):
            continue
        su, steps = float(np.std(channel.u[:, j])), wide * np.array([0.02, 0.04])
        starts = [p for _, p in tried]
        for _ in range(ROUNDS):  # in turn: what crosses an edge has no derivative, speeds and poles have
            moved = [q for p in starts for q in profile(channel, base, part, [p[len(base.p) :]], p)]
            near = sorted(
                (nearer(channel, base, part, best, steps) for best in moved), key=lambda entry: entry[0]
            )
            fits = list(ended(channel, base, part, (p for _, p in near), [su, su, su, 1e6 * CROSSED * su]))
            starts = [f.p for f in sorted(fits, key=lambda f: f.criterion)[:1]]
        yield from lean(channel, fits)


THREE_POINT = Effect(
    key="three_point", cause="rate_limiter", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=60, reversing=True, family="rates",
    sentence="a three-point motor follows the input: it starts beyond a neutral zone, runs at one speed up and another down, and halts near its command",
    parameters={"up": "u/sample", "down": "u/sample", "halt": "u", "zone": "u"}, apply=_run, search=_motors,
)  # fmt: skip
