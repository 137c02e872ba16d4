"""The verdict: what is claimed of the system, what is said of the data, and the sentences for both.

Two headlines: a finding about the record (rounding, held samples, outliers, feedback) is no answer to what the linear model lacks, and
takes the first place only where nothing of the system is claimed, or less of the error than reading the record rightly removes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from estimators.diagnosis.effects import CATALOGUE, Effect, Nature, Slot, named
from estimators.diagnosis.ladder.claims import Claim
from estimators.diagnosis.ladder.first_line import UNKNOWN, doubts, equations, headline, on_output
from estimators.diagnosis.ladder.held_out import HeldOut
from estimators.diagnosis.ladder.outcome import Outcome
from estimators.diagnosis.ladder.stated import SETTLES, Contradiction
from estimators.diagnosis.ladder.steps import Kind
from estimators.diagnosis.model.fitting import Fit
from estimators.diagnosis.model.forces import effective_samples
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.policy import Policy, Setting
from estimators.diagnosis.record.leftover import Leftover, leftovers
from estimators.diagnosis.result.words import in_units
from estimators.diagnosis.search.named import INDEPENDENT
from estimators.diagnosis.search.selection import FAMILY
from estimators.residual.measures import p_stated
from oed.data import Record

NONE = "none"
UNCLAIMED = "no cause found that holds on unused data"
NOTHING = "nothing is missing from the linear model that data not used could show"
ANSWERS = "the input answers the noise"
ECHO = f"{ANSWERS}: no cause can be told from the controller's answer"
APART = "a model that no controller's inverse can be halves the error on unused blocks as well; its names may be others"
MINGLED = "input and noise go together, as in a loop, in two measurements of one thing, or in signals filtered by later samples: no cause can be told"


@dataclass(frozen=True)
class Finding:
    """One thing found: its variant and cause, its nature, its weight among its kind, the evidence."""

    key: str
    cause: str
    nature: str
    weight: float
    p_value: float
    sentence: str


def verdict(
    outcomes: Sequence[Outcome],
    held: HeldOut,
    setting: Setting,
    record: Record,
    stated: Sequence[tuple[Outcome, Contradiction]] = (),
) -> dict[str, Any]:
    """The fields of a `Diagnosis` that name causes; what was `stated` and does not hold is one where no other is."""
    several, effects = len(outcomes) > 1, {e.key: e for e in (*CATALOGUE, *setting.effects)}
    every, outcomes = outcomes, [o for o in outcomes if not o.ladder.exact]  # rounding has no cause
    rests = [leftovers(o.examined.last, o.named.fit, alpha=setting.alpha / len(every) / 10) for o in outcomes]
    system = [f for o in outcomes for f in _system(o, on_output(o, several), setting.policy)]
    withdrawn = bool(system) and not held.bears
    doubted = [f.cause for f in system if withdrawn]
    if withdrawn or not system:
        # What one output feeds back, all outputs see at the inputs.
        told = [] if any(o.share.feedback for o in outcomes) else outcomes
        system = [f for o in told for f in _predictable(o, on_output(o, several), setting.policy)]
    for o, rest in zip(outcomes, rests, strict=True):
        if not any(f.cause == UNKNOWN for f in system):
            system += _unexplained(o, rest, setting.alpha / len(every), on_output(o, several))
    if not system:
        # beside a cause that the record does not bear, only a pole of the linear model itself is told
        told = [(o, c) for o, c in stated if not withdrawn or c.key == SETTLES]
        system = [
            _seen(effects, c.key, c.share, c.p_value, c.sentence + on_output(o, several)) for o, c in told
        ]
        withdrawn = withdrawn and not system
    first = sorted(system, key=lambda f: -f.weight)
    data = sorted(
        (f for o in outcomes for f in _data(o, setting, effects, on_output(o, several))),
        key=lambda f: -f.weight,
    )
    # beside a claim that the record refuses, what unused blocks have shown is in that noise
    heard = zip(outcomes, rests, strict=True) if first or not withdrawn else ()
    faults = [f for f in data if held.misread and f.key != "feedback"]
    found = [
        *faults,
        *first,
        *(f for f in data if f not in faults),
        *(f for o, rest in heard for f in _noise(o, rest, effects, on_output(o, several))),
    ]
    chosen = list(dict.fromkeys(f.cause for f in found))
    heads = [headline(f, outcomes, effects, record, held.bears) for f in (*faults[:1], *first[:1])]
    errors = f"error on fresh data {held.rmse_before.value:.3g} -> {held.rmse_after.value:.3g} {in_units('y', record)}"
    bare = all(o.ladder.chosen.linear for o in outcomes)  # else a model of no cause that holds is the answer
    echo = (
        ECHO
        if any(o.loop for o in outcomes)
        else MINGLED
        if any(o.inverse for o in outcomes)
        else NOTHING
        if bare
        else UNCLAIMED
    )
    rivals = _confusable(outcomes, chosen)
    unsure = doubts(rivals, held.untried and not held.difference.low > 0.0, held.within)
    return {
        "detected": bool(found), "effect": chosen[0] if chosen else NONE,
        "variant": ", ".join(dict.fromkeys((*(_meanings(outcomes) if first else []), *(f.key for f in found if f.key)))),
        "nature": found[0].nature if found else NONE,
        "ranked": tuple(dict.fromkeys((*chosen, *doubted, *_tried(outcomes)))) if chosen else (NONE,),
        "p_value": min((f.p_value for f in found), default=1.0),
        "evidence": (*([UNCLAIMED] if withdrawn else []), *(f.sentence for f in found), *_dropped(outcomes, several, effects)),
        "parameters": {k: v for o in outcomes for k, v in _parameters(o, several).items()},
        "confusable": rivals,
        "remaining": "; ".join(x.sentence + on_output(o, several) for o, rest in zip(outcomes, rests, strict=True) for x in rest[:3]),
        "refinements": tuple(dict.fromkeys(effects[key].cause for o in outcomes for key, _ in o.named.dropped)),
        "system": "; ".join([*(["; beside that, ".join(heads), *unsure] if first else [UNCLAIMED if withdrawn else echo]), errors]),
        "equation": "; ".join(equations(outcomes)),
        "floor_is_bound": any(map(bool, rests)) or any(_absorbing(o) for o in outcomes),
        "data": tuple(f.sentence for f in data), "explainable": _explainable(every),
    }  # fmt: skip


def _meanings(outcomes: Sequence[Outcome]) -> list[str]:
    """The equations with what their terms are in physical words."""
    steps = [s for o in outcomes for s in o.ladder.chosen.chain if s.equation]
    return [f"{s.equation} ({'; '.join(dict.fromkeys(s.sentences))})" for s in steps]


def _explainable(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """The share of the first output's residual, as there is one share for one residual; the least sure where several."""
    s = min((o.share.nothing if o.ladder.exact else o.share for o in outcomes), key=lambda s: -s.share)
    return {name: getattr(s, name) for name in ("share", "low", "high", "by", "nature", "noise_floor")}


