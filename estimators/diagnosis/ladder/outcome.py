"""What was found for one output, before anything is said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimators.diagnosis.discovery import Discovery
from estimators.diagnosis.discovery.found import leading_nature
from estimators.diagnosis.effects import Nature
from estimators.diagnosis.ladder.claims import Claim, Named
from estimators.diagnosis.ladder.steps import Kind, Ladder, Step, parameters_of
from estimators.diagnosis.model.fitting import ar_model, innovations
from estimators.diagnosis.model.forces import effective_samples
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.result.answers import LinearAnswer
from estimators.diagnosis.search.examination import Examined
from estimators.diagnosis.search.named import CLOCKED, INDEPENDENT
from estimators.diagnosis.share import Share
from oed.covariances import NORMAL
from oed.data import Record

FAILED = "its run on the test record is no answer"
UNSURE = "unused blocks are not surely better with it"
WORSE = 1.1
"""One-step error, of the best linear model's on unused blocks, up to which a fit, which has seen them, is as good."""
TWICE = 2.0
"""Squared error of the named model on unused blocks, up to which a regression explains as much: it has many more columns."""
WHOLE = 0.1
"""Of the linear model's error on unused blocks, below which what a named model leaves may be noise alone."""
RESTORING = {"duffing", "pendulum", "position_periodic_force"}
"""Names of one place, a force of the position: a record that turns by a part of a circle tells no sine from another spring."""
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
    loop: bool = False  # by so much of an input that a closed loop is told
    apart: bool = False  # beside an inverse: named effects that answer no input at once, and are none, halve the error as well

    def value(self, kind: Kind) -> float:
        """Least error on unused blocks of the steps of a kind; infinite where there is none."""
        return min((r.value for r in self.ladder.rungs if r.step.kind is kind), default=np.inf)

    def by_the_clock(self, train: Record) -> Outcome:
        """With a linear model whose level settles on the training record's clock: no other record begins with it anew."""
        rungs = self.ladder.rungs
        if not isinstance(linear := rungs[0].step.answer, LinearAnswer):
            return self
        answer = replace(linear, since=(train.t0, train.dt))
        first = replace(rungs[0], step=replace(rungs[0].step, answer=answer))
        return replace(self, ladder=replace(self.ladder, rungs=(first, *rungs[1:])))

    def standing(self, step: Step) -> Outcome:
        """With the step that stands on a record as the answer, in place of one that does not, whose names go with it; a linear one
        leaves open what is missing. One that was refused gets its names back where unused blocks are surely better with it too.
        """
        chosen = self.ladder.chosen
        if step is chosen or step.kind is Kind.LINEAR:
            return self
        at = next(i for i, r in enumerate(self.ladder.rungs) if r.step is step)
        out = replace(self, ladder=replace(self.ladder, answer=at), inverse=self.inverse or step.echo)
        before, after = ({s.kind for s in q.chain} for q in (chosen, step))
        if Kind.NAMED in before - after:
            return replace(out, named=self.named.without_claims(FAILED))
        if Kind.NAMED not in after - before:
            return out
        sure = self.ladder.rungs[at].figure.high < self.ladder.rungs[0].value
        return replace(out, named=self.named.with_refused() if sure else self.named.without_claims(UNSURE))

    @property
    def bent(self) -> bool:
        """Whether a regression predicts what the linear model leaves, and not by linear dynamics."""
        return self.share.explainable and self.share.nature not in (Nature.LINEAR, Nature.NOISE)

    @property
    def of_the_best(self) -> bool:
        """Whether the residual that was tested is that of a model as good as the best linear one: what a worse one leaves depends
        on anything that the better one knows. One-step errors, which a noise model does not flatter on one side only.
        """
        f, c, unused = self.named.fit, self.examined.last, self.ladder.linear.unused[0]
        if len(unused) != len(c):  # a thinned record: its simulation errors
            return float(np.sqrt(np.mean(f.residual[c.keep] ** 2))) <= WORSE * self.ladder.rungs[0].value
        use = c.keep & self.ladder.counted[0]
        e = np.where(use, c.y - unused, 0.0)
        return f.variance <= WORSE**2 * float(np.mean(innovations(e, ar_model(e)[0])[use] ** 2))

    @property
    def passing(self) -> bool:
        """Whether the answer runs by the clock and leaves an error as slow as itself: it may be a stretch of slow noise."""
        left = np.nan_to_num(self.ladder.rungs[self.ladder.answer].errors)
        return self.ladder.chosen.nature in CLOCKED and not effective_samples(left) > INDEPENDENT

    def surely(self, share: float) -> bool:
        """Whether the answer bends, and takes so large a share of the error on unused blocks: with intervals that lie apart, or
        where a regression predicts some of it too.
        """
        first, last = self.ladder.rungs[0], self.ladder.rungs[self.ladder.answer]
        bends = last.step.nature not in ("", Nature.LINEAR)
        return (
            bends
            and last.value < (1.0 - share) * first.value
            and (last.figure.high < first.figure.low or self.bent)
        )

    def behind(self, nature: str) -> bool:
        """Whether causes of another nature surely explain more than those of this one do, without any model of them."""
        if self.share.feedback or not self.bent:
            return False
        best, own = self.share.natures[0], [e for e in self.share.natures if e.nature == nature]
        return any(e.high < best.low for e in own)

    @property
    def kept(self) -> float:
        """Error of the named model on unused blocks, of the linear one's, 1 at most; nothing of nothing."""
        return min(1.0, self.value(Kind.NAMED) / max(self.value(Kind.LINEAR), 1e-300))

    def gainsaid(self, nature: str) -> bool:
        """Whether causes of another nature, without any model of them, explain as much as the named model does, and surely more
        than those of this one do: a cousin of the truth bends until it fits, a regression of its place alone does not. But it does
        not bend until nothing of what is left can be explained and that is a tenth of the error, or surely less than the other causes
        leave.
        """
        if not self.behind(nature):
            return False
        best, left = self.share.natures[0], self.kept**2
        whole = (self.kept < WHOLE or left < 1.0 - best.high) and not self.left.explainable
        return not whole and 1.0 - best.share <= TWICE * left

    @property
    def terms(self) -> int:
        """Number of terms discovered for this output."""
        return sum(t.output == self.index for t in self.discovery.terms)

    @property
    def discovered(self) -> str:
        """The nature of the terms discovered for this output; empty where there are none."""
        mine = [t for t in self.discovery.terms if t.output == self.index]
        return leading_nature(mine) if mine else ""

    def agrees(self, nature: str, cause: str) -> bool:
        """Whether a named cause is what the discovered terms are: of a nature with some of their weight, and of a term's name where
        many causes have it.
        """
        found = {t.same_as for t in self.discovery.terms if t.output == self.index}
        alike = RESTORING if cause in RESTORING else {cause}
        told = nature != Nature.DYNAMIC or bool(alike & found)
        return told and (nature == self.discovered or self.weighs(nature))

    def _blank(self, key: str) -> bool:
        """Whether no parameter of a named effect is told from nothing in the final joint fit."""
        steps = [r.step for r in self.ladder.rungs if r.step.kind is Kind.NAMED]
        own = [row for s in steps for row in parameters_of(s, key).values()]
        return bool(own) and all(abs(value) <= NORMAL * error for value, error, _ in own)

    @property
    def claims(self) -> Sequence[Claim]:
        """The claims of which a parameter is told from nothing; all where none is."""
        return [c for c in self.named.claims if not self._blank(c.key)] or self.named.claims

    def unsure(self, key: str, cause: str) -> bool:
        """Whether neither a named effect nor any of the discovered terms of its cause is told from nothing in its joint fit."""
        terms = [t.sure for t in self.discovery.terms if t.output == self.index and t.same_as == cause]
        return self._blank(key) and not any(terms)

    def weighs(self, nature: str) -> bool:
        """Whether the discovered terms of a nature have some of their weight."""
        mine = [t for t in self.discovery.terms if t.output == self.index]
        return sum(t.weight for t in mine if t.nature == nature) > SOME * sum(t.weight for t in mine)

    def named_carries(self, policy: Policy, agreed: bool = False) -> bool:
        """Whether the named model is so near the answer on unused blocks that its names stand for both: less, if some agree with it;
        never where it needs more effects than the answer has terms."""
        linear, answer = self.value(Kind.LINEAR) ** 2, self.ladder.rungs[self.ladder.answer].value ** 2
        named, (share, factor) = self.value(Kind.NAMED) ** 2, policy.carried
        share = policy.agreed if agreed else share
        alike = agreed or any(
            self.agrees(c.part.effect.nature, c.part.effect.cause) for c in self.named.claims[:1]
        )
        found = any(s.kind is Kind.DISCOVERED for s in self.ladder.chosen.chain)
        if found and not agreed and self.terms < len(self.named.claims):
            return False
        near = named <= factor**2 * answer or (alike and found)
        return linear - named >= share * (linear - answer) and answer < linear and near
