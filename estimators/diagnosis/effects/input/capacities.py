"""Processes whose capacity or loss changes: a flow fills what the input acts on, or empties it; its own power warms what takes from it."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.input.acting import kept
from estimators.diagnosis.effects.loops import PACES, slowest_rate
from estimators.diagnosis.effects.process import FASTEST, profiled_fits
from estimators.diagnosis.effects.profiled import MOST_FLOWS

Array = NDArray[Any]
WARM, HEATS, SLOW, MOST_WARM = (-0.6, 0.8), (0.3, 1.5), (0.05, 0.2), 20.0
"""Of a loss that its own power warms: share by which it changes in the end, heat for the mean power, time constants in records,
that are tried; and the largest share."""
SLOWER = 0.3
"""Of a process' rate, that of a slow state may be: as quick as the process, it is a curve of it."""
CONTENTS = (-0.6, 0.5, 1.5, 4.0, 10.0)
"""Relative changes over the record of what a capacity had at its start."""
FILLS = 0.5  # of all that flows, what must be net for something to be filled or emptied


def _warming(x: Array, p: Array) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import warmed

    rate, share, heat, pace = abs(float(p[0])), float(p[1]), abs(float(p[2])), abs(float(p[3]))
    if not (0.0 < rate < FASTEST and pace < SLOWER * rate and -1.0 < share < MOST_WARM):
        return np.full(len(x), np.inf)
    return warmed(x, rate, share, np.array([heat, pace]), level_before(x))


def _filled(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """A capacity at one input that another, the one p[-1] counted from 1, fills or empties."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import filled

    if not 0.0 < abs(p[0]) < FASTEST:
        return np.full(len(U), np.inf)
    x, flow = (np.ascontiguousarray(U[:, j]) for j in (channel, int(p[-1]) - 1))
    return filled(x, flow, np.array([abs(p[0]), *p[1:4], level_before(x), level_before(flow)]), clock.lead)


def _warmings(rates: list[float], u: Array) -> Iterator[list[float]]:
    power, n = float(np.mean(u**2)) + 1e-300, len(u)
    for rate, share, heat, m in product(rates, WARM, HEATS, SLOW):
        yield [rate, share, heat / power, 1.0 / (m * n)]


def _fillings(slowest: float, u: Array, flow: Array, which: int) -> Iterator[list[float]]:
    filled, size = float(np.sum(flow)), float(np.mean(u)) + float(np.std(u))
    for faster, change, (bring, carry) in product(PACES, CONTENTS, ((0, 0), (0, 1), (1, 1), (-1, 1))):
        yield [faster * slowest, change / filled, bring * size, float(carry), which + 1.0]


def _warm(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Every input, at the rates of the linear model's poles and of most rigs: its slowest may stand for the heat."""
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import sizes_of

    s, n = base.structure, len(channel)
    for j in s.inputs if s.layout == "tf" and s.order else ():
        u, part = channel.u[:, j], Part(WARMED, j)
        rates = sizes_of(channel, base, part).rates
        sizes = [max(rates), 1.0, 1.0 / (float(np.mean(u**2)) + 1e-300), 10.0 / n]
        yield from profiled_fits(channel, base, part, _warmings(rates, u), sizes)


def _capacities(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Every input with every flow that fills more than it takes back."""
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.free_runs import denominator

    s = base.structure
    if s.layout != "tf" or s.order < 1 or len(s.inputs) > MOST_FLOWS:
        return
    slowest = slowest_rate(denominator(base), len(channel))
    for j, i in product(s.inputs, s.inputs):
        u, flow = channel.u[:, j], channel.u[:, i]
        if abs(total := float(np.sum(flow))) > FILLS * float(np.sum(np.abs(flow))):
            sizes = [slowest, 1.0 / abs(total), float(np.std(u)) + abs(float(np.mean(u))), 1.0, 0.0]
            yield from profiled_fits(channel, base, Part(FILLED, j), _fillings(slowest, u, flow, i), sizes)


FILLED = Effect(
    key="capacity_filled", cause="filling_capacity", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=100, alone=True,
    sentence="a flow fills what the input acts on, or empties it: the time constant follows the flow's integral since the record began",
    parameters={"rate": "1/sample", "fill": "1/(u sample)", "bring": "u", "carry": "1", "flow": "1"},
    apply=lambda x, p, clock: _filled(x[:, None], 0, np.array([*p[:4], 1.0]), clock), signal=_filled, search=_capacities,
)  # fmt: skip
WARMED = Effect(
    key="loss_heat", cause="slow_hidden_state", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=60, alone=True, family="heat",
    sentence="the loss changes with a slow state that its own power feeds: oil, a winding that warms",
    parameters={"rate": "1/sample", "share": "1", "heat": "1/u^2", "pace": "1/sample"},
    apply=lambda x, p, clock: kept(_warming, x, p), search=_warm,
)  # fmt: skip

CAPACITIES = (FILLED, WARMED)