def _system(o: Outcome, tag: str, policy: Policy) -> list[Finding]:
    """What is claimed of the system: named effects that the answer stands on, else the terms that were discovered; where
    these are the answer, the named effects keep their names if they explain nearly all that it does.
    """
    kinds = {s.kind for s in o.ladder.chosen.chain}
    claimed = _supported(o, _claimed(o, tag), policy)
    if o.inverse:  # its own terms may be the controller's: what is no inverse tells the nature
        first = claimed[:1] if o.apart else []
        return [replace(f, key="", cause=UNKNOWN, sentence=APART + tag) for f in first]
    linear = bool(claimed) and o.bent and all(f.nature == Nature.LINEAR for f in claimed)
    anything = o.share.explainable and o.named.anything(CATALOGUE)
    if anything or linear or (claimed and o.gainsaid(claimed[0].nature)):
        what = "other linear dynamics" if linear else claimed[0].cause.replace("_", " ")
        more = "and as much with effects of other natures" if anything else "but there is more"
        words = f"unused blocks get better with {what}{tag}, {more}: {o.share.natures[0].sentence}"
        claimed = [Finding("", UNKNOWN, o.share.nature, claimed[0].weight, 0.0, words)]
    if Kind.NAMED in kinds:
        gained = sum(f.weight for f in claimed)
        return _nameless(o, tag, policy, gained) + claimed
    if Kind.DISCOVERED not in kinds and Kind.REMAINDER not in kinds:
        return []
    agree = Kind.DISCOVERED not in kinds or [f.nature for f in claimed[:1]] == [o.discovered]
    if agree and o.named_carries(policy):
        return claimed
    weight = o.ladder.explained
    mine = [t for t in o.discovery.terms if t.output == o.index]
    if Kind.DISCOVERED in kinds and mine:
        words = f"blocks not used are simulated with {_percent(o):.3g} % less error with the terms{tag}: {o.discovery.equation}"
        agreed = [f for f in claimed if o.agrees(f.nature, f.cause) and not o.unsure(f.key, f.cause)]
        doubted = o.weighs(o.share.nature) and o.behind(agreed[0].nature) if agreed else True
        if not doubted and o.named_carries(policy, agreed=True):
            return [*agreed, Finding("", agreed[0].cause, agreed[0].nature, 0.0, 0.0, words)]
        kind = o.share.nature if o.share.explainable and o.weighs(o.share.nature) else o.discovered
        heavy = [t for t in mine if t.weight >= HEAVY * mine[0].weight and t.nature == kind]
        cause = next((t.same_as for t in heavy[:1] if t.same_as and t.sure), UNKNOWN)
        return [Finding("", cause, kind, weight, 0.0, words)] + [
            Finding("", t.same_as, t.nature, 0.1 * weight / (2 + k), 0.0, f"{t.meaning}{tag}: {t.text}")
            for k, t in enumerate(mine[1:]) if t.same_as and t.same_as != cause
        ]  # fmt: skip
    nature = o.share.nature if o.share.explainable else Nature.DYNAMIC  # it has memory, as others need not
    if nature == Nature.LINEAR:
        words = f"what is left{tag} can be predicted by more linear dynamics"
        return [Finding("order", named("order").cause, nature, weight, 0.0, words)]
    words = f"what is left{tag} can be predicted, but neither a name nor an equation was found for it"
    return [Finding("", UNKNOWN, nature, weight, 0.0, words)]


