"""An automatic gain from the size of what linear models foretell to be read: what such a sensor shows tells too little of that.

One that holds its reading nearly level cannot be undone: an error in the level that was read stays, and undoing adds up the noise. A
slow pole of the linear model then is the gain's memory, which is no pole of what is read.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Effect
from estimators.diagnosis.effects.input import AWAY
from estimators.diagnosis.effects.output import KEPT
from estimators.diagnosis.effects.profiled import firm, of_order

Array = NDArray[Any]
TIMES = (4.0, 12.0, 36.0, 108.0, 324.0)
"""Samples of an envelope's time constant that are tried, by threes."""
LEFT = (0.6, 0.3, 0.1)
"""Gains at the mean size that are tried: from slight to one that holds what is shown nearly level."""
POWERS = (0.5, 1.0)
"""By which the gain falls with the size: it is told by what comes out, and by what goes in."""
ROUNDS = 2
"""Times that poles are made for a gain, and a gain for these."""
SLOWER = (1.0, 4.0)
"""Times as slowly, as the gain falls, that it comes up again: to turn down at once what is loud and up again late is common."""
NEARER = ((1.7, 1.0, 1.0), (0.6, 1.0, 1.0), (1.0, 1.7, 1.0), (1.0, 0.6, 1.0), (0.8, 1.0, 1.7), (1.25, 1.0, 0.6))  # fmt: skip
"""Factors of the time constant, of the gain at the mean size and of how much slower it comes up, closer to the best."""
MOST = 0.9  # gain at the mean size: nothing falls beyond it
WORTH = 0.5
"""Of the linear model's squared error, that the best gain may leave before it is fitted: a curve or a slow gain of another kind leaves
more, once its record is a few times as far from linear as from its noise."""


@dataclass(frozen=True, eq=False)
class _Shape:
    """A gain: time constants in samples as the size grows and as it shrinks, gain at the mean size, power, and whether sizes count
    about the mean of what is read."""

    rises: float
    falls: float
    left: float
    power: float
    centred: bool

    def closer(self, time: float, left: float, slower: float) -> "_Shape":
        """The same with a time, a gain at the mean size and a slower return by some factors."""
        rises, falls = self.rises * time, self.falls * time * slower
        return replace(self, rises=rises, falls=falls, left=min(self.left * left, MOST))


@dataclass(frozen=True, eq=False)
class _Told:
    """What a shape leaves behind some poles: squares, parameters of the linear part, constant, share, level, gain (N,)."""

    left: float
    poles: Array
    shape: _Shape
    numerators: Array
    constant: float
    share: float
    level: float
    gain: Array


def _settled(u: Array, poles: Array, s: Any) -> Array:
    """(N, inputs taps) the inputs (N, inputs) through each coefficient of a numerator, from where they had settled."""
    den = np.concatenate(([1.0], poles))
    moved = u - u[0]
    late = [np.eye(1, s.delay + 2 + i, s.delay + 1 + i)[0] for i in range(s.taps)]
    columns = [
        lfilter(b, den, x) + first / den.sum() for x, first in zip(moved.T, u[0], strict=True) for b in late
    ]
    return np.stack(columns, axis=1)


class _Reading:
    """What is read, behind some poles: its signals (N, coefficients), and what a linear model of them makes of the record."""

    def __init__(self, channel: Any, s: Any, poles: Array) -> None:
        self.channel, self.poles = channel, poles
        self.signals = _settled(channel.u[:, list(s.inputs)], poles, s)
        self.x = self.signals @ self._least(self.signals)[1][:-1]

    def _least(self, signals: Array) -> tuple[float, Array]:
        """Squares left by signals (N, m) and a constant, and their coefficients (m + 1,)."""
        keep, y = self.channel.keep, self.channel.y
        X = np.column_stack((signals, np.ones(len(y))))[keep]
        size = np.linalg.norm(X, axis=0) + 1e-300
        theta = np.linalg.lstsq(X / size, y[keep], rcond=1e-10)[0] / size
        rest = y[keep] - X @ theta
        return float(rest @ rest), theta

    def told(self, shape: _Shape) -> _Told:
        """A shape's gain of what is read, and the numerators and the constant that leave least with it."""
        from estimators.diagnosis.effects.kernels.recursion_kernels import size_of_late

        means = np.mean(self.signals, axis=0) if shape.centred else np.zeros(self.signals.shape[1])
        x = self.x - (float(np.mean(self.x)) if shape.centred else 0.0)
        of_late = size_of_late(np.abs(x), shape.rises, shape.falls)
        mean = float(np.mean(of_late)) + 1e-300
        rises = shape.left ** (-1.0 / shape.power) - 1.0  # share times the mean size
        gain = (1.0 + rises * of_late / mean) ** -shape.power
        left, theta = self._least(gain[:, None] * (self.signals - means))
        level = float(means @ theta[:-1])
        size = float(np.mean(np.abs(self.signals @ theta[:-1] - level))) + 1e-300
        return _Told(left, self.poles, shape, theta[:-1], float(theta[-1]) - level, rises / size, level, gain)


