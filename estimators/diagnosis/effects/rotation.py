"""Effects of turning parts: gravity on a pendulum, forces and gains that repeat with the angle."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.disturbances.added import harmonics, in_series
from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.plant import MOVING
from estimators.diagnosis.effects.profiled import (
    FIRM,
    ended,
    entering,
    in_common,
    lean,
    left_over,
    rotating,
    through,
    waved,
)

Array = NDArray[Any]
FLOWING = frozenset({"first", "cascade", "chain"})  # a level, which a loss pulls at
# rate of a sensor or an actuator beside it, which the linear model made slow to stand for the loss
LAG = np.log(0.7)
SWINGS = (0.7, 1.3, 2.2)  # largest angles in radian that a pendulum is started with
SHAKEN = (-0.95, 0.0)  # zeros of the block before a pendulum: its pivot is accelerated, or its torque lags
FEW = 4  # starts that are fitted
FAR = 3.0  # times the linear model's squares, beyond which a start is given up where several inputs make many of them
DAMPED = 0.5  # damping ratio from which on nothing swings more than once: a sine is then any curve
TURNS = 1500  # angles per record among which the period of a force is looked for
PHASES = ((0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4))  # of a periodic force, in sizes of the input
SLOW = 0.03  # loss per speed and sample where the balance shows none
BALANCE = (
    3  # samples of the inputs in the balance of forces: the hold, half a sample either way, a quick drive
)
FINE = 81  # angles about a peak: a fortieth of a turn over the record, beyond which the force's phase is lost
LEAST_TURNS = 3  # in a record, for its force to repeat
PEAK = 25.0  # times the mean power over all angles: by chance in one record of millions
CHUNK = 250  # rates at a time, whose responses fill some megabytes
TRIED = 2  # rates whose neighbourhood is looked at
WINDOWS = (0.04, 0.06, 0.09, 0.13, 0.2, 0.3, 0.45, 0.7, 1.0)
"""Growing shares of the record, each by half: a phase that is kept at first is kept to the end, and what nearly stands still on top
is lost within a turn or two where the parameters are a little off."""


def _pendulum(p, v, u, q, s, c):
    return np.sin(c[0] * p) / c[0] - p


def _pivot(p, v, u, q, s, c):
    return np.sin(c[0] * p) / c[0] - p + u * (1.0 - np.cos(c[0] * p))


def _periodic(p, v, u, q, s, c):
    return c[0] * np.cos(c[2] * p) + c[1] * np.sin(c[2] * p)


def _swings(effect: Callable[[], Effect]) -> Callable[..., Iterator[Any]]:
    """Starts of a pendulum: the model's oscillation, one of its real poles as a block before it, several sizes of the swing."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.fitting import fit, grown
        from estimators.diagnosis.model.structure import Part
        from estimators.diagnosis.search.starts import fitted

        s = base.structure
        poles = np.roots(np.concatenate(([1.0], base.p[: s.order]))) if s.layout == "tf" else np.zeros(0)
        pairs = [(abs(np.log(z)) ** 2, -2.0 * np.log(z).real) for z in poles.astype(complex) if z.imag > 0]
        real = sorted((z.real for z in poles if abs(z.imag) < 1e-9 and 0.02 < z.real < 0.9995), reverse=True)
        if not pairs and len(real) > 1:  # a swing that goes far looks like two lags
            a, b = -np.log(real[0]), -np.log(real[1])
            pairs, real = [(a * b, a + b)], real[2:]
        real = [z for z in real if z < 0.995][:1]
        if s.effects or not pairs:
            return
        starts: list[Any] = []
        for inputs, gains in _joint(channel, base)[: None if effect().each else 1]:
            few = replace(s, order=2, taps=2, layout="oscillator", delay=0, inputs=inputs)
            for pair in pairs:
                rates = np.log([max(pair[0], 1e-6), max(pair[1], 1e-3 * np.sqrt(pair[0]))])
                for block in [[]] + [[-z, b] for z in real or [0.5] for b in SHAKEN]:
                    part = Part(effect(), inputs[0], first=1 if block else 0, free=bool(block))
                    starts += _swung(channel, few.adding(part), rates, np.array(block), gains)
        most = FAR * float(base.residual @ base.residual) if len(s.inputs) > 1 else np.inf
        starts = sorted((x for x in starts if -x.promise < most), key=lambda x: -x.promise)
        quick = sorted(fitted(channel, base, starts[:FEW], 5), key=lambda f: f.deviance)[:2]
        begun = [(f.deviance, f.structure, f.p) for f in quick]
        for new in dict.fromkeys(x.structure for x in starts):
            of = [(x.p, x.scales) for x in starts if x.structure == new]
            begun += [(deviance, new, p) for deviance, p in grown(channel, new, of)]
        scales = {x.structure: x.scales for x in starts}
        for _, new, p in sorted(begun, key=lambda x: x[0])[:2]:
            g = fit(channel, new, p, scales[new], noise=base.noise, iterations=30)
            if g.p[1] - 0.5 * g.p[0] < np.log(2.0 * DAMPED):  # logarithms of damping and stiffness
                yield g

    return search


