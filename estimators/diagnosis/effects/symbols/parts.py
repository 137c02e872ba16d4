"""Effects as parts of a step: what each keeps from sample to sample, in the terms that the recursions are held to."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.effect import Clock, Effect
from estimators.diagnosis.effects.fed import NOTHING, SHARED, drawn
from estimators.diagnosis.effects.input import aside
from estimators.diagnosis.effects.kernels.recursion_kernels import LEAST_PACE, WITHIN, warm_rest
from estimators.diagnosis.effects.loops import play_widths
from estimators.diagnosis.effects.loops.ageing import worn_by
from estimators.diagnosis.effects.loops.switching import SWITCHING, times
from estimators.diagnosis.effects.path import curve_of_charge
from estimators.diagnosis.effects.process import Passing, led
from estimators.diagnosis.effects.sensing.gains import law_of
from estimators.diagnosis.effects.sensing.turns import TOP
from estimators.diagnosis.effects.symbols import terms
from estimators.diagnosis.effects.symbols.loops import LOOPED
from estimators.diagnosis.effects.symbols.meeting import MEETINGS
from estimators.diagnosis.effects.symbols.sensing import EXTREMES
from estimators.diagnosis.effects.symbols.wiring import Wiring

Array = NDArray[Any]
REMEDY = "simulate it, or diagnose without this effect"
SAMPLES = 64
"""On which a map of one's own is held to its symbols: one that looks at other samples or at the whole record differs in some."""
SIZES = (0.01, 0.1, 1.0, 10.0)


def _read(w: Wiring, moved: Any, stood: Any) -> Any:
    """What a sensor remembers, which before the record stood by its signal at rest, whatever way from zero that is on."""
    return w.ca.if_else(w.k > -0.5, moved, stood)


def _play(w: Wiring, x: Any, half: float, stood: float = 0.0, *, reads: bool = False) -> Any:
    """A play of half a width from where it stood aside of its first command, or of what it `reads`."""
    off = aside(half, stood)
    s, moved = w.state(w.value(x) + off), terms.play_step()
    s.after = _read(w, moved(s.x, x, half), x + off) if reads else moved(s.x, x, half)
    return s.after - off


def _reported(w: Wiring, x: Any, p: Array) -> Any:
    s = w.state(w.value(x) + p[1])
    s.after = _read(w, w.ca.if_else(w.ca.fabs(x - s.x) > abs(p[0]), x, s.x), x + p[1])
    return s.after


def _lost_in_motion(w: Wiring, x: Any, p: Array) -> Any:
    first, ca = w.value(x), w.ca
    s = w.state([first, first, 0.0])
    step = _read(w, x - s.x[1], 0.0)
    good = ca.if_else(ca.fabs(step + p[1] * (step - s.x[2])) > abs(p[0]), s.x[0], x)
    s.after = ca.vertcat(good, x, step)
    return good


def _paced(w: Wiring, x: Any, p: Array) -> Any:
    d = x - p[2]
    s = w.state(w.value(x) - p[2])
    s.after = d + (s.x - d) * w.ca.exp(-abs(p[0]) * w.ca.fmax(1.0 + p[1] * d, LEAST_PACE))
    return s.after + p[2]


def _side_by_side(reads: bool) -> Callable[[Wiring, Any, Array], Any]:
    return lambda w, x, p: (
        x
        + sum(
            a * _play(w, x, half, p[-1], reads=reads)
            for a, half in zip(p[1:-1], play_widths(p[0]), strict=True)
        )
    )


def _of_angle(w: Wiring, x: Any, p: Array) -> Any:
    turned = w.state()
    turned.after = turned.x + w.ca.if_else(w.k > -0.5, x, 0.0)  # from the record on
    angle = p[2] * 0.5 * (turned.x + turned.after)
    return x * (1.0 + p[0] * w.ca.cos(angle) + p[1] * w.ca.sin(angle))


