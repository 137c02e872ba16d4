"""The verdict: what is claimed of the system, what is said of the data, and the sentences for both.

Two headlines that never compete: a finding about the record (rounding, held samples, outliers, feedback) is no answer to
what the linear model lacks, and takes the first place only where nothing of the system is claimed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from estimators.diagnosis.effects import CATALOGUE, Effect, Nature, Slot, named
from estimators.diagnosis.examination import Examined
from estimators.diagnosis.ladder.held_out import HeldOut
from estimators.diagnosis.ladder.steps import Kind, Ladder, Step
from estimators.diagnosis.model.fitting import Fit
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.policy import Setting
from estimators.diagnosis.record.leftover import Leftover, leftovers
from estimators.diagnosis.search.named import Claim, Named
from estimators.diagnosis.search.selection import FAMILY, causes_of

__all__ = ["Outcome", "verdict"]

UNKNOWN, NONE = "unknown", "none"
UNCLAIMED = "no cause found that holds on unused data"


@dataclass(frozen=True, eq=False)
class Outcome:
    """Everything found for one output."""

    index: int
    examined: Examined
    named: Named
    ladder: Ladder

    @property
    def claims(self) -> tuple[Claim, ...]:
        """Effects of the answer: none where it does not stand on the named model."""
        return self.named.claims if any(s.kind is Kind.NAMED for s in self.ladder.chosen.chain) else ()

    @property
    def nameless(self) -> Step | None:
        """The part of the answer that has no name, where it gains more than all that has one."""
        chain = self.ladder.chosen.chain
        without = [s for s in chain if s.kind in (Kind.DISCOVERED, Kind.REMAINDER)]
        if not without:
            return None
        value = {id(r.step): r.value for r in self.ladder.rungs}
        base = next((value[id(s)] for s in chain if s.kind is Kind.NAMED), self.ladder.rungs[0].value)
        more = base**2 - value[id(chain[0])] ** 2
        return without[-1] if more > self.ladder.rungs[0].value ** 2 - base**2 else None


@dataclass(frozen=True)
class Finding:
    """One thing found: key of the catalogue (or what stands in its place), its weight among its kind, the evidence."""

    key: str
    weight: float
    p_value: float
    sentence: str


def verdict(outcomes: Sequence[Outcome], held: HeldOut, setting: Setting) -> dict[str, Any]:
    """The fields of a `Diagnosis` that name causes."""
    several, effects = len(outcomes) > 1, (*CATALOGUE, *setting.effects)
    system = [f for o in outcomes for f in _system(o, _tag(o, several))]
    nameless = [(o, step) for o in outcomes if (step := o.nameless) is not None]
    withdrawn = bool(system or nameless) and not held.difference.low > 0.0
    rests = [
        leftovers(o.examined.last, o.named.fit, alpha=setting.alpha / len(outcomes) / 10) for o in outcomes
    ]
    strange = [
        (o, item) for o, rest in zip(outcomes, rests, strict=True)
        if not nameless and (item := _unexplained(o, rest, setting.alpha / len(outcomes))) is not None
    ]  # fmt: skip
    data = [f for o in outcomes for f in _data(o, setting, _tag(o, several))]
    noise = [f for o in outcomes for f in _noise(o, _tag(o, several))]
    first = [] if withdrawn else sorted(system, key=lambda f: -f.weight)
    second = sorted(data, key=lambda f: -f.weight) + noise
    unknown = (bool(nameless) and not withdrawn) or bool(strange)
    keys = [
        *([(strange[0][1].key if strange else "") or UNKNOWN] if unknown else []),
        *(f.key for f in (*first, *second)),
    ]
    chosen = causes_of(keys, effects)
    evidence = [
        f"no effect of the catalogue explains what is left{_tag(o, several)}: {x.sentence}"
        for o, x in strange
    ]
    evidence += [UNCLAIMED] if withdrawn else []
    evidence += [
        f"no effect of the catalogue explains {_nameless_words(s)}{_tag(o, several)}"
        for o, s in nameless
        if unknown
    ]
    evidence += [f.sentence for f in (*first, *second)] + _dropped(outcomes, several, effects)
    natures = [*(x.nature for _, x in strange), *(s.nature for _, s in nameless)]
    nature = natures[0] if unknown else named(keys[0], effects).nature.value if keys else NONE
    tried = _tried(outcomes, chosen)
    return {
        "detected": bool(keys), "effect": chosen[0] if chosen else NONE,
        "variant": ", ".join(dict.fromkeys(_variant(keys, nameless, unknown))), "nature": nature,
        "ranked": (*chosen, *tried) if chosen else (NONE,),
        "p_value": min((f.p_value for f in (*first, *second)), default=1.0), "evidence": tuple(evidence),
        "parameters": {k: v for o in outcomes for k, v in _parameters(o, several).items()},
        "confusable": _confusable(outcomes, chosen),
        "remaining": "; ".join(x.sentence + _tag(o, several) for o, rest in zip(outcomes, rests, strict=True) for x in rest[:3]),
        "refinements": tuple(causes_of([key for o in outcomes for key, _ in o.named.dropped], effects)),
        "system": _headline(first, unknown, withdrawn, outcomes, held, effects), "equation": "; ".join(_equations(outcomes)),
        "floor_is_bound": any(map(bool, rests)) or any(_absorbing(o) for o in outcomes), "data": tuple(f.sentence for f in data),
    }  # fmt: skip


def _headline(
    first: list[Finding], unknown: bool, withdrawn: bool, outcomes: Sequence[Outcome], held: HeldOut,
    effects: tuple[Effect, ...],
) -> str:  # fmt: skip
    """The first line: what is missing from the system, and what that is worth on fresh data."""
    errors = f"error on fresh data {held.rmse_before.value:.3g} -> {held.rmse_after.value:.3g}"
    if withdrawn:
        return f"{UNCLAIMED}; {errors}"
    if unknown:
        return f"an effect without a name: {'; '.join(_equations(outcomes)) or 'predicted by no equation'}; {errors}"
    if not first:
        return f"nothing is missing from the linear model that data not used could show; {errors}"
    words = named(first[0].key, effects).cause.replace("_", " ")
    o = next(o for o in outcomes if any(c.key == first[0].key for c in o.claims))
    given = [f"{name.rpartition('.')[2]} {v:.4g} +- {se:.1g} {unit}".rstrip()
             for name, (v, se, unit) in _parameters(o, False).items() if name.startswith(first[0].key + ".")]  # fmt: skip
    return f"{words}{': ' + ', '.join(given[:MOST]) if given else ''}; {errors}"


MOST = 4
"""Parameters in the headline: a curve of many corners is given below it."""


def _equations(outcomes: Sequence[Outcome]) -> list[str]:
    return [s.equation for o in outcomes for s in o.ladder.chosen.chain if s.equation]


def _tag(o: Outcome, several: bool) -> str:
    return f" on output {o.index + 1}" if several else ""


def _system(o: Outcome, tag: str) -> list[Finding]:
    """The effects of the answer, by what they explain on unused blocks as a share of the error there."""
    return [
        Finding(
            c.key, c.gain.value / max(o.ladder.rungs[0].value ** 2, 1e-300), c.p_value,
            f"{c.part.effect.sentence}{tag}: the error on unused blocks is {100 * c.gain.share:.3g} % less with it, "
            f"corrected p = {c.p_value:.2g}{_assumed(o, c.key)}{_or(c)}",
        )
        for c in o.claims
    ]  # fmt: skip


def _or(c: Claim) -> str:
    return f"; it may as well be {' or '.join(c.rivals)}" if c.rivals else ""


def _data(o: Outcome, setting: Setting, tag: str) -> list[Finding]:
    """Faults of the measurement, then feedback: what shows in the samples before what a fit says."""
    a = o.examined.attribution
    order = {"held": 4.0, "quantised": 3.0, "outliers": 1.0}
    found = [Finding(s.key, order.get(s.key, 0.0), 0.0, s.sentence) for s in o.examined.signatures]
    if a.feedback < setting.alpha / 100:
        found.append(Finding("feedback", 2.0, a.feedback, "past innovations help to predict the input"
                             f"{tag} (p = {a.feedback:.2g}): the data are from a closed loop"))  # fmt: skip
    return found


def _noise(o: Outcome, tag: str) -> list[Finding]:
    """Noise that is correlated in time, beyond what the search over its orders finds in white noise."""
    f = o.named.fit
    if not len(f.noise):
        return []
    plain = f.n * float(np.log(max(np.sum(f.residual**2) / f.n, 1e-300)))
    p = min(
        1.0,
        FAMILY * named("coloured").trials * float(chi2.sf(max(plain - f.deviance, 0.0), len(f.noise))),
    )
    return (
        [Finding("coloured", 0.0, p, f"the noise is correlated in time{tag}: corrected p = {p:.2g}")]
        if p < 0.01
        else []
    )


def _dropped(outcomes: Sequence[Outcome], several: bool, effects: tuple[Effect, ...]) -> list[str]:
    return [
        f"not claimed{_tag(o, several)}: {named(key, effects).cause} ({why})"
        for o in outcomes
        for key, why in o.named.dropped
    ]


def _unexplained(o: Outcome, rest: list[Leftover], alpha: float) -> Leftover | None:
    """What the tests of the residual still show, where it weighs more than all that was found."""
    a, f = o.examined.attribution, o.named.fit
    if o.examined.signatures:
        return None
    explained = 0.0
    if (
        o.claims
    ):  # in one-step errors, or in simulation errors: a noise model predicts part of any model error
        before = float(np.mean(a.base.residual[o.examined.channel.keep] ** 2))
        after = float(np.mean(f.residual[o.examined.last.keep] ** 2))
        explained = max(
            a.coloured.criterion - f.criterion, f.n * float(np.log(before / max(after, 1e-300))), 0.0
        )
    limit = SURE if o.claims or len(f.noise) else alpha / 10
    for item in rest:
        noisy = item.nature == Nature.NOISE
        if item.p_value >= (SURE if noisy else limit):
            continue
        if (noisy and not o.claims) or (not noisy and item.gain > max(0.5 * explained, LEAST)):
            return item
    return None


SURE = 1e-6
"""Significance under a noise model or beside an effect is less sure than it says."""
LEAST = 6.0
"""Of Schwarz's criterion: odds of twenty to one."""


