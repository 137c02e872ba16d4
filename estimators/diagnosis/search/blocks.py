"""Wiener-Hammerstein models: a static nonlinearity between two linear blocks, found by splitting the linear model."""

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects import Clock, Effect, Slot
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.input import SANDWICH
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.linear import fit_linear, numerators, plant_scales
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part

Array = NDArray[Any]
SPLIT = 3000


def _groups(roots: Array) -> list[Array]:
    """Real roots alone, complex ones with their conjugates."""
    out = [np.array([z.real]) for z in roots if abs(z.imag) < 1e-9]
    return out + [np.array([z, np.conj(z)]) for z in roots if z.imag >= 1e-9]


def _subsets(groups: list[Array], most: int) -> list[tuple[Array, Array]]:
    """Every way to share the roots between the two blocks: (first, second)."""
    out = []
    for count in range(len(groups) + 1):
        for chosen in combinations(range(len(groups)), count):
            first = [groups[i] for i in chosen]
            second = [groups[i] for i in range(len(groups)) if i not in chosen]
            a = np.concatenate(first) if first else np.zeros(0)
            b = np.concatenate(second) if second else np.zeros(0)
            if 1 <= len(a) <= most and len(b) >= 1:
                out.append((a, b))
    return out


def sandwich(channel: Channel, base: Fit, order: int, *, corners: int = 12) -> Fit | None:
    """Wiener-Hammerstein model from the poles and zeros of a linear model of a higher order.

    `order` is that of the linear model whose poles are shared between the blocks. Every split of the poles is fitted with one corner; the best are fitted to the
    end, and corners are added while Schwarz's criterion gains. The blocks' zeros are free, they start at the origin in the
    first block and by least squares in the second.
    """
    s = base.structure
    if s.layout != "tf" or s.effects or len(s.inputs) != 1:
        return None
    j = s.inputs[0]
    wide = fit_linear(channel, replace(s, order=order, taps=order, delay=0))
    poles = np.roots(np.concatenate(([1.0], wide.p[:order])))
    trials: list[Fit] = []
    for first, second in _subsets(_groups(poles), order - 1):
        n1, n2 = len(first), len(second)
        f1, f2 = np.real(np.poly(first))[1:], np.real(np.poly(second))[1:]
        part = Part(SANDWICH, j, 1, first=n1, free=True)
        x = part.blocked(channel.u[:, j], np.concatenate((f1, np.zeros(n1))))
        if not np.all(np.isfinite(x)):  # a pole on the circle
            continue
        parts = tuple(replace(q) for q in s.parts)
        new = replace(s, order=n2, taps=n2 + 1, delay=0, parts=(*parts, part))
        b = numerators(channel.y - np.mean(channel.y), x[:, None], f2, n2 + 1, 0, channel.keep)
        nuisance = [np.zeros(q.count(n2)) for q in s.parts]
        for q, values in zip(s.parts, nuisance):
            if q.effect is OFFSET:
                values[:] = np.mean(channel.y[channel.keep])
        mine = []
        for level, slope in ((0.5, -0.3), (0.0, -0.3), (-0.5, 0.3)):
            shape = [slope, level * float(np.std(x))]
            p = np.concatenate((f2, b, *nuisance, f1, np.zeros(n1), shape))
            mine.append(fit(channel, new, p, _scales(new, p, channel), iterations=6, colour=False))
        trials.append(min(mine, key=lambda f: f.deviance))  # one per split of the poles
    splits = sorted((f for f in trials if np.isfinite(f.deviance)), key=lambda f: f.deviance)[:12]
    few = replace(channel, u=channel.u[:SPLIT], y=channel.y[:SPLIT], keep=channel.keep[:SPLIT],
                  clock=Clock(channel.clock.k[:SPLIT], channel.clock.length))  # fmt: skip
    splits = [fit(few, f.structure, f.p, f.scales, iterations=30, colour=False) for f in splits]
    splits = sorted((f for f in splits if np.isfinite(f.deviance)), key=lambda f: f.criterion)[:3]
    if not splits:
        return None
    splits = [fit(channel, f.structure, f.p, f.scales, iterations=20, colour=False) for f in splits]
    splits = [grown(channel, f, 2) for f in splits]
    best = grown(channel, min(splits, key=lambda f: f.criterion), corners)
    return fit(channel, best.structure, best.p, best.scales, iterations=40)


