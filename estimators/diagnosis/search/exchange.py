"""The backward step of a selection: each effect of the model taken out or exchanged once, the others kept."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline.linear_model import FAR
from estimators.diagnosis.effects import Effect, Slot, named
from estimators.diagnosis.effects.input import DELAY
from estimators.diagnosis.effects.path import LAG_BEFORE
from estimators.diagnosis.model.fitting import Channel, Fit, fit, innovations
from estimators.diagnosis.model.linear import relinearised
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part
from estimators.diagnosis.search.candidates import Menu, augmented, refit
from estimators.diagnosis.search.free_runs import denominator

Array = NDArray[Any]

WORTH = 2.0  # by which an exchange must lower Schwarz's criterion
TREND = named("drift")
KEEP = 6.0  # by which an effect must lower it to stay, as it had to when it came


CURVES = 4
"""Siblings of an effect that are fitted in its place, those whose scores promise most: families are smaller, curves of one cause are
more, most of them alike where no effect has spoilt the scores."""
IDLE = 0.01
"""Of the squared error, what a part must change of the run to do anything: where it does not, fits without a block stop where the
fit to all began, and unused blocks seem to ask for it."""


def without(channel: Channel, f: Fit, position: int, known: Sequence[Fit] = ()) -> list[Fit]:
    """A model fitted again without one of its parts, by least squares, its noise model chosen from its residual.

    Beside the part that goes the others were bent to it, and the fit may end far from what they are worth: each `known` fit with
    the same effects is another.
    """
    gone = f.structure.parts[position]
    s, at = f.structure.leaving(position)
    # The poles before it are linear ones, and stay: what they gain is nothing that the effect gains.
    if gone.own:
        lag = replace(gone, effect=LAG_BEFORE, size=1)
        start = f.structure.slices()[position].start
        s = replace(s, parts=(*s.parts[:position], lag, *s.parts[position:]))
        at = np.sort(np.concatenate((at, np.arange(start, start + gone.own))))
    keys = sorted(part.key for part in s.effects)
    alike = [g for g in known if keys and sorted(part.key for part in g.structure.effects) == keys]
    fits = [fit(channel, s, f.p[at], f.scales[at], iterations=20)]
    return fits + [fit(channel, g.structure, g.p, g.scales, iterations=20) for g in alike]


def without_idle(channel: Channel, f: Fit) -> tuple[int, Fit] | None:
    """The place of the first effect that changes nothing of the run, as a play without width, and the model without it; None where each does."""
    for position in range(f.structure.base, len(f.structure.parts)):
        part = f.structure.parts[position]
        if part.effect.slot is Slot.FORM or part.own:
            continue
        s, at = f.structure.leaving(position)
        change = channel.y - simulate(s, f.p[at], channel.u, channel.clock) - f.residual
        if np.sum(change[channel.keep] ** 2) < IDLE * np.sum(f.residual[channel.keep] ** 2):
            return position, fit(channel, s, f.p[at], f.scales[at], noise=f.noise)
    return None


def trending(channel: Channel, f: Fit) -> Fit | None:
    """The model with a trend in place of a pole that remembers where the record began to its end, as no input need drive it; None
    where it has none, or a trend beside it."""
    s, taken = f.structure, [part.effect for part in f.structure.parts]
    within = s.layout != "tf" and any(part.effect.slot in (Slot.PLANT, Slot.FORM) for part in s.effects)
    if s.layout == "tanks" or within or s.order < 2 or TREND in taken:
        return None
    poles = np.roots(denominator(f))
    slow = int(np.argmax(np.abs(poles)))
    if abs(poles[slow]) < FAR or poles[slow].imag != 0.0:
        return None
    new = replace(s, order=s.order - 1, taps=s.order - 1, layout="tf").adding(Part(TREND, s.inputs[0]))
    p, scales = np.zeros(new.size), np.ones(new.size)
    for part, old, at in zip(s.parts, s.slices(), new.slices(), strict=False):
        count = part.count(new.order)
        p[at], scales[at] = f.p[old][:count], f.scales[old][:count]
    p[: new.order] = np.real(np.poly(np.delete(poles, slow)))[1:]
    p = relinearised(channel, new, p)
    return None if p is None else fit(channel, new, p, scales, iterations=40)


def drifting(channel: Channel, f: Fit) -> Fit | None:
    """The model with a trend beside its effects; None where it has one."""
    s = f.structure
    if s.layout == "tanks" or TREND in [part.effect for part in s.parts]:
        return None
    new = s.adding(Part(TREND, s.inputs[0]))
    more = new.size - s.size
    return fit(channel, new, np.r_[f.p, np.zeros(more)], np.r_[f.scales, np.ones(more)], iterations=40)


def akin(one: Effect, other: Effect) -> bool:
    """Whether one effect may stand for another: of one family, or static curves of one cause."""
    curves = one.static and other.static and one.cause == other.cause
    return curves or (one.family != "" and one.family == other.family)


def exchanged(channel: Channel, f: Fit, menu: Menu) -> tuple[Fit, dict[str, tuple[Fit, Fit]], dict[str, Fit]]:
    """Each effect left out once and put up against its siblings, with all the others in the model.

    A sibling may have won the first round only because the effects found later were not yet there, and a change
    time that was found then may be wrong. Returns the best model by Schwarz's criterion; for each effect that came in, or
    found a better fit, the models without and with it; and for each effect of the best model the model without it.
    """
    came: dict[str, tuple[Fit, Fit]] = {}
    rests: dict[str, Fit] = {}
    if len(f.structure.effects) < 2:
        return f, came, rests
    for part in f.structure.effects:
        position = next((i for i, q in enumerate(f.structure.parts) if q == part), None)
        if position is None or len(f.structure.effects) < 2 or part.effect.slot is Slot.FORM:
            continue
        (rest,) = without(channel, f, position)
        if not np.isfinite(rest.deviance):
            continue
        options = [refit(channel, rest)]
        if siblings := tuple(e for e in menu.effects if akin(part.effect, e)):
            plain = fit(channel, rest.structure, rest.p, rest.scales, iterations=2, colour=False)
            others = replace(menu, effects=siblings)
            found = augmented(channel, plain, others, best=2, iterations=20, top=CURVES)
            options += [refit(channel, g) for g in found]
        best = min(options, key=lambda g: g.criterion)
        if best.criterion < f.criterion + (KEEP if best is options[0] else -WORTH):
            f = best
            if best is not options[0]:
                rests[best.structure.parts[-1].key] = rest
                came[best.structure.parts[-1].key] = (options[0], best)
        else:
            rests[part.key] = rest
    present = {part.key for part in f.structure.effects}
    return f, came, {key: rest for key, rest in rests.items() if key in present}


def whole_delay(channel: Channel, f: Fit) -> Fit:
    """The model with its delay at a whole sample, where that is no worse by Schwarz's criterion.

    A fraction of a sample mixes two taps, as free numerators do: near a whole delay the two are hard to tell
    apart, and a fit may end between samples at the same error.
    """
    at = next(
        (
            sl.start
            for q, sl in zip(f.structure.parts, f.structure.slices(), strict=True)
            if q.effect is DELAY
        ),
        None,
    )
    if at is None or channel.step > 0 or f.p[at] == np.floor(f.p[at]):
        return f
    low = int(np.floor(f.p[at]))
    held = f.scales.copy()
    held[at] = 0.0  # no step: it stays where it is put
    fits = []
    for d in (low, low + 1, low + 2):
        p = f.p.copy()
        p[at] = float(d)
        fits.append(fit(channel, f.structure, p, held, noise=f.noise, iterations=30))
    best = min(fits, key=lambda g: g.deviance + len(g.noise) * np.log(g.n))
    if not best.criterion < f.criterion + np.log(f.n) or best.p[at] < 1.0:
        return f
    q = best.p.copy()
    q[at] += 1e-6
    moved = simulate(f.structure, q, channel.u, channel.clock) - simulate(
        f.structure, best.p, channel.u, channel.clock
    )
    J = best.jacobian.copy()
    J[:, at] = innovations(np.where(channel.keep, -moved / 1e-6, 0.0), best.whitened)
    return replace(best, jacobian=J, scales=f.scales)
