"""Effects at the output: what a sensor makes of it, and clocks that disagree."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Grid, Nature, Sizes, Slot, numbered
from estimators.diagnosis.effects.input import broken_line, dead_zone, exponential, odd, quantiles, zones

Array = NDArray[Any]


BETWEEN = 4
"""Values per sample that a play at the output follows where the linear part is not known between samples."""


def _lag(x: Array, p: Array, clock: Clock) -> Array:
    from scipy.signal import lfilter

    pole = np.clip(p[0], -0.999, 0.9999)
    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], x))


def _upsampled(x: Array, by: int) -> Array:
    """Cubic (Catmull-Rom) values between samples: a sensor with play sees the extremes between them."""
    before = np.concatenate((x[:1], x[:-1]))
    ahead = np.concatenate((x[1:], x[-1:]))
    later = np.concatenate((ahead[1:], x[-1:]))
    m0, m1 = (ahead - before) / 2, (later - x) / 2
    rows = [
        (2 * r**3 - 3 * r**2 + 1) * x
        + (r**3 - 2 * r**2 + r) * m0
        + (3 * r**2 - 2 * r**3) * ahead
        + (r**3 - r**2) * m1
        for r in np.arange(by) / by
    ]
    return np.stack(rows, axis=1).ravel()


def _play(x: Array, p: Array, clock: Clock, by: int = 1) -> Array:
    """Play in what follows a signal of `by` values per sample; it stands in the middle of its gap where a record begins."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import play, settled

    x = settled(np.ascontiguousarray(x), by * clock.lead)
    return play(x, abs(p[0]), x[0])


def _before_play(key: str, channel: Any, base: Any, j: int) -> Any:
    """A start whose linear part is made for what the play shows of it, with the poles that it needs."""
    from estimators.diagnosis.effects import named
    from estimators.diagnosis.model.shown import with_play
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import Start

    f = with_play(channel, base, Part(named(key), j))
    return None if f is None else Start(f.structure, f.p, f.scales, base.deviance - f.deviance)


def _widths(s: Sizes) -> Grid:
    return [[f * s.sy] for f in (0.08, 0.16, 0.3, 0.5, 0.8)], [s.sy]


def _sharp(function: Any) -> Any:
    """f(c x)/c, the identity for no c."""
    return lambda x, p, clock: x if p[0] == 0.0 else function(p[0] * x) / p[0]


def _sharpness(s: Sizes) -> Grid:
    return [[f / s.sy] for f in (0.25, 0.5, 1.0, 1.8)], [1 / s.sy]


def sensor(key: str, sentence: str, parameters: dict[str, str], trials: float, **fields: Any) -> Effect:
    """A static curve that a sensor has."""
    return Effect(
        key=key, cause="output_nonlinearity", nature=Nature.OUTPUT_STATIC, slot=Slot.OUTPUT, sentence=sentence,
        parameters=parameters, trials=trials, **fields,
    )  # fmt: skip


def _backlash(key: str, sentence: str, **fields: Any) -> Effect:
    return Effect(
        key=key, cause="backlash", nature=Nature.DYNAMIC, slot=Slot.OUTPUT, sentence=sentence, trials=6, memory=True,
        parameters={"half_width": "y"}, family="backlash", reversing=True, starts=_widths,
        more=partial(_before_play, key), **fields,
    )  # fmt: skip


