"""Sensors that take turns: one sample of every cycle is another one's."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.loops.ageing import leaky
from estimators.diagnosis.effects.output import read_at
from estimators.diagnosis.effects.profiled import firm

Array = NDArray[Any]
LONGEST = 24
"""Samples of the longest cycle of sensors that take turns: of a longer one too few samples are of any."""
WAYS = (
    (0.0, 0.0),
    *((lag, 0.0) for lag in (3.0, 10.0, 30.0, 100.0)),
    *((0.0, at) for at in (-0.6, -0.2, 0.2, 0.6)),
)
"""Lags of the sensor whose turn it is, and instants at which it reads, in samples, that it is tried with: neither, or one of them."""
TOP = float(np.cos(np.pi / LONGEST))  # between that of a wave and the samples next to it


def _turn(p: Array, clock: Clock) -> Any:
    """1 in the samples whose turn it is, else 0: where a wave of the cycle's length has its top."""
    return 1.0 * (np.cos(2.0 * np.pi * (clock.k - p[1]) / p[0]) > TOP)


def _turned(x: Any, p: Array, clock: Clock) -> Any:
    return x + _turn(p, clock) * (p[2] * _its_own(x, p[4], p[5]) + p[3] - x)


def _its_own(x: Array, lag: float, later: float) -> Array:
    """What a sensor of some lag, in samples from one on, would show so much later than the others."""
    x = x if abs(lag) < 1.0 else leaky(x, lag)
    return x if later == 0.0 else read_at(x, np.arange(len(x)) + later)


def _turns(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Of all cycles and places in them, where a line through the output and what lags behind it explains most of the residual; the others
    tell the plant, and with it the lag or the instant."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Part

    def line(columns: Array, y: Array, on: Array) -> tuple[Array, float]:
        """Coefficients of columns, the first of them 1, and the sum of squares that they explain."""
        told = np.linalg.lstsq(columns[on], y[on], rcond=None)[0]
        return told, float(np.sum((columns[on] @ told) ** 2))

    s, keep, clock = base.structure, channel.keep, channel.clock
    if s.layout != "tf" or s.effects:
        return
    places = [np.array([c, i]) for c in range(2, LONGEST + 1) for i in range(c)]
    x, squares = channel.y - base.residual, float(np.sum(base.residual**2))
    columns = np.stack([np.ones(len(x)), *(_its_own(x, *way) for way in WAYS)], axis=1)
    told = np.array([line(columns, base.residual, keep & (_turn(p, clock) > 0.0))[1] for p in places])
    if not firm(base, squares - told.max()):
        return
    for place in (
        places[i] for i in np.argsort(-told)[:2]
    ):  # of two in turn, either stands out of the model of both
        on = _turn(place, clock) > 0.0
        f = fit(replace(channel, keep=keep & ~on), s, base.p, base.scales, iterations=20, colour=False)
        x = simulate(s, f.p, channel.u, clock)
        seen = [
            (way, *line(np.stack([np.ones(len(x)), _its_own(x, *way)], axis=1), channel.y, keep & on))
            for way in WAYS
        ]
        way, (offset, gain), _ = max(seen, key=lambda entry: entry[2])
        p = np.concatenate((f.p, place, [gain, offset, *way]))
        scales = np.concatenate((f.scales, [0.0, 0.0, 1.0, float(np.std(channel.y)), *np.abs(way)]))
        yield fit(channel, s.adding(Part(TURNS)), p, scales, noise=base.noise, iterations=20)


TURNS = Effect(
    key="multiplexed", cause="multiplexed_sensor", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, ahead=True, trials=300,
    sentence="one sample of every cycle is read otherwise than the rest: a scanner, or sensors in turn, one of another gain, zero, lag or instant",
    parameters={"cycle": "sample", "place": "sample", "gain": "1", "zero": "y", "lag": "sample", "later": "sample"}, apply=_turned, search=_turns,
)  # fmt: skip