def _forms(base: Any) -> list[tuple[Any, list[Array]]]:
    """The linear model's structure, and one of a pole less, with poles to begin with: its own, and without its slowest real one, for
    which a quick one may stand."""
    s = base.structure
    roots = np.roots(np.concatenate(([1.0], base.p[: s.order])))
    real = np.where(np.abs(roots.imag) < 1e-9, roots.real, -1.0)
    if s.order < 2 or np.max(real) <= 0.0:
        return [(s, [base.p[: s.order]])]
    faster = np.real(np.poly(np.delete(roots, np.argmax(real))))[1:]
    fewer = of_order(base, s.order - 1, min(s.taps, s.order - 1))[0]
    return [(s, [base.p[: s.order], np.append(faster, 0.0)]), (fewer, [faster])]


def _profiled(channel: Any, s: Any, poles: Array) -> _Told:
    """The gain that leaves least, and poles made for it, one after the other."""
    from estimators.diagnosis.model.linear import fresh_poles
    from estimators.diagnosis.model.structure import stable_polynomial

    reading = _Reading(channel, s, poles)
    centre, spread = float(np.mean(reading.x)), float(np.std(reading.x))
    ways = (True, False) if abs(centre) > AWAY * spread else (False,)
    grid = product(TIMES, SLOWER, LEFT, POWERS, ways)
    every = [_Shape(t, t * slower, g, b, way) for t, slower, g, b, way in grid if 5.0 * t < len(channel)]
    best = min((reading.told(shape) for shape in every), key=lambda told: told.left)
    for _ in range(ROUNDS):
        # undone by the gain that is foretold, not by one of the size that is shown
        read = (channel.y - best.constant - best.level) / best.gain
        again = fresh_poles(read, channel.u[:, list(s.inputs)], s, channel.keep, begun=True)
        if not stable_polynomial(again):
            break
        reading = _Reading(channel, s, again)
        near = [best.shape, *(best.shape.closer(*by) for by in NEARER)]
        told = min((reading.told(shape) for shape in near), key=lambda told: told.left)
        if not told.left < best.left:
            break
        best = told
    return best


def _started(base: Any, form: Any, best: _Told) -> Any:
    """The linear model of a structure with the poles, numerators and constant that leave least."""
    from estimators.diagnosis.effects.disturbances.added import OFFSET
    from estimators.diagnosis.model.linear import plant_scales

    few, p, scales = of_order(base, form.order, form.taps)
    p[few.plant_size :] = 0.0
    p[: form.order], p[form.order : few.plant_size] = best.poles, best.numerators
    for part, at in zip(few.parts, few.slices(), strict=True):
        if part.effect is OFFSET:
            p[at] = best.constant
    scales[: few.plant_size] = plant_scales(few, p)
    return replace(base, structure=few, p=p, scales=scales)


def _fitted(channel: Any, start: Any, part: Any, best: _Told) -> Any:
    """The gain's fit. Its power and level lie in one long valley with its share where it levels all, and are freed last."""
    from estimators.diagnosis.model.fitting import fit

    shape, new = best.shape, start.structure.adding(part)
    p = np.concatenate((start.p, [best.share, shape.power, shape.rises, shape.falls, best.level]))
    free = np.concatenate((start.scales, [best.share, 1.0, 10.0, 10.0, float(np.std(channel.y))]))
    held = free.copy()
    held[[-4, -1]] = 0.0
    f = fit(channel, new, p, held, noise=start.noise, iterations=20)
    again = fit(channel, new, f.p, free, noise=f.noise, iterations=25)
    ended = min(replace(f, scales=free), again, key=lambda g: g.criterion)
    p = ended.p.copy()
    p[-5:-1] = np.abs(p[-5:-1])  # as it acts, whatever its signs
    return replace(ended, p=p)


def by_size(effect: Callable[[], Effect]) -> Callable[..., Iterator[Any]]:
    """Fits of an automatic gain from the shape and the poles that leave least, behind as many poles as the linear model has or one less."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.structure import Part

        s = base.structure
        if s.layout != "tf" or s.effects or np.mean(channel.keep) < KEPT:
            return
        squares = float(np.sum(base.residual[channel.keep] ** 2))
        for form, begun in _forms(base):
            best = min((_profiled(channel, form, poles) for poles in begun), key=lambda told: told.left)
            if firm(base, best.left) and best.left < WORTH * squares:
                yield _fitted(channel, _started(base, form, best), Part(effect(), s.inputs[0]), best)

    return search
