"""Curves of sensors: those that bend one way all along, the logarithm and what goes with a reciprocal; a titration's; an error that repeats.

A constant before one of the first is one of it with another parameter, behind another gain and before another constant.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.disturbances.added import level_at
from estimators.diagnosis.effects.effect import Clock, Effect, Grid, Nature, Sizes, Slot
from estimators.diagnosis.effects.input import odd
from estimators.diagnosis.effects.output import KEPT, quickly_made, sensor
from estimators.diagnosis.effects.profiled import firm, highest, in_common, left_over, of_order

Array = NDArray[Any]
NEAREST = 0.02
"""Distance to the pole of a hyperbola, over that at zero, below which it goes on straight: a fiftieth is a slope of 2500."""
REACHED = (0.5, 0.9)
"""Of the way to its pole, the largest reading that is tried."""


def _logarithm(x: Any, p: Array, clock: Clock) -> Any:
    """log(1 + c x)/c, of slope 1 at zero and the identity for no c; flat where there is none."""
    return x if p[0] == 0.0 else np.log1p(np.maximum(p[0] * x, 1e-9 - 1.0)) / p[0]


def _hyperbola(x: Any, p: Array, clock: Clock) -> Any:
    """x/(1 - c x), of slope 1 at zero."""
    return x / np.maximum(1.0 - p[0] * x, NEAREST)


def _scale(s: Sizes) -> float:
    middle = float(np.median(s.y))
    return 1.0 / float(np.copysign(max(abs(middle), s.sy), middle))


def _bends(s: Sizes) -> Grid:
    return [[f * _scale(s)] for f in (0.3, 1.0, 4.0, 20.0)], [abs(_scale(s))]


def _poles(s: Sizes) -> Grid:
    """A pole beyond either end of what is read, or on the other side of zero."""
    ends = [end for end in (float(np.max(s.y)), float(np.min(s.y))) if abs(end) >= s.sy]
    grid = [[f / end] for end in ends for f in REACHED] + [[-f * _scale(s)] for f in (1.0, 4.0)]
    return grid, [abs(_scale(s))]


FEWEST, MOST, TURN = 1.5, 100.0, 0.1
"""Periods that what is read passes over, as less than one and a half bend no more often than other curves do, and the step between two
numbers of them that are tried: a tenth turns the ends by 18 degrees each against the middle."""
RIPPLES = 3  # of them, fitted


def _rippled(x: Any, p: Array) -> Any:
    """What a sensor reads whose error repeats over its scale: period, size of the sine and of the cosine, where they begin."""
    angle = 2.0 * np.pi * (x - p[3]) / p[0]
    return x + p[1] * np.sin(angle) + p[2] * np.cos(angle)


def _ripples(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The sines of what the linear model simulates that explain most of what it leaves."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.structure import Part

    seen = channel.y - base.residual
    low, high = np.quantile(seen[channel.keep], (0.01, 0.99))
    if not high > low:
        return
    centre, turns = 0.5 * (low + high), np.arange(FEWEST, MOST, TURN)
    angle = 2.0 * np.pi * np.outer(seen - centre, turns / (high - low))
    D = np.where(channel.keep[:, None], np.hstack((np.sin(angle), np.cos(angle))), 0.0)
    D = np.asarray(lfilter(np.concatenate(([1.0], base.noise)), [1.0], D, axis=0))
    r, Q = left_over(channel, base)
    gains, sizes = in_common(D - Q @ (Q.T @ D), r)
    spread = float(np.std(seen))
    for i in highest(gains, RIPPLES):
        p = np.concatenate((base.p, [(high - low) / turns[i], *sizes[:, i], centre]))
        scales = np.concatenate((base.scales, [0.1 * p[-4] / turns[i], spread, spread, 0.0]))
        f = fit(channel, base.structure.adding(Part(RIPPLE)), p, scales, noise=base.noise, iterations=30)
        if abs(f.p[-4]) * FEWEST < high - low:
            yield f


RIPPLE = Effect(
    key="output_ripple", cause="output_nonlinearity", nature=Nature.OUTPUT_STATIC, slot=Slot.OUTPUT, trials=400,
    sentence="the sensor's error repeats over its scale: a screw's pitch, an encoder's lines, an eccentric wheel",
    parameters={"period": "y", "sine": "y", "cosine": "y", "centre": "y"}, apply=lambda x, p, clock: _rippled(x, p),
    curve=_rippled, search=_ripples,
)  # fmt: skip

ENDS = (0.002, 0.998)
"""Quantiles between which what is read counts: an outlier's hyperbolic sine would be all that a fit sees."""
BENT, MIDDLES = (0.7, 1.3, 2.5, 4.5, 8.0), (0.0, 0.25, 0.5, 0.75, 1.0)
"""Of a titration curve, its sharpness times half of what is read, and where in that its steep middle lies, that are tried: the slopes in the
middle are 1.3 to 1500 times those at the ends."""
SETTLED, TITRATED, NEAREST_SHAPES = 8, 3, 6
"""Gauss-Newton steps by which a linear part finds itself behind each of them; those that are fitted, and that are tried with more poles."""
MORE = (-1, 0, 1, 2)
"""Poles beyond the linear model's: one may have stood for the curve, and in a loop that holds the reading about one level a curve hides some."""

