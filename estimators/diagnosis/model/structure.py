"""The form of a model: a linear part and the effects around and inside it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Effect, Slot, level_before, numbered
from estimators.diagnosis.model.layouts import LAYOUTS, STEPS
from estimators.residual.algebra import stable

Array = NDArray[Any]


def stable_polynomial(f: Array, limit: float = 0.99999) -> bool:
    """Whether 1 + f1 z^-1 + ... (f without its leading 1) is stable, and told from one that is not."""
    return stable(f, limit)


@dataclass(frozen=True)
class Part:
    """One effect in a structure: the input that it concerns, how many terms it has, and the poles of a linear block before it.

    The block has a gain of 1 and starts settled, or (`free`) as many zeros as poles after a first tap of 1 and starts at rest.
    """

    effect: Effect
    channel: int = 0
    size: int = 1
    first: int = 0
    free: bool = False

    @property
    def key(self) -> str:
        """The effect's key."""
        return self.effect.key

    @property
    def own(self) -> int:
        """Where the effect's own parameters start, after those of the block."""
        return self.first * (2 if self.free else 1)

    @property
    def enters(self) -> bool:
        """Whether it, or the linear block before it, acts on an input."""
        slot = self.effect.slot
        return slot is Slot.INPUT or (self.first > 0 and slot in (Slot.PLANT, Slot.FORM))

    def parameters(self, order: int) -> list[tuple[str, str]]:
        """Names and units in the order of the parameter vector, given the order of the linear part."""
        block = numbered({"f": "1"}, self.first) + (numbered({"b": "1"}, self.first) if self.free else [])
        shape = self.effect.shape
        return block + (list(self.effect.parameters.items()) if shape is None else shape(self.size, order))

    def times(self, order: int) -> tuple[int, ...]:
        """Which of its parameters are times of a change: the last one, each time that the effect comes."""
        if not self.effect.timed:
            return ()
        last = list(self.effect.parameters)[-1]
        return tuple(
            i for i, (name, _) in enumerate(self.parameters(order)) if name.rstrip("0123456789") == last
        )

    def count(self, order: int) -> int:
        """Number of parameters, given the order of the linear part."""
        return len(self.parameters(order))

    def apply(self, x: Array, p: Array, clock: Clock) -> Array:
        """The signal after this part: through its linear block, then the effect; infinite where the parameters are not admissible."""
        if self.effect.apply is None:
            return x
        x = self.blocked(x, p)
        return self.effect.apply(x, p[self.own :], clock) if math.isfinite(x[-1]) else x

    def drawn(self, x: Array, p: Array) -> Array | None:
        """The effect's characteristic at x, None where it is no curve."""
        return self.effect.drawn(x, p[self.own :])

    def blocked(self, x: Array, p: Array) -> Array:
        """The signal after the linear block, where the effect acts."""
        if not self.first:
            return x
        f = np.concatenate(([1.0], p[: self.first]))
        if not stable_polynomial(f[1:]):
            return np.full(len(x), np.inf)
        if self.free:
            return np.asarray(lfilter(np.concatenate(([1.0], p[self.first : self.own])), f, x))
        level = level_before(x)
        return level + np.asarray(lfilter([f.sum()], f, x - level))


@dataclass(frozen=True)
class Structure:
    """The linear part's order and layout, and the parts added to it.

    `order` order of the linear part; `inputs` which inputs act on this output; `layout` "tf" or a key of
    LAYOUTS; `delay` whole samples of delay beyond the first; `taps` numerator coefficients per input; `parts`
    effects; `base` how many of the parts belong to the linear model itself (offset, initial state of real
    records); `steps` integration steps per sample where effects act inside a layout.
    """

    order: int
    inputs: tuple[int, ...] = (0,)
    layout: str = "tf"
    delay: int = 0
    taps: int = 0
    parts: tuple[Part, ...] = ()
    base: int = 0
    steps: int = STEPS

    def __post_init__(self) -> None:
        if self.taps == 0:
            object.__setattr__(self, "taps", self.order)

    @cached_property
    def plant_size(self) -> int:
        """Number of parameters of the linear part."""
        if self.layout == "tf":
            return self.order + self.taps * len(self.inputs)
        if self.layout == "tanks":
            return LAYOUTS["tanks"][1]
        return LAYOUTS[self.layout][1] + self.order * len(self.inputs)

    def rates(self, p: Array) -> Array:
        """Of a physical layout: its rates, and the columns by which inputs beyond the first enter."""
        head = LAYOUTS[self.layout][1]
        return np.concatenate((p[:head], p[head + self.order : self.plant_size]))

    @cached_property
    def size(self) -> int:
        """Number of parameters."""
        return self.plant_size + sum(p.count(self.order) for p in self.parts)

    def slices(self) -> list[slice]:
        """Where each part's parameters stand in the vector."""
        return self._slices

    @cached_property
    def _slices(self) -> list[slice]:
        out, start = [], self.plant_size
        for part in self.parts:
            out.append(slice(start, start + part.count(self.order)))
            start = out[-1].stop
        return out

    @cached_property
    def placed(self) -> tuple[tuple[tuple[Part, slice], ...], ...]:
        """The parts with their parameters, by where they act on the way of a signal: before the linear part, beside it, and after it, the
        sum's curves before what is added."""
        every = list(zip(self.parts, self._slices, strict=True))
        before = [x for x in every if x[0].effect.timed or x[0].enters]
        beside = [x for x in every if x[0].effect.slot is Slot.PATH]
        after = [x for slot in (Slot.OUTPUT, Slot.ADDED) for x in every if x[0].effect.slot is slot]
        return tuple(before), tuple(beside), tuple(after)

    @cached_property
    def begins(self) -> slice | None:
        """Where the initial state stands in the vector; None where it is zero."""
        every = zip(self.parts, self._slices, strict=True)
        return next((sl for part, sl in every if part.effect.slot is Slot.START), None)

    @cached_property
    def ahead(self) -> bool:
        """Whether a part reads the output beyond the end of a record."""
        return any(part.effect.ahead for part in self.parts)

    def keeping(self, wanted: Sequence[bool]) -> tuple[Structure, NDArray[np.int_]]:
        """The structure with some of its parts only."""
        parts = tuple(part for part, stays in zip(self.parts, wanted, strict=True) if stays)
        stays = np.ones(self.size, dtype=bool)
        for sl, kept in zip(self._slices, wanted, strict=True):
            stays[sl] = kept
        return replace(self, parts=parts, base=sum(wanted[: self.base])), np.flatnonzero(stays)

    def leaving(self, position: int) -> tuple[Structure, NDArray[np.int_]]:
        """The structure without one of its parts."""
        return self.keeping([i != position for i in range(len(self.parts))])

    def adding(self, part: Part) -> Structure:
        """The structure with one more part."""
        return replace(self, parts=(*self.parts, part))

    @property
    def effects(self) -> tuple[Part, ...]:
        """The parts that are not of the linear model itself."""
        return self.parts[self.base :]
