"""Linear dynamics that the model lacks: paths beside the plant, more poles, longer delays, a state at the start, a store."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before, numbered
from estimators.diagnosis.effects.input import after, any_linear, told_beside

Array = NDArray[Any]


def _rational(size: int, order: int) -> list[tuple[str, str]]:
    return numbered({"b": "y/u"}, size) + numbered({"f": "1"}, size)


def settled_through(p: Array, delay: float, before: float, x: Array) -> Array:
    """A signal (N,) through a linear block, b then f in p, that had settled on a value before."""
    from estimators.diagnosis.model.structure import stable_polynomial

    b, f = np.split(p, 2)
    if not stable_polynomial(f):
        return np.full(len(x), np.inf)
    num, den = np.concatenate((np.zeros(int(delay)), b)), np.concatenate(([1.0], f))
    return before * num.sum() / den.sum() + np.asarray(lfilter(num, den, x - before))


def _paths(channel: Any, base: Any, effect: Effect, j: int, sizes: tuple[int, ...]) -> Iterator[Any]:
    """A path from an input, started from a linear fit to the residual."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part, Structure

    residual = replace(channel, y=base.residual, step=0.0)
    for size in sizes:
        f = fit_linear(residual, Structure(size, (j,)))
        p = np.concatenate((base.p, f.p[size:], f.p[:size]))
        scales = np.concatenate((base.scales, f.scales[size:], f.scales[:size]))
        yield fit(channel, base.structure.adding(Part(effect, j, size)), p, scales, noise=base.noise)


