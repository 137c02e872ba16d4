"""Actuators that are switched on and off: by commands, keeping to times of their own, or by themselves, until they are near enough to a command."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.loops.anew import remade
from estimators.diagnosis.effects.loops.limited import ACROSS
from estimators.diagnosis.effects.profiled import (
    CROSSED,
    descended,
    ended,
    firm,
    lean,
    nearer,
    of_order,
    profile,
)

Array = NDArray[Any]
LONGEST, TRIED, KEPT, FURTHER = 80.0, 24, 2, (0, 1)
"""Samples that an actuator keeps to, at most, how many times up to the longest are tried, and of them those that are moved closer; and
poles that the linear part may have more than the linear model, which leaves out what the actuator hides."""
RATIOS, HALTS, ZONES = (0.7, 1.0, 1.4), (0.01, 0.03, 0.07, 0.15), (0.0, 0.05, 0.12)
"""Of the speed down to the speed up; of the input's range, the distance from the command at which the motor halts, and how much
farther off it starts, that are tried."""
NEAREST, ROUNDS = 3, 2
"""Shapes that are moved and fitted, and how often."""


def times(which: str, p: Array) -> tuple[float, float, float, float]:
    """Samples by which it starts and stops late, and which it pauses and runs at least."""
    t = float(p[0])
    late = max(t, 0.0), max(-t, 0.0)
    return (
        (*late, 0.0, 0.0)
        if which == "switched_late"
        else (0.0, 0.0, *((abs(t), 0.0) if which == "least_pause" else (0.0, abs(t))))
    )


def _applied(which: str) -> Callable[..., Array]:
    def apply(x: Array, p: Array, clock: Clock) -> Array:
        from estimators.diagnosis.effects.kernels.loop_kernels import in_own_time

        return in_own_time(np.ascontiguousarray(x), *times(which, p))

    return apply


def _told(which: str, u: Array) -> Array:
    """Times that tell something of an input: of pauses or runs that are longer than the shortest, up to the longest."""
    between = np.diff(np.flatnonzero(np.diff(u)))
    grid = np.unique(np.round(np.geomspace(1.0, min(float(np.max(between, initial=1.0)), LONGEST), TRIED), 1))
    return (
        np.concatenate((-grid, grid))
        if which == "switched_late"
        else grid[grid > np.min(between, initial=1.0)]
    )


def _left(entry: tuple[float, Array]) -> float:
    return entry[0]


def _tried(channel: Any, bare: Any, part: Any, time: float) -> tuple[float, Array]:
    """(sum of squares, parameters) of an actuator that keeps to a time, with a linear part made for it."""
    return remade(channel, bare.structure.adding(part), np.append(bare.p, time))


def _searched(which: str) -> Callable[..., Iterator[Any]]:
    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.linear import plant_scales
        from estimators.diagnosis.model.structure import Part
        from estimators.diagnosis.record.measurement import switched

        s = base.structure
        for j in s.inputs if s.layout == "tf" and not s.effects else ():
            if not switched(channel.u[:, j]):
                continue
            fits: list[Any] = []
            part, grid = Part(SWITCHING[which], j), _told(which, channel.u[:, j])
            for more, delay in product(FURTHER, sorted({0, s.delay})):
                few, p, scales = of_order(base, s.order + more, s.taps + more)
                bare = replace(base, structure=replace(few, delay=delay), p=p, scales=scales)
                tried = partial(_tried, channel, bare, part)
                found = sorted(map(tried, grid), key=_left)[:KEPT]
                if not found or not firm(base, found[0][0]):
                    continue
                around = lambda p, size, tried=tried: [tried(p[-1] + way * size) for way in (-1.0, 1.0)]
                close = sorted((descended(around, best) for best in found), key=_left)
                scales[: few.plant_size] = plant_scales(few, close[0][1])
                fits += ended(channel, bare, part, [p for _, p in close], [1.0])
            yield from lean(channel, sorted(fits, key=lambda f: f.criterion)[:1])

    return search


SWITCHING = {
    key: Effect(
        key=key, cause="switching_time", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=60, reversing=True, alone=True,
        sentence=f"the actuator is switched, and {what}", parameters={"duration": "sample"}, apply=_applied(key), search=_searched(key),
    )
    for key, what in (
        ("switched_late", "starts that much later after its command than it stops (less than zero: stops later)"),
        ("least_pause", "once it has stopped it does not start again for that time, whatever its command"),
        ("least_run", "once it has started it does not stop again for that time, whatever its command"),
    )
}  # fmt: skip


def _motor(x: Array, p: Array, clock: Clock) -> Array:
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
    parameters={"up": "u/sample", "down": "u/sample", "halt": "u", "zone": "u"}, apply=_motor, search=_motors,
)  # fmt: skip