def _used_up(w: Wiring, x: Any, p: Array) -> Any:
    use, recovery = abs(float(p[0])), abs(float(p[1])) + 1e-300
    s = w.state(recovery / (recovery + use * abs(w.value(x))))
    rate = recovery + use * w.ca.fabs(x)
    rest, stays = recovery / rate, w.ca.exp(-rate)
    s.after = rest + (s.x - rest) * stays
    return x * (rest + (s.x - rest) * (1.0 - stays) / rate)


def _worn(w: Wiring, x: Any, p: Array) -> Any:
    passed = w.state()
    through = w.ca.if_else(w.k > -0.5, w.ca.fabs(x), 0.0)
    passed.after = passed.x + through
    return x * (1.0 + abs(float(p[0])) * (passed.x + 0.5 * through)) ** worn_by(p)


def _warmed(w: Wiring, x: Any, p: Array) -> Any:
    rate, share, heat, pace = abs(float(p[0])), float(p[1]), abs(float(p[2])), abs(float(p[3]))
    s = w.state(warm_rest(w.value(x), share, heat))
    y, warm, h = s.x[0], s.x[1], 1.0 / WITHIN
    loss = lambda warm: 1.0 + share * (1.0 - w.ca.exp(-heat * warm))
    for _ in range(WITHIN):
        middle = y + 0.5 * h * rate * (x - loss(warm) * y)
        then = warm + 0.5 * h * pace * (loss(warm) * y * y - warm)
        y, warm = (
            y + h * rate * (x - loss(then) * middle),
            warm + h * pace * (loss(then) * middle * middle - then),
        )
    s.after = w.ca.vertcat(y, warm)
    return y


def _stem(slides: bool) -> Callable[[Wiring, Any, Array], Any]:
    def run(w: Wiring, x: Any, p: Array) -> Any:
        half = abs(p[0])
        left, off, first = half * float(np.clip(p[1], 0.0, 1.0)), aside(half, p[2]), w.value(x)
        s = w.state([first + off, first, 0.0])  # where it stands, the last command, and which way it slides
        gap = x - s.x[0]
        breaks = w.ca.if_else(gap > half, 1.0, w.ca.if_else(gap < -half, -1.0, 0.0))
        way = w.ca.if_else((x - s.x[1]) * s.x[2] > 0.0, s.x[2], breaks) if slides else breaks
        stem = w.ca.if_else(way * gap > left, x - way * left, s.x[0])
        s.after = w.ca.vertcat(stem, x, way)
        return stem - off

    return run


def _bouc_wen(w: Wiring, x: Any, width: float) -> Any:
    z, before = w.state(), w.state()
    z.after, before.after = terms.bouc_wen_step()(z.x, before.x, x, width), x
    return z.after


def _hysteresis(w: Wiring, x: Any, p: Array) -> Any:
    share = float(np.clip(p[0], -2.0, 1.0))
    return (1.0 - share) * x + share * _bouc_wen(w, x, abs(p[1]))


def _rate_driven(w: Wiring, x: Any, p: Array) -> Any:
    way, width = w.state(), abs(p[1]) + 1e-12
    way.after = way.x + x
    return x + p[0] * _bouc_wen(w, way.after, width) / width


def _delay(w: Wiring, x: Any, p: Array) -> Any:
    whole = int(np.floor(p[0]))
    past = w.state(np.zeros(whole + 1))
    seen = w.ca.vertcat(x, past.x)
    past.after = seen[:-1]
    return terms.delay_term(whole)(seen, p[0])


def _recycled(w: Wiring, x: Any, p: Array) -> Any:
    from estimators.diagnosis.effects.loops.recycled import stays

    (a, b), whole, before = stays(p), int(np.floor(p[3])), w.value(x) / (1.0 - p[0])
    one, two, past = w.state(before), w.state(before), w.state(np.full(whole + 1, before))
    back = past.x[whole - 1] + (p[3] - whole) * (past.x[whole] - past.x[whole - 1])
    out = x + p[0] * back
    one.after = out + a * (one.x - out)
    two.after = one.after + b * (two.x - one.after)
    past.after = w.ca.vertcat(two.after, past.x[:-1])
    return out


def _lag(w: Wiring, x: Any, p: Array) -> Any:
    s = w.state()
    s.after = terms.lag_step()(s.x, x, p[0])
    return s.after


