"""Sensors that report a change of more than a least step, and stand in between; some report at fixed times besides."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.output import KEPT
from estimators.diagnosis.effects.sensing.sensors import settled
from estimators.diagnosis.record.measurement import STILL

Array = NDArray[Any]
REPORTS = 20
"""Moves of the reading at least, of a sensor that reports changes only."""
CLEAR_OF = 4.5
"""Of the spread of the steps from sample to sample, from which on one is a report: the others are noise, or none. Once in a hundred records
of 1500 samples noise steps so far, and a report may be of hardly more than the least step, with noise against it."""
CLEAR_BEAT = 6.0
"""Standard errors by which reports are denser at fixed times than elsewhere, of hundreds of periods."""
LEAST_STEPS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35)
"""Quantiles of the reports' steps at which the least change that is reported may lie: most are larger, as the signal moves on."""
BEATS, SHORTEST = 8, 3
"""Reports at fixed times that a record must hold, and samples from one to the next at least."""
NEARBY = np.linspace(0.85, 1.15, 31)
"""Factors of the best of them that are looked at then."""
BEATEN = (0.1, 0.2, 0.3, 0.45, 0.6, 0.75, 0.9, 0.97)
"""Quantiles of the reports' steps at which the least one may lie where those at fixed times are of any size."""


def _reported(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import reported

    beaten = (
        np.zeros(len(x), dtype=bool) if len(p) < 3 else (clock.k - p[2]) % max(abs(float(p[1])), 1.0) < 0.5
    )
    x = settled(x, clock)
    return reported(x, abs(float(p[0])), float(x[0] + p[-1]), beaten)


def densest(moved: NDArray[np.bool_]) -> tuple[int, int]:
    """Samples from one report to the next, and the place of the first, where reports are denser than elsewhere: (0, 0) where nowhere are."""
    best, n, share = (0.0, 0, 0), len(moved), float(np.mean(moved))
    for every in range(SHORTEST, n // BEATS + 1):
        whole = moved[: n // every * every].reshape(-1, every)
        mean = whole.mean(axis=0)
        place = int(np.argmax(mean))
        clear = (mean[place] - share) * np.sqrt(len(whole) / (share * (1.0 - share)))
        best = max(best, (float(clear), every, place))
    return best[1:] if best[0] > CLEAR_BEAT else (0, 0)


def _of_each(y: Array, seen: NDArray[np.bool_], keep: NDArray[np.bool_]) -> Array:
    """(N,) readings of which each is the mean of those until the next report: what was reported, read as often as it stood."""
    which = np.cumsum(seen)
    count, total = np.bincount(which, keep), np.bincount(which, np.where(keep, y, 0.0))
    return np.where(count[which] > 0, (total / np.maximum(count, 1.0))[which], y)


def _least_step(x: Array, held: Array, seen: NDArray[np.bool_], keep: NDArray[np.bool_]) -> float:
    """The step at which most samples of a signal x (N,) are rightly said to be reported or not, each against the report before it."""
    from_last = np.abs(x[1:] - held[:-1])[keep[1:]]
    order = np.argsort(from_last)
    reported = seen[1:][keep[1:]][order]
    # where the step lies above so many of them
    wrong = np.cumsum(reported) + np.sum(~reported) - np.cumsum(~reported)
    at = int(np.argmin(wrong))
    return float(np.mean(from_last[order[at : at + 2]]))


def _reports(channel: Any, base: Any, beaten: bool) -> Iterator[Any]:
    """A linear model of the samples that were reported, which are the signal itself, and the least step that leaves least."""
    from estimators.diagnosis.model.fitting import Fit, fit
    from estimators.diagnosis.model.shown import LATER, as_shown, begun_at_rest
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Part, Structure

    s, keep = base.structure, channel.keep
    if s.layout != "tf" or s.effects or np.mean(keep) < KEPT:
        return
    steps = np.abs(np.diff(channel.y))
    moved = steps > CLEAR_OF * 1.4826 * np.median(steps)
    if not (REPORTS <= moved.sum() <= (1.0 - STILL) * len(steps)):
        return
    every, place = densest(moved) if beaten else (0, 0)
    if beaten and not every:
        return
    # a change that is reported between the fixed times alone shows a least step: without any, the sensor is read anew every so often
    if beaten and not np.sum(moved & (np.arange(len(moved)) % every != place)) >= REPORTS:
        return
    seen = np.concatenate(([False], moved))  # the first reading may be of any time before
    beat = [float(every), float((channel.clock.k[0] + place + 1) % every)] if beaten else []
    first = int(np.argmax(moved)) + 1
    quantiles = np.quantile(steps[moved], BEATEN if beaten else LEAST_STEPS)
    held = replace(channel, y=_of_each(channel.y, seen, keep))
    at_times = np.arange(len(seen)) % every == place + 1 if beaten else np.zeros(len(seen), dtype=bool)
    size = 0.05 * float(quantiles[0])
    found: list[tuple[float, Array, Fit, Structure]] = []
    for shown in as_shown(held, base, held.y, seen, LATER):
        f = begun_at_rest(held.without(~seen), shown)
        new, at = f.structure.adding(Part(BEAT if beaten else REPORTED, s.inputs[0])), len(f.p)

        def left(p: Array, new: Structure = new) -> float:
            return float(np.sum((channel.y - simulate(new, p, channel.u, channel.clock))[keep] ** 2))

        x = simulate(f.structure, f.p, channel.u, channel.clock)
        off = float(np.mean(channel.y[:first]) - x[0])
        sizes = [*quantiles, _least_step(x, held.y, seen, keep & ~at_times)]
        best = min((np.append(f.p, [size, *beat, off]) for size in sizes), key=left)
        near = min(np.where(np.arange(len(best)) == at, best * NEARBY[:, None], best), key=left)
        # what is reported late or early is off by a step: of the samples that were seen alone, a model of one pole more may be as good
        found.append((left(near), near, f, new))
    _, p, f, new = min(found, key=lambda entry: entry[0])
    scales = np.append(f.scales, [size, *np.zeros(len(beat)), size])
    yield fit(channel, new, p, scales, noise=base.noise, iterations=10)


SENDS = "the sensor reports a change of more than a least step only, and stands in between"
REPORTED = Effect(
    key="reported_on_change", cause="report_on_change", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, trials=12,
    sentence=SENDS, apply=_reported, parameters={"least_step": "y", "start": "y"},
    search=lambda channel, base, others: _reports(channel, base, False),
)  # fmt: skip
BEAT = Effect(
    key="reported_in_time", cause="report_on_change", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, trials=100,
    sentence=f"{SENDS}, but for reports at fixed times", apply=_reported,
    parameters={"least_step": "y", "every": "sample", "place": "sample", "start": "y"},
    search=lambda channel, base, others: _reports(channel, base, True),
)  # fmt: skip
REPORTING = (REPORTED, BEAT)
