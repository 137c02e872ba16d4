"""Attribution: which effects, one or several, explain what the linear model leaves."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2

from estimators.diagnosis.effects import Effect, Nature, named
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Structure
from estimators.diagnosis.record.paired import as_good
from estimators.diagnosis.search.candidates import Menu, augmented, refit
from estimators.diagnosis.search.exchange import exchanged, whole_delay
from estimators.diagnosis.search.feedback import feedback_of
from estimators.diagnosis.search.ratios import explained

EVERYTHING = Menu()
FAMILY = EVERYTHING.family


@dataclass(frozen=True, eq=False)
class Claim:
    """One effect as a candidate: the gain of Schwarz's criterion over the model without it, and its corrected p-value."""

    effect: Effect
    gain: float
    p_value: float
    fit: Fit

    @property
    def key(self) -> str:
        """Its variant."""
        return self.effect.key

    @property
    def cause(self) -> str:
        """Its cause."""
        return self.effect.cause


@dataclass(frozen=True, eq=False)
class Attribution:
    """Outcome for one output.

    `base` the linear model, fitted by least squares; `coloured` the linear model with the noise model that
    its residual asks for; `final` the augmented model; `claims` single effects, best first; `chosen` keys of
    the effects in `final`, most important first, noise effects included; `feedback` p-value of the
    innovations against the future input; `p_values` corrected p-values of the tests, by name; `rivals` by the
    key of an effect of a model of several: causes that would do as well in its place; `refinements` effects
    that are weak beside the first one, by their key: what they explain as a share of what it explains;
    `alternatives` the best single effect of each cause by the simulation error that it leaves, least first.
    """

    base: Fit
    coloured: Fit
    final: Fit
    claims: list[Claim]
    chosen: list[str]
    feedback: float
    p_values: dict[str, float] = field(default_factory=dict)
    rivals: dict[str, list[str]] = field(default_factory=dict)
    refinements: dict[str, float] = field(default_factory=dict)
    alternatives: tuple[Fit, ...] = ()


def _noise_criterion(f: Fit) -> float:
    return f.deviance + len(f.noise) * np.log(f.n)


def significance(null: Fit, f: Fit, family: int = FAMILY) -> float:
    """Corrected p-value of a model against a smaller one: Bonferroni over effects and shapes, at most 1."""
    ratio = _noise_criterion(null) - _noise_criterion(f)
    k = max(1, len(f.p) - len(null.p))
    new = f.structure.parts[len(null.structure.parts) :]
    tries = float(np.prod([part.effect.tries(f.n) for part in new])) if new else 1.0
    return float(min(1.0, family * tries * chi2.sf(max(ratio, 0.0), k)))


def _white(f: Fit) -> Fit:
    """The same fit without a noise model (its deviance recomputed)."""
    if not len(f.noise):
        return f
    variance = float(np.sum(f.residual**2) / f.n)
    return replace(f, noise=np.zeros(0), variance=variance, deviance=f.n * np.log(max(variance, 1e-300)))


FEW = 8
"""Gauss-Newton steps after which candidates are compared: what is far behind then does not win with more."""
BASES, FULL = 5, 1500
"""Single effects of different causes that a second one is looked for beside, the best and four in its place, as loops that follow
any lag may take two of them; fewer beside longer records, whose criteria tell the best from the others."""
NEAR = 0.15
"""Share of the best first effect's gain that another must have to be one of them."""
PLAIN = 1.0
"""Gain that a second effect must promise beside one that leaves white noise: tones, delays, modes and whatever else has a
search of its own in place of a score would colour it."""
SIBLINGS = 2
"""Fits of one cause that are put before unused blocks: the closest, and a simpler one."""
FINISHED = 6
"""Candidates that are fitted on."""
ON, TO_THE_END = 25, 100
"""Further steps of those, and of the best, which others are looked for beside: a curve of an input of two levels lies in a long valley."""


def _finished(channel: Channel, fits: list[Fit]) -> list[Fit]:
    """The most promising fits, fitted on, the best of them to the end, and the others as they are."""
    fits = sorted(fits, key=lambda f: f.criterion)
    criterion = lambda f: f.criterion
    on = lambda f, n: min(f, fit(channel, f.structure, f.p, f.scales, iterations=n), key=criterion)
    head = sorted((on(f, ON) for f in fits[:FINISHED]), key=criterion)
    return [*(on(f, TO_THE_END) for f in head[:1]), *head[1:], *fits[FINISHED:]]


def _settled(channel: Channel, fits: list[Fit], count: int) -> list[Fit]:
    """The most promising fits, fitted again under their own noise models; sorted by criterion."""
    fits = sorted(fits, key=lambda f: f.criterion)
    head = [refit(channel, f) for f in fits[:count]]
    return sorted(head + fits[count:], key=lambda f: f.criterion)


def _per_key(fits: list[Fit], position: int) -> list[Fit]:
    """Best fit per effect and input."""
    best: dict[tuple[str, int], Fit] = {}
    for f in fits:
        part = f.structure.parts[position]
        name = (part.key, part.channel)
        if name not in best or f.criterion < best[name].criterion:
            best[name] = f
    return sorted(best.values(), key=lambda f: f.criterion)