OUTPUT = (
    Effect(key="lag", cause="sensor_lag", nature=Nature.LINEAR, slot=Slot.OUTPUT, sentence="one more first-order lag",
           parameters={"pole": "1"}, trials=3, apply=_lag, memory=True, linear=True,
           starts=lambda s: ([[v] for v in (0.2, 0.4, 0.6, 0.75, 0.85, 0.92)], [1.0])),
    sensor("output_quadratic", "the sensor reads y + c2 y^2", {"c2": "1/y"}, 1, amplitude=0,
           apply=lambda x, p, c: x * (1.0 + p[0] * x), starts=lambda s: ([[0.03 / s.sy]], [1 / s.sy])),
    sensor("output_cubic", "the sensor reads y + c3 y^3", {"c3": "1/y^2"}, 1, amplitude=0,
           apply=lambda x, p, c: x * (1.0 + p[0] * x**2), starts=lambda s: ([[0.02 / s.sy**2]], [1 / s.sy**2])),
    sensor("output_polynomial", "the sensor reads y + c2 y^2 + c3 y^3", {"c2": "1/y", "c3": "1/y^2"}, 1,
           apply=lambda x, p, c: x * (1.0 + x * (p[0] + p[1] * x)),
           starts=lambda s: ([[a / s.sy, b / s.sy**2] for a in (-0.1, 0.1) for b in (-0.03, 0.03)],
                             [1 / s.sy, 1 / s.sy**2])),
    sensor("output_lines", "the sensor's curve is a broken line, of no simpler form", {}, 30, block=True,
           apply=lambda x, p, c: broken_line(x, p),
           shape=lambda size, order: numbered({"slope": "1", "corner": "y"}, size)),
    sensor("output_arctan", "the sensor reads atan(c y)/c", {"c": "1/y"}, 2, apply=_sharp(np.arctan), starts=_sharpness),
    sensor("output_tanh", "the sensor reads tanh(c y)/c", {"c": "1/y"}, 2, apply=_sharp(np.tanh), starts=_sharpness),
    sensor("output_exponential", "the sensor reads an exponential curve, (exp(c y) - 1)/c", {"c": "1/y"}, 4, apply=exponential,
           starts=lambda s: ([[f / s.sy] for f in (0.3, 1.0, -0.3, -1.0)], [1 / s.sy])),
    sensor("output_sigmoid", "the sensor saturates smoothly on either side of a centre: tanh(c (y - centre))/c",
           {"c": "1/y", "centre": "y"}, 8, apply=odd(np.tanh),
           starts=lambda s: ([[f / s.sy, m] for f in (0.4, 1.0) for m in s.centres(s.y)], [1 / s.sy, s.sy])),
    sensor("output_clip", "the sensor saturates at +-limit", {"limit": "y"}, 6, two_sided=True,
           apply=lambda x, p, c: np.clip(x, -abs(p[0]), abs(p[0])),
           starts=lambda s: (quantiles(np.abs(s.y), 0.97, 0.9, 0.8, 0.65), [s.sy])),
    sensor("output_clip_upper", "the sensor saturates above", {"high": "y"}, 6,
           apply=lambda x, p, c: np.minimum(x, p[0]),
           starts=lambda s: (quantiles(s.y, 0.98, 0.93, 0.85, 0.75, 0.6), [s.sy])),
    sensor("output_clip_lower", "the sensor saturates below", {"low": "y"}, 6,
           apply=lambda x, p, c: np.maximum(x, p[0]),
           starts=lambda s: (quantiles(s.y, 0.02, 0.07, 0.15, 0.25, 0.4), [s.sy])),
    sensor("output_dead_zone", "the sensor does not see outputs between low and high", {"low": "y", "high": "y"}, 10,
           apply=lambda x, p, c: dead_zone(x, min(p), max(p)), starts=lambda s: (zones(s.y, (0.2, 0.6)), [s.sy, s.sy])),
    sensor("output_absolute", "the sensor has another gain for each sign, y + c |y|", {"c": "1"}, 1, amplitude=0,
           apply=lambda x, p, c: x + p[0] * np.abs(x), starts=lambda s: ([[0.05]], [1.0])),
    _backlash("backlash_output", "play at the output",
              apply=lambda x, p, clock: _play(_upsampled(x, BETWEEN), p, clock, BETWEEN)[::BETWEEN], between=True),
    _backlash("backlash_sampled", "play at the output that moves with the samples, not between them", apply=_play),
)  # fmt: skip


SHIFTS = (0.5, 1.0, 1.8, 2.8, 4.0, 5.5)  # samples by which the clocks are apart in the end
PACES, LEAST_PACE = (0.1, 0.25, 0.6), 0.02  # of the record: memories of a clock that settles
AGES = (0.1, 0.4, 1.0, 2.0)  # logarithms of the gain lost over the record
CARRIED = (1.0, 2.0, 3.0, 4.5, 6.0, 8.0, 11.0, 15.0, 20.0, 27.0, 36.0, 50.0)  # fmt: skip
"""Samples that a belt takes at its mean speed: a third more from one to the next, as the best is looked for closer."""
LEAST_FLOW = 1e-3  # of the mean: what stands still takes for ever
NOTHING = 1.02  # of the linear model's squared error, that the best shape may leave before it is fitted


def read_at(y: Array, at: Array) -> Array:
    """Values between the samples by a cubic spline; the first and the last value beyond the ends."""
    from estimators.diagnosis.effects.kernels.spline_kernels import read_between

    return read_between(np.ascontiguousarray(y, dtype=float), np.ascontiguousarray(at, dtype=float))


