"""What the named stage claims of one output: effects in a joint model, and why others are not claimed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects import Effect, Slot
from estimators.diagnosis.ladder.steps import Gain, Step
from estimators.diagnosis.model.fitting import Fit
from estimators.diagnosis.model.structure import Part
from estimators.diagnosis.result.answers import NamedAnswer

if TYPE_CHECKING:
    from estimators.diagnosis.search.named import Bench

Array = NDArray[Any]

ANYTHING = "effects of several natures do as well, and a regression predicts nothing of what is left"
NOTHING_NEW = "a linear predictor of the output gains nothing from it"
TOO_SLOW = "what it explains goes together with what is left over too few independent samples: slow noise does so by chance"
NATURES = 3
"""Natures of equal rivals from which on a single effect is no cause: two are one place seen from both sides."""


@dataclass(frozen=True, eq=False)
class Claim:
    """One effect of the joint model: what it gains on unused blocks there, its significance there, and its rivals."""

    part: Part
    gain: Gain
    p_value: float
    rivals: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Key of the catalogue."""
        return self.part.key

    @property
    def cause(self) -> str:
        """The cause, in the words of the vocabulary."""
        return self.part.effect.cause


@dataclass(frozen=True, eq=False)
class Named:
    """The joint model of one output with the effects that hold, and what was dropped on the way."""

    fit: Fit
    claims: tuple[Claim, ...]  # largest gain first
    dropped: tuple[tuple[str, str], ...]  # key, and why in words
    step: Step | None  # None where nothing holds
    unused: Array = field(default_factory=lambda: np.zeros(0))  # (N,) of unused blocks; empty for no effects
    alike: tuple[Effect, NamedAnswer] | None = None  # linear dynamics that fit as well as its one bent effect
    bent: tuple[Claim, ...] = ()  # the claim of that, where they stand in for it
    refused: tuple[Claim, ...] = ()  # what is not claimed, though the model has it

    def without_claims(self, why: str) -> Named:
        """The same model, of which nothing is claimed for a reason."""
        dropped = (*self.dropped, *((c.key, why) for c in self.claims))
        return replace(self, claims=(), refused=self.claims, dropped=dropped)

    def with_refused(self) -> Named:
        """With the claims that were not made, where other data make them."""
        if not self.refused:
            return self
        keys = [c.key for c in self.refused]
        return replace(
            self, claims=self.refused, refused=(), dropped=tuple(d for d in self.dropped if d[0] not in keys)
        )

    def as_linear(self) -> Named:
        """With the linear dynamics as the cause in place of the bent effect that they fit as well as."""
        if self.alike is None or not self.claims or self.bent:
            return self
        head = self.claims[0]
        names = tuple(n for n in dict.fromkeys((*head.rivals, head.cause)) if n != self.alike[0].cause)
        part = replace(head.part, effect=self.alike[0])
        return replace(self, claims=(Claim(part, head.gain, head.p_value, names),), bent=self.claims)

    def anything(self, effects: Iterable[Effect]) -> bool:
        """Whether its one effect has equals of so many natures that unused blocks tell nothing of which it is."""
        names = {name for c in self.claims for name in c.rivals}
        return len(self.claims) == 1 and len({e.nature for e in effects if e.cause in names}) >= NATURES

    @property
    def whole(self) -> bool:
        """Whether every effect of the joint model holds, but for forms that others stand in."""
        return len(self.claims) >= sum(q.effect.slot is not Slot.FORM for q in self.fit.structure.effects)

    def step_error(self, bench: Bench) -> float:
        """Root mean square error of its step on unused blocks."""
        return bench.error(self.unused) if len(self.unused) else float("inf")