def _nameless_words(step: Step) -> str:
    return (
        f"what is left: {step.equation}"
        if step.equation
        else "what is left, but it can be predicted from the inputs"
    )


def _variant(keys: list[str], nameless: list[tuple[Outcome, Step]], unknown: bool) -> list[str]:
    said = [s.equation for _, s in nameless if s.equation] if unknown else []
    return said + [k for k in keys if k != UNKNOWN]


def _tried(outcomes: Sequence[Outcome], chosen: list[str]) -> tuple[str, ...]:
    """The other single effects, by what they gain."""
    pool: dict[str, float] = {}
    for o in outcomes:
        for c in o.examined.attribution.claims:
            pool[c.cause] = pool.get(c.cause, 0.0) + max(c.gain, 0.0)
    return tuple(k for k, gain in sorted(pool.items(), key=lambda x: -x[1]) if k not in chosen and gain > 0)


def _confusable(outcomes: Sequence[Outcome], chosen: list[str]) -> tuple[str, ...]:
    names = [name for o in outcomes for c in o.claims if chosen and c.cause == chosen[0] for name in c.rivals]
    return tuple(dict.fromkeys(names))


def _parameters(o: Outcome, several: bool) -> dict[str, tuple[float, float, str]]:
    prefix = f"y{o.index + 1}." if several else ""
    return {prefix + k: v for step in o.ladder.chosen.chain for k, v in step.parameters.items()}


def _assumed(o: Outcome, key: str) -> str:
    """What a symmetric limit takes for granted where the record reaches one side of it only."""
    f, channel = o.named.fit, o.examined.last
    at = next((i for i, part in enumerate(f.structure.parts) if part.key == key), None)
    if at is None or not f.structure.parts[at].effect.two_sided:
        return ""
    limit = abs(float(f.p[f.structure.slices()[at]][0]))
    if f.structure.parts[at].effect.slot is Slot.INPUT:
        x = channel.u[:, f.structure.parts[at].channel]
    else:
        x = simulate(f.structure, f.p, channel.u, channel.clock)
    beyond = [bool(np.any(side * x > 0.98 * limit)) for side in (1.0, -1.0)]
    if all(beyond) or not any(beyond):
        return ""
    return "; this record reaches one side of the limit only, the other side is assumed"


def _absorbing(o: Outcome) -> bool:
    """Whether a noise model stands beside an effect: it may have taken some of the model error for noise."""
    f: Fit = o.named.fit
    return len(f.noise) > 0 and any("nonlinearity" in part.effect.nature for part in f.structure.effects)