def curved(channel: Channel, f: Fit, effect: Effect, *, corners: int = 12) -> Fit | None:
    """The model with a broken line (`effect`) for its static curve, corner by corner: for curves that no simple form fits.

    A curve of a simple form is left out of the model, other effects stay. None where no corner gains.
    """
    s, slot = f.structure, effect.slot
    if len(s.inputs) != 1 or (slot is Slot.INPUT and s.layout != "tf"):
        return None
    stays, at = s.keeping([q.effect.slot is not slot or not q.effect.static or q.first > 0 for q in s.parts])
    bare = stays.adding(Part(effect, s.inputs[0], 0))
    white = fit(channel, bare, f.p[at], f.scales[at], iterations=15, colour=False)
    best = grown(channel, white, corners)
    if not best.structure.parts[-1].size:
        return None
    return fit(channel, best.structure, best.p, best.scales, iterations=40)


def grown(channel: Channel, f: Fit, corners: int) -> Fit:
    """Corners added to the broken line that is the last part of a model, as many as pay by Schwarz's criterion."""
    best, poor = f, 0
    while f.structure.parts[-1].size < corners and poor < 2:
        more = _cornered(channel, f)
        if more is None:
            break
        f, poor = more, poor + 1
        if f.criterion < best.criterion:
            best, poor = f, 0
        elif f.structure.parts[-1].first:
            break  # a jump needs two corners, and the first alone may not pay: tried only where that is cheap
    return best


def _scales(s, p: Array, channel: Channel) -> Array:
    out = np.ones(len(p))
    out[: s.plant_size] = plant_scales(s, p)
    sy = float(np.std(channel.y)) + 1e-300
    for part, sl in zip(s.parts, s.slices(), strict=True):
        if part.effect is not SANDWICH:
            out[sl] = sy
    return out


def _cornered(channel: Channel, f: Fit) -> Fit | None:
    """One more corner, at the place whose score against the residual is the highest."""
    s, part = f.structure, f.structure.parts[-1]
    at_output = part.effect.slot is Slot.OUTPUT
    if at_output:
        linear, at = s.keeping([q.effect.slot not in (Slot.OUTPUT, Slot.ADDED) for q in s.parts])
        x = simulate(linear, f.p[at], channel.u, channel.clock)
    else:
        x = part.blocked(channel.u[:, part.channel], f.p[s.slices()[-1]])
    new = replace(s, parts=(*s.parts[:-1], replace(part, size=part.size + 1)))
    den = np.concatenate(([1.0], f.p[: s.order]))
    num = np.concatenate((np.zeros(1 + s.delay), f.p[s.order : s.order + s.taps]))
    follows = (lambda v: v) if at_output else (lambda v: lfilter(num, den, v))
    Q = np.linalg.qr(f.jacobian)[0] if f.jacobian.size else np.zeros((len(x), 0))
    r = f.residual - Q @ (Q.T @ f.residual)
    trials: list[tuple[float, float, float]] = []
    for level in np.concatenate(([0.003, 0.01], np.linspace(0.03, 0.97, 24), [0.99, 0.997])):
        corner = float(np.quantile(x, level))
        d = np.where(channel.keep, follows(np.maximum(x - corner, 0.0)), 0.0)
        d0 = d - Q @ (Q.T @ d)
        power = float(d0 @ d0)
        if power > 1e-14 * float(d @ d):
            trials.append((float(d0 @ r) ** 2 / power, float(d0 @ r) / power, corner))
    trials.sort(reverse=True)
    scales = np.concatenate((f.scales, [1.0, float(np.std(x))]))
    found = []
    for _, slope, corner in trials[:2]:
        p = np.concatenate((f.p, [slope, corner]))
        found.append(fit(channel, new, p, scales, iterations=15, colour=False))
    found = [g for g in found if np.isfinite(g.deviance)]
    return min(found, key=lambda g: g.deviance) if found else None