def attribute(
    channel: Channel, s: Structure, menu: Menu = EVERYTHING, *, alpha: float = 0.01, most: int = 3, feedback: bool = True,
    base: Fit | None = None, singles: Sequence[Fit] = (),
) -> Attribution:  # fmt: skip
    """Find what a linear model of one output lacks: at most `most` effects of a menu, the noise model not counted.

    alpha is the false-alarm rate over all effects together; `feedback` whether to test for it; `base` the linear model where
    it is known; `singles` fits with one effect each, where all but a few of the samples were searched for them before.
    """
    base = fit_linear(channel, s) if base is None else base
    coloured = base
    if len(base.noise):
        coloured = refit(channel, base, iterations=25)
        again = fit_linear(channel, s, noise=coloured.noise, extra=[coloured.p[: s.order]])
        again = refit(channel, again)
        coloured = min((coloured, again), key=lambda f: f.criterion)
    white = _white(base)
    position = len(s.parts)
    fits = [fit(channel, f.structure, f.p, f.scales, iterations=FEW) for f in singles]
    fits = _finished(channel, fits or list(augmented(channel, white, menu, iterations=FEW, top=menu.top)))
    simulated = _explained(white, fits, position) if s.base else {}
    alternatives = _alternatives(fits, position) if s.base else ()
    fits = _settled(channel, fits, 6)
    if not singles and len(coloured.noise) and not s.base and (not fits or len(fits[0].noise)):
        more = list(augmented(channel, coloured, menu, best=1, iterations=15, top=menu.top))
        fits = _settled(channel, _per_key(fits + more, position), 4)
    fits = _per_key(fits, position)
    claims = [
        Claim(
            f.structure.parts[position].effect,
            coloured.criterion - f.criterion,
            significance(coloured, f, menu.family),
            f,
        )
        for f in fits
    ]
    final = coloured
    # under an estimated noise model the likelihood ratio runs high: a tenth of the rate for it
    level = 0.1 * alpha if len(coloured.noise) else alpha
    good = [c for c in claims if c.p_value < level and c.gain > 0]
    p_values: dict[str, float] = {}
    rivals: dict[str, list[str]] = {}
    rests: dict[str, Fit] = {}
    if good:
        final = good[0].fit
        p_values[good[0].key] = good[0].p_value
        if not explained(channel, white, [final]):  # else a pair could do no better
            final, rests = _more_effects(channel, final, good, menu, alpha, most, p_values, rivals)
        final = whole_delay(channel, final)
        present = {part.key for part in final.structure.effects}
        p_values = {key: p for key, p in p_values.items() if key in present}
        rivals = {key: names for key, names in rivals.items() if key in present}
    chosen = _importance(final, claims, simulated)
    return Attribution(
        base, coloured, final, claims, chosen, feedback_of(channel, final) if feedback else 1.0, p_values, rivals,
        _refinements(final, rests, chosen), alternatives,
    )  # fmt: skip


WEAK = 0.01  # share of the first effect's variance: a tenth of its error
SHAPING = (Nature.INPUT_STATIC, Nature.OUTPUT_STATIC, Nature.DYNAMIC, Nature.LINEAR)
"""Natures of terms that can bend the curve or the poles of another."""


def _refinements(final: Fit, rests: dict[str, Fit], chosen: list[str]) -> dict[str, float]:
    """Effects without which the simulation error grows little beside what the first one explains."""
    rss = float(np.sum(final.residual**2))
    explained = {key: max(float(np.sum(f.residual**2)) - rss, 0.0) for key, f in rests.items()}
    if not chosen or explained.get(chosen[0], 0.0) <= 0.0:
        return {}
    shares = {key: value / explained[chosen[0]] for key, value in explained.items() if key != chosen[0]}
    natures = {part.key: part.effect.nature for part in final.structure.effects}
    return {key: share for key, share in shares.items() if share < WEAK and natures.get(key) in SHAPING}


def _explained(base: Fit, fits: list[Fit], position: int) -> dict[str, float]:
    """By how much each effect alone lowers the simulation error: n log of the ratio of the variances."""
    out: dict[str, float] = {}
    rss = float(np.sum(base.residual**2))
    for f in fits:
        key = f.structure.parts[position].key
        gain = f.n * float(np.log(rss / max(float(np.sum(f.residual**2)), 1e-300)))
        out[key] = max(gain, out.get(key, -np.inf))
    return out


def _alternatives(fits: list[Fit], position: int) -> tuple[Fit, ...]:
    """The best fit of each cause by its simulation error, as a noise model may prefer another, and the best with fewer parameters.

    The more parameters of one cause fit the record itself better, whatever the cause.
    """
    best: dict[str, list[Fit]] = {}
    for f in sorted(fits, key=lambda f: float(np.sum(f.residual**2))):
        known = best.setdefault(f.structure.parts[position].effect.cause, [])
        if np.isfinite(f.deviance) and (not known or (len(known) < SIBLINGS and len(f.p) < len(known[0].p))):
            known.append(f)
    return tuple(
        sorted((f for known in best.values() for f in known), key=lambda f: float(np.sum(f.residual**2)))
    )


