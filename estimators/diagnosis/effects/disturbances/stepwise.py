"""Disturbances that come and stay, or pass: a level that changes several times, at the input or at the output.

Poles of a linear model bend to follow them: they are looked for where any mixture of lags stands for its linear part.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.disturbances.added import begun_beside
from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, numbered
from estimators.diagnosis.effects.input import after, any_linear, banked
from estimators.diagnosis.effects.profiled import FIRM, gained, of_order

Array = NDArray[Any]
SHORT = 3  # poles of the model that a passing disturbance is put into: more of them would follow it
TIMES = 48
"""Of a record, at any of which a level may change: what lasts no two of them is an impulse."""
MOST, AGAIN = 4, 20.0
"""Changes that are looked for, one after the other, and what each must gain of Schwarz's criterion: more of them follow a random walk."""
BEGUN = 10  # steps by which numbers of poles are told apart
LAGS = 10  # of the autoregression
CLOSER, ROUNDS = 8, 3  # times between two of them, beside those found, and how often each is moved


class _Changes:
    """What changes of a level at some times explain of an output, in one of three ways: each through a mixture of lags of its own,
    at once, or in an autoregression of it, which knows of resonances, and hears little of what is slow beside its noise."""

    def __init__(self, channel: Any, inputs: tuple[int, ...], way: str) -> None:
        from estimators.diagnosis.share.signals import late

        self.channel, self.way = channel, way
        u, y, n = channel.u[:, list(inputs)], channel.y, len(channel)
        if way == "regressed":
            past = [late(x, k) for x in (y, *u.T) for k in range(1, LAGS + 1)]
            self.Z = np.linalg.qr(np.column_stack((*past, u, np.ones(n)))[channel.keep])[0]
        else:
            self.Z = any_linear(u, channel.keep)
        self.r = self.free(y[:, None])[:, 0]

    def free(self, x: Array) -> Array:
        """Signals (N, m) on the samples that count, free of what is linear in the inputs."""
        x = x[self.channel.keep]
        return np.asarray(x - self.Z @ (self.Z.T @ x))

    def responses(self, times: Array) -> Array:
        """(M, times, lags) responses to a change at each time."""
        steps = np.stack([after(self.channel.clock, t) for t in times], axis=1)
        D = banked(steps) if self.way == "lagged" else steps[:, :, None]
        return self.free(D.reshape(len(steps), -1)).reshape(-1, *D.shape[1:])

    def left(self, D: Array) -> float:
        """Sum of squares that responses (M, m) leave."""
        Q = np.linalg.qr(D)[0]
        return float(self.r @ self.r - np.sum((Q.T @ self.r) ** 2))

    def first_two(self, times: Array, passes: bool = False) -> tuple[float, list[float]]:
        """What two changes leave, and their times, of all pairs two apart at least; the second takes the first back where it `passes`."""
        D = self.responses(times)
        m, lags = D.shape[1:]
        flat = D.reshape(len(D), -1)
        common, products = (self.r @ flat).reshape(m, lags), (flat.T @ flat).reshape(m, lags, m, lags)
        first, last = np.triu_indices(m, 2)
        own, cross = products[np.arange(m), :, np.arange(m)], products[first, :, last]
        if passes:
            c = common[first] - common[last]
            power = own[first] + own[last] - cross - cross.transpose(0, 2, 1)
        else:
            c = np.concatenate((common[first], common[last]), axis=1)
            power = np.block([[own[first], cross], [cross.transpose(0, 2, 1), own[last]]])
        ridge = 1e-6 * np.trace(power, axis1=1, axis2=2)[:, None, None] / c.shape[1] + 1e-300
        gains = np.sum(c * np.linalg.solve(power + ridge * np.eye(c.shape[1]), c[..., None])[..., 0], axis=1)
        at = int(np.argmax(gains))
        return float(self.r @ self.r - gains[at]), [float(times[first[at]]), float(times[last[at]])]

    def one_more(self, known: list[float], times: Array) -> list[float]:
        """The times with the one that explains most beside them."""
        D, beside = self.responses(times), self.responses(np.array(known)).reshape(len(self.r), -1)
        left = [self.left(np.column_stack((beside, D[:, i]))) for i in range(len(times))]
        return sorted([*known, float(times[int(np.argmin(left))])])

    def closer(self, known: list[float], step: float) -> list[float]:
        """The times, each moved to where it explains most with the others kept, between those of a grid of a step, until none moves."""
        for fine in (step, step / CLOSER):
            for _ in range(ROUNDS):
                before = known
                for i in range(len(known)):
                    near = known[i] + fine * np.linspace(-1.0, 1.0, 2 * CLOSER + 1)
                    known = self.one_more(known[:i] + known[i + 1 :], near)
                if known == before:
                    break
        return known

    def sizes(self, times: list[float]) -> Array:
        """(m,) of each change: of the responses to all, for as long as none is cut short by the next, what they have in common."""
        D = self.responses(np.array(times))
        flat = D.reshape(len(D), -1)
        power = flat.T @ flat
        ridge = (1e-6 * np.trace(power) / len(power) + 1e-300) * np.eye(len(power))
        c = np.linalg.solve(power + ridge, flat.T @ self.r).reshape(D.shape[1:])
        alone = int(max(min(np.diff(times)), len(self.channel) // TIMES))
        common = (banked(np.ones((alone, 1)))[:, 0] if self.way == "lagged" else np.ones((1, 1))) @ c.T
        u, s, vt = np.linalg.svd(common, full_matrices=False)
        return np.asarray(vt[0] * s[0] * (np.sign(u[:, 0].sum()) or 1.0))


def _grid(clock: Clock) -> Array:
    return np.asarray(clock.k[0] + np.linspace(0.03, 0.97, TIMES) * len(clock.k))


def _changing(channel: Any, base: Any, way: str, passes: bool = False) -> Iterator[tuple[Array, Array]]:
    """Sizes and times of two changes of a level, of three, and so on, for as long as they are asked for; in a way or in an
    autoregression, by which two of them tell more."""
    s = base.structure
    if s.layout != "tf" or s.order < 1:
        return
    grid, before = _grid(channel.clock), float(np.sum(base.residual**2))
    found = []
    for seen in (_Changes(channel, s.inputs, way), _Changes(channel, s.inputs, "regressed")):
        left, times = seen.first_two(grid, passes)
        least = before if seen.way == way else float(seen.r @ seen.r)
        found.append((gained(base.n, least, left), seen, times))
    gain, seen, times = max(found, key=lambda way: way[0])
    while gain > FIRM and len(times) <= MOST:
        times = seen.closer(times, float(grid[1] - grid[0]))
        yield seen.sizes(times), np.array(times)
        times = seen.one_more(times, grid)


def _stepped(x: Any, p: Array, clock: Clock) -> Any:
    """A signal with sizes and times of changes of a level, one after the other, added."""
    for size, time in p.reshape(-1, 2):
        x = x + size * after(clock, time)
    return x


def _begun(channel: Any, base: Any, effect: Effect, sizes: Array, times: Array) -> Iterator[Any]:
    """The effect at each input after a few steps, with each number of poles up to a few: what has stood for the disturbance goes."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part

    changes, count = np.stack((sizes, times), axis=1), 1 if effect is PULSE else len(times)
    signal = _stepped(np.zeros(len(channel)), changes, channel.clock)
    for order in range(1, min(base.structure.order, SHORT) + 1):
        few, p, scales = of_order(base, order, min(base.structure.taps, order))
        bare, scale = replace(base, structure=few, p=p, scales=scales), dict.fromkeys(few.inputs[:1], 1.0)
        if effect.slot is Slot.INPUT:
            bare, scale = begun_beside(channel, bare, signal)
        else:
            straight = fit_linear(replace(channel, y=channel.y - signal), few)
            bare = replace(bare, p=straight.p, scales=straight.scales)
        for j, size in scale.items():
            spread = float(np.std(channel.u[:, j] if effect.slot is Slot.INPUT else channel.y)) + 1e-300
            shape = (
                [size * sizes[0], *times]
                if effect is PULSE
                else np.stack((size * sizes, times), axis=1).ravel()
            )
            s = few.adding(Part(effect, j, count))
            sized = [1.0 if unit == "sample" else spread for _, unit in s.parts[-1].parameters(order)]
            start, scales = np.concatenate((bare.p, shape)), np.concatenate((bare.scales, sized))
            yield fit(channel, s, start, scales, noise=base.noise, iterations=BEGUN, colour=False)


def _fits(channel: Any, base: Any, effect: Effect, sizes: Array, times: Array) -> Iterator[Any]:
    """The effect at each input, fitted to the end."""
    from estimators.diagnosis.model.fitting import fit

    begun = list(_begun(channel, base, effect, sizes, times))
    for j in dict.fromkeys(f.structure.parts[-1].channel for f in begun):
        here = (f for f in begun if f.structure.parts[-1].channel == j)
        f = min(here, key=lambda f: f.deviance + len(f.p) * np.log(f.n))
        f = fit(channel, f.structure, f.p, f.scales, noise=base.noise, iterations=30)
        yield from [f] if effect is PULSE else _needed(channel, f)


def _needed(channel: Any, f: Any) -> Iterator[Any]:
    """A fit, and without its least change for as long as that loses too little: one may stand for another's time."""
    from estimators.diagnosis.model.fitting import fit

    yield f
    while (part := f.structure.parts[-1]).size > 2:
        at = f.structure.slices()[-1].start
        gone = at + 2 * int(np.argmin(np.abs(f.p[at::2])))
        s = replace(f.structure, parts=(*f.structure.parts[:-1], replace(part, size=part.size - 1)))
        p, scales = (np.delete(x, [gone, gone + 1]) for x in (f.p, f.scales))
        less = fit(channel, s, p, scales, noise=f.noise, iterations=30)
        if not less.criterion < f.criterion + AGAIN:
            return
        yield (f := less)


def _passing(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A pulse between the two times at which it explains most."""
    for _, times in islice(_changing(channel, base, "lagged", passes=True), 1):
        yield from _fits(channel, base, PULSE, np.array([1.0, -1.0]), times)


def _several(effect: Callable[[], Effect], way: str) -> Callable[..., Iterator[Any]]:
    """Ever more changes, until one more gains too little at each input."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        least: dict[int, float] = {}
        for sizes, times in _changing(channel, base, way):
            before = dict(least)
            for f in _fits(channel, base, effect(), sizes, times):
                yield f
                j = f.structure.parts[-1].channel
                least[j] = min(least.get(j, np.inf), f.criterion)
            if not any(v < before.get(j, np.inf) - AGAIN for j, v in least.items()):
                return

    return search


PULSE = Effect(
    key="pulse_input", cause="step_disturbance", nature=Nature.ADDED, slot=Slot.INPUT, trials=1.0, per_sample=True, family="steps",
    sentence="a disturbance enters at the plant input and passes",
    apply=lambda x, p, clock: x + p[0] * (after(clock, p[1]) - after(clock, p[2])), search=_passing, settles=True,
    parameters={"size": "u", "start": "sample", "end": "sample"},
)  # fmt: skip


def _steps(key: str, unit: str, sentence: str, **fields: Any) -> Effect:
    parameters = {"size": unit, "time": "sample"}
    return Effect(
        key=key, cause="step_disturbance", nature=Nature.ADDED, trials=1.0, per_sample=True, family="steps", sentence=sentence,
        apply=_stepped, parameters=parameters,
        shape=lambda size, order: numbered(parameters, size) if size > 1 else list(parameters.items()), **fields,
    )  # fmt: skip


STEPS_INPUT = _steps(
    "steps_input", "u", "step disturbances enter at the plant input, one after the other",
    slot=Slot.INPUT, settles=True, search=_several(lambda: STEPS_INPUT, "lagged"),
)  # fmt: skip
STEPS_OUTPUT = _steps(
    "steps_output", "y", "steps are added to the output, one after the other", slot=Slot.ADDED,
    search=_several(lambda: STEPS_OUTPUT, "bare"),
)  # fmt: skip

STEPWISE = (PULSE, STEPS_INPUT, STEPS_OUTPUT)
