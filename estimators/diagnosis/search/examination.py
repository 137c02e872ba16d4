"""One output examined: measurement faults first, then the attribution of what is left."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline.choice import SLOW
from estimators.diagnosis.effects import Clock, Effect, Nature, Slot, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.input import LINES, SANDWICH
from estimators.diagnosis.effects.path import INITIAL, OUTFLOW
from estimators.diagnosis.ladder.steps import ROUNDING
from estimators.diagnosis.model.fitting import Channel, Fit, fit, innovations, leaving
from estimators.diagnosis.model.forces import balanced_fit, force_balance
from estimators.diagnosis.model.linear import begun_linear, fit_linear
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.policy import Effort, Setting
from estimators.diagnosis.record.measurement import (
    Signature,
    at_extremes,
    at_reversals,
    lost_samples,
    refreshed_every,
    rounding_step,
    wild_samples,
)
from estimators.diagnosis.search.blocks import curved, grown, sandwich
from estimators.diagnosis.search.candidates import Menu
from estimators.diagnosis.search.feedback import feedback_of
from estimators.diagnosis.search.free_runs import denominator, largest_pole, thinned
from estimators.diagnosis.search.selection import Attribution, attribute
from estimators.residual.algebra import gapless
from oed.data import Record

Array = NDArray[Any]
LONG = 8000
SCREEN = 4096
MIDDLE = 20000
LEAST_MOTION = 400  # samples of a force balance


@dataclass(frozen=True, eq=False)
class Examined:
    """All that was found for one output.

    `channel` which output, from 0; `attribution` causes and fits; `signatures` traces of the measurement: outliers, quantisation,
    held samples; `naive` the linear fit before anything was added; `thin` by how much the record was thinned for screening;
    `final_channel` data of the final model, fitted to a record thinned less; `final_thin` by how much that was thinned; 0 where it is `thin`.
    """

    channel: Channel
    attribution: Attribution
    signatures: list[Signature]
    naive: Fit
    thin: int = 1
    final_channel: Channel | None = None
    final_thin: int = 0

    @property
    def last(self) -> Channel:
        """The data that the final model was fitted to."""
        return self.channel if self.final_channel is None else self.final_channel

    def thin_of(self, f: Fit) -> int:
        """By how much the data of one of the fits were thinned."""
        return self.final_thin if self.final_thin and f is self.attribution.final else self.thin


def _structure(setting: Setting, record: Record, i: int, order: int) -> tuple[Structure, tuple[int, ...]]:
    every = tuple(range(record.n_inputs))
    if setting.structure == "diagonal" and record.n_inputs == record.n_outputs:
        inputs = (i,)
    else:
        inputs = every
    s = Structure(order, inputs)
    if not setting.deviations:
        s = s.adding(Part(OFFSET)).adding(Part(INITIAL))
        s = replace(s, base=2)
    return s, tuple(j for j in every if j not in inputs)


@dataclass(frozen=True, eq=False)
class Known:
    """What the best linear model says of the structure that effects are added to: poles, and samples of delay beyond one."""

    order: int
    delay: int = 0
    added: Array | None = None  # (N,) tones that no input drives, which a light pole would take for its own
    memory: float = np.inf  # samples that a pole may remember


FITTED = {Effort.QUICK: 6, Effort.NORMAL: 14, Effort.THOROUGH: 0}
"""Effects whose scores promise most that are fitted at first; 0 for all. A score is a linearised gain: among fourteen the
right one has not been missed where all were fitted."""
PAID, LEAST_FITTED = 2000, 4
"""Samples of a record from which on fewer effects are fitted, so that the work does not grow with it, and the fewest: the
scores of a long record are sharp."""
ALIKE, FEW = 0.1, 0.01  # shares of the wild samples, of all, that may change where fits are only fitted on
EXACT = 1e-6  # of the step between levels: what a model hits so nearly was not rounded to them, its inputs have few values
PHYSICAL = 4
"""Poles from which on a linear model is no plant that effects could sit in, but an approximation of one."""


def _beside(channel: Channel, s: Structure, added: Array) -> Fit:
    """The linear model of what is left without an added signal (N,), as a fit of the record as it is."""
    added = added[: len(channel)]
    f = fit_linear(replace(channel, y=channel.y - added), s)
    return leaving(f, f.residual + np.where(channel.keep, added, 0.0))


def _forgetting(channel: Channel, s: Structure, first: Fit, known: Known) -> tuple[Structure, Fit]:
    """The linear fit, of lower order where a pole that remembers longer than it may lowers the error too little: it follows what
    an effect does slowly, and would run away with the effect beside it."""
    while s.order > 1 and largest_pole(denominator(first)) > 1.0 - 1.0 / known.memory:
        s = replace(s, order=s.order - 1, taps=s.taps - 1)
        fewer = fit_linear(channel, s) if known.added is None else _beside(channel, s, known.added)
        if np.sum(fewer.residual**2) > SLOW**2 * np.sum(first.residual**2):
            return first.structure, first
        first = fewer
    return s, first


def _order(channel: Channel, record: Record, setting: Setting, i: int, known: Known) -> int:
    """The order of the best linear model; where that is no plant's, the smallest within a quarter of the best error."""
    if 1 <= known.order <= PHYSICAL:
        return known.order
    errors = []
    for order in range(1, PHYSICAL + 3):
        s = replace(_structure(setting, record, i, order)[0], delay=known.delay)
        begun = begun_linear(channel, s)  # the two ends may be different minima
        fits = [fit_linear(channel, s, rough=rough, begun=begun) for rough in (True, False)]
        errors.append(min(float(np.sqrt(np.mean(f.residual**2))) for f in fits))
    return next((order for order, e in enumerate(errors, start=1) if e <= 1.25 * min(errors)), 2)