def _joint(channel: Any, base: Any) -> list[tuple[tuple[int, ...], Array]]:
    """The inputs of a transfer function, each first once and the one that does most before all; of the others what they do beside it."""
    s = base.structure
    b = base.p[s.order : s.plant_size].reshape(len(s.inputs), s.taps).sum(axis=1)
    share = np.abs(b) * np.std(channel.u[:, list(s.inputs)], axis=0)
    out = []
    for j in np.argsort(-share):
        rest = [i for i in range(len(b)) if i != j]
        out.append((tuple(s.inputs[i] for i in (j, *rest)), b[rest] / (b[j] or 1.0)))
    return out


def _swung(channel: Any, new: Any, rates: Array, block: Array, gains: Array) -> list[Any]:
    """Starts of several swings: the other inputs push where the first does, as far as in the linear model."""
    from estimators.diagnosis.model.layouts import layout_matrices, states
    from estimators.diagnosis.model.linear import relinearised
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.search.starts import Start

    part, at = new.parts[-1], new.slices()[-1]
    U = channel.u[:, list(new.inputs)]
    U[:, 0] = part.blocked(np.ascontiguousarray(U[:, 0]), block)
    push = layout_matrices(new.layout, rates)[1]
    first = np.zeros(new.size)
    first[:2], first[4 : new.plant_size] = rates, np.outer(gains, push).ravel()
    first[at.start : at.stop - 1] = block
    top = float(np.max(np.abs(states(new.layout, new.rates(first), U)[:, 0]))) + 1e-300
    scales = np.ones(new.size)
    for q, sl in zip(new.parts, new.slices(), strict=True):
        scales[sl] = 1.0 if q is part else float(np.std(channel.y)) + 1e-300
    scales[-1] = 1.0 / top
    scales[4 : new.plant_size] = np.outer(np.abs(gains) + 0.1, push + push.max()).ravel()
    starts = []
    for swing in SWINGS:
        p = first.copy()
        p[-1] = swing / top
        p = relinearised(channel, new, p)
        if p is not None:
            C = np.abs(p[2:4])
            scales[2:4] = C + 0.1 * C.max() + 1e-300
            rest = np.where(channel.keep, channel.y - simulate(new, p, channel.u, channel.clock), 0.0)
            starts.append(Start(new, p, scales.copy(), -float(rest @ rest)))
    return starts


def _turning(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A force of the angle of a turning part whose speed is measured: the angle from the output itself, then growing windows."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.structure import Part

    s = base.structure
    if s.layout != "tf" or s.effects:
        return
    inputs, beside = _joint(channel, base)[0]
    j, at_first = inputs[0], s.order + s.inputs.index(inputs[0]) * s.taps
    n, keep = len(channel), channel.keep
    speed = np.where(keep, channel.y, channel.y - base.residual)
    angle = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))))
    span = float(np.ptp(angle)) + 1e-300
    own = channel.u[:, list(inputs)]
    force = _balance(speed, own, keep)[0]
    turns = 2 * np.pi * np.arange(LEAST_TURNS, TURNS) / span
    power = np.array([abs(np.vdot(np.exp(1j * w * angle), force)) ** 2 for w in turns])
    peaks = [i for i in np.argsort(-power)[:2] if power[i] > PEAK * float(power.mean())]
    size, gain = float(np.std(channel.u[:, j])) + 1e-300, float(np.sum(base.p[at_first : at_first + s.taps]))
    gain /= float(1.0 + np.sum(base.p[: s.order]))  # output per unit of input
    spread = float(np.std(channel.y)) + 1e-300
    turning = replace(s, order=2, taps=2, layout="integrator", delay=0, inputs=inputs)
    for w in turns[peaks]:
        near = w + np.linspace(-1.0, 1.0, FINE) * (turns[1] - turns[0])
        balances = [(w, *_balance(speed, own, keep, w * angle)) for w in near]
        w, _, loss, push, c = min(balances, key=lambda found: float(found[1] @ found[1]))
        told = loss > 0.0
        rate, still, phases = SLOW, gain, [size * np.array(phase) for phase in PHASES]
        if told:
            rate, still, phases = loss, push / loss, [c / push]
        further = np.outer(beside, [0.0, rate]).ravel()
        found: list[tuple[float, Array, Array, Any]] = []
        for first in (0, 1):  # without and with a lag of the drive
            part = Part(POSITION, j, first=first)
            new = turning.adding(part)
            scales = np.full(new.size, spread)
            scales[:3], scales[3 : new.plant_size] = (1.0, abs(still), abs(still)), rate
            at = new.slices()[-1]
            scales[at] = [1.0] * first + [size, size, 1e-3 * abs(w * still)]
            for q, sl in zip(new.parts, new.slices(), strict=True):
                if q.effect.slot is Slot.START:
                    scales[sl.start] = 0.0  # the angle at the start is the phase of the force
            trials: list[tuple[float, Array]] = []
            for share in WINDOWS:
                few = replace(channel, keep=keep & (np.arange(n) < share * n))
                begun = [p for _, p in sorted(trials, key=lambda trial: trial[0])[:1]]
                # what the whole record told, a window may lose
                for phase in phases if told or not begun else ():
                    p = np.zeros(new.size)
                    p[:3], p[3 : new.plant_size] = (np.log(rate), 0.0, still), further
                    p[at] = [-0.5] * first + [*phase, w * still]
                    begun.append(p)
                fits = [fit(few, new, p, scales, iterations=8, colour=False) for p in begun]
                trials = [(f.deviance, f.p) for f in fits if np.isfinite(f.deviance)]
            found += [(deviance, p, scales, new) for deviance, p in trials]
        for _, p, scales, new in sorted(found, key=lambda entry: entry[0])[:1]:
            yield fit(channel, new, p, scales, noise=base.noise, iterations=30)