LEAST_SIDE = 0.02  # of the readings on either side of its middle: on one side alone it is a logarithm, or what goes with a reciprocal


def _two_sided(channel: Any, f: Any) -> bool:
    """Whether what is read lies on both sides of the steep middle of a curve that was fitted."""
    c, centre = f.p[-2:]
    level = f.p[level_at(f.structure)]
    below = np.mean(channel.y[channel.keep] < level + np.arcsinh(c * centre) / (c or 1.0))
    return bool(LEAST_SIDE < below < 1.0 - LEAST_SIDE)


def _titrated(
    channel: Any, base: Any, shapes: list[tuple[float, float]]
) -> list[tuple[float, Array, tuple[float, float]]]:
    """(sum of squares, parameters, shape) of each sharpness and middle, the best first: undone, a linear part is made for what the sensor
    saw, and settles behind the curve, as beyond the middle most of what was undone is noise."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import plant_scales, relinearised
    from estimators.diagnosis.model.structure import Part

    s, found = base.structure, []
    at = level_at(s)
    new, (low, high) = s.adding(Part(TITRATION)), np.quantile(channel.y[channel.keep], ENDS)
    for c, middle in shapes:
        there = replace(channel, y=np.sinh(c * (np.clip(channel.y, low, high) - middle)) / c)
        known = relinearised(there, s, base.p) if np.any(base.p[: s.order]) else None
        for p in (p for p in (quickly_made(there, s), known) if p is not None):
            centre, scales = -p[at], np.concatenate((base.scales, [0.0, 0.0]))
            scales[: s.plant_size] = plant_scales(s, p)
            p[at] = middle - np.arcsinh(c * centre) / c
            start = np.concatenate((p, [c, centre]))
            f = fit(channel, new, start, scales, noise=base.noise, iterations=SETTLED, colour=False)
            if np.isfinite(f.deviance):
                found.append((float(np.sum(f.residual**2)), f.p, (c, middle)))
    return sorted(found, key=lambda entry: entry[0])


def _titrations(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Curves of any sharpness and middle, behind the linear model's poles and behind more of them for as long as these pay."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import plant_scales
    from estimators.diagnosis.model.structure import Part

    s, least = base.structure, np.inf
    low, high = np.quantile(channel.y[channel.keep], ENDS)
    if (
        s.layout != "tf"
        or s.effects
        or s.order < 1
        or level_at(s) is None
        or np.mean(channel.keep) < KEPT
        or not high > low
    ):
        return
    shapes = [
        (2.0 * bent / (high - low), low + share * (high - low)) for bent, share in product(BENT, MIDDLES)
    ]
    for more in (more for more in MORE if s.order + more > 0):
        few, p, scales = of_order(base, s.order + more, s.taps + more)
        tried = _titrated(
            channel, replace(base, structure=few, p=p if more else base.p, scales=scales), shapes
        )
        if not tried or not firm(base, tried[0][0]):
            if more < 0:
                continue
            return
        fits = []
        for _, p, _ in tried[:TITRATED]:
            sizes = np.concatenate((scales, [abs(p[-2]), abs(p[-1]) + 1.0 / abs(p[-2])]))
            sizes[: few.plant_size] = plant_scales(few, p)
            fits.append(fit(channel, few.adding(Part(TITRATION)), p, sizes, noise=base.noise, iterations=40))
        yield from (f for f in fits if _two_sided(channel, f))
        best = min(f.criterion for f in fits)
        if not best < least:
            return
        least, shapes = best, list(dict.fromkeys(shape for _, _, shape in tried))[:NEAREST_SHAPES]


TITRATION = sensor(
    "output_arsinh", "the sensor is steep in the middle and reads a logarithm on either side, asinh(c (y - centre))/c: a titration curve",
    {"c": "1/y", "centre": "y"}, 20, apply=odd(np.arcsinh), search=_titrations,
)  # fmt: skip
CURVES = (
    RIPPLE,
    TITRATION,
    sensor("output_logarithm", "the sensor reads the logarithm of what it sees, log(1 + c y)/c", {"c": "1/y"}, 4, apply=_logarithm,
           starts=_bends),
    sensor("output_ratio", "the sensor saturates as a ratio: y/(1 + c |y|)", {"c": "1/y"}, 4,
           apply=lambda x, p, c: x / (1.0 + np.abs(p[0] * x)), starts=_bends),
    sensor("output_hyperbola", "the sensor reads a hyperbola, y/(1 - c y): the reciprocal of a gap, of a distance, a divider", {"c": "1/y"}, 6,
           apply=_hyperbola, starts=_poles),
)  # fmt: skip
