"""What a remainder stands on: any earlier model's free runs, with all parameters and without each block."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline import Baseline, Blocks
from oed.data import Record

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Footing:
    """Free runs of an earlier model on the training records.

    `final` per record (N, ny), with the parameters fitted to all blocks; `without` per block, per record (N,
    ny): the run of parameters that did not see the block.
    """

    final: tuple[Array, ...]
    without: tuple[tuple[Array, ...], ...]

    def unused(self, blocks: Blocks) -> tuple[Array, ...]:
        """Every block by the parameters that did not see it."""
        out = tuple(np.full_like(run, np.nan) for run in self.final)
        for runs, b in zip(self.without, blocks.blocks, strict=True):
            out[b.record][b.rows] = runs[b.record][b.rows]
        return out


def linear_footing(base: Baseline, records: Sequence[Record]) -> Footing:
    """The linear model's runs; each block's own model runs through the whole records."""
    folds = [m.folds for m in base.outputs]
    if not all(folds):
        return spliced(base.y_model, base.unused, base.blocks)
    without = tuple(
        tuple(
            np.stack(
                [
                    m.folds[k].free_run(m.prior, r.u[:, list(m.inputs)], r.y[:, i], base.blocks.window)
                    for i, m in enumerate(base.outputs)
                ],
                axis=1,
            )
            for r in records
        )
        for k in range(len(base.blocks.blocks))
    )
    return Footing(base.y_model, without)


def spliced(final: Sequence[Array], unused: Sequence[Array], blocks: Blocks) -> Footing:
    """A footing of a model of which only its final run and its unused blocks are known."""
    without = []
    for b in blocks.blocks:
        runs = [np.array(run) for run in final]
        runs[b.record][b.rows] = unused[b.record][b.rows]
        without.append(tuple(np.where(np.isfinite(r), r, f) for r, f in zip(runs, final, strict=True)))
    return Footing(tuple(final), tuple(without))
