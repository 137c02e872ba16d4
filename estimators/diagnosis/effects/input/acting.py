"""Effects at the input: what happens to it before it reaches the linear part of a plant."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import (
    Clock,
    Effect,
    Grid,
    Nature,
    Sizes,
    Slot,
    level_before,
    numbered,
)

Array = NDArray[Any]
_recent: deque[tuple[tuple[Any, ...], Array]] = deque(maxlen=8)  # of `kept`


def quantiles(x: Array, *levels: float) -> list[list[float]]:
    """One shape per quantile of a signal."""
    return [[float(v)] for v in np.quantile(x, levels)]


def kept(run: Callable[[Array, Array], Array], x: Array, p: Array, mark: Any = None) -> Array:
    """A recursion's run over a signal (N,), kept as long as only the linear part behind it changes; `mark` tells it from others
    where the function does not."""
    key = (run if mark is None else mark, p.tobytes(), x.tobytes())
    known = next((out for mark, out in tuple(_recent) if mark == key), None)
    if known is None:
        known = run(np.ascontiguousarray(x), p)
        _recent.append((key, known))
    return known


def after(clock: Clock, time: float) -> Array:
    """0 before a time in samples, 1 after, linear over the sample that it falls into."""
    return np.clip(clock.k - time, 0.0, 1.0)


def dead_zone(x: Any, low: float, high: float) -> Any:
    """Zero between low and high, the excess outside."""
    return np.maximum(x - high, 0.0) + np.minimum(x - low, 0.0)


AWAY = 0.3
"""Of its standard deviation, from which on the mean of a signal is a level that it was moved about."""


def zones(x: Array, shares: tuple[float, ...]) -> list[list[float]]:
    """Zones about where a valve or a gear may rest, at nothing and at the mean of a signal that has a level, in its standard deviations."""
    mean, size = float(np.mean(x)), float(np.std(x))
    rests = [0.0, mean] if abs(mean) > AWAY * size else [0.0]
    return [[m - a * size, m + b * size] for m in rests for a in shares for b in shares]


LEAST = 1e-100
"""Of a width or a sharpness, by which is divided: far below any in a unit in which signals may be, of which 1e-50 is the smallest."""

ARCS = (0.5, 0.8, 1.2, 1.8)
"""Radians of a sine to a standard deviation of the input: with fewer it is a parabola, with more it turns back and forth."""


def broken_line(x: Array, p: Array) -> Array:
    """Slopes and corners in turn: a broken line through the origin, of slope 1 at the far left."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import hinges

    c = np.ascontiguousarray(p)
    return hinges(np.ascontiguousarray(x), c) - hinges(np.zeros(1), c)[0]


def exponential(x: Any, p: Array, clock: Clock) -> Any:
    """(exp(c x) - 1)/c, of slope 1 at zero and the identity for small c."""
    return x if abs(p[0]) < LEAST else np.expm1(np.clip(p[0] * x, -60.0, 60.0)) / p[0]


def power(x: Any, p: Array, clock: Clock) -> Any:
    """|x|^power with the sign of x; from a twentieth to twenty."""
    return np.sign(x) * np.abs(x) ** min(max(p[0], 0.05), 20.0)


def odd(f: Callable[[Any], Any]) -> Callable[[Any, Array, Clock], Any]:
    """The curve f(c (x - centre))/c of an f of slope 1 at zero, odd or not, from its value at zero; the identity for small c."""

    def curve(x: Any, p: Array, clock: Clock) -> Any:
        if abs(p[0]) < LEAST:
            return x
        return (f(p[0] * (x - p[1])) - f(-p[0] * p[1])) / p[0]

    return curve


def _arcs(s: Sizes) -> Grid:
    """Sines of which the input's spread is a share of a quarter turn or more, rising, falling or at the top in its middle."""
    middle, turns = float(np.mean(s.u)), [f / s.su for f in ARCS]
    return [[c, middle + side / c] for c in turns for side in (-1.3, -0.7, 0.0, 0.7, 1.3)], [1.0 / s.su, s.su]


