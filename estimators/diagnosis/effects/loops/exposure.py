"""A flow that changes on its way through a volume: heated by its walls, converted, exposed to light, for as long as it passes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.profiled import BEGUN, MOST_FLOWS, ended, firm, profile, quick_behind

Array = NDArray[Any]
LEAST_FLOW = 1e-4  # volumes a sample: what stands still takes for ever
PASSAGES, LONGEST = 1.5, 0.05
"""Ratio of one time of passage at the mean flow to the next that are tried, from one sample on; and the longest, of the record."""
CHANGED, POWERS = (0.6, 1.5, 4.0), (0.0, 0.5, 0.8)
"""Of what a passage at the mean flow leaves, the negative logarithms that are tried; powers of the flow with which the change is
the faster: none where it takes its time, .8 where turbulence carries heat from a wall."""
SHORTEST, GENTLEST, STEEPEST = 0.7, -1.0, 0.98
"""Samples that a passage takes at least at the mean flow: one within a sample is a curve of the input; and the powers between which
what leaves depends on the flow as on a time: at one it does not."""
NEARBY = 6.0
"""Times the linear model's squares, which may have poles that imitate a passage, within which the best of these is worth a fit."""
BACKWARDS = 0.02  # of an input's samples, as many may be no flow
PARTS = 4  # of a sample: what leaves has a kink wherever a step of the flow entered
SWIFTEST = 1e-9  # of a change, the exposure in a sample: a shorter one has no time constant


@dataclass(frozen=True, eq=False)
class _Way:
    """`entered` volumes (M + 2,) and `exposure` since, from long before a record on to the end of each part of a sample; `leaving`
    (M + 1,) what had entered of what leaves, and `change` its exposure, from the record's start on."""

    entered: Array
    exposure: Array
    leaving: Array
    change: Array

    def mean(self, x: Array) -> Array:
        """(N,) what a signal (M + 1,) at the ends of the parts is on average in each sample: the linear part takes it as held."""
        return np.asarray((0.5 * (x[1:] + x[:-1])).reshape(-1, PARTS).mean(axis=1))


def _way(x: Array, p: Array) -> _Way | None:
    """The way of a flow (N,) through a volume; p: the volume in samples of flow, the rate of change at a flow of one volume a sample,
    and the power of the flow by which that grows. No record's mean comes in: another record has another."""
    volume, rate, power = abs(float(p[0])), float(p[1]), float(p[2])
    if not (volume > 0.0 and rate > 0.0 and GENTLEST < power < STEEPEST):
        return None
    flow = np.maximum(_parted(x) / volume, LEAST_FLOW)
    quicker, long = rate * np.power(flow, power), 2.0 / flow[0]
    entered = np.concatenate(([-long * flow[0], 0.0], np.cumsum(flow[1:]) / PARTS))
    exposure = np.concatenate(([-long * quicker[0], 0.0], np.cumsum(quicker[1:]) / PARTS))
    leaving = entered[1:] - 1.0
    return _Way(entered, exposure, leaving, exposure[1:] - np.interp(leaving, entered, exposure))


def _parted(x: Array) -> Array:
    """(M + 1,) an input before a record, and in the parts of each of its samples."""
    return np.append(level_before(x), np.repeat(x, PARTS))


def _passed(x: Array, p: Array, clock: Clock) -> Array:
    """What is left of a full volume, once it leaves."""
    way = _way(x, p)
    return np.full(len(x), np.inf) if way is None else abs(float(p[0])) * way.mean(np.exp(-way.change))