def _more_effects(
    channel: Channel, first: Fit, good: list[Claim], menu: Menu, alpha: float, most: int,
    p_values: dict[str, float], rivals: dict[str, list[str]],
) -> tuple[Fit, dict[str, Fit]]:  # fmt: skip
    """Second and further effects, from several of the best first ones, and by its effects the model without each.

    Each that comes is followed by a step back: what lacks a term of one that is there would be taken for a third effect.
    """
    final, rests = first, dict[str, Fit]()
    for depth in range(1, most):
        options: list[tuple[Fit, Fit]] = []
        tried: dict[int, list[Fit]] = {}
        bases = [final] + (_beginnings(good, len(channel)) if depth == 1 else [])
        for start in bases:
            reached = min((f.criterion for f, _ in options), default=final.criterion)
            plain = start.criterion - reached if len(start.noise) else max(start.criterion - reached, PLAIN)
            found = second(channel, start, menu, start is final, plain)
            limit = alpha * (1e-4 if len(found) and len(found[0].noise) else 1e-1)
            tried[id(start)] = found
            if found and significance(start, found[0]) < limit:
                options.append((found[0], start))
        if not options:
            break
        best, start = min(options, key=lambda pair: pair[0].criterion)
        if best.criterion > final.criterion - 6.0:
            break
        p_values[best.structure.parts[-1].key] = significance(start, best)
        cause = best.structure.parts[-1].effect.cause
        near = [g.structure.parts[-1].effect.cause for g in tried[id(start)][1:] if as_good(best, g)]
        others_near = [name for name in dict.fromkeys(near) if name != cause]
        if others_near:
            rivals[best.structure.parts[-1].key] = others_near
        for g, _ in options:  # other effects altogether
            if g is not best and as_good(best, g):
                _exchangeable(best, g, rivals)
        if start is not final:
            before = start.structure.parts[-1].key
            p_values[before] = next(c.p_value for c in good if c.fit is start)
        final, came, rests = exchanged(channel, best, menu)
        p_values |= {key: significance(*pair) for key, pair in came.items()}
    return final, rests


def _beginnings(good: list[Claim], n: int) -> list[Fit]:
    """Other first effects to go on from: the best of some causes, and of every nature, as a pair's first may be hidden behind many of another."""
    several = max(1, round(BASES * min(1.0, FULL / n)))
    causes, natures, out = {good[0].cause}, {good[0].effect.nature}, list[Fit]()
    for claim in good[1:]:
        wanted = len(causes) < several or claim.effect.nature not in natures
        if wanted and claim.cause not in causes and claim.gain > NEAR * good[0].gain:
            causes.add(claim.cause)
            natures.add(claim.effect.nature)
            out.append(claim.fit)
    return out


def _exchangeable(best: Fit, other: Fit, rivals: dict[str, list[str]]) -> None:
    """Notes which causes of one model stand where another model, as good, has others."""
    mine, theirs = ([part.effect.cause for part in f.structure.effects] for f in (best, other))
    for part in best.structure.effects:
        if part.effect.cause not in theirs:
            names = rivals.setdefault(part.key, [])
            names += [name for name in theirs if name not in (*mine, *names)]


def second(channel: Channel, f: Fit, menu: Menu, coloured: bool = True, needed: float = 0.0) -> list[Fit]:
    """The model with one more effect, the best by Schwarz's criterion first; nothing where a gain `needed` is not in sight."""
    position = len(f.structure.parts)
    fits = list(
        augmented(channel, _white(f), menu, best=1, iterations=FEW, top=min(8, menu.top or 8), needed=needed)
    )
    fits = _settled(channel, _per_key(fits, position), 3)
    if coloured and not f.structure.base and len(f.noise) and (not fits or len(fits[0].noise)):
        fits += list(augmented(channel, f, menu, best=1, iterations=10, top=5))
        fits = _settled(channel, _per_key(fits, position), 2)
    if fits:
        top = fit(channel, fits[0].structure, fits[0].p, fits[0].scales, noise=fits[0].noise, iterations=40)
        if np.isfinite(top.criterion) and top.criterion < fits[0].criterion:
            fits[0] = top
    return fits


def _importance(final: Fit, claims: list[Claim], simulated: dict[str, float]) -> list[str]:
    """Effects of the final model, the one that explains most by itself first; correlated noise where significant.

    For records that are no deviations that is the simulation error explained (`simulated`): there a noise model
    of high order predicts most of a smooth model error, and what is left says little of its causes.
    """
    alone: dict[str, float] = {}
    for claim in claims:
        alone[claim.key] = max(claim.gain, alone.get(claim.key, -np.inf))
    alone |= simulated
    costs = {part.key: alone.get(part.key, -np.inf) for part in final.structure.effects}
    if len(final.noise):
        plain = _white(final)
        ratio = plain.deviance - final.deviance
        p = FAMILY * named("coloured").trials * chi2.sf(ratio, len(final.noise))
        if p < 0.01:
            costs["coloured"] = plain.criterion - final.criterion
    return sorted(costs, key=lambda k: (k == "coloured", -costs[k]))