def _hinges(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import hinges

    return hinges(np.ascontiguousarray(x), np.ascontiguousarray(p))


def _rate_limited(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import servo_mean

    rate = np.abs(p[:1])
    return servo_mean(np.ascontiguousarray(x), rate, rate, 0.0, level_before(x))


def _rate_limited_samples(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import rate_limited

    return rate_limited(np.ascontiguousarray(x), abs(p[0]), level_before(x))


def _play(x: Array, p: Array, clock: Clock) -> Array:
    return moved(x, abs(p[0]), p[1])


def moved(x: Array, half: float, stood: float) -> Array:
    """What a play hands on, from where it stood: the plant behind it was at rest there, as it is before a test record."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import play

    off = aside(half, stood)
    return play(np.ascontiguousarray(x), half, level_before(x) + off) - off


def aside(half: float, stood: float) -> float:
    """How far what has a gap stood from its first command, by the share of half the gap. Nothing in its later motion says so, and a
    record that rests at first would begin with an error as wide as the gap."""
    return half * float(np.clip(stood, -1.0, 1.0))


def _hysteretic(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.plant_kernels import bouc_wen

    share = float(np.clip(p[0], -2.0, 1.0))
    return (1.0 - share) * x + share * bouc_wen(np.ascontiguousarray(x), abs(p[1]))


def _relay(x: Array, p: Array, clock: Clock) -> Array:
    """A relay about a level; on a scale of its input, for the plant's gain to be one of inputs."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import relay

    return float(np.std(x)) * relay(np.ascontiguousarray(x - p[1]), abs(p[0]))


def _rate_driven(x: Array, p: Array, clock: Clock) -> Array:
    """Where the input is a velocity: a share of it acts through a hysteretic element of the way that it has made."""
    from estimators.diagnosis.effects.kernels.plant_kernels import bouc_wen

    way = np.ascontiguousarray(np.cumsum(x))
    width = max(abs(p[1]), LEAST)
    return x + p[0] * bouc_wen(way, width) / width


def _late(x: Array, p: Array, clock: Clock) -> Array:
    """Delay linear between samples; from no delay to a quarter of the record."""
    if not 0.0 <= p[0] <= len(x) / 4:
        return np.full(len(x), np.inf)
    whole = int(np.floor(p[0]))
    part = p[0] - whole
    shifted = np.concatenate((np.zeros(whole), x[: len(x) - whole])) if whole > 0 else x
    return (1.0 - part) * shifted + part * np.concatenate(([0.0], shifted[:-1]))


def _rates(s: Sizes) -> Grid:
    jump = np.abs(np.diff(s.u))
    jump = jump[jump > 1e-9 * s.su]
    wide = float(np.ptp(s.u))
    moving = quantiles(jump, 0.9, 0.7, 0.4) if len(jump) else []
    return moving + [[wide / m] for m in (1.3, 2, 3, 5, 8, 12, 20, 32, 50)], [s.su]


def _widths(s: Sizes) -> Grid:
    return [[f * s.su, 0.0] for f in (0.08, 0.16, 0.3, 0.5, 0.8)], [s.su, 1.0]


def _corners(count: int, order: int) -> list[tuple[str, str]]:
    return numbered({"slope": "1", "corner": "u"}, count)


def _delays(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Whole delays of the linear model one after another, then fractions beside the best."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import fitted, scored

    s, part = base.structure, Part(DELAY, base.structure.inputs[0])
    if len(s.effects):
        yield from fitted(channel, base, scored(channel, base, part, 3).starts, 20)
        return
    if s.layout != "tf":
        return
    best, worse = base, 0
    for d in (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25):
        if d > len(channel) // 10:
            break
        f = fit_linear(channel, replace(s, delay=d), noise=base.noise, extra=[best.p[: s.order]])
        best, worse = (f, 0) if f.deviance < best.deviance else (best, worse + 1)
        if worse >= 4:
            break
    source = best if best.structure.delay else base
    for start in {max(best.structure.delay + x, 0.05) for x in (-0.5, 0.02, 0.5)}:
        p, scales = np.append(source.p, start), np.append(source.scales, 1.0)
        yield fit(channel, replace(s, delay=0).adding(part), p, scales, noise=base.noise, iterations=20)


BANK = (300.0, 100.0, 30.0, 10.0, 3.0)
"""Rates, per record, of the lags that a mixture of stands for any linear part: slower ones hardly differ from what is added."""


def banked(x: Array) -> Array:
    """(N, T, lags) signals (N, T) through each lag of a bank."""
    from scipy.signal import lfilter

    poles = np.exp(-np.array(BANK) / len(x))
    return np.stack([lfilter([0.0, 1.0 - z], [1.0, -z], x, axis=0) for z in poles], axis=2)


def any_linear(u: Array, rows: NDArray[np.bool_]) -> Array:
    """(M, r) orthonormal directions, on some rows, of what a bank makes of inputs (N, m) and of a level they had stood on."""
    known = banked(np.column_stack((u, np.ones(len(u))))).reshape(len(u), -1)
    return np.asarray(np.linalg.qr(np.column_stack((known, np.ones(len(u))))[rows])[0])


def told_beside(x: Array, Z: Array, rest: Array, rows: NDArray[np.bool_], *bare: Array) -> float:
    """The squares that signals (N, ...) through any linear part, and `bare` ones, explain on some rows of a rest free of directions Z."""
    D = np.column_stack((banked(x.reshape(len(x), -1)).reshape(len(x), -1), *bare))[rows]
    D = np.linalg.qr(D - Z @ (Z.T @ D))[0]
    return float(np.sum((D.T @ rest) ** 2))


def _changed_gain(channel: Any, base: Any, j: int) -> Any:
    """The gain of an input that changes, from linear fits with one numerator before and one after: the poles of one linear model
    for the whole record may be far off, and with them the time at which its score is best; a mixture of lags has another."""
    from estimators.diagnosis.model.linear import fit_linear, prefiltered_error
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import Start

    s = base.structure
    if s.layout != "tf" or s.effects:
        return None
    k, n, m = channel.clock.k, len(channel), len(s.inputs)
    y = channel.y - np.mean(channel.y[channel.keep]) if s.parts else channel.y
    seen = channel.keep.copy()
    seen[: s.order + s.delay] = False

    def later(time: float) -> Array:
        return channel.u[:, j] * (k >= time)

    def inputs(time: float) -> Array:
        return np.column_stack((channel.u[:, list(s.inputs)], later(time)))

    def filtered(time: float) -> float:
        return prefiltered_error(y, inputs(time), np.concatenate(([1.0], base.p[: s.order])), s, seen)

    Z = any_linear(channel.u[:, list(s.inputs)], seen)
    rest = channel.y[seen] - Z @ (Z.T @ channel.y[seen])
    mixed = lambda time: -told_beside(later(time), Z, rest, seen)

    def started(squares: Callable[[float], float]) -> tuple[float, Array]:
        time = float(min(k[0] + np.linspace(0.06, 0.94, 23) * n, key=squares))
        time = float(min(time + np.linspace(-0.035, 0.035, 15) * n, key=squares))
        f = fit_linear(
            replace(channel, u=inputs(time)),
            replace(s, inputs=tuple(range(m + 1))),
            extra=[base.p[: s.order]],
        )
        end = s.order + (m + 1) * s.taps
        *rows, more = f.p[s.order : end].reshape(m + 1, s.taps)
        own = rows[s.inputs.index(j)]
        change = float(own @ more) / (float(own @ own) + 1e-300)
        p = np.concatenate((f.p[: s.order], *rows, f.p[end:], [change, time]))
        return float(np.sum(f.residual**2)), p

    _, p = min(map(started, (filtered, mixed)), key=lambda entry: entry[0])
    return Start(s.adding(Part(GAIN_CHANGE, j)), p, np.concatenate((base.scales, [1.0, 1.0])), 0.0)


def static(key: str, cause: str, sentence: str, **fields: Any) -> Effect:
    """A static curve of one input, before which an actuator may lag."""
    return Effect(
        key=key, cause=cause, nature=Nature.INPUT_STATIC, slot=Slot.INPUT, sentence=sentence, lagged=True, **fields
    )  # fmt: skip


def _moving(key: str, cause: str, sentence: str, **fields: Any) -> Effect:
    return Effect(key=key, cause=cause, nature=Nature.DYNAMIC, slot=Slot.INPUT, sentence=sentence, **fields)


DELAY = Effect(
    key="delay", cause="transport_delay", nature=Nature.LINEAR, slot=Slot.INPUT,
    sentence="the input acts later than modelled", parameters={"delay": "sample"}, trials=8, apply=_late, search=_delays,
    starts=lambda s: ([[v] for v in (0.3, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 8.0)], [1.0]),
)  # fmt: skip

GAIN_CHANGE = Effect(
    key="gain_change", cause="parameter_change", nature=Nature.TIME, slot=Slot.INPUT, sentence="the gain changes abruptly",
    parameters={"change": "1", "time": "sample"}, trials=0.03, per_sample=True, amplitude=0, family="changes",
    apply=lambda x, p, c: x * (1.0 + p[0] * after(c, p[1])),
    starts=lambda s: ([[0.05, t] for t in s.times()], [1.0, 1.0]), more=_changed_gain,
)  # fmt: skip

SANDWICH = Effect(
    key="sandwich", cause="output_nonlinearity", nature=Nature.OUTPUT_STATIC, slot=Slot.INPUT, trials=30, block=True,
    sentence="a static nonlinearity stands between two linear blocks (Wiener-Hammerstein)",
    apply=_hinges, shape=_corners,
)  # fmt: skip

LINES = static(
    "input_lines", "hammerstein", "the input acts through a broken line, a static curve of no simpler form",
    trials=30, block=True, apply=lambda x, p, c: broken_line(x, p), shape=_corners,
)  # fmt: skip

INPUT = (
    static("saturation", "input_saturation", "the input is limited to +-limit", parameters={"limit": "u"}, trials=6,
            two_sided=True, apply=lambda x, p, c: np.clip(x, -abs(p[0]), abs(p[0])),
            starts=lambda s: (quantiles(np.abs(s.u), 0.97, 0.9, 0.8, 0.65, 0.5) + [[1.5 * s.su], [s.su]], [s.su])),
    static("saturation_asymmetric", "input_saturation", "the input is limited to [low, high]",
            parameters={"low": "u", "high": "u"}, trials=15, apply=lambda x, p, c: np.clip(x, min(p), max(p)),
            starts=lambda s: ([a + b for a in quantiles(s.u, 0.03, 0.12, 0.25)
                               for b in quantiles(s.u, 0.97, 0.88, 0.75)], [s.su, s.su])),
    static("saturation_upper", "input_saturation", "the input is limited from above", parameters={"high": "u"}, trials=6,
            apply=lambda x, p, c: np.minimum(x, p[0]),
            starts=lambda s: (quantiles(s.u, 0.98, 0.93, 0.85, 0.75, 0.6), [s.su])),
    static("saturation_lower", "input_saturation", "the input is limited from below", parameters={"low": "u"}, trials=6,
            apply=lambda x, p, c: np.maximum(x, p[0]),
            starts=lambda s: (quantiles(s.u, 0.02, 0.07, 0.15, 0.25, 0.4), [s.su])),
    static("dead_zone", "input_deadzone", "small inputs do nothing", parameters={"half_width": "u"}, trials=6,
            apply=lambda x, p, c: dead_zone(x, -abs(p[0]), abs(p[0])),
            starts=lambda s: ([[f * s.su] for f in (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)], [s.su])),
    static("dead_zone_asymmetric", "input_deadzone", "inputs between low and high do nothing",
            parameters={"low": "u", "high": "u"}, trials=15,
            apply=lambda x, p, c: dead_zone(x, min(p), max(p)),
            starts=lambda s: (zones(s.u, (0.1, 0.3, 0.6)), [s.su, s.su])),
    static("input_quadratic", "hammerstein", "the input acts through u + c2 u^2", parameters={"c2": "1/u"}, amplitude=0,
            apply=lambda x, p, c: x * (1.0 + p[0] * x), starts=lambda s: ([[0.03 / s.su]], [1 / s.su])),
    static("input_cubic", "hammerstein", "the input acts through u + c3 u^3", parameters={"c3": "1/u^2"}, amplitude=0,
            apply=lambda x, p, c: x * (1.0 + p[0] * x**2), starts=lambda s: ([[0.02 / s.su**2]], [1 / s.su**2])),
    static("input_exponential", "hammerstein", "the input acts through an exponential curve, (exp(c u) - 1)/c: a valve of equal percentage",
            parameters={"c": "1/u"}, trials=4, apply=exponential,
            starts=lambda s: ([[f / s.su] for f in (0.25, 0.6, 1.2, -0.25, -0.6, -1.2)], [1 / s.su])),
    static("input_power", "hammerstein", "the input acts through a power of its size", parameters={"power": "1"}, trials=4,
            apply=power, starts=lambda s: ([[0.5], [1.5], [2.0], [3.0]], [1.0])),
    static("input_threshold", "input_deadzone", "nothing passes up to a level of the input, and a power of what exceeds it beyond",
            parameters={"level": "u", "power": "1"}, trials=12, apply=lambda x, p, c: power(np.maximum(x - p[0], 0.0), p[1:], c),
            starts=lambda s: ([[c, a] for (c,) in quantiles(s.u, 0.02, 0.1, 0.25, 0.4) for a in (0.5, 1.0, 2.0)], [s.su, 1.0])),
    static("input_tanh", "input_saturation", "the input saturates smoothly: tanh(c (u - centre))/c",
            parameters={"c": "1/u", "centre": "u"}, trials=8, apply=odd(np.tanh),
            starts=lambda s: ([[f / s.su, m] for f in (0.4, 1.2) for m in s.centres(s.u)], [1 / s.su, s.su])),
    static("input_sine", "hammerstein", "the input acts through a sine: sin(c (u - centre))/c, light through a modulator, a crank's angle",
            parameters={"c": "1/u", "centre": "u"}, trials=12, apply=odd(np.sin), starts=_arcs),
    LINES,
    _moving("rate_limit", "rate_limiter", "the actuator cannot move faster than the rate", trials=6, reversing=True,
            parameters={"rate": "u/sample"}, family="rates", apply=_rate_limited, starts=_rates),
    _moving("rate_limit_sampled", "rate_limiter", "the command cannot change faster than the rate from one sample to the next",
            parameters={"rate": "u/sample"}, trials=6, reversing=True, family="rates", apply=_rate_limited_samples,
            starts=_rates),
    _moving("backlash_input", "backlash", "play in the actuator", parameters={"half_width": "u", "start": "1"}, trials=6, reversing=True,
            lagged=True, apply=_play, starts=_widths),
    _moving("hysteresis", "hysteresis",
            "the input acts with hysteresis (Bouc-Wen): a share of it bends off and returns on another way",
            parameters={"share": "1", "width": "u"}, trials=10, reversing=True, apply=_hysteretic,
            starts=lambda s: ([[a, w * s.su] for a in (0.3, 0.7) for w in (0.15, 0.4, 1.0)], [1.0, s.su])),
    _moving("hysteresis_rate", "hysteresis", "the input is a velocity, and the force that it makes has a hysteretic part",
            parameters={"level": "u", "way": "u sample"}, trials=15, reversing=True, lagged=True, apply=_rate_driven,
            starts=lambda s: ([[f * s.su, w * s.su] for f in (0.4, 1.5) for w in (0.5, 2.0, 8.0)], [s.su, s.su])),
    static("input_kink", "hammerstein", "the input acts through a kink at zero: u + level tanh(c u), as of dry friction",
            parameters={"level": "u", "c": "1/u"}, trials=8, apply=lambda x, p, clock: x + p[0] * np.tanh(p[1] * x),
            starts=lambda s: ([[f * s.su, c / s.su] for f in (-0.5, 0.5, 1.5) for c in (2.0, 8.0)], [s.su, 1.0 / s.su])),
    _moving("relay", "relay", "the input acts through a relay that switches with hysteresis", lagged=True,
            parameters={"half_width": "u", "level": "u"}, trials=12, apply=_relay,
            starts=lambda s: ([[f * s.su, m] for f in np.linspace(0.0, 1.6, 9) for m in {0.0, float(np.mean(s.u))}], [s.su, s.su])),
    SANDWICH,
    Effect(key="gain_drift", cause="gain_drift", family="drifts", nature=Nature.TIME, slot=Slot.INPUT, amplitude=0,
           sentence="the gain changes slowly: (1 + slope t)", parameters={"slope": "1/record"},
           apply=lambda x, p, c: (1.0 + p[0] * c.turn) * x, starts=lambda s: ([[0.05]], [1.0])),
    GAIN_CHANGE,
    Effect(key="step_input", cause="step_disturbance", nature=Nature.ADDED, slot=Slot.INPUT, amplitude=0, family="steps",
           sentence="a step disturbance enters at the plant input", parameters={"size": "u", "time": "sample"},
           trials=0.03, per_sample=True, settles=True, apply=lambda x, p, c: x + p[0] * after(c, p[1]),
           starts=lambda s: ([[0.05 * s.su, t] for t in s.times()], [s.su, 1.0])),
    DELAY,
)  # fmt: skip
