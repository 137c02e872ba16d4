"""What an effect may be called: a name says no more than its fit to this record shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects import Nature, named
from estimators.diagnosis.effects.input.capacities import FILLED
from estimators.diagnosis.effects.loops.ageing import WORN
from estimators.diagnosis.effects.loops.recycled import RECYCLE
from estimators.diagnosis.effects.path import STORE_CURVE
from estimators.diagnosis.effects.plant import MOVING, SWINGS
from estimators.diagnosis.effects.process import CHECKED, PULLED, THROUGH, at_once
from estimators.diagnosis.effects.sensing.folding import RECTIFIED
from estimators.diagnosis.model.errors import parameters_of
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part
from estimators.diagnosis.search.free_runs import denominator, largest_pole
from oed.covariances import NORMAL

if TYPE_CHECKING:
    from estimators.diagnosis.ladder.claims import Claim
    from estimators.diagnosis.search.named import Bench

Array = NDArray[Any]
FOLD, FOLDED = "magnitude_sensor", 0.02
"""Cause of a sensor that folds; and of the samples, what it must read from its rarer side by more than the model's error: from one side
alone it is a curve like any other."""

CONTENT, LATE = 0.4, 0.5
"""Of a capacity, change over the record, and of a pipe, samples of delay at the mean flow, below which a flow does no more than
multiply what it carries away."""
BENT = (Nature.INPUT_STATIC, Nature.OUTPUT_STATIC, Nature.DYNAMIC)
"""Natures of causes by which a run departs from proportion."""
SMALL, MUST = 0.05, 0.5
"""Size of the inputs, of theirs, at which a model is taken for proportional; and the power of its departure from that, of what
it gains over a linear model, below which poles and delays that came with an effect have gained it: a nonlinear part cannot
gain more than its own power, half of which is left for chance."""


def as_shown(part: Part, f: Fit, channel: Channel) -> Part:
    """The part of a fit with the effect by whose name it goes.

    A curve of the input where its process is too quick for a memory; of the output where the lag before the curve is slower than
    what follows it, or where a fold is hardly reached; a loss where nothing can swing that a spring would hold; a product where
    a flow hardly fills its capacity, or passes no pipe; more dynamics where nothing but a lag is told.
    """
    at = f.structure.parts.index(part)
    p, effect = f.p[f.structure.slices()[at]], part.effect
    if effect.nature is Nature.INPUT_STATIC and part.own > 0:
        before, after = np.concatenate(([1.0], p[: part.first])), denominator(f)
        return replace(part, effect=named("sandwich")) if largest_pole(before) > largest_pole(after) else part
    if at_once(effect, p[part.own :], channel, part.channel):
        return replace(part, effect=named("input_polynomial"))
    if effect.cause == "duffing" and not _swings(f):
        return replace(part, effect=replace(effect, cause=named("loss").cause))
    if _multiplies(part, p[part.own :], channel):
        return replace(part, effect=named("bilinear"))
    if effect.key in LAGGING and not _departs(part, f, channel):
        return replace(part, effect=named("order"))
    if effect.cause == FOLD and not _folds(f, at, channel):
        return replace(part, effect=replace(effect, cause=named("output_polynomial").cause))
    return part


LAGGING = {
    RECYCLE.key: ("share",),
    **{key + fed: own for fed in ("", "_fed") for key, own in {
        "rise_and_fall": ("asymmetry",), "loss_cubic": ("k3",), "loss": ("k2", "k3"), "capacity_bump": ("more",),
        "capacity_level": ("k1", "k2")}.items()},
    CHECKED.key: (), PULLED.key: (),
}  # fmt: skip
"""Effects that without these parameters are lags beside the plant: more linear dynamics. Those without any have a range in which they are
two lags: a valve that never closes, a slip far from the one of most torque."""
FAR = 1e3  # widths of an input's range, at which a slip of most torque leaves two lags, as does a valve that never closes
STRAIGHTENED = 30  # steps in which a lag is fitted in the place of one


def _departs(part: Part, f: Fit, channel: Channel) -> bool:
    """Whether any of the parameters is told from nothing that an effect has beyond a lag, or no lag is as good."""
    told = (
        abs(value) > NORMAL * error
        for name, (value, error, _) in parameters_of(f, channel).items()
        if name.removeprefix(f"{part.key}.") in LAGGING[part.key]
    )
    return any(told) or _bends(part, f, channel)


def _bends(part: Part, f: Fit, channel: Channel) -> bool:
    """Whether a lag in the place of an effect is no match for it by Schwarz's criterion: a bump far from all levels of the record has
    no size that is told from nothing, as its tail has any beside a width and a level that go with it."""
    names = [name for name, _ in part.parameters(f.structure.order)]
    at, s, p, scales = f.structure.parts.index(part), f.structure, f.p.copy(), f.scales.copy()
    own = s.slices()[at]
    held = [own.start + names.index(name) for name in LAGGING[part.key]]
    p[held], scales[held] = 0.0, 0.0
    if not held:
        far = FAR * float(np.ptp(channel.u[:, part.channel]))
        beside = [own.start + i for i, name in enumerate(names) if name != "width"]
        s = replace(s, parts=(*s.parts[:at], replace(part, effect=PULLED), *s.parts[at + 1 :]))
        p, scales = (
            np.concatenate((x[: own.start], np.insert(x[beside], 1, width), x[own.stop :]))
            for x, width in ((p, far), (scales, 0.0))
        )
    lag = fit(channel, s, p, scales, noise=f.noise, iterations=STRAIGHTENED)
    return bool(lag.deviance - f.deviance > len(names) * np.log(f.n))


def _multiplies(part: Part, q: Array, channel: Channel) -> bool:
    """Whether a flow into or through a capacity, of parameters q, only multiplies its content."""
    if part.effect is FILLED:
        return abs(float(q[1] * np.sum(channel.u[:, int(q[4]) - 1]))) < CONTENT
    return part.effect is THROUGH and abs(float(q[1])) < LATE * abs(
        float(np.mean(channel.u[:, part.channel]))
    )


def _swings(f: Fit) -> bool:
    """Whether the part of the plant that a spring acts in has complex poles; what creeps back has no mass that would show."""
    if f.structure.layout not in MOVING or f.structure.layout == "integrator":
        return True
    stiffness, damping = np.exp(f.p[:2])
    return bool(damping < 2.0 * SWINGS * np.sqrt(stiffness))


def _folds(f: Fit, at: int, channel: Channel) -> bool:
    """Whether what a folding sensor sees in this record lies on both sides of its fold."""
    start = f.structure.slices()[at].start
    x = simulate(replace(f.structure, parts=f.structure.parts[:at]), f.p[:start], channel.u, channel.clock)
    above = x + f.p[start] > 0.0
    rarer = above if np.mean(above[channel.keep]) < 0.5 else ~above
    effect = f.structure.parts[at].effect
    if effect.apply is not None and effect is not RECTIFIED:  # which reads nothing there
        rarer &= effect.apply(x, f.p[start:], channel.clock) > np.sqrt(np.mean(f.residual[channel.keep] ** 2))
    return float(np.mean(rarer[channel.keep])) >= FOLDED


def _middle(f: Fit, c: Channel) -> Array:
    """The inputs about which runs are scaled: their mean, or nothing where a model bends along the way that the mean takes it."""
    along = any(part.effect in (STORE_CURVE, FILLED, WORN) for part in f.structure.parts)
    return np.mean(c.u, axis=0) * (not along)


def scaled_runs(f: Fit, c: Channel) -> list[Array]:
    """Runs of a fit on the inputs at no size about their mean, at a SMALL one, reversed and whole."""
    middle = _middle(f, c)
    return [
        simulate(f.structure, f.p, middle + size * (c.u - middle), c.clock)
        for size in (0.0, SMALL, -1.0, 1.0)
    ]


SPLITS = 2.0 ** np.arange(0, 10)
"""Time constants in samples, by one of which an input is split into a slow and a quick part."""


def _unadded(f: Fit, c: Channel, still: Array, little: Array, full: Array) -> Array:
    """(N,) a run on the inputs less its runs on a slow and a quick part of them that have half of a linear run's power each, all three
    less the run `still`; zero of what is no number."""
    lag = lambda x, time: np.asarray(lfilter([1.0 / time], [1.0, 1.0 / time - 1.0], x, axis=0))
    time = min(SPLITS, key=lambda time: abs(float(np.var(lag(little, time)) - 0.5 * np.var(little))))
    middle = _middle(f, c)
    slow = lag(c.u - middle, time)
    parts = (simulate(f.structure, f.p, u, c.clock) - still for u in (middle + slow, c.u - slow))
    return np.nan_to_num(full - sum(parts), posinf=0.0, neginf=0.0)


DATED = 0.05
"""Of the record, the standard error of a time from which on nothing has changed at it: what changes shows when, within a few of its
own time constants; a model that is only bent has its best time anywhere."""


def dated(claim: Claim, f: Fit, channel: Channel) -> bool:
    """Whether the record tells when what changes for good has changed."""
    part = claim.part
    if not part.effect.timed:
        return True
    errors = (
        error
        for name, (_, error, _) in parameters_of(f, channel).items()
        if name.startswith(f"{part.key}.time")
    )
    return all(error < DATED * len(channel) for error in errors)


HARMONICS, AGAIN, BETWEEN, APART = 12, 0.9, 0.5, 0.5
"""Harmonics of what repeats that its answer may have; the correlation with itself from which on an input comes again, and what it must have
fallen to in between; and turns over the record, by which what repeats runs off from a harmonic of the input where the two are known apart."""


def told_apart(claim: Claim, f: Fit, channel: Channel) -> bool:
    """Whether what repeats by the clock is known not to be what the inputs do, which do not come again with it."""
    if claim.part.effect.nature not in (Nature.TIME, Nature.ADDED):
        return True
    own = np.abs(f.p[f.structure.slices()[f.structure.parts.index(claim.part)]])
    values = [(name, v) for (name, _), v in zip(claim.part.parameters(f.structure.order), own, strict=True)]
    periods = [2.0 * np.pi / v for name, v in values if name.startswith("frequency") and v > 0.0]
    periods += [v for name, v in values if name == "period"]
    if not periods:
        return True
    returns = [first for j in f.structure.inputs if (first := _return(channel.u[:, j])) > 0]
    return not any(
        0.5 < first / every < HARMONICS + 0.5
        and abs(first / every - np.rint(first / every)) * len(channel) < APART * first
        for every in periods
        for first in returns
    )


def _return(u: Array) -> float:
    """Lag in samples at which an input (N,) is first itself again, after it was another, as its later returns tell it; 0 where it never is."""
    n, x = len(u), u - u.mean()
    shifted = np.fft.irfft(np.abs(np.fft.rfft(x, 2 * n)) ** 2)[: 3 * n // 4]
    power = np.concatenate(([0.0], np.cumsum(x**2)))
    # of the first n - lag samples, and of the last
    both = np.sqrt(power[n : n - len(shifted) : -1] * (power[-1] - power[: len(shifted)]))
    alike = shifted / np.maximum(both, 1e-300)
    another = np.flatnonzero(alike < BETWEEN)
    again = np.flatnonzero(alike[another[0] :] > AGAIN) + another[0] if len(another) else another
    if not len(again):
        return 0.0
    end = again[0] + np.flatnonzero(np.append(alike[again[0] :], -1.0) <= AGAIN)[0]
    lag, times = int(again[0] + np.argmax(alike[again[0] : end])), 1
    while 2 * lag + 2 < len(alike):
        lag, times = 2 * lag - 2 + int(np.argmax(alike[2 * lag - 2 : 2 * lag + 3])), 2 * times
    return lag / times


def bending(
    bench: Bench, f: Fit, held: list[Claim], unused: Array, alternatives: Sequence[Fit]
) -> list[Claim]:
    """The claims; of missing dynamics where a run is too near proportion for a nonlinear effect to have gained what it did.

    What is proportional to either sign of the input alone, as rates that differ up and down, shows with the sign reversed; what is so
    to all of it, as friction that grows with the deflection, where two parts of an input act together. Most of the gain may be of
    dynamics that the linear model lacks, and yet more dynamics alone may leave what the bend explains.
    """
    runs = scaled_runs(f, bench.channel)
    if not all(np.all(np.isfinite(run)) for run in runs):
        return held
    little, back, full = (run - runs[0] for run in runs[1:])
    keep = bench.channel.keep
    power = float(np.mean((full - little / SMALL)[keep] ** 2 + (0.5 * (full + back))[keep] ** 2))
    power = max(power, float(np.mean(_unadded(f, bench.channel, runs[0], little, full)[keep] ** 2)))
    gained = bench.over(unused, bench.linear).value
    squares = lambda g: float(np.mean(g.residual**2))
    linear = (g for g in alternatives if g.structure.effects[0].effect.nature is Nature.LINEAR)
    more = min(map(squares, linear), default=np.inf) - squares(f)
    if squares(f) < more < power / MUST:  # twice the squares, and no more than the bend can have explained
        return held
    return [
        replace(claim, part=replace(claim.part, effect=named("order")))
        if claim.part.effect.nature in BENT and power < MUST * min(gained, claim.gain.value)
        else claim
        for claim in held
    ]