HEAVY = 0.5
"""Of the strongest term's weight, from which on another of the answer's nature may name it: a product with a difference is two terms."""


def _supported(o: Outcome, claimed: list[Finding], policy: Policy) -> list[Finding]:
    """The claims, first of those that may have come first one of the nature that the regression of the residual saw.

    What a joint model loses without one of its effects says little of which that was: each bends towards the other. One may
    have that gains half as much as the first, without which the others explain less than half, or that explains alone nearly all
    that the joint model does. Else linear dynamics, which any misled order asks for, come behind such a one of another nature.
    """
    squares = lambda f: float(np.sum(f.residual**2))
    a = o.examined.attribution
    limit = squares(a.base) - policy.carried[0] * (squares(a.base) - squares(o.named.fit))
    alone = {g.structure.effects[0].key for g in a.alternatives if squares(g) <= limit}
    gone = 1.0 - o.kept**2
    near = [f for f in claimed if f.weight >= policy.agreed * min(claimed[0].weight, gone) or f.key in alone]
    # where causes of that nature alone explain more than the first can, any of them that holds is the better name
    able = claimed if claimed and o.gainsaid(claimed[0].nature) else near
    seen = [f for f in able if o.share.explainable and f.nature == o.share.nature and f.key != "order"]
    other = [f for f in near if f.nature != Nature.LINEAR]
    first = (seen or other or claimed)[:1]
    return [replace(f, weight=claimed[0].weight) for f in first] + [f for f in claimed if f not in first]


