"""What an effect may be called: a name says no more than its fit to this record shows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects import Nature, named
from estimators.diagnosis.effects.plant import MOVING, SWINGS
from estimators.diagnosis.effects.process import FILLED, THROUGH, at_once
from estimators.diagnosis.model.fitting import Channel, Fit
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part
from estimators.diagnosis.search.free_runs import denominator, largest_pole

Array = NDArray[Any]
FOLD, FOLDED = "magnitude_sensor", 0.02
"""Cause of a sensor that folds; and of the samples, what it must read from its rarer side: from one side alone it is a curve like any other."""

CONTENT, LATE = 0.4, 0.5
"""Of a capacity, change over the record, and of a pipe, samples of delay at the mean flow, below which a flow does no more than
multiply what it carries away."""


def as_shown(part: Part, f: Fit, channel: Channel) -> Part:
    """The part of a fit with the effect by whose name it goes.

    A curve of the input where its process is too quick for a memory; of the output where the lag before the curve is slower than
    what follows it, or where a fold is hardly reached; a loss where nothing can swing that a spring would hold; a product where
    a flow hardly fills its capacity, or passes no pipe.
    """
    at = f.structure.parts.index(part)
    p, effect = f.p[f.structure.slices()[at]], part.effect
    if effect.nature is Nature.INPUT_STATIC and part.own > 0:
        before, after = np.concatenate(([1.0], p[: part.first])), denominator(f)
        return replace(part, effect=named("sandwich")) if largest_pole(before) > largest_pole(after) else part
    if at_once(effect, p[part.own :]):
        return replace(part, effect=named("input_polynomial"))
    if effect.cause == "duffing" and not _swings(f):
        return replace(part, effect=replace(effect, cause=named("loss").cause))
    if _multiplies(part, p[part.own :], channel):
        return replace(part, effect=named("bilinear"))
    if effect.cause == FOLD and not _folds(f, at, channel):
        return replace(part, effect=replace(effect, cause=named("output_polynomial").cause))
    return part


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
    above = float(np.mean(x[channel.keep] + f.p[start] > 0.0))
    return min(above, 1.0 - above) >= FOLDED