def _thinning(y: Array, n_most: int = LONG) -> int:
    """Factor by which a long record is thinned out: as far as its spectrum allows, its movement oversampled 10 times."""
    n = len(y)
    if n <= n_most:
        return 1
    power = np.abs(np.fft.rfft((y - y.mean()) * np.hanning(n))) ** 2
    share = np.cumsum(power) / np.sum(power)
    top = float(np.searchsorted(share, 0.999) / (n / 2))  # of the Nyquist frequency
    return int(max(1, min(0.2 / max(top, 1e-6), n // 1500)))


def examine(record: Record, i: int, setting: Setting, known: Known | None = None) -> Examined:
    """Find what the linear model of one output lacks."""
    known = Known(PHYSICAL + 1) if known is None else known
    thin = _thinning(gapless(record.y)[:, i])
    known = replace(
        known,
        delay=known.delay // thin,
        added=None if known.added is None else known.added[::thin],
        memory=known.memory / thin,
    )
    record = thinned(record, thin)
    if len(record) > LONG:
        short = _examined(record[:SCREEN], i, setting, known)
        return replace(_lengthened(record, i, short, setting), thin=thin)
    return replace(_examined(record, i, setting, known), thin=thin)


BALANCED, DRY = 0.9, 5.0
"""Of the force's variance, that a balance must explain for the record to be a motion, and standard errors of its dry friction."""


def as_motion(record: Record, i: int, setting: Setting, known: Known) -> Examined | None:
    """The output as a motion under dry friction, where its force balance shows one; None otherwise. Nothing else is tried.

    The search thins a long record, and a linear model of it takes poles to imitate what sticks: the balance needs neither.
    """
    if setting.deviations or setting.orders or record.n_inputs != 1 or len(record) < LEAST_MOTION:
        return None
    one = record.replace(y=gapless(record.y[:, i : i + 1]), output_names=(), output_units=())
    balance = force_balance(one)
    if balance.share < BALANCED or balance.coulomb[0] < DRY * balance.coulomb[1]:
        return None
    found = examine(record, i, replace(setting, effects=()), known)
    fine = max(1, found.thin // 2)  # where the motion sticks shows; what drifts has few independent samples
    short = thinned(one, fine)
    keep = np.isfinite(thinned(record, fine).y[:, i])
    channel = Channel(short.u, short.y[:, 0], Clock(np.arange(len(short), dtype=float), len(short)), keep)
    f = balanced_fit(channel, short.dt, balance)
    if f is None or not np.isfinite(f.deviance):
        return None
    again = replace(
        found.attribution, final=f, chosen=["coulomb_asymmetric"], feedback=feedback_of(channel, f)
    )
    return replace(found, attribution=again, final_channel=channel, final_thin=fine)


def _lengthened(record: Record, i: int, short: Examined, setting: Setting) -> Examined:
    """What was found on the first part of a long record, fitted to all of it."""
    n = len(record)
    missing = ~np.isfinite(record.y[:, i])
    y = gapless(record.y)[:, i]
    faults = {sig.key for sig in short.signatures}
    keep = ~missing & ~lost_samples(record.u, y) if "held" in faults else ~missing
    channel = Channel(record.u, y, Clock(np.arange(n, dtype=float), n), keep, short.channel.step)
    ratio = n / len(short.channel)

    def again(f: Fit, channel: Channel, white: bool = False) -> Fit:
        p = f.p.copy()
        for part, sl in zip(f.structure.parts, f.structure.slices(), strict=True):
            for k, unit in enumerate(part.effect.units[: sl.stop - sl.start]):
                if unit.endswith("/record"):
                    p[sl.start + k] *= ratio
        return fit(channel, f.structure, p, f.scales, noise=None if white else f.noise, iterations=40)

    a = short.attribution
    if any(part.effect is SANDWICH for part in a.final.structure.parts):  # more data bear more corners
        few = replace(channel, u=channel.u[:MIDDLE], y=channel.y[:MIDDLE], keep=keep[:MIDDLE],
                      clock=Clock(channel.clock.k[:MIDDLE], n))  # fmt: skip
        f = fit(few, a.final.structure, a.final.p, a.final.scales, iterations=40, colour=False)
        a = replace(a, final=grown(few, f, 16))
    found = replace(
        a, base=again(a.base, channel, True), coloured=again(a.coloured, channel),
        final=again(a.final, channel, not setting.deviations),
    )  # fmt: skip
    naive = again(found.base, replace(channel, keep=~missing), True) if "held" in faults else found.base
    if "outliers" in faults:
        channel = channel.without(wild_samples(found.final.residual, keep))
        found = replace(found, base=again(found.base, channel, True), final=again(found.final, channel))
    return Examined(channel, found, short.signatures, naive)


def _examined(record: Record, i: int, setting: Setting, known: Known) -> Examined:
    n, missing = len(record), ~np.isfinite(record.y[:, i])
    y = gapless(record.y)[:, i]
    keep = ~missing
    clock = Clock(np.arange(n, dtype=float), n)
    signatures: list[Signature] = []
    step = rounding_step(y)
    held, every = lost_samples(record.u, y) & keep, refreshed_every(record.u, y)
    if held.sum() >= max(3, 0.004 * n):
        keep &= ~held
        signatures.append(Signature("held", i, int(held.sum()), float(held.mean()),
            f"{record.output_names[i]}: {int(held.sum())} of {n} samples repeat the one before exactly"
            + (f": it is read anew every {every} samples only" if every > 1 else "")))  # fmt: skip
    channel = Channel(record.u, y, clock, keep)
    order = setting.orders[i] if setting.orders else _order(channel, record, setting, i, known)
    s, others = _structure(setting, record, i, order)
    s = s if setting.orders else replace(s, delay=known.delay)
    few = FITTED[setting.effort] * min(1.0, PAID / n)
    menu = Menu(setting.effects, others, max(LEAST_FITTED, round(few)) if few else 0)
    first = fit_linear(channel, s) if known.added is None else _beside(channel, s, known.added)
    s, first = _forgetting(channel, s, first, known)
    naive = fit_linear(replace(channel, keep=~missing), s) if not np.array_equal(keep, ~missing) else first
    if step > 0.0:
        sigma = float(np.sqrt(np.mean(first.residual[keep] ** 2)))
        if EXACT * step < sigma < step / 0.8:
            channel = replace(channel, step=step)
            levels = len(np.unique(y))
            signatures.append(Signature("quantised", i, levels, step,
                f"{record.output_names[i]}: all samples lie on {levels} levels {step:.5g} apart, "
                f"{step / sigma:.2g} times the residual's standard deviation"))  # fmt: skip
    wild = _wild(channel, s, first) if channel.step == 0.0 else np.zeros(n, dtype=bool)
    # a transient from the start, not faults: asked again
    if np.sum(wild[: max(20, n // 50)]) > 0.7 * wild.sum():
        wild[:] = False
    if wild.any():  # what stands out from the best single effect too
        found = attribute(channel.without(wild), s, menu, alpha=setting.alpha, most=1)
        first_wild, residual = wild, y - simulate(found.final.structure, found.final.p, channel.u, clock)
        wild = _enough(
            wild_samples(residual, keep) & wild_samples(innovations(residual, found.final.noise), keep), n
        )
        if not wild.any() and not len(found.final.noise):
            found = _refitted(channel.without(wild), found)
        else:
            alike = max(ALIKE * first_wild.sum(), FEW * n)
            singles = [c.fit for c in found.claims] if np.sum(wild != first_wild) <= alike else ()
            found = attribute(channel.without(wild), s, menu, alpha=setting.alpha, singles=singles)
    else:
        found = attribute(channel, s, menu, alpha=setting.alpha, base=None if channel.step else first)
        # beside an order that is stated no delay is, but for what the best linear model has of one
        if setting.orders and known.delay > found.final.structure.delay and len(found.final.noise):
            later = attribute(channel, replace(s, delay=known.delay), menu, alpha=setting.alpha)
            found = min((found, later), key=lambda a: a.final.criterion)
        if channel.step == 0.0 and found.chosen:
            residual = y - simulate(found.final.structure, found.final.p, channel.u, clock)
            wild = _enough(wild_samples(residual, keep), n)
            if wild.any():
                found = _refitted(channel.without(wild), found)
    channel = channel.without(wild)
    found = _structured(channel, found, setting) if channel.step == 0.0 else found
    if wild.any():
        simulated = simulate(found.final.structure, found.final.p, channel.u, channel.clock)
        size = float(np.median(np.abs((y - simulated)[wild])))
        spread = float(np.sqrt(np.mean(found.final.residual[channel.keep] ** 2)))
        still = _enough(wild & wild_samples(y - simulated, keep), n).any()
        expected = at_extremes(wild, channel.u, simulated) or _reversing(found, wild, simulated)
        if not still or size < max(4.0 * spread, ROUNDING * float(np.max(np.abs(y)))) or expected:
            # they stood out from a model error only, or by what rounding leaves
            channel = replace(channel, y=y, keep=keep)
            return Examined(
                channel, _simulating(channel, _refitted(channel, found), setting), signatures, naive
            )
        signatures.append(Signature("outliers", i, int(wild.sum()), size,
            f"{record.output_names[i]}: {int(wild.sum())} isolated samples are off by about {size:.3g}, "
            f"{size / max(spread, 1e-300):.0f} standard deviations of the rest"))  # fmt: skip
    return Examined(channel, _simulating(channel, found, setting), signatures, naive)


def _simulating(channel: Channel, a: Attribution, setting: Setting) -> Attribution:
    """For records that are not deviations: the chosen model fitted to the simulation error itself.

    A noise model weighs the fit for one-step prediction; where the structure is only nearly right, that costs
    simulation error, which is what is reported. The noise model is then of the residual that remains.
    """
    if setting.deviations or not len(a.final.noise) or channel.step > 0:
        return a
    return replace(a, final=fit(channel, a.final.structure, a.final.p, a.final.scales, iterations=40))


def _structured(channel: Channel, a: Attribution, setting: Setting) -> Attribution:
    """Block structures, where a nonlinearity was found but its model leaves a coloured residual."""
    from estimators.diagnosis.model.outflow import tanks
    from estimators.diagnosis.search.selection import Claim, significance

    if not len(a.final.noise):
        return a
    order = a.base.structure.order
    trials = [] if setting.deviations else [(OUTFLOW, tanks(channel, a.base))]
    nonlinear = (Nature.INPUT_STATIC, Nature.OUTPUT_STATIC, Nature.DYNAMIC)
    if (order <= 4 or not setting.deviations) and any(
        q.effect.nature in nonlinear for q in a.final.structure.effects
    ):
        trials += [(line, curved(channel, f, line)) for line, f in _curves(a)]
        wide = max(order + 2, min(2 * order, 6))
        # a suggested order counts the poles of both blocks; one chosen for an approximation has too few
        for size in (max(order, 2), wide) if setting.deviations else (wide,):
            trials.append((SANDWICH, sandwich(channel, a.base, size)))
            if (f := trials[-1][1]) is not None and not len(f.noise):
                break  # nothing is left that more poles could explain
    found = [
        (effect, f)
        for effect, f in trials
        if f is not None and f.criterion < a.final.criterion - max(0.02 * f.n, 20.0)
    ]
    if not found:
        return a
    first, f = min(found, key=lambda pair: pair[1].criterion)
    claims = [
        Claim(e, a.coloured.criterion - g.criterion, significance(a.coloured, g), g)
        for e, g in sorted(found, key=lambda pair: pair[1].criterion)
    ]
    key = first.key
    beside = {part.key for part in f.structure.effects} - {key}
    chosen = [key, *(k for k in a.chosen if k in beside)] + (["coloured"] if len(f.noise) else [])
    p_values = {key: claims[0].p_value} | {k: p for k, p in a.p_values.items() if k in beside}
    return replace(a, final=f, claims=[*claims, *a.claims], chosen=chosen, p_values=p_values)


def _curves(a: Attribution) -> list[tuple[Effect, Fit]]:
    """Where a broken line is tried, and the model that it becomes part of: one with effects that stay beside it."""
    slots = {q.effect.slot for q in a.final.structure.effects if q.effect.static}
    several = len(a.final.structure.effects) > 1
    found = [(LINES, a.final if several and Slot.INPUT in slots else a.base)]
    return found + ([(named("output_lines"), a.final)] if Slot.OUTPUT in slots else [])


def _enough(wild: NDArray[np.bool_], n: int) -> NDArray[np.bool_]:
    """The wild samples, or none where they are too few to be a fault."""
    return wild if wild.sum() >= max(3, 0.001 * n) else np.zeros(n, dtype=bool)


def _reversing(a: Attribution, wild: NDArray[np.bool_], simulated: Array) -> bool:
    """Whether the wild samples are the misfit of an effect that acts where the motion turns."""
    return any(part.effect.reversing for part in a.final.structure.effects) and at_reversals(wild, simulated)


def _wild(channel: Channel, s: Structure, first: Fit) -> NDArray[np.bool_]:
    """Wild samples of the linear model's residual, found again after each refit without them."""
    wild = np.zeros(len(channel), dtype=bool)
    keep = channel.keep
    for _ in range(4):
        found = wild_samples(first.residual, keep & ~wild)
        if not found.any():
            break
        wild |= found
        first = fit_linear(channel.without(wild), s)
    return _enough(wild, len(channel))


def _refitted(channel: Channel, a: Attribution) -> Attribution:
    """The chosen models fitted again where the samples that count have changed."""

    def again(f: Fit) -> Fit:
        return fit(channel, f.structure, f.p, f.scales, noise=f.noise)

    return replace(
        a,
        base=fit(channel, a.base.structure, a.base.p, a.base.scales),
        coloured=again(a.coloured),
        final=again(a.final),
    )