def _predictable(o: Outcome, tag: str, policy: Policy) -> list[Finding]:
    """What a regression predicts of the linear model's residual on unused blocks, or a model that the test record did not bear
    has gained there beyond all luck, where no model of it could be given.
    """
    if o.examined.signatures:
        return []
    if o.bent and o.share.predicted[0] > policy.searched[1]:
        words = f"no model of it holds on unused blocks{tag}, but there is more than noise: {o.share.natures[0].sentence}"
        return [Finding("", UNKNOWN, o.share.nature, o.share.share, 0.0, words)]
    # in a loop a model may gain by hearing what the input knows of the noise
    looped = o.examined.attribution.feedback < FIRM
    if o.inverse or looped or o.passing or not o.surely(policy.lasting):
        return []
    if effective_samples(o.examined.attribution.base.residual) < INDEPENDENT:
        return []  # slow noise leaves luck a free hand: on linear records models had taken three quarters of it
    words = f"a model lowers the error on unused blocks{tag} by {_percent(o):.3g} %, but does not hold on the test record"
    return [Finding("", UNKNOWN, o.ladder.chosen.nature, 1.0, 0.0, words)]


def _percent(o: Outcome) -> float:
    return 100 * (1.0 - np.sqrt(1.0 - o.ladder.explained))


def _nameless(o: Outcome, tag: str, policy: Policy, gained: float) -> list[Finding]:
    """What the named model leaves, where more of it can be explained than the model explains."""
    if not o.left.explainable:
        return []
    value = next(r.value for r in o.ladder.rungs if r.step.kind is Kind.NAMED)
    left = o.left.share * o.ladder.left(value)
    if left <= max(gained, policy.claimed[1]):
        return []
    words = f"of what the named effects leave{tag}, {o.left.share:.0%} can be explained: {o.left.natures[0].sentence}"
    return [Finding("", UNKNOWN, o.left.nature, np.inf, 0.0, words)]


def _claimed(o: Outcome, tag: str) -> list[Finding]:
    """The named effects that hold, by what they explain on unused blocks as a share of the error there."""
    return [
        Finding(
            c.key, c.cause, c.part.effect.nature.value, c.gain.value / max(o.ladder.rungs[0].value ** 2, 1e-300), c.p_value,
            f"{c.part.effect.sentence}{tag}: the error on unused blocks is {100 * c.gain.share:.3g} % less with it, "
            f"corrected {p_stated(c.p_value)}{_assumed(o, c.key)}{_or(c)}",
        )
        for c in o.claims
    ]  # fmt: skip


def _or(c: Claim) -> str:
    return f"; it may as well be {' or '.join(c.rivals)}" if c.rivals else ""


def _seen(effects: dict[str, Effect], key: str, weight: float, p: float, sentence: str) -> Finding:
    """A finding of the catalogue that is no part of a model."""
    return Finding(key, effects[key].cause, effects[key].nature.value, weight, p, sentence)


def _data(o: Outcome, setting: Setting, effects: dict[str, Effect], tag: str) -> list[Finding]:
    """Faults of the measurement, then feedback: what shows in the samples before what a fit says."""
    p = o.examined.attribution.feedback
    order = {"held": 4.0, "quantised": 3.0, "outliers": 1.0}
    found = [_seen(effects, s.key, order.get(s.key, 0.0), 0.0, s.sentence) for s in o.examined.signatures]
    limit = 1e-2 if o.share.feedback else 1e-4 * o.of_the_best  # alone, a model's error may foretell an input
    told = p < setting.alpha * limit
    if o.loop or (told and not o.inverse):  # which two measurements of one thing may be
        what = f"past innovations help to predict the input ({p_stated(p)})" if told else ANSWERS
        found.append(_seen(effects, "feedback", 2.0, p, f"{what}{tag}: the data are from a closed loop"))
    return found


def _noise(o: Outcome, rest: list[Leftover], effects: dict[str, Effect], tag: str) -> list[Finding]:
    """Noise that is correlated in time, beyond what the search over its orders finds in white noise.

    Where the residual surely depends on something else, a noise model stands for that and is no cause.
    """
    f = o.named.fit
    plain = (Nature.NOISE, Nature.LINEAR)
    if not len(f.noise) or any(x.p_value < SURE and x.nature not in plain for x in rest):
        return []
    plain = f.n * float(np.log(max(np.sum(f.residual**2) / f.n, 1e-300)))
    tail = float(chi2.sf(max(plain - f.deviance, 0.0), len(f.noise)))
    p = min(1.0, FAMILY * effects["coloured"].trials * tail)
    words = f"the noise is correlated in time{tag}: corrected {p_stated(p)}"
    return [_seen(effects, "coloured", 0.0, p, words)] if p < LEVEL else []


