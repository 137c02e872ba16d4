"""Blocks of the training records, and the samples that count: the one definition that every later stage uses."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.data import Record


@dataclass(frozen=True)
class Block:
    """Consecutive samples of one record.

    `record` which record; `start, stop` first sample, and the one after the last.
    """

    record: int
    start: int
    stop: int

    @property
    def rows(self) -> slice:
        """The block as a slice of its record."""
        return slice(self.start, self.stop)


@dataclass(frozen=True)
class Blocks:
    """A partition of the records into consecutive blocks, each to be simulated by a model fitted to the
    others.

    A free run begins where the record begins and runs through to the block, with the parameters of the other
    blocks.

    `lengths` samples of each record; `window` first samples of a record: they set the state of its free run
    and do not count; `guard` samples on both sides of a held-out block that no fit may use, as they are
    correlated with it; `blocks` in the order of the records and of time; together they are all samples; `once` first samples of
    the first record that do not count either: they answer a start of which no other block shows anything.
    """

    lengths: tuple[int, ...]
    window: int
    guard: int
    blocks: tuple[Block, ...]
    once: int = 0

    @property
    def shortest(self) -> int:
        """Samples of the shortest block."""
        return min(b.stop - b.start for b in self.blocks)

    def memory(self, radius: float) -> float:
        """Samples that a pole beside one of this radius may remember: a block, unless the one remembers longer."""
        return np.inf if self.slow(radius) else self.shortest

    def slow(self, radius: float) -> bool:
        """Whether a pole of this radius remembers longer than the shortest block."""
        return bool(radius > 1.0 - 1.0 / self.shortest)

    def endless(self, radius: float) -> bool:
        """Whether a pole of this radius outlives the longest record."""
        return bool(radius > 1.0 - 1.0 / max(self.lengths))

    def training(self, held_out: Block) -> list[NDArray[np.bool_]]:
        """The samples that a fit may use while a block is held out."""
        rows = [np.ones(n, dtype=bool) for n in self.lengths]
        rows[held_out.record][max(0, held_out.start - self.guard) : held_out.stop + self.guard] = False
        return rows

    def counting(self, records: Sequence[Record]) -> list[NDArray[np.bool_]]:
        """The samples that count in an error."""
        out = [np.isfinite(record.y) for record in records]
        for counts in out:
            counts[: self.window] = False
        out[0][: self.once] = False
        return out

    def scattered(self, each: int) -> list[tuple[list[Block], list[NDArray[np.bool_]]]]:
        """As many folds as blocks, each of `each` stretches all over the records, with the samples that a fit may use.

        For what goes one way through its range, as a charge that is used up: a whole block held out is a part of the range
        that no other block has seen.
        """
        parts = [
            Block(b.record, i, j)
            for b in self.blocks
            for i, j in itertools.pairwise(np.linspace(b.start, b.stop, each + 1).astype(int).tolist())
        ]
        fine = Blocks(
            self.lengths, self.window, min(self.guard, (parts[0].stop - parts[0].start) // 4), tuple(parts)
        )
        folds = [parts[k :: len(self.blocks)] for k in range(len(self.blocks))]
        masks = [
            [np.logical_and.reduce(m) for m in zip(*(fine.training(b) for b in fold), strict=True)]
            for fold in folds
        ]
        return list(zip(folds, masks, strict=True))

    def batches(self, each: int) -> list[Block]:
        """The units of standard errors."""
        out = []
        for b in self.blocks:
            first = max(b.start, self.window, 0 if b.record else self.once)
            edges = np.linspace(first, b.stop, each + 1).astype(int)
            out += [Block(b.record, i, j) for i, j in itertools.pairwise(edges) if j > i]
        return out


def blocks_of(records: Sequence[Record], count: int, window: int, guard: int) -> Blocks:
    """About `count` blocks of equal length over all records, at least one a record and two in all."""
    lengths = tuple(len(record) for record in records)
    size = sum(lengths) / max(count, 2)
    blocks = []
    for r, n in enumerate(lengths):
        parts = max(2 if len(lengths) == 1 else 1, round(n / size))
        edges = np.linspace(0, n, parts + 1).astype(int)
        blocks += [Block(r, a, b) for a, b in itertools.pairwise(edges)]
    shortest = min(b.stop - b.start for b in blocks)
    return Blocks(lengths, min(window, shortest // 4), min(guard, shortest // 2), tuple(blocks))
