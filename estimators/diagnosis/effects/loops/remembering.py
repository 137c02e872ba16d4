"""What remembers where it stood: a stem that sticks, plays side by side, a second stage."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.disturbances.added import begun_beside
from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.input import any_linear, aside, moved, told_beside
from estimators.diagnosis.effects.loops.anew import remade
from estimators.diagnosis.effects.loops.limited import PACES, slowest_rate
from estimators.diagnosis.effects.output import mended
from estimators.diagnosis.effects.profiled import CROSSED, ended, entering, firm, nearer

Array = NDArray[Any]
STUCK, LEFT = np.linspace(0.1, 2.0, 234), np.linspace(0.0, 0.9, 7)
"""Of a stem that sticks, half widths in standard deviations of its command, and shares of them that a jump leaves, that are looked at:
a hundredth off, and in a loop it jumps at other times ever after; and what sticks there swings its command by little more than the width."""
PROMISING = 60
"""Of them, those that have poles of their own made."""
RIDGE = 1e-9  # of lags of one stem that are nearly alike
CLOSER, HALVED, NEAREST = (-1.0, -0.5, 0.0, 0.5, 1.0), 6, 2
"""Steps about the best of them, how often they are halved, and how many are kept."""
STOOD = (-1.0, -0.5, 0.5, 1.0)  # where in its gap the stem stood before the record

PLAYS = 4
"""Plays side by side (Prandtl and Ishlinskii): half widths of a quarter, a half, three quarters and all of the largest, which is
free; a loop of as many corners each way is as round as noise lets it be seen."""


def play_widths(largest: float) -> Array:
    """(PLAYS,) half widths of the plays side by side."""
    return abs(largest) * np.arange(1, PLAYS + 1) / PLAYS


def plays(x: Array, p: Array, clock: Clock) -> Array:
    """A signal and, by their weights, its plays of up to p[0] half width, which stood at the last parameter's share of it."""
    x = np.ascontiguousarray(x)
    return x + sum(w * moved(x, r, p[-1]) for w, r in zip(p[1:-1], play_widths(p[0]), strict=True))


def _played(x: Array, p: Array, clock: Clock) -> Array:
    from estimators.diagnosis.effects.kernels.recursion_kernels import settled

    return plays(settled(np.ascontiguousarray(x), clock.lead), p, clock)


REACHES, SHARES = (0.5, 1.0, 2.0, 4.0), (0.7, 3.0)
"""Of a signal's standard deviation, the widest play, and of what acts directly, what acts through plays, from which shapes go on:
a play as wide as the signal is long never moves, and what is narrower than noise is none."""


def looped(size: float) -> list[list[float]]:
    """Shapes of plays side by side for a signal of a size."""
    return [[w * size / (1.0 + a), *(PLAYS * [a / PLAYS]), 0.0] for w in REACHES for a in SHARES]


PLAYED_BY = {"width": "{}"} | {f"weight{i}": "1" for i in range(1, PLAYS + 1)} | {"start": "1"}
"""Units of the parameters of plays side by side; at the start they stand at -1 of their half widths if led there from below, at 1 if from above."""


def _units(size: float) -> list[float]:
    return [size, *(PLAYS * [1.0]), 1.0]