LEVEL = 0.01
"""Of the noise model's likelihood ratio, corrected for the orders tried."""


def _dropped(outcomes: Sequence[Outcome], several: bool, effects: dict[str, Effect]) -> list[str]:
    return [
        f"not claimed{on_output(o, several)}: {effects[key].cause} ({why})"
        for o in outcomes
        for key, why in o.named.dropped
    ]


def _unexplained(o: Outcome, rest: list[Leftover], alpha: float, tag: str) -> list[Finding]:
    """What the tests of the residual still show, where it weighs more than all that was found."""
    a, f = o.examined.attribution, o.named.fit
    if o.examined.signatures or o.ladder.chosen.kind in (Kind.DISCOVERED, Kind.REMAINDER):
        return []
    # an input that knows the noise makes any residual depend on it
    if o.inverse or o.share.feedback or not o.of_the_best:
        return []
    explained = 0.0
    if (
        o.named.claims
    ):  # in one-step errors, or in simulation errors: a noise model predicts part of any model error
        before = float(np.mean(a.base.residual[o.examined.channel.keep] ** 2))
        after = float(np.mean(f.residual[o.examined.last.keep] ** 2))
        explained = max(
            a.coloured.criterion - f.criterion, f.n * float(np.log(before / max(after, 1e-300))), 0.0
        )
    limit = SURE if o.named.claims or len(f.noise) else alpha / 10
    bursts = any(item.nature == Nature.NOISE for item in rest)
    for item in rest:
        noisy = item.nature == Nature.NOISE
        if item.p_value >= (SURE if noisy else limit) or item.nature == Nature.LINEAR:
            continue  # the linear model is the best there is on unused blocks: another is no cause
        # slow or narrow noise looks like what is added, bursts look like what changes with time; others go with it
        looks = (Nature.ADDED, Nature.TIME) if bursts else (Nature.ADDED,)
        most = item is rest[0] and item.nature not in looks
        telling = most and item.gain > TELLING * f.n and item.p_value < FIRM < a.feedback
        if not (noisy or o.left.explainable or telling):
            continue  # a significant dependence that predicts nothing on unused blocks
        if (noisy and not o.named.claims and not len(f.noise)) or (
            not noisy and item.gain > max(0.5 * explained, LEAST)
        ):
            words = "what is left" if item.key else "no effect of the catalogue explains what is left"
            cause = named(item.key).cause if item.key else UNKNOWN
            return [
                Finding(
                    item.key, cause, str(item.nature), np.inf, item.p_value, f"{words}{tag}: {item.sentence}"
                )
            ]
    return []


SURE = 1e-6
"""Significance under a noise model or beside an effect is less sure than it says."""
TELLING, FIRM = 0.08, 1e-12
"""Likelihood ratio per sample (a twelfth of the innovations' variance) and significance from which on a dependence is no
accident of a noise model, though no regression predicts it on unused blocks; but slow or narrow noise is a trend or a line, and
goes with whatever else is slow, and an input that follows the noise makes any residual depend on it."""
LEAST = 6.0
"""Of Schwarz's criterion: odds of twenty to one."""


def _tried(outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    """The single effects, by what they gain."""
    pool: dict[str, float] = {}
    for o in outcomes:
        for c in o.examined.attribution.claims:
            pool[c.cause] = pool.get(c.cause, 0.0) + max(c.gain, 0.0)
    return tuple(k for k, gain in sorted(pool.items(), key=lambda x: -x[1]) if gain > 0)


def _confusable(outcomes: Sequence[Outcome], chosen: list[str]) -> tuple[str, ...]:
    claims = [c for o in outcomes for c in o.named.claims if chosen and c.cause == chosen[0]]
    return tuple(dict.fromkeys(name for c in claims for name in c.rivals))


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