def _heated(w: Wiring, x: Any, p: Array) -> Any:
    pole = float(np.exp(-1.0 / max(abs(p[1]), 0.5)))
    s = w.state(w.value(x) ** 2)
    s.after = pole * s.x + (1.0 - pole) * x**2
    return x * (1.0 + p[0] * s.after)


def _store(w: Wiring, x: Any, p: Array) -> Any:
    charge = w.state()
    charge.after = charge.x + w.ca.if_else(w.k > -0.5, x, 0.0)
    return curve_of_charge(charge.x, p)


def _beyond(w: Wiring, x: Any, p: Array) -> Any:
    *_, delay, level = p
    b, f = np.split(p[:-2], 2)
    above = w.ca.fmax(x - level, 0.0)
    before = w.value(above)
    num, den = np.concatenate((np.zeros(int(delay)), b)), np.concatenate(([1.0], f))
    return before * num.sum() / den.sum() + w.rational([num], den, [above - before])


def _line(w: Wiring, x: Any, p: Array) -> Any:
    return terms.hinges_term(len(p) // 2)(x, p)


def _line_from_origin(w: Wiring, x: Any, p: Array) -> Any:
    return _line(w, x, p) - _line(w, 0.0, p)


def _levelled(w: Wiring, x: Any, p: Array) -> Any:
    share, power, rises, falls = law_of(p)
    size, x = w.state(abs(w.value(x) - p[4])), x - p[4]
    more = w.ca.fabs(x) - size.x
    up, down = (1.0 - float(np.exp(-1.0 / t)) for t in (rises, falls))
    size.after = size.x + w.ca.if_else(more > 0.0, up, down) * more
    return x * (1.0 + share * size.x) ** -power + p[4]


TWINS: Mapping[str, Callable[[Wiring, Any, Array], Any]] = {
    "plays": _side_by_side(False), "plays_output": _side_by_side(True),
    "backlash_input": lambda w, x, p: _play(w, x, abs(p[0]), p[1]), "backlash_sampled": lambda w, x, p: _play(w, x, abs(p[0]), reads=True), **LOOPED,
    "gain_of_angle": _of_angle, "gain_fatigue": _used_up, "gain_worn": _worn, "loss_heat": _warmed, "stiction": _stem(False), "stiction_sliding": _stem(True), "hysteresis": _hysteresis, "hysteresis_rate": _rate_driven, "delay": _delay, "lag": _lag, "recycle": _recycled,
    "gain_heat": _heated, "integral_curve": _store, "acts_beyond": _beyond, "sandwich": _line, "input_lines": _line_from_origin,
    "output_lines": _line_from_origin, "reported_on_change": _reported, "held_in_motion": _lost_in_motion, "sensor_paced": _paced, "automatic_gain": _levelled,
}  # fmt: skip
"""Of the catalogue's effects that are no map of one sample and its time."""


def _tones(w: Wiring, y: Any, p: Array, k: Any) -> Any:
    return y + sum(a * np.cos(f * k) + b * np.sin(f * k) for f, a, b in p.reshape(-1, 3))


def _since(w: Wiring, k: Any, every: float, phase: float) -> Any:
    """Samples since the last of the times that come every so many, one of them at a phase."""
    return k - phase - every * w.ca.floor((k - phase) / every)


def _beaten(w: Wiring, x: Any, p: Array, k: Any) -> Any:
    every = max(abs(float(p[1])), 1.0)
    s = w.state(w.value(x) + p[3])
    s.after = w.ca.if_else(
        w.ca.logic_or(_since(w, k, every, float(p[2])) < 0.5, w.ca.fabs(x - s.x) > abs(p[0])), x, s.x
    )
    return s.after


def _scanned(w: Wiring, x: Any, p: Array, k: Any) -> Any:
    every, phase = float(p[0]), float(p[1])
    s, since = w.state(w.value(x)), _since(w, k, every, phase)
    held = w.ca.if_else(since == 0.0, x, s.x)
    until = w.ca.fmin(every - since, 1.0)
    s.after = w.ca.if_else(until < 1.0, x, held)
    return until * held + (1.0 - until) * x


def _in_turn(w: Wiring, x: Any, p: Array, k: Any) -> Any:
    if p[5] != 0.0:
        w.refuse("the effect 'multiplexed' reads between the samples", REMEDY)
    slow = x
    if abs(float(p[4])) >= 1.0:
        s, stays = w.state(w.value(x)), float(np.exp(-1.0 / abs(float(p[4]))))
        slow = s.after = stays * s.x + (1.0 - stays) * x
    turn = w.ca.if_else(w.ca.cos(2.0 * np.pi * (k - p[1]) / p[0]) > TOP, 1.0, 0.0)
    return x + turn * (p[2] * slow + p[3] - x)


def _in_own_time(which: str) -> Callable[[Wiring, Any, Array, Any], Any]:
    def taken_over(w: Wiring, x: Any, p: Array, k: Any) -> Any:
        starts_late, stops_late, pause, run = times(which, p)
        first, ca = w.value(x), w.ca
        s = w.state([first, first, 0.0, 0.0, 0.0, -1e9])
        v, before, way, taken, since, last = (s.x[i] for i in range(6))
        since = ca.if_else(x == before, since, k)
        way = ca.if_else(x > before, 1.0, ca.if_else(x < before, -1.0, way))
        up, down = ca.fmax(since + starts_late, last + pause), ca.fmax(since + stops_late, last + run)
        due = ca.fmax(ca.if_else(way > 0.0, up, down), k)
        waits = ca.if_else(way == taken, 0.0, ca.fmin(due - k, 1.0))
        turns = ca.logic_and(way != taken, waits < 1.0)
        s.after = ca.vertcat(
            ca.if_else(waits < 1.0, x, v),
            x,
            way,
            ca.if_else(turns, way, taken),
            since,
            ca.if_else(turns, due, last),
        )
        return waits * v + (1.0 - waits) * x

    return taken_over


TIMED: Mapping[str, Callable[[Wiring, Any, Array, Any], Any]] = {
    "tones": _tones,
    "input_scanned": _scanned,
    "reported_in_time": _beaten,
    "multiplexed": _in_turn,
    **{key: _in_own_time(key) for key in SWITCHING},
    "select_low": lambda w, x, p, k: w.ca.fmin(x, p[1] * w.u[int(p[0]) - 1] + p[2]),
    "select_high": lambda w, x, p, k: w.ca.fmax(x, p[1] * w.u[int(p[0]) - 1] + p[2]),
    "share": lambda w, x, p, k: x / (x + p[1] * w.u[int(p[0]) - 1]),
    **MEETINGS, **EXTREMES,
}  # fmt: skip
"""Of those that know the time, too, or another input."""


def _process(w: Wiring, x: Any, p: Array, passing: Passing) -> Any:
    from estimators.diagnosis.effects.kernels.plant_kernels import Elements
    from estimators.diagnosis.model.layouts import STEPS, held_plant

    s = w.state([passing.start(w.value(x), p), *[w.value(x)] * passing.lagged])
    held = held_plant(*led(p, passing.lagged), STEPS)
    step = terms.feedback_step(len(held.phi), held, Elements(), [(passing.force, p[1:])])
    s.after = s.x
    for _ in range(STEPS):
        s.after, _ = step(s.after, x, 0.0)
    return s.after[0]


def _map(w: Wiring, effect: Effect, x: Any, p: Array, k: Any, length: int) -> Any:
    """A map of one sample and its time, held to the effect on numbers: what has a memory, or asks for more, is refused."""
    apply: Any = effect.apply
    given = np.random.default_rng(0).standard_normal(SAMPLES) * np.repeat(SIZES, SAMPLES // len(SIZES))
    at = np.arange(float(SAMPLES))
    try:
        term = terms.map_term(apply, p, length)
        same = np.allclose(np.array(term(given[None, :], at[None, :])).ravel(), apply(given, p, Clock(at, length)),
                           rtol=1e-9, atol=1e-12)  # fmt: skip
    except Exception:  # CasADi, NumPy and numba each have their own error for what no symbol can pass
        same = False
    if not same:
        w.refuse(f"the effect {effect.key!r} ({effect.sentence}) has no CasADi twin", REMEDY)
    return term(x, k)


def acted(w: Wiring, part: Any, x: Any, p: Array, k: Any, length: int) -> Any:
    """A signal after a part of a structure, its own linear block first."""
    x, q, effect = blocked(w, part, x, p), p[part.own :], part.effect
    if effect.apply is None:
        return x
    if (known := effect in _known()) and effect.key in TIMED:
        return TIMED[effect.key](w, x, q, k)
    if effect.signal is not None:  # it reads another input
        w.refuse(f"the effect {effect.key!r} ({effect.sentence}) has no CasADi twin", REMEDY)
    if isinstance(effect.apply, Passing):
        return _process(w, x, q, effect.apply)
    return TWINS[effect.key](w, x, q) if known else _map(w, effect, x, q, k, length)


def rationed(w: Wiring, part: Any, U: Mapping[int, Any], p: Array) -> dict[int, Any]:
    """What becomes of the inputs that act here, which with others draw on one supply."""
    if part.effect is not SHARED:
        w.refuse(f"the effect {part.key!r} ({part.effect.sentence}) has no CasADi twin", REMEDY)
    draws, limit = drawn(part.channel, p), max(abs(float(p[0])), NOTHING)
    asked = sum(draw * w.ca.fabs(U.get(j, w.u[j])) for j, draw in enumerate(draws))
    return {j: x * (limit / w.ca.fmax(asked, limit) if draws[j] else 1.0) for j, x in U.items()}


def _known() -> tuple[Effect, ...]:
    """The catalogue's own: an effect of the same key from elsewhere may be another one."""
    return tuple(named(key) for key in (*TWINS, *TIMED))


def blocked(w: Wiring, part: Any, x: Any, p: Array) -> Any:
    """A signal after the linear block of a part, which has a gain of 1 and starts settled, or zeros of its own and starts at rest."""
    if not part.first:
        return x
    f = np.concatenate(([1.0], p[: part.first]))
    if part.free:
        return w.rational([np.concatenate(([1.0], p[part.first : part.own]))], f, [x])
    level = w.value(x)
    return level + w.rational([f[:1] * f.sum()], f, [x - level])


def inside_plant(w: Wiring, s: Any, p: Array, u: Any) -> Any:
    """Output of a physical layout with the effects inside it, driven by u."""
    from estimators.diagnosis.effects.kernels.plant_kernels import Elements
    from estimators.diagnosis.model.layouts import LAYOUTS, held_plant

    if len(s.inputs) > 1:
        w.refuse(f"several inputs ({len(s.inputs)}) drive a plant with effects inside it", REMEDY)
    forces, elements = [], {}
    for part, sl in zip(s.parts, s.slices(), strict=True):
        effect, q = part.effect, p[sl][part.own :]
        paced = effect.inside is not None and "pace" in effect.inside(q)
        if effect.signal is not None or effect.change is not None or paced:
            w.refuse(f"the effect {effect.key!r} changes a coefficient of the plant while it runs", REMEDY)
        forces += [] if effect.force is None else [(effect.force, q)]
        elements |= {} if effect.inside is None else effect.inside(q)
    if s.layout == "tanks":
        w.refuse("two tanks that overflow have no CasADi twin", "simulate it, or diagnose without 'outflow'")
    n, head = s.order, LAYOUTS[s.layout][1]
    x, u = w.state(np.zeros(n)), w.late(u, s.delay)
    steps = s.steps if forces or elements else 1
    held = held_plant(s.layout, tuple(s.rates(p)), steps)
    step = terms.feedback_step(n, held, Elements(**elements), forces)
    z = w.state() if elements.get("spring") else None
    x.after, bent = x.x, 0.0 if z is None else z.x
    for _ in range(steps):
        x.after, bent = step(x.after, u, bent)
    if z is not None:
        z.after = bent
    return w.ca.dot(x.x, w.ca.DM(p[head : head + n]))
