"""The form of a model: a linear part and the effects around and inside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.catalogue import CATALOGUE, Effect
from estimators.diagnosis.model.layouts import LAYOUTS

__all__ = ["Part", "Structure"]


@dataclass(frozen=True)
class Part:
    """One effect in a structure: its key in the catalogue, the input it concerns, how many terms it has.

    Attributes
    ----------
    key : str
        Key of the effect in the catalogue.
    channel : int
        The input it concerns, from 0.
    size : int
        How many terms it has.
    """

    key: str
    channel: int = 0
    size: int = 1

    @property
    def effect(self) -> Effect:
        """The catalogue's entry."""
        return CATALOGUE[self.key]

    def parameters(self, order: int) -> list[tuple[str, str]]:
        """Names and units of the parameters, given the order of the linear part.

        Parameters
        ----------
        order : int
            Order of the linear part.

        Returns
        -------
        list of tuple of str
            In the order in which they stand in the vector.
        """
        known = self.effect
        signal = "y" if known.slot == "output" else "u"
        numbered = lambda names, count: [(f"{n}{i + 1}", u) for i in range(count) for n, u in names]
        corners = [("slope", "1"), ("corner", signal)]
        if (
            self.key == "sandwich"
        ):  # size = order of the first block + 100 times the corners of the nonlinearity
            first = self.size % 100
            blocks = numbered([("f", "1")], first) + numbered([("b", "1")], first)
            return blocks + numbered(corners, self.size // 100)
        if self.key in ("input_lines", "output_lines"):
            return numbered(corners, self.size)
        if self.key in ("cross", "mode"):
            return numbered([("b", "y/u")], self.size) + numbered([("f", "1")], self.size)
        if self.key == "initial":
            return numbered([("x", "y")], order)
        if self.key == "tones" and self.size > 1:
            return numbered(list(zip(known.parameters, known.units, strict=True)), self.size)
        return list(zip(known.parameters, known.units, strict=True))

    def count(self, order: int) -> int:
        """Number of parameters, given the order of the linear part.

        Parameters
        ----------
        order : int
            Order of the linear part.

        Returns
        -------
        int
            Number of parameters.
        """
        return len(self.parameters(order))


@dataclass(frozen=True)
class Structure:
    """The linear part's order and layout, and the parts added to it.

    Attributes
    ----------
    order : int
        Order of the linear part.
    inputs : tuple of int
        Which inputs act on this output.
    layout : str
        "tf" or a key of LAYOUTS.
    delay : int
        Whole samples of delay beyond the first.
    taps : int
        Numerator coefficients per input.
    parts : tuple of Part
        Effects.
    base : int
        How many of the parts belong to the linear model itself (offset, initial state of real records).
    """

    order: int
    inputs: tuple[int, ...] = (0,)
    layout: str = "tf"
    delay: int = 0
    taps: int = 0
    parts: tuple[Part, ...] = ()
    base: int = 0

    def __post_init__(self) -> None:
        if self.taps == 0:
            object.__setattr__(self, "taps", self.order)

    @property
    def plant_size(self) -> int:
        """Number of parameters of the linear part."""
        if self.layout == "tf":
            return self.order + self.taps * len(self.inputs)
        if self.layout == "tanks":
            return LAYOUTS["tanks"][1]
        return LAYOUTS[self.layout][1] + self.order + self.taps * (len(self.inputs) - 1)

    @cached_property
    def size(self) -> int:
        """Number of parameters."""
        return self.plant_size + sum(p.count(self.order) for p in self.parts)

    def slices(self) -> list[slice]:
        """Where each part's parameters stand in the vector.

        Returns
        -------
        list of slice
            One per part.
        """
        return self._slices

    @cached_property
    def _slices(self) -> list[slice]:
        out, start = [], self.plant_size
        for part in self.parts:
            out.append(slice(start, start + part.count(self.order)))
            start = out[-1].stop
        return out

    def keeping(self, wanted: Sequence[bool]) -> tuple[Structure, NDArray[np.int_]]:
        """The structure with some of its parts only.

        Parameters
        ----------
        wanted : sequence of bool
            For every part, whether it stays.

        Returns
        -------
        structure : Structure
            With those parts.
        places : ndarray of int
            Where its parameters stand in the vector of this structure.
        """
        parts = tuple(part for part, stays in zip(self.parts, wanted, strict=True) if stays)
        stays = np.ones(self.size, dtype=bool)
        for sl, kept in zip(self._slices, wanted, strict=True):
            stays[sl] = kept
        return replace(self, parts=parts, base=sum(wanted[: self.base])), np.flatnonzero(stays)

    def adding(self, part: Part) -> Structure:
        """The structure with one more part.

        Parameters
        ----------
        part : Part
            The effect to add.

        Returns
        -------
        Structure
            A new structure.
        """
        return replace(self, parts=(*self.parts, part))

    @property
    def effects(self) -> tuple[Part, ...]:
        """The parts that are not of the linear model itself."""
        return self.parts[self.base :]