def in_step(e: Effect, shape: list[float], channel: Any) -> tuple[Array, Array] | None:
    """The output as its clock should have read it."""
    k = np.arange(len(channel), dtype=float)
    when = e.apply(k, np.array(shape), channel.clock) if e.apply is not None else k  # what each sample shows
    if not np.all(np.isfinite(when)):
        return None
    back = np.interp(k, when, k) if np.all(np.diff(when) > 0) else k - (when - k)
    return read_at(channel.y, back), np.ones(len(k))


def _kept_up(e: Effect, shape: list[float], channel: Any) -> tuple[Array, Array]:
    """The output as it would have been at the gain of the record's start."""
    gain = np.exp(-shape[0] * channel.clock.turn)
    return channel.y / gain, gain


def _entered(flow: Array, volume: float) -> Array:
    """(N,) when what leaves a belt or pipe at the end of each sample had entered, negative before the record."""
    through = np.cumsum(np.maximum(np.abs(flow), LEAST_FLOW * float(np.mean(np.abs(flow)))))
    return np.interp(through - volume, through, np.arange(len(through)), left=-1.0)


def _conveyed(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    x = U[:, channel]
    if p[0] < 0.0:
        return np.full(len(x), np.inf)
    return np.interp(_entered(U[:, int(p[1]) - 1], p[0]), np.arange(len(x)), x)


def _unconveyed(e: Effect, shape: list[float], channel: Any) -> tuple[Array, Array]:
    """The output before its belt or pipe; what had not left it at the end stays at its last value."""
    when, k = _entered(channel.u[:, int(shape[1]) - 1], shape[0]), np.arange(len(channel))
    return np.interp(k, when, channel.y), np.ones(len(k))


def _warming(y: Array, p: Array, clock: Clock) -> Array:
    pace = max(abs(float(p[1])), LEAST_PACE)
    left = np.exp(-np.maximum(clock.turn, 0.0) / pace) + pace * np.expm1(
        -1.0 / pace
    )  # of no mean over the training record
    return read_at(y, np.arange(len(y)) + p[0] * left)


def _ways(channel: Any) -> list[list[float]]:
    """Delays at the mean flow of each of several inputs that never stands still or turns."""
    flows = [
        (i, float(np.mean(u)))
        for i, u in enumerate(channel.u.T)
        if channel.u.shape[1] > 1 and np.min(u * np.mean(u)) > 0
    ]
    return [[d * abs(mean), i + 1.0] for i, mean in flows for d in CARRIED]


def quickly_made(channel: Any, s: Any) -> Array | None:
    """A linear model's parameters for a channel, behind a quick guess of its poles; None where these are not stable."""
    from estimators.diagnosis.model.linear import fresh_poles, relinearised
    from estimators.diagnosis.model.structure import stable_polynomial

    p = np.zeros(s.size)
    p[: s.order] = fresh_poles(channel.y, channel.u[:, list(s.inputs)], s, channel.keep)
    return relinearised(channel, s, p) if stable_polynomial(p[: s.order]) else None


KEPT = 0.9  # share of the samples, from which on the others may stand between their neighbours while an effect is undone


def mended(
    effect: Callable[[], Effect],
    shapes: Callable[[Any], list[list[float]]],
    closer: Callable[[Any, list[float]], list[list[float]]],
    units: Callable[[Any], list[float]] = lambda c: [1.0, 1.0],
    undone: Callable[[Effect, list[float], Any], tuple[Array, Array] | None] = in_step,
    late: bool = True,
    fitted: bool = False,
) -> Callable[..., Iterator[Any]]:
    """Fits from the best shapes, and from others closer to the best, each with the poles that the output has once its shape is undone.

    Shapes, those closer to one, and their units are of a channel; not `late` where the effect is the delay of the linear part; the
    poles are `fitted` where levels would mislead a quick guess.
    """

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.fitting import fit
        from estimators.diagnosis.model.linear import fit_linear
        from estimators.diagnosis.model.simulation import simulate
        from estimators.diagnosis.model.structure import Part

        s = base.structure if late else replace(base.structure, delay=0)
        if s.layout != "tf" or s.effects or np.mean(channel.keep) < KEPT:
            return
        found, e = [], effect()

        def tried(shape: list[float]) -> None:
            got = undone(e, shape, channel)
            if got is None:
                return
            there = replace(channel, y=got[0])
            p = fit_linear(there, s, rough=True).p if fitted else quickly_made(there, s)
            if p is not None:
                rest = (got[1] * (there.y - simulate(s, p, there.u, there.clock)))[channel.keep]
                found.append((float(rest @ rest), shape, p))

        for shape in shapes(channel):
            tried(shape)
        least = min((entry[0] for entry in found), default=np.inf)
        if least > NOTHING * float(np.sum(base.residual[channel.keep] ** 2)):
            return
        for shape in closer(channel, min(found, key=lambda entry: entry[0])[1]):
            tried(shape)
        part = Part(e, s.inputs[0])
        for _, shape, p in sorted(found, key=lambda entry: entry[0])[:2]:
            scales = np.concatenate((base.scales, units(channel)))
            yield fit(
                channel, s.adding(part), np.concatenate((p, shape)), scales, noise=base.noise, iterations=25
            )

    return search


DRIFT = Effect(
    key="clock_drift", cause="clock_drift", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, linear=True, ahead=True, trials=12,
    sentence="the clock of the output runs off from that of the input", parameters={"drift": "1"},
    apply=lambda y, p, clock: read_at(y, np.arange(len(y)) + p[0] * clock.k),
    search=mended(lambda: DRIFT, lambda c: [[sign * d / len(c)] for d in SHIFTS for sign in (1.0, -1.0)],
                   lambda c, best: [[best[0] * f] for f in (0.8, 0.9, 1.1, 1.25)], lambda c: [1.0 / len(c)]),
)  # fmt: skip
SKEWS = (0.05, 0.15, 0.3, 0.45)  # samples by which every other one is early, the rest late
INTERLEAVED = Effect(
    key="interleaved", cause="interleaved_samples", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, linear=True, ahead=True, trials=4,
    sentence="every other sample is read early and the rest late, as two converters in turn do", parameters={"skew": "sample"},
    apply=lambda y, p, clock: read_at(y, np.arange(len(y)) + p[0] * (1.0 - 2.0 * (np.round(clock.k) % 2))),
    search=mended(lambda: INTERLEAVED, lambda c: [[sign * d] for d in SKEWS for sign in (1.0, -1.0)],
                   lambda c, best: [[best[0] * f] for f in (0.8, 1.2)], lambda c: [0.1]),
)  # fmt: skip
WARMING = Effect(
    key="clock_settles", cause="clock_drift", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, linear=True, ahead=True, trials=30,
    sentence="the clock of the output runs off from that of the input, ever less: as its logger warms up",
    parameters={"samples": "sample", "memory": "record"}, apply=_warming,
    search=mended(lambda: WARMING, lambda c: [[sign * d, t] for d in SHIFTS for t in PACES for sign in (1.0, -1.0)],
                   lambda c, best: [[best[0] * f, best[1] * g] for f in (0.7, 1.0, 1.4) for g in (0.8, 1.0, 1.25) if f * g != 1.0]),
)  # fmt: skip
DECAY = Effect(
    key="gain_decay", cause="gain_drift", family="drifts", nature=Nature.TIME, slot=Slot.OUTPUT, trials=6,
    sentence="the gain from all inputs decays with time, or grows: exp(-rate t)", parameters={"rate": "1/record"},
    apply=lambda x, p, c: x * np.exp(-p[0] * c.turn),
    search=mended(lambda: DECAY, lambda c: [[sign * r] for r in AGES for sign in (1.0, -1.0)],
                   lambda c, best: [[best[0] * f] for f in (0.75, 1.3)], lambda c: [1.0], _kept_up, fitted=True),
)  # fmt: skip
CONVEYED = Effect(
    key="conveyed", cause="flow_dependent_delay", nature=Nature.DYNAMIC, slot=Slot.OUTPUT, memory=True, trials=60,
    sentence="a belt or a pipe that an input drives brings what is measured: the delay falls with its speed",
    parameters={"volume": "u sample", "flow": "1"}, apply=lambda x, p, c: x, signal=_conveyed,
    search=mended(lambda: CONVEYED, _ways, lambda c, best: [[best[0] * f, best[1]] for f in (0.8, 0.9, 1.1, 1.25)],
                   lambda c: [float(np.mean(np.abs(c.u))), 0.0], _unconveyed, late=False),
)  # fmt: skip
FALSE = 1e-4  # chance of a line of the age where there is none, over all frequencies
# lines tried; phases of each; periods about each, in its resolution
LINES, PHASES, NEAR = (3, 8, np.linspace(-1.0, 1.0, 9))


LATE = (0.25, 0.5, 0.75, 1.0)  # of a period, by which what an analyser reads may be late, that are tried
MOST = 0.9  # samples that must count
# ever closer to a period and its phase
GRID, FINER = (np.linspace(-1.0, 1.0, 5), (0.1, 0.05, 0.025, 0.012, 0.006, 0.003, 0.0015))


def _refreshed(y: Array, p: Array, clock: Clock) -> Array:
    """The value of the last refresh, every p[0] samples, one of them at sample p[1]."""
    if not 1.05 < p[0] < 0.1 * clock.length:
        return np.full(len(y), np.inf)
    return read_at(y, np.floor((clock.k - p[1]) / p[0]) * p[0] + p[1] - clock.k[0])


def _ages(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Where readings age between refreshes, the residual is the age times the output's rate: a line in their product."""
    from scipy.interpolate import CubicSpline

    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Part

    s, n = base.structure, len(channel)
    keep = channel.keep  # without those that stand out, as stale readings do
    if s.layout != "tf" or s.effects or np.mean(keep) < MOST:
        return
    rate = np.gradient(channel.y - base.residual)
    power = np.abs(np.fft.rfft((base.residual * rate) * np.hanning(n), 4 * n)) ** 2
    power[: 4 * n // 50] = 0.0  # refreshes every fifty samples and more show as repeats
    shapes: list[tuple[float, float]] = []
    for _ in range(LINES):
        top = int(np.argmax(power))
        # the first of them all: nothing is left
        if not top or power[top] < np.log(2 * n / FALSE) * np.mean(power[power > 0.0]):
            break
        f = top / (4.0 * n)
        periods = [1.0 / f, 1.0 / (1.0 - f)]
        shapes += [
            (q + 0.25 * q * q / n * d, i / PHASES * q) for q in periods for d in NEAR for i in range(PHASES)
        ]
        power[max(0, top - 12) : top + 12] = 0.0
    k, x, trials = channel.clock.k, channel.y - base.residual, []
    for q, phase in shapes:  # the linear model's delay holds the mean age already
        at = np.floor((k - phase) / q) * q + phase - k[0]
        e = np.where(keep, channel.y - read_at(x, at + 0.5 * (q - 1.0)), 0.0)
        trials.append((float(e @ e), (q, phase), at))
    for left, shape, at in sorted(trials, key=lambda t: t[0])[:LINES]:
        if left > NOTHING * float(base.residual @ base.residual):
            break
        # of the refreshes, and the samples that read them first
        when, first = np.unique(at, return_index=True)
        fresh = CubicSpline(when, channel.y[first])(np.arange(n)) if len(when) > 3 else channel.y
        delays = sorted({0, s.delay, *(round(part * shape[0]) for part in LATE)})
        fits = [fit_linear(replace(channel, y=fresh), replace(s, delay=d), rough=True) for d in delays]
        f = min(fits, key=lambda g: g.deviance)
        form = f.structure.adding(Part(REFRESHED, s.inputs[0]))
        p, scales = np.concatenate((f.p, shape)), np.concatenate((f.scales, [shape[0] ** 2 / n, shape[0]]))
        held = np.concatenate((f.scales, [0.0, 0.0]))
        for size in FINER:  # samples that change their refresh jump: no derivative knows of them
            p = fit(channel, form, p, held, iterations=5, colour=False).p
            steps = size * scales[-2:] * np.stack(np.meshgrid(GRID, GRID), axis=-1).reshape(-1, 2)
            moved = [np.concatenate((p[:-2], p[-2:] + step)) for step in steps]
            p = min(
                moved,
                key=lambda q: float(
                    np.sum((channel.y - simulate(form, q, channel.u, channel.clock))[keep] ** 2)
                ),
            )
        yield fit(channel, form, p, scales, noise=base.noise, iterations=20)


REFRESHED = Effect(
    key="refreshed", cause="held_between_refreshes", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, linear=True, trials=2000,
    sentence="the sensor is refreshed at a rate of its own: every sample reads its last value, which ages until the next",
    parameters={"period": "sample", "phase": "sample"}, apply=_refreshed, search=_ages,
)  # fmt: skip

TIMING = (DRIFT, INTERLEAVED, WARMING, REFRESHED, DECAY, CONVEYED)
