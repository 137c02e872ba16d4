"""Hidden loops between the input and the linear part: an actuator of limited stroke or speed, a relay.

They replace the slowest dynamics, so that the linear model is no guide to them: their shapes are profiled with a gain and a
short filter behind them.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.input import kept
from estimators.diagnosis.effects.profiled import BEGUN, CROSSED, ended, firm, profile, profiled_behind

Array = NDArray[Any]
PACES = (0.5, 1.0, 2.0, 4.0)
"""Of the linear model's slowest pole, how fast a loop is taken to be: one that is limited looks slower than it is."""
ACROSS = tuple(1.5 ** np.arange(1, 11))
"""Samples that a limited actuator takes across its input's range, that are tried: quicker ones are hardly limited."""
DRIFTING = 3.0
"""Records per time constant, of a pole that is no loop's: a model lets it follow what moves once in a record."""
WIDTHS = (0.5, 0.7, 0.9, 1.2, 1.7, 2.5)
"""Half the distance of the limits, of half the set point's range: narrower than one, some levels are never reached, wider, only
transients are cut."""
OPEN = (0.03, 0.1, 0.25, 0.45)
"""Share of the loop's damping that is the plant's own: the rest is the controller's doing."""
DAMPINGS = (0.4, 0.7, 1.2)
"""Of the loop without its limit, as the linear model of a loop that winds up is no guide to it."""
LEVELS = (0.1, 0.25, 0.4, 0.5, 0.6, 0.75, 0.9)
"""Of the range that the input would drive a relay's plant over, where it may switch: any two of them."""
LEAST_GAP = 0.03
"""Of the input's range, between a relay's levels: what switches at one level is a curve."""
TIMES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Of a loop's own time, its inverse natural frequency, that an actuator takes for what a step across the input's range asks for."""
LAG = 0.5
"""Samples by which an actuator is taken to lag beside its limit."""
NEAR = 2.0
"""Times the linear model's squares, within which a fit may find the way from the nearest shape: an actuator that runs at its limit
most of the time turns with it, and a quarter off in its rate is a quarter of a turn late within a few."""
WOUND = 8.0
"""The same of a loop that winds up, whose parameters the error leads to from any of the nearest shapes; the less it is limited, the more of
the linear model's error they leave."""
FACTORS, PASSES = (1.6, 1.25, 1.1), 4
"""By which factors the best shapes of a loop are moved before they are fitted, one less by each, and at most how often."""
MOVES = np.concatenate(
    (
        np.eye(7)[:6],
        [[0, 0, 0, 1, 1, 0, 0], [0, 0, 0, 1, -1, 0, 0], [1, 0, 0, 1, 1, 0, 0], [1, -1, 0, 0, 0, 0, 0]],
    )
)
"""What is moved together: each by itself, the rates, one against the other, with the plant, the plant against its gain."""
PUSHES = (-0.6, -0.3, -0.15, 0.15, 0.3, 0.6)
"""Of the input's range, what a relay may add to it while it is on."""


def _wound_up(x: Array, p: Array) -> Array:
    from estimators.diagnosis.effects.kernels.loop_kernels import wound_up

    pace, proportional, integral = (abs(float(v)) for v in p[:3])
    return wound_up(x, pace, proportional, integral, float(p[3]), float(p[4]), level_before(x))


def _steered(which: int) -> Any:
    def run(x: Array, p: Array) -> Array:
        from estimators.diagnosis.effects.kernels.loop_kernels import steered_loop

        return steered_loop(x, np.maximum(np.abs(p), 1e-300), level_before(x), which)

    return run


def _switched(x: Array, p: Array) -> Array:
    from estimators.diagnosis.effects.kernels.loop_kernels import switched

    low, high = sorted((float(p[3]), float(p[4])))
    if not high - low > LEAST_GAP * float(np.ptp(x)):
        return np.full(len(x), np.inf)
    return switched(x, abs(float(p[0])), float(p[1]), float(p[2]), low, high, level_before(x))


def _applied(run: Any) -> Any:
    """A loop's run as what an effect makes of its input."""
    return lambda x, p, clock: kept(run, x, p)


def _loops(slowest: float) -> Iterator[tuple[float, list[float]]]:
    """Natural frequency w; pole a of the plant, Kp and Ki of a damping z: a (1 + Kp) = 2 z w, a Ki = w^2."""
    for faster, z, share in product(PACES, DAMPINGS, OPEN):
        w = faster * slowest
        a = 2.0 * z * w * share
        yield w, [a, 2.0 * z * w / a - 1.0, w * w / a]


def _controlled(slowest: float, u: Array) -> Iterator[list[float]]:
    middle, half = 0.5 * float(u.max() + u.min()), 0.5 * float(np.ptp(u))
    for _, loop in _loops(slowest):
        for wide in WIDTHS:
            yield [*loop, middle - wide * half, middle + wide * half]


def _ramping(slowest: float, u: Array, course: bool = False) -> Iterator[list[float]]:
    """Actuators that need some part of the loop's time for what a step across the input's range asks for."""
    for w, loop in _loops(slowest):
        for time in TIMES:
            rate = (loop[2] if course else 1.0 + loop[1]) * float(np.ptp(u)) * w / time
            yield [*loop, rate, rate, LAG, 0.0]


def _switching(slowest: float, u: Array) -> Iterator[list[float]]:
    """A lag that switches between two levels of what the input alone would make of it."""
    wide = float(np.ptp(u))
    for faster in PACES[:-1]:
        alone = _switched(u, np.array([faster * slowest, 0.0, 0.0, 0.0, 1e300]))
        if not np.all(np.isfinite(alone)):  # in units in which its steps are no numbers
            continue
        for low, high in combinations(np.quantile(alone, LEVELS), 2):
            for push in PUSHES:
                yield [faster * slowest, push * wide, 0.0, float(low), float(high)]


