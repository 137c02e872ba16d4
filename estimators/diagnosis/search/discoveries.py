"""The discovered stage: terms of no catalogue for every output, together where outputs may push one another, and as steps of the ladder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline import Baseline, Options, best_linear, of_output
from estimators.diagnosis.discovery import BUDGETS, Discovery, discover
from estimators.diagnosis.discovery.search import Budget
from estimators.diagnosis.ladder.claims import Named
from estimators.diagnosis.ladder.steps import Kind, Step, paired_gain
from estimators.diagnosis.policy import Setting
from estimators.diagnosis.record.admission import LEAST
from estimators.diagnosis.result.answers import DiscoveredAnswer
from estimators.diagnosis.search.examination import Examined
from estimators.diagnosis.search.named import Bench
from estimators.diagnosis.share import Share
from oed.data import Record

Array = NDArray[Any]
TOGETHER = 2
"""Outputs whose terms are looked for in one search, as one axis may push the other: what it costs and holds in memory grows with the
fourth power of their number. Of more, each is looked at alone."""
LATER = 1
"""Samples by which an input may act later on one output than on another in one search, whose models see it at one time: later outputs
have no poles to spare for more."""


@dataclass(frozen=True, eq=False)
class Discovered:
    """What was discovered of output `output`, from `records` and their linear model `base`, of whose outputs it is `column`."""

    output: int
    column: int
    records: Sequence[Record]
    base: Baseline
    found: Discovery
    again: Callable[[], tuple[Baseline, Discovery]]  # both made without the last block
    setting: Setting

    def step(self) -> Step | None:
        """The model as a step of the ladder; None where nothing was found."""
        d = self.found
        if d.model is None:
            return None
        terms = [t for t in d.terms if t.output == self.output]
        parameters = {
            f"term {k + 1}.{name}": v for k, t in enumerate(terms) for name, v in t.parameters.items()
        }
        answer = lambda model: DiscoveredAnswer(self.output, model)
        return Step(
            Kind.DISCOVERED, tuple(t.text for t in terms), tuple(u[:, self.column] for u in d.unused), answer(d.model),
            len(d.model.theta), parameters, tuple(t.meaning for t in terms), d.equation, nature=d.nature,
            folds=tuple(map(answer, d.folds)), rivals=tuple(map(answer, d.rivals)),
        )  # fmt: skip

    def confirmed(self, counted: Sequence[Array]) -> bool:
        """Whether a search that never saw the last block finds terms that simulate it better.

        The parameters of a discovered model did not see the blocks that vouch for it, but the search for its terms did.
        """
        (linear, again), last = self.again(), self.base.blocks.blocks[-1]
        if again.model is None:
            return False
        unseen, use = self.records[last.record], counted[last.record].copy()
        use[: last.start] = False
        runs = [m.simulate(unseen, self.base.blocks.window)[:, self.column] for m in (linear, again.model)]
        y = np.nan_to_num(unseen.y[:, self.column])
        gain = paired_gain([y], runs[:1], runs[1:], [use], self.setting.policy)
        return gain.meets(self.setting.policy.claimed)


HALVED, LITTLE = 0.5, 0.25
"""Of the linear model's error, what named effects leave, and of the variance of that the share that may at the most be explainable, for
no terms of none to be looked for: all that they could explain then is an eighth of the error that is left."""


def nothing_left(found: Examined, bench: Bench, named: Named, left: Share) -> bool:
    """Whether there is no term and no remainder in what one output leaves: nothing of it is explainable, and it is white, or named
    effects leave little that could be."""
    if left.explainable or named.step is None:
        return not (left.explainable or len(found.attribution.coloured.noise))
    halved = named.step_error(bench) < HALVED * bench.error(bench.linear)
    return not len(named.fit.noise) or (halved and left.high < LITTLE)


def discovered(
    records: Sequence[Record], base: Baseline, setting: Setting, options: Options, exhausted: Sequence[bool]
) -> list[Discovered]:
    """The discovered stage of every output; no search where all that it would look at is `exhausted`.

    Outputs are looked at together. Where the linear models have the inputs act on some of them later, which what is missing may only
    seem to, that stands if it betters every output: else each is looked at by itself.
    """
    outputs = range(len(base.outputs))
    if len(outputs) <= TOGETHER:
        both = _searched(records, base, setting, options, all(exhausted))
        found = both[0]
        better = found.model is not None and bool(np.all(found.rmse_unused < base.rmse_unused))
        if better or all(exhausted) or _at_one_time(base):
            return [Discovered(i, i, records, base, *both, setting) for i in outputs]
    out = []
    for i in outputs:
        own, mine = [of_output(r, i) for r in records], base.alone(i)
        found, again = _searched(own, mine, setting, replace(options, diagonal=False), exhausted[i])
        found = replace(found, terms=tuple(replace(t, output=i) for t in found.terms))
        out.append(Discovered(i, 0, own, mine, found, again, setting))
    return out


def _at_one_time(base: Baseline) -> bool:
    """Whether the inputs act on all outputs at nearly one time, as far as the same ones act on all."""
    delays = [m.shared[1] for m in base.outputs]
    return len({len(d) for d in delays}) > 1 or bool(np.all(np.ptp(delays, axis=0) <= LATER))


def _searched(
    records: Sequence[Record], base: Baseline, setting: Setting, options: Options, exhausted: bool
) -> tuple[Discovery, Callable[[], tuple[Baseline, Discovery]]]:
    """What is found, and how to look again without the last block."""
    budget, skip = BUDGETS[setting.effort.value], setting.skip
    found = Discovery(None, sought=False) if exhausted else discover(records, base, budget, skip)
    return found, cache(lambda: _without_the_last_block(records, base, found, budget, options, skip))


def _without_the_last_block(
    records: Sequence[Record], base: Baseline, whole: Discovery, budget: Budget, options: Options, skip: int
) -> tuple[Baseline, Discovery]:
    """The linear model and what is discovered from the records without the last block and what is beside that.

    The second search is as wide as the `whole` one's answer needs.
    """
    last = base.blocks.blocks[-1]
    unseen = records[last.record]
    head = unseen[: max(0, last.start - base.blocks.guard)]
    heads = [*(r for r in records if r is not unseen), *([head] if len(head) >= LEAST else [])]
    linear = best_linear(heads, options)
    if whole.model is not None:
        budget = budget.about(whole.model.form.orders, len(whole.terms))
    return linear, discover(heads, linear, budget, skip)
