"""The first line of a diagnosis: the effect in words with its parameters and their units, as an engineer would say it."""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from estimators.diagnosis.effects import Effect
from estimators.diagnosis.ladder.outcome import Outcome
from estimators.diagnosis.ladder.steps import Kind, Step, parameters_of
from estimators.diagnosis.result.words import named_plainly, spoken
from oed.data import Record

if TYPE_CHECKING:
    from estimators.diagnosis.ladder.verdicts import Finding

UNKNOWN = "unknown"
NAMELESS = "an effect without a name"
MOST = 4
"""Parameters in the headline: a curve of many corners is given below it."""
INSIDE = "it is borne out only where the test record stays in the range of the training data"
UNJUDGED = "the test record asks for more than the training data cover, and does not bear it"
COEFFICIENT = re.compile(r"[bfx]\d+")
"""Coefficients and states of a linear block say nothing in a headline."""


def headline(
    top: "Finding", outcomes: Sequence[Outcome], effects: dict[str, Effect], record: Record, bears: bool
) -> str:
    """What is missing from the system; `bears` whether the record bears the answer, so that its terms may be told."""
    several = len(outcomes) > 1
    terms = _terms(outcomes, top.cause) if bears else ""
    if top.cause == UNKNOWN:
        return f"{NAMELESS} ({top.nature}){': ' + terms if terms else ''}"
    name = top.cause.replace("_", " ")
    if not top.key:
        return f"{name}{': ' + terms if terms else ''}"
    claimed = [o for o in outcomes if any(c.key == top.key for c in o.named.claims)]
    given = [f"{named_plainly(key, alone=True)} {spoken(*row, record)}{on_output(o, several)}"
             for o in outcomes for key, row in _known(o, top.key).items()]  # fmt: skip
    if given and top.key in effects:
        return f"{name} ({effects[top.key].sentence}): {', '.join(given[:MOST])}"
    if (
        claimed
    ):  # its numbers are coefficients, which say nothing; what it gains is evidence, and stands below
        where = " and".join(on_output(o, several) for o in claimed)
        return f"{name} ({effects[top.key].sentence}){where}{_instead(claimed, top.key, effects)}"
    return f"{name}: {top.sentence}"


def doubts(rivals: Sequence[str], unjudged: bool, within: bool = False) -> list[str]:
    """Why the first cause may be another: the record cannot tell it from its rivals, or no data unlike the training data bear it."""
    words = [f"it may as well be {' or '.join(rivals).replace('_', ' ')}"] if rivals else []
    return [*words, *([UNJUDGED] if unjudged else []), *([INSIDE] if within else [])]


def _instead(claimed: Sequence[Outcome], key: str, effects: dict[str, Effect]) -> str:
    """What the answer has where linear dynamics are told in its place, as they do as well."""
    steps = [s for o in claimed for s in o.ladder.chosen.chain if s.kind is Kind.NAMED and key not in s.adds]
    other = [effects[k] for s in steps for k in s.adds if k in effects]
    return (
        f" or {other[0].cause.replace('_', ' ')} ({other[0].sentence}), as the answer has it" if other else ""
    )


def on_output(o: Outcome, several: bool) -> str:
    """Which output it is of, where there are several."""
    return f" on output {o.index + 1}" if several else ""


def equations(outcomes: Sequence[Outcome]) -> list[str]:
    """What was discovered of all outputs; those of one model have it in common."""
    return list(dict.fromkeys(s.equation for o in outcomes for s in o.ladder.chosen.chain if s.equation))


def _terms(outcomes: Sequence[Outcome], cause: str) -> str:
    """The heaviest discovered term of a cause, or of all, with what it means, and how many more there are."""
    steps = [s for o in outcomes for s in o.ladder.chosen.chain if s.equation and s.adds]
    if not steps:
        return ""
    told = [pair for s in steps for pair in zip(s.sentences, s.adds, strict=True)]
    of_cause = {t.text for o in outcomes for t in o.discovery.terms if t.same_as == cause}
    meaning, text = next((pair for pair in told if pair[1] in of_cause), told[0])
    more = len(told) - 1
    return f"{meaning}, {text}" + (f", and {more} more term{'s' * (more > 1)}" if more else "")


def _known(o: Outcome, effect: str) -> dict[str, tuple[float, float, str]]:
    """An effect's parameters in the answer, or in the named model where the answer has it as terms."""
    named = [r.step for r in o.ladder.rungs if r.step.kind is Kind.NAMED] if o.named.claims else []
    return next(filter(None, (_of(s, effect) for s in (*o.ladder.chosen.chain, *named))), {})


def _of(step: Step, effect: str) -> dict[str, tuple[float, float, str]]:
    own = parameters_of(step, effect).items()
    return {k: v for k, v in own if not COEFFICIENT.fullmatch(k.rpartition(".")[2])}