def _hysteretic(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Plays side by side with a linear part made for them: the linear model's poles hold their lag."""
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import renewed

    if base.structure.layout != "tf" or base.structure.effects:
        return
    for j, u in entering(channel, base):
        part, size = Part(SIDE_BY_SIDE, j), float(np.std(u))
        starts = [np.concatenate((base.p, shape)) for shape in looped(2.0 * size)]
        every = [q for p in starts for q in (p, *renewed(channel, base.structure.adding(part), p))]
        yield from ended(channel, base, part, every, _units(size))


def _unplayed(e: Effect, shape: list[float], channel: Any) -> tuple[Array, Array]:
    """The output before its hysteresis, and how much larger an error of it is behind: by the weights of the plays that move."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import play, unplayed

    widths, weights = play_widths(shape[0]), np.array(shape[1:-1])
    x = unplayed(np.ascontiguousarray(channel.y), widths, weights)
    moves = [np.diff(play(x, r, x[0]), prepend=x[0]) != 0.0 for r in widths]
    return x, 1.0 + weights @ np.array(moves)


def _sticky(slides: bool, x: Array, p: Array, clock: Clock) -> Array:
    """A stem that stays until its command is half a width off, then jumps to within a share of that, and may slide on."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import sticky

    half = abs(p[0])
    left = half * float(np.clip(p[1], 0.0, 1.0))
    off = aside(half, p[2])
    return sticky(np.ascontiguousarray(x), half, left, level_before(x) + off, slides) - off


def _promising(channel: Any, base: Any, slides: bool, j: int, delay: int) -> list[tuple[float, float, float]]:
    """Shapes of the stem that, through a few lags, explain most of what the linear model leaves."""
    from estimators.diagnosis.search.free_runs import denominator

    u, keep = channel.u[:, j], channel.keep
    su, slowest = float(np.std(u)), slowest_rate(denominator(base), len(channel))
    Q = np.linalg.qr(np.column_stack((np.ones(len(u)), channel.y - base.residual))[keep])[0]
    r, found = base.residual[keep] - Q @ (Q.T @ base.residual[keep]), []
    for left in LEFT:
        shapes = (np.array([w * su, left, 0.0]) for w in STUCK)
        stems = np.stack([_sticky(slides, u, shape, channel.clock) for shape in shapes], axis=1)
        stems = np.concatenate((np.zeros((delay, len(STUCK))), stems[: len(u) - delay]))
        lags = [
            lfilter([1.0 - z], [1.0, -z], stems, axis=0)[keep] for z in np.exp(-slowest * np.array(PACES))
        ]
        Z = np.stack([x - Q @ (Q.T @ x) for x in lags])  # (lags, N, widths)
        gram, cross = np.einsum("anw,bnw->wab", Z, Z), np.einsum("anw,n->wa", Z, r)
        size = np.trace(gram, axis1=1, axis2=2)[:, None, None]
        gram += (RIDGE * size + 1e-300) * np.eye(len(Z))
        told = np.sum(cross * np.linalg.solve(gram, cross[..., None])[..., 0], axis=1)
        found += [(-float(t), (float(w), float(left), 0.0)) for t, w in zip(told, STUCK, strict=True)]
    return [shape for _, shape in sorted(found)[:PROMISING]]


def _sticking(slides: bool, channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """Widths and shares on a grid, then ever closer to the best, each with poles of its own: the error jumps with every sample in
    which the stem does, so that no derivative leads there, and the linear model's poles stand for the stem too."""
    from estimators.diagnosis.model.structure import Part

    s, order, effect = base.structure, base.structure.order, (STICTION, SLIDING)[slides]
    ways = [
        (j, delay) for j in s.inputs for delay in sorted({0, s.delay})
    ]  # what sticks looks late to a linear model
    for j, delay in ways if s.layout == "tf" and order else ():
        su, part = float(np.std(channel.u[:, j])), Part(effect, j)
        new = replace(s, delay=delay).adding(part)

        def tried(shape: tuple[float, float, float], new: Any = new, su: float = su) -> tuple[float, Array]:
            width, left, start = shape
            own = [abs(width) * su, min(max(left, 0.0), 1.0), start]
            return remade(channel, new, np.concatenate((base.p, own)))

        def best(
            shapes: Any, so_far: list[tuple[float, Array]], tried: Any = tried
        ) -> list[tuple[float, Array]]:
            return sorted([*so_far, *map(tried, shapes)], key=lambda entry: entry[0])[:NEAREST]

        found = best(_promising(channel, base, slides, j, delay), [])
        step = np.array([STUCK[1] - STUCK[0], LEFT[1] - LEFT[0]])
        around = [(a, b) for a in CLOSER for b in CLOSER if a or b]
        for size in 0.5 ** np.arange(HALVED) if firm(base, found[0][0]) else ():
            near = [(p[-3] / su, p[-2]) + size * step * d for _, p in found for d in around]
            found = best(((w, left, 0.0) for w, left in near), found)
        if firm(base, found[0][0]):
            found = best(((found[0][1][-3] / su, found[0][1][-2], at) for at in STOOD), found)
            bare = replace(base, structure=replace(s, delay=delay))
            yield from ended(channel, bare, part, [p for _, p in found], [su, 1.0, 1.0])


STICTION, SLIDING = (
    Effect(
        key=key, cause="stiction", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=12, reversing=True, search=partial(_sticking, slides),
        sentence=f"the actuator sticks until its command is far enough off, then {then}", apply=partial(_sticky, slides),
        parameters={"half_width": "u", "left": "1", "start": "1"},
    )
    for slides, key, then in (
        (False, "stiction", "jumps"), (True, "stiction_sliding", "jumps, and slides on until it halts or turns"),
    )
)  # fmt: skip

SIDE_BY_SIDE = Effect(
    key="plays", cause="hysteresis", nature=Nature.DYNAMIC, slot=Slot.INPUT, reversing=True, trials=40, apply=plays, search=_hysteretic,
    sentence="the input acts with hysteresis: directly, and through plays of four widths side by side",
    parameters={k: v.format("u") for k, v in PLAYED_BY.items()},
)  # fmt: skip
PLAYED = Effect(
    key="plays_output", cause="hysteresis", nature=Nature.DYNAMIC, slot=Slot.OUTPUT, memory=True, reversing=True, trials=40,
    sentence="the output has hysteresis: it is read directly, and through plays of four widths side by side",
    parameters={k: v.format("y") for k, v in PLAYED_BY.items()},
    apply=_played,
    search=mended(lambda: PLAYED, lambda c: looped(float(np.std(c.y))),
                  lambda c, best: [[best[0] * f, *(np.array(best[1:]) * g)] for f in (0.7, 1.0, 1.4) for g in (0.6, 1.6)],
                  lambda c: _units(float(np.std(c.y))), _unplayed),
)  # fmt: skip

STAGED_AT, STAGES = np.linspace(0.08, 0.92, 22), (0.0, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.2)
"""Quantiles of the input at which a second stage may come on or off, and half the gap between the two in its standard deviations, that
are looked at."""
NEARBY = 0.05
"""Of its standard deviation, by which both are moved once the linear part is known: before it is, a mixture of lags tells them roughly."""


def stage(x: Array, half: float, level: float) -> Array:
    """1 while a stage is on, which comes on above `level` + `half`, and goes off below `level` - `half`; 0 while it is off, as at first."""
    from estimators.diagnosis.effects.kernels.recursion_kernels import relay

    return 0.5 + 0.5 * relay(np.ascontiguousarray(x - level), abs(half))


def _stages(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The stage that explains most where any mixture of lags stands for the linear part, and then closer to it."""
    from estimators.diagnosis.model.structure import Part

    s, keep = base.structure, channel.keep
    if s.layout != "tf" or s.order < 1:
        return
    Z = any_linear(channel.u[:, list(s.inputs)], keep)
    r = channel.y[keep] - Z @ (Z.T @ channel.y[keep])
    for j in s.inputs:
        u, su = channel.u[:, j], float(np.std(channel.u[:, j]))
        told = cache(lambda shape, u=u: told_beside(stage(u, *shape), Z, r, keep))
        at = max(((h * su, float(v)) for v in np.quantile(u, STAGED_AT) for h in STAGES), key=told)
        for size in 0.1 * su * 0.5 ** np.arange(HALVED):
            around = ((max(at[0] + a * size, 0.0), at[1] + b * size) for a in CLOSER for b in CLOSER)
            at = max(around, key=told)
        if not firm(base, float(r @ r) - told(at)):
            continue
        bare, sizes = begun_beside(channel, base, stage(u, *at))
        part, start, scales = (
            Part(STAGED, j),
            np.concatenate((bare.p, [sizes[j], *at])),
            [su, *[1e6 * CROSSED * su] * 2],
        )
        for f in ended(channel, bare, part, [start], scales):
            left = float(np.sum(f.residual[channel.keep] ** 2))
            near = nearer(channel, bare, part, (left, f.p), np.full(2, NEARBY * su))
            yield from ended(channel, bare, part, [near[1]], scales) if near[0] < left else (f,)


STAGED = Effect(
    key="input_staged", cause="relay_with_hysteresis", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=100, reversing=True, search=_stages,
    sentence="a second stage comes on beside the input as it rises, and goes off at a lower level of it: a jump with hysteresis",
    parameters={"size": "u", "half_width": "u", "level": "u"}, apply=lambda x, p, clock: x + p[0] * stage(x, p[1], p[2]),
)  # fmt: skip
