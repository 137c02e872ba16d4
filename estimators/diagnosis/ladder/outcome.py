"""What was found for one output, before anything is said of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.diagnosis.discovery import Discovery
from estimators.diagnosis.discovery.model import leading_nature
from estimators.diagnosis.effects import Nature
from estimators.diagnosis.ladder.steps import Kind, Ladder
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.search.examination import Examined
from estimators.diagnosis.search.named import Named
from estimators.diagnosis.share import Share

SOME = 0.1
"""Of the weight of the terms discovered, from which on those of a nature are no accident of a dictionary's other curves."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Everything found for one output."""

    index: int
    examined: Examined
    named: Named
    ladder: Ladder
    share: Share
    left: Share  # of what the named model leaves
    discovery: Discovery
    # the present input answers the present noise: a model may predict better by being the controller's inverse as well
    inverse: bool = False

    def value(self, kind: Kind) -> float:
        """Least error on unused blocks of the steps of a kind; infinite where there is none."""
        return min((r.value for r in self.ladder.rungs if r.step.kind is kind), default=np.inf)

    @property
    def bent(self) -> bool:
        """Whether a regression predicts what the linear model leaves, and not by linear dynamics."""
        return self.share.explainable and self.share.nature not in (Nature.LINEAR, Nature.NOISE)

    @property
    def discovered(self) -> str:
        """The nature of the terms discovered for this output; empty where there are none."""
        mine = [t for t in self.discovery.terms if t.output == self.index]
        return leading_nature(mine) if mine else ""

    def agrees(self, nature: str, cause: str) -> bool:
        """Whether a named cause is what the discovered terms are: of a nature with some of their weight, and of a term's name where
        many causes have it.
        """
        mine = [t for t in self.discovery.terms if t.output == self.index]
        names = {t.same_as for t in mine} if nature == Nature.DYNAMIC else {cause}
        return cause in names and (nature == self.discovered or self.weighs(nature))

    def weighs(self, nature: str) -> bool:
        """Whether the discovered terms of a nature have some of their weight."""
        mine = [t for t in self.discovery.terms if t.output == self.index]
        return sum(t.weight for t in mine if t.nature == nature) > SOME * sum(t.weight for t in mine)

    def named_carries(self, policy: Policy, agreed: bool = False) -> bool:
        """Whether the named model is so near the answer on unused blocks that its names stand for both: less, if some agree with it."""
        linear, answer = self.value(Kind.LINEAR) ** 2, self.ladder.rungs[self.ladder.answer].value ** 2
        named, (share, factor) = self.value(Kind.NAMED) ** 2, policy.carried
        share = policy.agreed if agreed else share
        alike = agreed or any(
            self.agrees(c.part.effect.nature, c.part.effect.cause) for c in self.named.claims[:1]
        )
        near = named <= factor**2 * answer or (
            alike and any(s.kind is Kind.DISCOVERED for s in self.ladder.chosen.chain)
        )
        return linear - named >= share * (linear - answer) and answer < linear and near