def _turned_by(x: Array, clock: Clock) -> Array:
    """Integral of a held signal (N,) from the record's first sample to the middle of each."""
    x = np.where(np.arange(len(x)) < clock.lead, 0.0, x)
    return np.cumsum(x) - 0.5 * x


def _with_the_angle(x: Array, p: Array, clock: Clock) -> Array:
    angle = p[2] * _turned_by(x, clock)
    return x * (1.0 + p[0] * np.cos(angle) + p[1] * np.sin(angle))


def _common(base: Any, j: int, u: Array, angle: Array, r: Array, Q: Array, w: Array) -> tuple[Array, Array]:
    """`in_common` of the residual with the response to an input times the cosine and the sine of its angle, for rates w (M,)."""
    turn = np.outer(angle, w)
    D = through(base, j, u[:, None] * np.concatenate((np.cos(turn), np.sin(turn)), axis=1))
    return in_common(D - Q @ (Q.T @ D), r)


def _revolving(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """What the residual has in common with the linear response to a speed times a rotation by its integral, for all rates of that:
    the angle is of the input, as what lags behind it is hardly behind in phase."""
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import renewed

    s = base.structure
    for j, u in entering(channel, base):
        angle, (r, Q) = _turned_by(u, channel.clock), left_over(channel, base)
        span, fastest = float(np.ptp(angle)), float(np.max(np.abs(u)))
        if not span > 2 * LEAST_TURNS * fastest:
            continue
        common = partial(_common, base, j, u, angle, r, Q)
        turns = np.pi / span * np.arange(2 * LEAST_TURNS, min(2 * TURNS, span / fastest))
        gains = np.concatenate([common(w)[0] for w in np.array_split(turns, 1 + len(turns) // CHUNK)])
        starts: list[tuple[float, Array]] = []
        for at in np.argsort(-gains)[:TRIED]:
            near = turns[at] + np.linspace(-1.0, 1.0, FINE) * np.pi / span
            gain, c = common(near)
            best = int(np.argmax(gain))
            promise = -base.n * float(np.log(max(1.0 - gain[best] / max(float(r @ r), 1e-300), 1e-12)))
            starts += [(promise, np.array([*c[:, best], near[best]]))] if promise > FIRM else []
        for first in (0, 1) if starts else ():  # without and with a lag of the drive
            part = Part(REVOLVING, j, first=first)
            begun = [np.concatenate((base.p, [-0.5] * first, q)) for _, q in starts]
            begun = [p for q in begun for p in (q, *renewed(channel, s.adding(part), q))]
            yield from lean(
                channel, ended(channel, base, part, begun, [1.0] * first + [1.0, 1.0, 1.0 / span])
            )


def _balance(
    speed: Array, u: Array, keep: Array, angle: Array | None = None
) -> tuple[Array, float, float, Array]:
    """Balance of a turning part's forces, from its speed and inputs: no linear model stands in it that has bent towards a force.

    What it leaves of the speed's change (N,); the loss per speed, the push per unit of the first input, and the cosine and
    sine of an angle that oppose it, where one is given.
    """
    at = np.arange(len(u))
    columns = [speed, np.ones(len(u)), *(u[np.maximum(at - by, 0)] for by in range(BALANCE))]
    columns += [] if angle is None else [np.cos(angle), np.sin(angle)]
    X, change = np.column_stack(columns), np.gradient(speed)
    c = np.linalg.lstsq(X[keep], change[keep], rcond=None)[0]
    left = np.where(keep, change - X @ c, 0.0)
    return left, float(-c[0]), float(np.sum(c[2 :: u.shape[1]][:BALANCE])), -c[-2:]


def _turned(
    key: str,
    cause: str,
    sentence: str,
    force: Any,
    parameters: dict[str, str],
    search: Any,
    trials: float,
    each: bool = False,
) -> Effect:
    return Effect(
        key=key, cause=cause, nature=Nature.DYNAMIC, slot=Slot.PLANT, sentence=sentence, force=force, trials=trials,
        parameters=parameters, search=search, against="position", each=each,
    )  # fmt: skip


PENDULUM = _turned(
    "pendulum", "pendulum", "gravity pulls with the sine of the angle", _pendulum, {"angle": "1/u"},
    _swings(lambda: PENDULUM), 6,
)  # fmt: skip
PIVOT = _turned(
    "pendulum_pivot", "pendulum", "gravity pulls with the sine of the angle, and the moved pivot pushes with its cosine", _pivot,
    {"angle": "1/u"}, _swings(lambda: PIVOT), 6, each=True,
)  # fmt: skip
POSITION = _turned(
    "position_periodic", "position_periodic_force", "a force that repeats with the angle: an eccentric, cogging",
    _periodic, {"cosine": "u", "sine": "u", "per_angle": "1/(u sample)"}, _turning, 200,
)  # fmt: skip

REVOLVING = Effect(
    key="gain_of_angle", cause="position_periodic_gain", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=3000,
    sentence="the input is a speed, and the gain repeats with the angle that it has turned: rollers, lobes, a bent shaft",
    parameters={"cosine": "1", "sine": "1", "per_angle": "1/(u sample)"}, apply=_with_the_angle, search=_revolving,
)  # fmt: skip


def _breath(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    return in_series(p, clock)


def _breathing(effect: Callable[[], Effect]) -> Callable[..., Iterator[Any]]:
    """A stiffness or a loss that varies is a force on the position, which the output shows: at the frequencies that the residual shows in
    the response to the output as an input, one harmonic after the other."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.fitting import fit
        from estimators.diagnosis.model.layouts import LAYOUTS
        from estimators.diagnosis.model.linear import layout_starts
        from estimators.diagnosis.model.structure import Part

        s, n, e = base.structure, len(channel), effect()
        if s.layout != "tf" or s.effects or s.order not in {LAYOUTS[layout][0] for layout in e.layouts or ()}:
            return
        quiet = replace(base, noise=np.zeros(0))
        position = np.sum([through(quiet, j, u) for j, u in entering(channel, base)], axis=0)
        gain = float(np.sum(base.p[s.order : s.order + s.taps]) / (1.0 + np.sum(base.p[: s.order])))
        shapes = rotating(channel, base, position, partial(through, base, s.inputs[0]))
        for new, known, scales in layout_starts(channel, base) if shapes else ():
            quick = [np.r_[known[:1], LAG, known[2:]]] if new.layout in ("cascade", "chain") else []
            for p in (known, *quick) if e.fits(new.layout) else ():
                f = fit(channel, new, p, scales, noise=base.noise, iterations=8, colour=False)
                starts = [np.concatenate((f.p, shape * (1.0, -gain, -gain))) for shape in shapes]
                for g in ended(channel, f, Part(e, new.inputs[0]), starts, [1.0 / n, 1.0, 1.0]):
                    yield from waved(channel, g)

    return search


def _breathes(
    key: str, cause: str, what: str, layouts: frozenset[str], effect: Callable[[], Effect]
) -> Effect:
    return Effect(
        key=key, cause=cause, nature=Nature.TIME, slot=Slot.PLANT, per_sample=True, family="drifts", layouts=layouts,
        sentence=f"the {what} changes periodically: (1 + a cos(w t) + b sin(w t)), with harmonics where there are some",
        force=lambda p, v, u, q, s, c: s * p, signal=_breath, search=_breathing(effect), **harmonics("1"),
    )  # fmt: skip


BREATH = _breathes(
    "stiffness_periodic", "periodic_stiffness", "stiffness", MOVING - {"integrator"}, lambda: BREATH
)
WARMTH = _breathes("loss_periodic", "periodic_loss", "loss", FLOWING, lambda: WARMTH)

ROTATION = (PENDULUM, PIVOT, POSITION, REVOLVING, BREATH, WARMTH)