def _nearer(
    channel: Any, bare: Any, part: Any, tried: list[tuple[float, Array]], moves: Array
) -> list[Array]:
    """The parameters after steps of one of the shape's after the other, and of some together, by factors that shrink, while one after
    the other of the shapes gives way: where an actuator turns at its limit the error has valleys that no derivative leads to."""
    count = len(part.effect.parameters)
    for stay, factor in zip(range(len(FACTORS), 0, -1), FACTORS, strict=True):
        tried = sorted(tried, key=lambda entry: entry[0])[:stay]
        for i, best in enumerate(tried):
            for _ in range(PASSES):
                shapes = best[1][-count:] * factor ** np.concatenate((moves, -moves))
                found = profile(channel, bare, part, shapes, best[1])[:1]
                if not found or not found[0][0] < best[0]:
                    break
                tried[i] = best = found[0]
    return [p for _, p in tried]


def _behind(channel: Any, f: Any) -> Iterator[Any]:
    """The fit with the lag behind the actuator as well, which is held at none before: at its end nothing leads away from it."""
    from estimators.diagnosis.model.fitting import fit

    p, scales = f.p.copy(), f.scales.copy()
    p[-1], scales[-1] = LAG, 1.0
    g = fit(channel, f.structure, p, scales, noise=f.noise, iterations=30)
    if g.criterion < f.criterion:
        yield g


def slowest_rate(den: Array, n: int) -> float:
    """Rate per sample of the slowest pole, those left out that stand for a level or a drift where there are others."""
    poles = np.roots(den).astype(complex)
    rates = np.sort(np.abs(np.log(np.where(np.abs(poles) < 1e-12, 1e-12, poles))))
    first = next((r for r in rates if r * n > DRIFTING), rates[0])
    return float(np.clip(first, 0.3 / n, 1.0))


def shaped(
    effect: Any, shapes: Any, steps: Any, near: float = 1.0, moves: Array | None = MOVES, least: int = 1
) -> Any:
    """The search of an effect over the shapes of a loop; `steps` sizes of its parameters for a slowest pole and an input, `near` how
    far above the linear model's squares the best shape may be, from where a fit finds the way after `moves`, `least` the order from
    which on a linear model may stand for one."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterable[Any]:
        from estimators.diagnosis.model.structure import Part
        from estimators.diagnosis.search.free_runs import denominator

        s = base.structure
        if s.layout != "tf" or len(s.inputs) != 1 or s.order < least:
            return
        slowest = slowest_rate(denominator(base), len(channel))
        u = np.ascontiguousarray(channel.u[:, s.inputs[0]])
        part = Part(effect(), s.inputs[0])
        bare, tried = profiled_behind(channel, base, part, shapes(slowest, u))
        if not tried or tried[0][0] > near * float(np.sum(base.residual**2)):
            return
        starts = [q for _, q in tried[:BEGUN]]
        if near > 1.0 and moves is not None:
            starts = _nearer(channel, bare, part, tried, moves)
        for f in ended(channel, bare, part, starts, steps(slowest, float(np.std(u)))):
            if firm(base, float(np.sum(f.residual**2))):
                yield f
                yield from _behind(channel, f) if "behind" in part.effect.parameters and len(f.noise) else ()

    return search


WINDUP = Effect(
    key="wind_up", cause="wind_up", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=_applied(_wound_up),
    sentence="a loop of its own follows the input, its actuator is limited, and its integrator winds up",
    parameters={"plant": "1/sample", "proportional": "1", "integral": "1/sample", "low": "u", "high": "u"},
    search=shaped(lambda: WINDUP, _controlled, lambda slowest, su: [slowest, 1.0, slowest, su, su], WOUND, None),
)  # fmt: skip

RELAY = Effect(
    key="relay_feedback", cause="relay_with_hysteresis", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=100, apply=_applied(_switched),
    sentence="a relay with hysteresis, a thermostat, switches something on and off as what the input drives passes two levels",
    parameters={"rate": "1/sample", "push": "u", "share": "1", "low": "u", "high": "u"},
    search=shaped(lambda: RELAY, _switching, lambda slowest, su: [slowest, su, 1.0, *[1e6 * CROSSED * su] * 2]),
)  # fmt: skip

STEERED, STEERING, COURSED = (
    Effect(
        key=key, cause="rate_limiter", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=50, apply=_applied(_steered(which)), sentence=sentence,
        parameters={"plant": "1/sample", "proportional": "1", "integral": "1/sample", "up": f"u/sample{unit}", "down": f"u/sample{unit}", "lag": "sample", "behind": "sample"},
        search=shaped(lambda which=which: (STEERED, STEERING, COURSED)[which], partial(_ramping, course=bool(unit)),
                       lambda slowest, su, steep=1 + bool(unit): [slowest, 1.0, slowest, *[slowest**steep * su] * 2, 1.0, 0.0], NEAR),
    )
    for which, (key, unit, sentence) in enumerate((
        ("rate_in_loop", "", "a loop of its own follows the input, and its actuator moves no faster than one rate up and another down"),
        ("rate_of_loop", "", "it is the actuator of a loop of its own that follows the input, and moves no faster than one rate up and another down"),
        ("rate_in_course", "^2", "a position, a course, follows the input in a loop of its own that its speed damps, and the actuator moves no faster than one rate up and another down"),
    ))
)  # fmt: skip