def _modes(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    if base.structure.effects:  # a linear model takes more poles instead
        yield from _paths(channel, base, MODE, base.structure.inputs[0], (2,))


def _crossings(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    for j in others:
        yield from _paths(channel, base, CROSS, j, (1, 2))


def _delayed_orders(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part

    s = base.structure
    if s.layout != "tf" or s.effects or s.delay:
        return
    for order, delay in ((s.order + 1, 2), (s.order + 1, 3), (s.order + 2, 2), (s.order + 2, 3)):
        if order - delay >= 1:
            new = replace(s, order=order, taps=order - delay, delay=delay)
            f = fit_linear(channel, new, noise=base.noise)
            yield replace(f, structure=f.structure.adding(Part(DELAY_ORDER)))


def _wider(channel: Any, base: Any, effect: Effect, extra: int) -> Iterator[Any]:
    """More poles; beside effects that act on the input, from a linear fit to what they make of it."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.simulation import acted
    from estimators.diagnosis.model.structure import Part

    s, part = base.structure, Part(effect, 0, extra)
    if s.layout != "tf" or any(q.effect.slot is not Slot.INPUT for q in s.effects):
        return
    wide = replace(s, order=s.order + extra, taps=s.taps + extra, parts=s.parts[: s.base])
    if not s.effects:
        f = fit_linear(channel, wide, noise=base.noise)
        yield replace(f, structure=f.structure.adding(part))
        return
    entering = acted(s, base.p, channel.u, channel.clock)
    if entering is None:
        return
    f = fit_linear(replace(channel, u=entering), replace(wide, inputs=tuple(range(len(s.inputs)))))
    start = s.slices()[s.base].start
    p, scales = np.concatenate((f.p, base.p[start:])), np.concatenate((f.scales, base.scales[start:]))
    yield fit(channel, replace(wide, parts=(*s.parts, part)), p, scales, noise=base.noise)


def _initial_states(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.simulation import free_responses
    from estimators.diagnosis.model.structure import Part

    X = free_responses(base.structure, base.p, len(channel))
    theta = np.linalg.lstsq(X[channel.keep], base.residual[channel.keep], rcond=None)[0]
    scales = np.concatenate((base.scales, np.abs(theta) + 0.1 * np.abs(theta).max() + 1e-300))
    new, p = base.structure.adding(Part(INITIAL)), np.concatenate((base.p, theta))
    yield fit(channel, new, p, scales, noise=base.noise)


def _linear(key: str, cause: str, slot: Slot, trials: float, sentence: str, **fields: Any) -> Effect:
    return Effect(
        key=key, cause=cause, nature=Nature.LINEAR, slot=slot, trials=trials, sentence=sentence, **fields
    )


MODE = _linear("mode", "missing_mode", Slot.PATH, 20, "a second-order mode in parallel with the model",
               shape=_rational, search=_modes)  # fmt: skip
CROSS = _linear("cross", "mimo_cross", Slot.PATH, 5, "another input acts on this output",
                shape=_rational, search=_crossings)  # fmt: skip
DELAY_ORDER = _linear("delay_order", "transport_delay", Slot.FORM, 3,
                      "the input acts at least two samples later than modelled, through one order more",
                      search=_delayed_orders)  # fmt: skip
ORDER_ONE = _linear("order_one", "sensor_lag", Slot.FORM, 3, "the linear part needs one more order",
                    search=lambda channel, base, others: _wider(channel, base, ORDER_ONE, 1))  # fmt: skip
ORDER = _linear("order", "missing_mode", Slot.FORM, 3, "the linear part needs a higher order",
                search=lambda channel, base, others: _wider(channel, base, ORDER, 2))  # fmt: skip
LAG_BEFORE = _linear("lag_before", "missing_mode", Slot.FORM, 1, "a lag stands before the linear part",
                     search=lambda channel, base, others: iter(()))  # fmt: skip
"""What is left of an effect behind a linear block of its own when the effect is taken out: poles that the linear part can have too."""
INITIAL = _linear("initial", "initial_condition", Slot.START, 1, "the record does not start at rest",
                  shape=lambda size, order: numbered({"x": "y"}, order), search=_initial_states)  # fmt: skip
OUTFLOW = Effect(
    key="outflow", cause="square_root_outflow", nature=Nature.DYNAMIC, slot=Slot.FORM, trials=30, block=True,
    sentence="the outflow grows with the square root of the level, and the upper tank overflows",
)  # fmt: skip

PATH = (MODE, CROSS, DELAY_ORDER, ORDER_ONE, ORDER, LAG_BEFORE, INITIAL, OUTFLOW)


TIMES, NEARER = 40, 0.5 ** np.arange(1, 5)
"""Of a record, at any of which the way an input acts may change, and shares of what lies between two by which the best is moved."""
POLES_MORE = (0, 1, 2)
"""Poles of what comes or goes there, beyond those of the linear model: two stretches of a record have one of their own each."""


def _since(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """What an input adds from a time on, about a centre, through poles of its own, and these from a state at that time."""
    from estimators.diagnosis.model.structure import stable_polynomial

    size = len(p) // 2 - 2
    b, f, (state, delay, centre, time) = p[:size], p[size : 2 * size], p[2 * size :]
    if not stable_polynomial(f):
        return np.full(len(U), np.inf)
    gate = after(clock, time)
    driven = np.convolve((U[:, channel] - centre) * gate, np.concatenate((np.zeros(int(delay)), b)))[: len(U)]
    driven += state * np.diff(gate, prepend=gate[0])
    return np.asarray(lfilter([1.0], np.concatenate(([1.0], f)), driven))


def _since_shape(size: int, order: int) -> list[tuple[str, str]]:
    held = {"state": "y", "delay": "sample", "centre": "u", "time": "sample"}
    return _rational(size, order) + list(held.items())


def _unexplained(channel: Any, base: Any) -> tuple[Array, Array] | None:
    """Directions of any mixture of lags, and what they leave of the output there; None where no further way is looked for."""
    s, keep = base.structure, channel.keep
    if s.layout != "tf" or s.order < 1 or s.effects or channel.step > 0:
        return None
    Z = any_linear(channel.u[:, list(s.inputs)], keep)
    return Z, channel.y[keep] - Z @ (Z.T @ channel.y[keep])


def _placed(told: Callable[[float], float], grid: Array, apart: float) -> float:
    """Where most is told: the best place of a grid, moved closer by shares of what two of them are apart."""
    place = float(max(grid, key=told))
    for share in NEARER:
        place = max((place + a * share * apart for a in (0.0, -1.0, 1.0)), key=told)
    return place


def _switches(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The time from which an input, or all of them, beside what it did before, explains most, where any mixture of lags stands for both
    ways; then a linear fit to the inputs and to these from there on, with poles in common, and last each way with its own."""
    from estimators.diagnosis.effects.profiled import firm

    s, n, keep = base.structure, len(channel), channel.keep
    if (known := _unexplained(channel, base)) is None:
        return
    Z, r = known
    for which in dict.fromkeys((*((j,) for j in s.inputs), s.inputs)):
        x = channel.u[:, list(which)] - np.mean(channel.u[:, list(which)], axis=0)

        def told(time: float, x: Array = x) -> float:
            gate = after(channel.clock, time)[:, None]
            return told_beside(np.column_stack((x * gate, gate)), Z, r, keep, gate)

        time = _placed(told, channel.clock.k[0] + np.linspace(0.06, 0.94, TIMES) * n, n / TIMES)
        if not firm(base, float(r @ r) - told(time)):
            continue
        centres = np.mean(channel.u[:, list(which)], axis=0)
        gated = (channel.u[:, list(which)] - centres) * after(channel.clock, time)[:, None]
        yield from _two_ways(
            channel, base, SINCE, which, gated,
            [([0.0, 1.0 + s.delay, c, time], [float(np.std(channel.y)), 0.0, float(np.std(channel.u[:, j])), 1.0])
             for j, c in zip(which, centres, strict=True)],
        )  # fmt: skip


def _two_ways(
    channel: Any, base: Any, effect: Effect, which: tuple[int, ...], added: Array, places: list[tuple[list[float], list[float]]]
) -> Iterator[Any]:  # fmt: skip
    """Fits of a linear model beside what some inputs add, (N, len(which)), through poles of their own: first they have them in common.

    `places` the values and scales of the effect's last parameters for each of the inputs.
    """
    from estimators.diagnosis.model.fitting import fit

    ways = (_in_common(channel, base, effect, which, added, places, more) for more in POLES_MORE)
    begun = [fit(channel, *way, noise=base.noise, iterations=10, colour=False) for way in ways]
    for f in sorted(begun, key=lambda f: f.criterion)[:2]:
        yield fit(channel, f.structure, f.p, f.scales, noise=base.noise, iterations=30)


def _in_common(
    channel: Any, base: Any, effect: Effect, which: tuple[int, ...], added: Array, places: list[tuple[list[float], list[float]]], more: int,
) -> tuple[Any, Array, Array]:  # fmt: skip
    """Structure, parameters and scales of such a model of so many more poles, before each way has its own."""
    from estimators.diagnosis.effects.profiled import of_order
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part

    s, u = base.structure, channel.u
    order, count = s.order + more, len(s.inputs)
    taps = max(order, s.taps)
    wide = replace(s, order=order, taps=taps, inputs=tuple(range(count + len(which))))
    f = fit_linear(replace(channel, u=np.column_stack((u[:, list(s.inputs)], added))), wide, noise=base.noise)
    new, p, scales = of_order(base, order, taps)
    p[: new.plant_size], p[new.plant_size :] = f.p[: new.plant_size], f.p[wide.plant_size :]
    scales[: new.plant_size] = f.scales[: new.plant_size]
    poles = np.concatenate((f.p[:order], np.zeros(taps - order)))
    for i, (j, (place, own)) in enumerate(zip(which, places, strict=True)):
        at = slice(new.plant_size + i * taps, new.plant_size + (i + 1) * taps)
        new = new.adding(Part(effect, j, taps))
        p = np.concatenate((p, f.p[at], poles, place))
        scales = np.concatenate((scales, f.scales[at], np.ones(taps), own))
    return new, p, scales


SINCE = Effect(
    key="acts_since", cause="parameter_change", nature=Nature.TIME, slot=Slot.PATH, trials=0.3, per_sample=True, family="changes",
    sentence="from a time on an input acts in another way", parameters={"time": "sample"},
    shape=_since_shape, signal=_since, search=_switches,
)  # fmt: skip


LEVELS = np.linspace(0.1, 0.9, 17)
"""Of what an input does, at which it may begin to act in another way: a twentieth from one to the next, as the best is moved closer."""


def _beyond(x: Array, p: Array, clock: Clock) -> Array:
    """What an input adds above a level, through a linear block of its own that had settled before."""
    *_, delay, level = p
    return settled_through(p[:-2], delay, max(level_before(x) - level, 0.0), np.maximum(x - level, 0.0))


def _splits(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The level beyond which an input, beside what it does below, explains most, where any mixture of lags stands for both ways."""
    from estimators.diagnosis.effects.profiled import firm

    s, keep = base.structure, channel.keep
    if (known := _unexplained(channel, base)) is None:
        return
    Z, r = known
    for j in s.inputs:
        u = channel.u[:, j]
        told = lambda level, u=u: told_beside(np.maximum(u - level, 0.0), Z, r, keep)
        levels = np.unique(np.quantile(u[keep], LEVELS))
        level = _placed(told, levels, float(np.max(np.diff(levels), initial=0.0)))
        if firm(base, float(r @ r) - told(level)):
            place = [1.0 + s.delay, level], [0.0, float(np.std(u))]
            yield from _two_ways(channel, base, BEYOND, (j,), np.maximum(u - level, 0.0)[:, None], [place])


BEYOND = Effect(
    key="acts_beyond", cause="split_range", nature=Nature.DYNAMIC, slot=Slot.PATH, trials=20,
    sentence="beyond a level an input acts in another way: a heater beside a cooler, the second valve of a split range",
    parameters={"level": "u"}, apply=_beyond, search=_splits,
    shape=lambda size, order: [*_rational(size, order), ("delay", "sample"), ("level", "u")],
)  # fmt: skip
PATH = (*PATH, SINCE, BEYOND)


BENDS = tuple((a, b) for a in (5.0, 10.0, 20.0) for b in (5.0, 10.0, 20.0))
"""Rates of the two exponentials, in ranges of the charge that the record covers, that are tried."""
POLES = (0.0, 0.8, 0.9, 0.95, 0.98)
"""Of the linear part beside the store, which a model with an integrator has lost."""
LEAST_BEND = 0.1  # of the squares that an integrator leaves, which the bends of the curve must explain
STEEPEST = 40.0  # exponent at which an exponential is cut: outside the record's range it says nothing


def _curved(u: Array, p: Array, clock: Clock) -> Array:
    """The curve of the charge less its value at the start of the training record: what adds up, adds up from the record on."""
    if p[5] <= 0.0 or p[2] < 0.0 or p[4] < 0.0:
        return np.full(len(u), np.inf)
    added = np.where(np.arange(len(u)) < clock.lead, 0.0, u)
    return curve_of_charge(np.cumsum(added) - added, p)


def curve_of_charge(charge: Any, p: Array) -> Any:
    """slope x + first (exp(-a x) - 1) + last (exp(b (x - 1)) - exp(-b)), less the same at the start of the training record.

    x is the charge, numbers or symbols, in ranges of that record from its least: a store is full at one end and empty at the other.
    """
    slope, first, a, last, b, size, least, start = p

    def at(x: Any) -> Any:
        low = np.expm1(np.clip(-a * x, -STEEPEST, STEEPEST))
        high = np.exp(np.clip(b * (x - 1.0), -STEEPEST, STEEPEST)) - np.exp(-b)
        return slope * x + first * low + last * high

    return at((charge + start - least) / size) - at(-least / size)


def _stores(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A store that one input or another fills."""
    s = base.structure
    if s.layout == "tf" and not s.effects:
        for j, order in product(s.inputs, {s.order, max(s.order - 1, 1)}):
            yield from _filled_by(channel, base, j, order)


def _filled_by(channel: Any, base: Any, j: int, order: int) -> Iterator[Any]:
    """Least squares of the curve and of a linear part without an integrator, for several bends and poles; the best are fitted.

    A pole of the linear model that stands for the store goes with it, where the order is one less: beside it nothing tells the two apart.
    """
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Part

    s, keep = replace(base.structure, order=order), channel.keep
    charge = np.concatenate(([0.0], np.cumsum(channel.u[:-1, j])))
    if not np.ptp(charge) > 0.0:
        return
    covered = np.array([np.ptp(charge), charge.min(), 0.0])
    size = float(np.std(channel.y)) + 1e-300
    new = s.adding(Part(STORE_CURVE, j))
    at = new.slices()[-1].start
    linear = [*range(s.order, at), at, at + 1, at + 3]
    scales = np.ones(new.size)
    scales[:order] = base.scales[:order]
    for part, old, own in zip(s.parts, base.structure.slices(), new.slices(), strict=False):
        scales[own] = base.scales[old][: part.count(order)]
    scales[at:] = size, size, 10.0, size, 10.0, 0.0, 0.0, 0.0  # the range only names the units
    scales[s.order : s.plant_size] = np.repeat(
        size / (np.std(channel.u[:, list(s.inputs)], axis=0) + 1e-300), s.taps
    )

    def least(p: Array, free: list[int]) -> tuple[float, Array]:
        """Sum of squares and parameters at the least squares of those in which the output is linear."""
        still = simulate(new, p, channel.u, channel.clock)
        X = np.zeros((len(channel), len(free)))
        for i, where in enumerate(free):
            q = p.copy()
            q[where] = 1.0
            X[:, i] = simulate(new, q, channel.u, channel.clock) - still
        norm = np.sqrt(np.mean(X**2, axis=0)) + 1e-300
        theta = np.linalg.lstsq(X[keep] / norm, (channel.y - still)[keep], rcond=1e-9)[0] / norm
        q = p.copy()
        q[free] = theta
        return float(np.sum((channel.y - still - X @ theta)[keep] ** 2)), q

    def shape(pole: float, bend: tuple[float, float]) -> Array:
        p = np.zeros(new.size)
        p[: s.order] = np.real(np.poly([pole] + [0.0] * (s.order - 1)))[1:]
        p[[at + 2, at + 4]], p[at + 5 :] = bend, covered
        return p

    found = [least(shape(pole, bend), linear) for pole in POLES for bend in BENDS]
    # without its bends it is an integrator, which is linear
    straight = [least(shape(pole, BENDS[0]), linear[:-2])[0] for pole in POLES]
    if min(found, key=lambda entry: entry[0])[0] > (1.0 - LEAST_BEND) * min(straight):
        return
    quick = []
    for _, p in sorted(found, key=lambda entry: entry[0])[:3]:
        quick.append(fit(channel, new, p, scales, iterations=8, colour=False))
    best = min(quick, key=lambda f: f.deviance)
    if np.isfinite(best.deviance):
        yield fit(channel, new, best.p, scales, noise=base.noise, iterations=30)


STORE_CURVE = Effect(
    key="integral_curve", cause="integrated_input_curve", nature=Nature.OUTPUT_STATIC, slot=Slot.PATH, trials=20,
    sentence="a curve of the integral of the input is added: a store, as a battery's voltage over its state of charge",
    parameters={"slope": "y", "first": "y", "first_rate": "1", "last": "y", "last_rate": "1", "range": "u sample",
                "least": "u sample", "start": "u sample"},
    shape=lambda size, order: list(STORE_CURVE.parameters.items()), apply=_curved, search=_stores,
)  # fmt: skip

STORE = (STORE_CURVE,)
