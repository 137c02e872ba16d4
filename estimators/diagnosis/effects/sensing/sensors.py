"""Sensors that report changes only, lag by what they read, show a sine or steps of it, or have a clock that swings or slips."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from estimators.diagnosis.effects.disturbances.added import level_at
from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.input import moved
from estimators.diagnosis.effects.output import KEPT, in_step, mended, quickly_made, read_at
from estimators.diagnosis.effects.profiled import FINEST, ended, firm, of_order, profile

Array = NDArray[Any]
CHANGES = (-0.6, -0.3, 0.3, 0.6)
"""Relative changes of a sensor's rate per standard deviation of what it reads, that are tried."""


SENSED = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Rates per sample of a sensor that lags, at its mean reading, that are tried."""


def _centred(x: Array, p: Array) -> tuple[Array, float, float]:
    return np.ascontiguousarray(x - p[2]), abs(float(p[0])), float(p[1])


def settled(x: Array, clock: Clock) -> Array:
    """What a sensor has read: before the record that was its rest, not the way there from zero."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import settled

    return settled(np.ascontiguousarray(x), clock.lead)


def _paced(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import paced

    return paced(*_centred(settled(x, clock), p)) + p[2]


def _unpaced(e: Effect, shape: list[float], channel: Any) -> tuple[Array, Array]:
    from estimators.diagnosis.effects.kernels.recursion_kernels import unpaced

    x, through = unpaced(*_centred(channel.y, np.array(shape)))
    return x + shape[2], through


def _paces(channel: Any) -> list[list[float]]:
    size, level = float(np.std(channel.y)), float(np.mean(channel.y))
    return [[rate, change / size, level] for rate in SENSED for change in CHANGES]


def _closer(channel: Any, best: list[float]) -> list[list[float]]:
    factors, more = (0.7, 1.0, 1.4), 0.15 / float(np.std(channel.y))
    return [[best[0] * f, best[1] + d, best[2]] for f in factors for d in (-more, 0.0, more)]


def before_sensor(channel: Any, base: Any, order: int, delay: int) -> Any:
    """The linear model with another number of poles or delay, roughly fitted: the sensor stands for the others."""
    from estimators.diagnosis.model.linear import fit_linear, plant_scales

    few, p, scales = of_order(base, order, min(base.structure.taps, order))
    few = replace(few, delay=delay)
    p[: few.plant_size] = fit_linear(channel, few, rough=True).p[: few.plant_size]
    scales[: few.plant_size] = plant_scales(few, p)
    return replace(base, structure=few, p=p, scales=scales)


def _sensed(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """With all of the linear model's poles before the sensor, and with one less: it was one of them."""
    search = mended(
        lambda: PACED, _paces, _closer, lambda c: [0.2, 1.0 / float(np.std(c.y)), 0.0], _unpaced, fitted=True
    )
    s = base.structure
    if s.layout != "tf" or s.effects:
        return
    yield from search(channel, base, others)
    if s.order > 1:
        yield from search(channel, before_sensor(channel, base, s.order - 1, s.delay), others)


PACED = Effect(
    key="sensor_paced", cause="level_dependent_lag", nature=Nature.DYNAMIC, slot=Slot.OUTPUT, memory=True, trials=20,
    sentence="the sensor lags, and is the quicker or the slower the more it reads: its rate goes with the level", apply=_paced,
    parameters={"rate": "1/sample", "change": "1/y", "level": "y"},
    search=_sensed,
)  # fmt: skip

SPANS = (1.0, 1.05, 1.15, 1.4, 2.0)
"""Of half the span that a sensor shows, the amplitude of its sine; its middle lies where the span leaves room for it."""


def _sine(x: Array, p: Array) -> Array:
    size = abs(float(p[0])) + 1e-300
    return size * (np.sin((x - p[1]) / size) + np.sin(p[1] / size))


def _sines(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Of sines that hold all readings, the arc of each, which is linear in the inputs; the best are fitted."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Part

    s, found = base.structure, []
    at = level_at(s)
    if s.layout != "tf" or s.effects or at is None or np.mean(channel.keep) < KEPT:
        return
    new = s.adding(Part(SINE))
    low, high = float(channel.y.min()), float(channel.y.max())
    for share, side in ((f, d) for f in SPANS for d in (-1.0, 0.0, 1.0) if d == 0.0 or f > 1.0):
        size = 0.5 * share * (high - low)
        middle = 0.5 * (high + low) + side * (size - 0.5 * (high - low))
        arc = size * np.arcsin(np.clip((channel.y - middle) / size, -1.0, 1.0))
        p = fit_linear(replace(channel, y=arc), s, rough=True).p
        centre = -p[at]
        p[at] = middle - size * np.sin(centre / size)
        p = np.concatenate((p, [size, centre]))
        found.append((float(np.sum((channel.y - simulate(new, p, channel.u, channel.clock)) ** 2)), p))
    sizes = np.concatenate((base.scales, [float(np.std(channel.y))] * 2))
    for _, p in sorted(found, key=lambda entry: entry[0])[:2]:
        yield fit(channel, new, p, sizes, noise=base.noise, iterations=30)


SINE = Effect(
    key="output_sine", cause="output_nonlinearity", nature=Nature.OUTPUT_STATIC, slot=Slot.OUTPUT, trials=12,
    sentence="the sensor reads a sine of its signal: an angle's component, light through a polariser", apply=lambda x, p, clock: _sine(x, p),
    parameters={"amplitude": "y", "centre": "y"}, curve=_sine, search=_sines,
)  # fmt: skip

GATHERED = 0.6
"""Resultant of the readings' phases in a step, from which on they lie on levels: with noise of a sixth of a step it is that, and that
of readings that lie anywhere is near none."""
FLATTER = (0.3, 0.1, 0.03, 0.01)
"""Widths of the risers, in steps, that a plant behind a staircase is fitted with one after the other: what is flat has no derivative."""
RISER = 0.004
"""Width of a riser that stands for an edge: what it leaves, .03 of a step, is under the noise that keeps the levels from being exact."""


def _treads(x: Any, p: Array, riser: float = RISER) -> Any:
    step = abs(float(p[0])) + 1e-300
    z = (x - p[1]) / step
    below = np.floor(z)
    return p[1] + step * (below + 0.5 + 0.5 * np.tanh((z - below - 0.5) / riser) / np.tanh(0.5 / riser))


@lru_cache(maxsize=1)  # for what steps at once, and for what does past a band
def _levels(channel: Any) -> tuple[float, float] | None:
    """Step of the levels that readings gather on, and one of the levels; None where they lie anywhere."""
    y = channel.y[channel.keep]
    wide = float(np.ptp(y)) + 1e-300
    waves = np.arange(2.0, FINEST, 0.1) / wide
    resultant = np.exp(2j * np.pi * np.outer(waves, y)).mean(axis=1)
    at = int(np.argmax(np.abs(resultant)))
    if abs(resultant[at]) < GATHERED:
        return None
    step, level = 1.0 / float(waves[at]), float(np.angle(resultant[at])) / (2.0 * np.pi * float(waves[at]))
    return step, level + step * round((float(np.mean(y)) - level) / step)


def _stepped(
    effect: Callable[[], Effect], shown: Callable[..., Array], bands: Sequence[list[float]]
) -> Callable[..., Iterator[Any]]:
    """The best of some bands, in steps, each from the levels that the readings gather on, with ever steeper risers."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.fitting import fit
        from estimators.diagnosis.model.structure import Part

        s, found = base.structure, []
        if s.layout != "tf" or s.effects or channel.step > 0 or (levels := _levels(channel)) is None:
            return
        new = s.adding(Part(effect()))
        for band in bands:
            p = np.concatenate((base.p, levels, levels[0] * np.array(band)))
            scales = np.append(base.scales, [levels[0]] * (2 + len(band)))
            for width in FLATTER:
                flatter = replace(effect(), apply=lambda x, p, clock, width=width: shown(x, p, width))
                flat = s.adding(Part(flatter))
                p = fit(channel, flat, p, scales, noise=base.noise, iterations=15, colour=False).p
            found.append(fit(channel, new, p, scales, noise=base.noise, iterations=10))
        yield from sorted(found, key=lambda f: f.deviance)[:1]

    return search


def _banded(x: Array, p: Array, riser: float = RISER) -> Array:
    """A staircase of a play: each step up or down comes as much after the middle between two levels."""
    return _treads(moved(x, abs(float(p[2])), 0.0), p, riser)


TREADS = Effect(
    key="output_staircase", cause="quantisation", nature=Nature.SAMPLING, slot=Slot.OUTPUT, trials=300,
    sentence="the sensor shows what it reads in whole steps, and noise comes on top", apply=lambda x, p, clock: _treads(x, p),
    parameters={"step": "y", "level": "y"}, curve=_treads,
    search=_stepped(lambda: TREADS, _treads, [[]]),
)  # fmt: skip
BANDED = Effect(
    key="output_dead_band", cause="quantisation", nature=Nature.SAMPLING, slot=Slot.OUTPUT, trials=300, memory=True,
    sentence="the sensor shows whole steps, a new one only once its signal is past the middle between two by a band, and noise comes on top",
    apply=lambda x, p, clock: _banded(x, p), parameters={"step": "y", "level": "y", "band": "y"},
    search=_stepped(lambda: BANDED, _banded, [[0.1], [0.3], [0.45]]),
)  # fmt: skip

SWINGS_TRIED, LEAST_SWINGS, FINER = 4, 3, 4
"""Frequencies of a time base that are fitted; its fewest turns in a record; frequencies per line of a record among which they are looked for."""
ROUNDS = 6  # of them about the best, the steps half as wide each time: to a thousandth of a period
STEEP = 0.8  # samples per sample by which a time base may swing at first: beyond one it would turn back
SLIPS, PLACES, PERIODS = (0.7, 1.0, 1.4), (-0.06, 0.0, 0.06), (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Of a clock that slips, beside what its first harmonic tells: sizes, places in a period, and periods by how much of one the last is off."""

WHOLE, AS_GOOD = 41, 1.005
"""Places that are tried with a period of whole samples, over two of them, and what it may leave, of the squares of any other."""


def _mistimed(y: Array, p: Array, clock: Clock) -> Array:
    """The values a while before or after the samples, which swings about none."""
    return read_at(y, np.arange(len(y)) + p[1] * np.cos(p[0] * clock.k) + p[2] * np.sin(p[0] * clock.k))


def _slipped(y: Array, p: Array, clock: Clock) -> Array:
    """The values ever longer before the samples, until the clock is set right, once in a period."""
    if not 2.0 < p[0] < clock.length / LEAST_SWINGS:
        return np.full(len(y), np.inf)
    turns = clock.k / p[0] + p[1]
    return read_at(y, np.arange(len(y)) - p[2] * (turns - np.floor(turns)))


def _swings(channel: Any, base: Any) -> Iterator[tuple[float, Array]]:
    """Where the time base swings, the residual is the swing times the output's rate, a line in their product: its frequency and its
    cosine and sine parts."""
    s, r, n, k = base.structure, base.residual, len(channel), channel.clock.k
    if s.layout != "tf" or s.effects or np.mean(channel.keep) < KEPT:
        return
    rate = np.gradient(channel.y - r)
    common = np.abs(np.fft.rfft(r * rate, FINER * n))
    common[: LEAST_SWINGS * FINER] = 0.0
    for top in np.argsort(-common * (common == maximum_filter1d(common, 2 * FINER + 1)))[:SWINGS_TRIED]:
        w = 2.0 * np.pi * top / (FINER * n)
        D = rate[:, None] * np.stack((np.cos(w * k), np.sin(w * k)), axis=1)
        c = np.linalg.lstsq(D, r, rcond=None)[0]
        if not firm(base, float(np.sum((r - D @ c) ** 2))):
            return
        yield w, c


def _read_in_time(e: Effect, channel: Any, base: Any, shape: Array) -> Array | None:
    """The linear model's parameters made for the output as its clock should have read it, and a shape of the clock."""
    if (there := in_step(e, list(shape), channel)) is None:
        return None
    p = quickly_made(replace(channel, y=there[0]), base.structure)
    return None if p is None else np.concatenate((p, shape))


def _timings(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A time base that swings, with the linear model's poles and with those made for the output read in time."""
    from estimators.diagnosis.model.structure import Part

    n = len(channel)
    starts: list[Array | None] = []
    for w, c in _swings(channel, base):
        shape = np.array([w, *(c * min(1.0, STEEP / (w * np.hypot(*c))))])
        starts += [np.concatenate((base.p, shape)), _read_in_time(SWUNG, channel, base, shape)]
    begun = (p for p in starts if p is not None)
    yield from ended(channel, base, Part(SWUNG, base.structure.inputs[0]), begun, [1.0 / n, 1.0, 1.0])


def _slippings(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A clock that slips, from the first harmonic of its sawtooth, which falls behind or runs ahead; as it has edges, size, place and
    period are tried before poles are made for it."""
    from estimators.diagnosis.model.structure import Part

    n, part = len(channel), Part(SLIPPED, base.structure.inputs[0])
    found: list[tuple[float, Array]] = []
    for w, c in _swings(channel, base):
        for side in (1.0, -1.0):
            place = float(np.arctan2(side * c[0], side * c[1])) / (2.0 * np.pi)
            best = np.array([2.0 * np.pi / w, place, side * np.pi * np.hypot(*c)])
            for fine in 0.5 ** np.arange(ROUNDS):
                p = _read_in_time(SLIPPED, channel, base, best)
                shapes = [
                    [best[0] / (1.0 + fine * late * best[0] / n), best[1] + fine * (off - 0.5 * late), best[2] * f**fine]
                    for late, off, f in product(PERIODS, PLACES, SLIPS)
                ]  # fmt: skip
                tried = profile(channel, base, part, shapes, p)
                if not tried:
                    break
                found.append(tried[0])
                best = tried[0][1][-3:]
    nearest = sorted(found, key=lambda entry: entry[0])[:2]
    # a clock is set right every so many samples: edges tell the period to a part of one only
    for left, p in nearest[:1]:
        whole = max(round(float(p[-3])), 3)
        off = 0.5 * n * (1.0 / p[-3] - 1.0 / whole)
        if abs(off) < 1.0 / whole:
            places = p[-2] + off + (abs(off) + 1.0 / whole) * np.linspace(-1.0, 1.0, WHOLE)
            tried = profile(channel, base, part, [[whole, place, p[-1]] for place in places], p)
            nearest = tried[:1] if tried and tried[0][0] < AS_GOOD * left else nearest
    starts = (p for left, p in nearest if firm(base, left))
    yield from ended(channel, base, part, starts, [0.0, 0.0, 1.0])


SWUNG = Effect(
    key="delay_periodic", cause="periodic_delay", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, linear=True, ahead=True, trials=300,
    sentence="the time base of the output swings periodically: it is read by b cos(w t) + c sin(w t) late or early",
    parameters={"frequency": "rad/sample", "cosine": "sample", "sine": "sample"}, apply=_mistimed, search=_timings,
)  # fmt: skip

SLIPPED = Effect(
    key="clock_slips", cause="clock_drift", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, linear=True, ahead=True, trials=300,
    sentence="the clock of the output falls behind, or runs ahead, and is set right once in every period",
    parameters={"period": "sample", "place": "1", "slip": "sample"}, apply=_slipped, search=_slippings,
)  # fmt: skip
