"""Terms as they were found: text, nature, parameters and curve of each, and which of them is most of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
MOST = 0.6  # of the terms' weight, that one nature must have to be the equation's


@dataclass(frozen=True, eq=False)
class Curve:
    """A term along its first signal: grid and values (GRID,) in the user's units, half width of the 95 % band."""

    signal: str
    unit: str
    grid: Array
    value: Array
    band: Array
    value_unit: str


@dataclass(frozen=True, eq=False)
class FoundTerm:
    """One term: its text with coefficient, nature, meaning, the catalogue's name, parameters (value, error, unit)."""

    text: str
    slot: str
    output: int
    nature: str
    meaning: str
    same_as: str
    parameters: dict[str, tuple[float, float, str]]
    curve: Curve
    # squares of the outputs (in their spreads) that its curve moves beyond a linear model, by term; whether the joint fit tells a
    # coefficient of it from nothing, or others are the same curve
    weight: float = 0.0
    sure: bool = True


def strongest_first(terms: Sequence[FoundTerm], bent: Array) -> list[FoundTerm]:
    """Terms with their weights, the heaviest first; `bent` (samples, terms) is what each moves beyond a linear model.

    Terms of the same signal and meaning are one curve and share its weight: two may nearly cancel, each unsure beside the other.
    """
    out = []
    for t in terms:
        alike = [
            i
            for i, q in enumerate(terms)
            if (q.slot, q.output, q.meaning, q.curve.signal) == (t.slot, t.output, t.meaning, t.curve.signal)
        ]
        power = float(np.sum(np.sum(bent[:, alike], axis=1) ** 2))
        out.append(replace(t, weight=power / len(alike), sure=t.sure or len(alike) > 1))
    return sorted(out, key=lambda t: -t.weight)


def leading_nature(terms: Sequence[FoundTerm]) -> str:
    """The nature that has most of the terms' weight; where none has, several places act at once, which is dynamic."""
    total = sum(t.weight for t in terms)
    natures = {t.nature: sum(q.weight for q in terms if q.nature == t.nature) for t in terms}
    top = max(natures, key=lambda n: natures[n])
    return top if natures[top] >= MOST * total else "dynamic nonlinearity"