def _carried(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """What is left of an input above a level that entered with the flow, the input p[-1] counted from 1."""
    way, x = _way(U[:, int(p[-1]) - 1], p), U[:, channel]
    if way is None:
        return np.full(len(U), np.inf)
    content = _parted(x) - p[3]
    carried = np.concatenate(([0.0], np.cumsum(content * np.diff(way.entered))))
    left = np.diff(np.interp(way.leaving, way.entered, carried)) / np.diff(way.leaving)
    left *= np.exp(-0.5 * (way.change[1:] + way.change[:-1]))
    return np.asarray(left.reshape(-1, PARTS).mean(axis=1))


def _walled(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """How near a flow, the input p[-1] counted from 1, has come to an input above a level, the wall's, on its way."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import lagged

    way, x = _way(U[:, int(p[-1]) - 1], p), U[:, channel]
    if way is None:
        return np.full(len(U), np.inf)
    wall = _parted(x) - p[3]
    near = lagged(wall, 1.0 / np.maximum(np.diff(way.exposure), SWIFTEST))  # without an end of the way
    began = np.interp(way.leaving, way.entered, np.append(near[0], near))
    return way.mean(near - began * np.exp(-way.change))


def _flows(channel: Any, base: Any) -> Iterator[tuple[int, float]]:
    """Every input that is a flow, and its mean."""
    for j in base.structure.inputs if base.structure.layout == "tf" else ():
        u = channel.u[:, j]
        if (mean := float(np.mean(u))) > 0.0 and np.mean(u <= 0.0) <= BACKWARDS:
            yield j, mean


def _looked(channel: Any, mean: float, left: Callable[[list[list[float]]], list[Any]], at: int) -> list[Any]:
    """What the best ways through a volume `left`, and with which parameters, the volume `at` a place of them: all times of passage with
    one power are tried, then the best time with the others."""
    times = PASSAGES ** np.arange(np.log(LONGEST * len(channel)) / np.log(PASSAGES))
    ways = [[t * mean, c * t ** (m - 1.0), m] for t, c, m in product(times, CHANGED, POWERS)]
    found = sorted(left([way for way in ways if way[2] == POWERS[1]]), key=lambda entry: entry[0])
    if found:
        best = [way for way in ways if way[0] == found[0][1][at] and way[2] != POWERS[1]]
        found = sorted([*found, *left(best)], key=lambda entry: entry[0])
    return found[:BEGUN]


def _fits(
    channel: Any, base: Any, bare: Any, part: Any, tried: list[tuple[float, Array]], sizes: list[float]
) -> Iterator[Any]:
    if not tried or tried[0][0] > NEARBY * float(np.sum(base.residual**2)):
        return
    for f in ended(channel, bare, part, (p for _, p in tried), sizes):
        volume = f.p[f.structure.slices()[-1]][0]
        if volume > SHORTEST * sizes[0] and firm(base, float(np.sum(f.residual**2))):
            yield f


def _passages(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Every flow, with a quick linear part behind: the poles of the linear model stood for the passage."""
    from estimators.diagnosis.model.structure import Part

    for j, mean in _flows(channel, base):
        for quick in quick_behind(channel, base):
            part = Part(EXPOSED, j)
            tried = _looked(channel, mean, partial(profile, channel, quick, part), -3)
            yield from _fits(channel, base, quick, part, tried, [mean, 0.1, 1.0])


def _beside(channel: Any, alone: Any, part: Any, ways: list[list[float]]) -> list[tuple[float, Array]]:
    """The profile of ways of a content, `part`, without a level, beside what the flow does `alone` on the same way."""
    flow = alone.structure.parts[-1].channel + 1.0
    beside = ((way, replace(alone, p=np.concatenate((alone.p, way)))) for way in ways)
    return [run for way, begun in beside for run in profile(channel, begun, part, [[*way, 0.0, flow]])]


def _contents(effect: Callable[[], Effect], sign: float) -> Callable[..., Iterator[Any]]:
    """Every input with every other that is a flow: what the flow alone would do, beside it, tells the level."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.structure import Part

        quick, inputs = quick_behind(channel, base)[-1], base.structure.inputs
        for (j, mean), i in product(_flows(channel, base), inputs if len(inputs) <= MOST_FLOWS else ()):
            if i == j:
                continue
            part, su = Part(effect(), i), float(np.std(channel.u[:, i]))
            alone = replace(quick, structure=quick.structure.adding(Part(EXPOSED, j)))
            starts = []
            for _, p in _looked(channel, mean, partial(_beside, channel, alone, part), -5):
                content, flow = (_gain(quick.structure, p, k) for k in (i, j))
                starts += [[*p[-5:-2], sign * flow * p[-5] / (content or 1e-300), j + 1.0]]
            tried = profile(channel, quick, part, starts)
            yield from _fits(channel, base, quick, part, tried, [mean, 0.1, 1.0, su, 0.0])

    return search


def _gain(s: Any, p: Array, j: int) -> float:
    """What the linear part's numerator makes of a constant at an input."""
    at = s.order + s.inputs.index(j) * s.taps
    return float(np.sum(p[at : at + s.taps]))


_NAME = "flow_dependent_delay"
_WAY = {"volume": "u sample", "rate": "1/sample", "power": "1"}
EXPOSED = Effect(
    key="exposure", cause=_NAME, nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=100, alone=True, parameters=_WAY,
    sentence="the input is a flow, and what passes is heated, converted or exposed for as long as it takes: a heat exchanger, a tube reactor",
    apply=_passed, search=_passages,
)  # fmt: skip
CARRIED = Effect(
    key="exposure_carried", cause=_NAME, nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=100, alone=True,
    sentence="a flow, another input, carries what enters with it, and changes it for as long as it takes to pass: a heat exchanger, a tube reactor",
    parameters=_WAY | {"level": "u", "flow": "1"}, apply=lambda x, p, clock: x, signal=_carried,
    search=_contents(lambda: CARRIED, -1.0),
)  # fmt: skip
WALLED = Effect(
    key="exposure_walled", cause=_NAME, nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=100, alone=True,
    sentence="a flow, another input, nears what its walls have for as long as it takes to pass them: a heat exchanger",
    parameters=_WAY | {"level": "u", "flow": "1"}, apply=lambda x, p, clock: x, signal=_walled,
    search=_contents(lambda: WALLED, 1.0),
)  # fmt: skip
EXPOSURES = (EXPOSED, CARRIED, WALLED)
