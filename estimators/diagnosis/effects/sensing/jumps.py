"""Samples of the output that are lost or come twice, a buffer that grows: from then on its time base is another, once or several times."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, numbered
from estimators.diagnosis.effects.output import in_step, mended, read_at

Array = NDArray[Any]
JUMPS = (1.0, 2.0, 3.0, 5.0)  # samples lost at once
TIMES = 12  # of a jump, over the record
EDGE = 0.07  # of the record, at either end of which no jump is looked for
MOST, AGAIN = 5, 20.0
"""Jumps that are looked for, one after the other, and what each must gain of Schwarz's criterion."""


def _jumped(y: Array, p: Array, clock: Clock) -> Array:
    at = np.arange(len(y), dtype=float)
    for samples, time in p.reshape(-1, 2):
        # all samples are out of step, or none: a delay, or nothing
        if not EDGE < time / clock.length < 1.0 - EDGE:
            return np.full(len(y), np.inf)
        at += samples * np.clip(clock.k - time, 0.0, 1.0)
    return read_at(y, at)


_once = mended(
    lambda: LOST,
    lambda c: [[sign * d, t * len(c)] for t in np.linspace(0.08, 0.92, TIMES) for d in JUMPS[:2] for sign in (1.0, -1.0)],
    lambda c, best: [[d, best[1] + t * len(c)] for d in {best[0], np.sign(best[0]) * JUMPS[2]} for t in np.linspace(-0.07, 0.07, 9)],
)  # fmt: skip


def _lost(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The best jump, and one more after the other until one gains too little; beside a new one the others are looked for anew."""
    for f in _once(channel, base, others):
        yield f
        for size in range(2, MOST + 1):
            if (more := _beside(channel, f, _jumps(f))) is None:
                break
            for i in range(size):
                again = _beside(channel, more, np.delete(_jumps(more), i, axis=0))
                more = more if again is None or again.criterion >= more.criterion else again
            if not more.criterion < f.criterion - AGAIN:
                break
            yield (f := more)


def _jumps(f: Any) -> Array:
    """(m, 2) samples and time of each jump of a fit."""
    return f.p[f.structure.slices()[-1]].reshape(-1, 2)


def _beside(channel: Any, f: Any, known: Array) -> Any:
    """The fit with the best jump in an output that some jumps have been taken out of, beside these; None where there is none."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear

    if (stepped := in_step(LOST, list(known.ravel()), channel)) is None:
        return None
    there, straight = replace(channel, y=stepped[0]), replace(f.structure, parts=f.structure.parts[:-1])
    found = list(_once(there, fit_linear(there, straight, rough=True), ()))
    if not found:
        return None
    best = min(found, key=lambda g: g.criterion)
    s = straight.adding(replace(f.structure.parts[-1], size=len(known) + 1))
    p = np.concatenate((best.p[: straight.size], known.ravel(), _jumps(best).ravel()))
    scales = np.concatenate((f.scales[: straight.size], np.ones(len(p) - straight.size)))
    return fit(channel, s, p, scales, noise=f.noise, iterations=25)


LOST = Effect(
    key="lost_samples", cause="lost_samples", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, linear=True, ahead=True, trials=0.1,
    per_sample=True, sentence="samples of the output are lost, or come twice, and what follows is out of step", apply=_jumped, search=_lost,
    parameters={"samples": "1", "time": "sample"},
    shape=lambda size, order: numbered(LOST.parameters, size) if size > 1 else list(LOST.parameters.items()),
)  # fmt: skip
