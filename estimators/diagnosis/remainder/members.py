"""Recurrent networks as members of a remainder: their scales, their starts, their training stretches."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline import OutputModel
from estimators.diagnosis.remainder.network import Network, Piece, Sizes, fitted, poles_of
from oed.data import Record

Array = NDArray[np.float64]

LEAD = 64
"""Samples of the first input before a record, which bring the states from zero to about their rest."""
MARGIN = 0.1
"""By how much of its span an input may leave its training range before it is clipped: noise does not know the range."""
LONGEST = 2000
"""Samples that a network is fitted to: work grows with them, and its few dozen parameters are known well by then."""
STRETCHES = 4
"""Pieces into which a longer record is cut, evenly spread: they meet more of its levels than one piece does."""
PENALTY = 1e-3
"""Pull of the parameters to their start, per sample of unit residual: the lesser and the larger of 1e-4 and 1e-2 predicted
unused blocks worse on practice records."""
SEED = 20
"""First seed of the starts; the same for every block, so that blocks differ by their data alone."""


@dataclass(frozen=True, eq=False)
class Scale:
    """Scale of the inputs w (m,), their clipping range, and scale of the target."""

    centre: Array
    spread: Array
    low: Array
    high: Array
    level: float
    size: float

    def inputs(self, u: Array, run: Array) -> Array:
        """(LEAD + N, m) what the network sees of inputs (N, nu) and an earlier run (N, ny)."""
        w = (np.clip(np.column_stack((u, run)), self.low, self.high) - self.centre) / self.spread
        return np.concatenate((np.repeat(w[:1], LEAD, axis=0), w))


def scale_of(us: Sequence[Array], runs: Sequence[Array], residual: Array) -> Scale:
    """Scales of training data: inputs and runs per record, residual (M,) of the samples that count."""
    w = np.concatenate([np.column_stack(pair) for pair in zip(us, runs, strict=True)])
    low, high = w.min(axis=0), w.max(axis=0)
    more, spread = MARGIN * (high - low), w.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    return Scale(
        w.mean(axis=0), spread, low - more, high + more, float(residual.mean()), float(residual.std()) or 1.0
    )


@dataclass(frozen=True, eq=False)
class Networks:
    """The mean of several networks of one size: a correction of the earlier model's run."""

    scale: Scale
    networks: tuple[Network, ...]
    bounds: tuple[float, float]

    def run(self, record: Record, run: Array) -> Array:
        """(N,) correction for a record, within the bounds."""
        w = self.scale.inputs(record.u, run)
        mean = np.mean([n.run(w)[LEAD:] for n in self.networks], axis=0)
        return np.clip(self.scale.level + self.scale.size * mean, *self.bounds)


def starts_of(model: OutputModel, states: int, count: int) -> list[tuple[Array, int]]:
    """Linear parts to start from, each with its seed: the weightiest poles, the slowest, then time constants by chance."""
    poles, m = model.model.poles, model.model
    weights = np.zeros(len(poles))
    for i, z in enumerate(poles):
        if abs(z) > 0.02:  # the energy of the pole's part of the impulse responses
            others = np.prod(1.0 - np.delete(poles, i) / z)
            gains = [abs(np.polyval(row[::-1], 1.0 / z)) ** 2 for row in m.num]
            weights[i] = np.nan_to_num(sum(gains) / abs(others) ** 2, posinf=1e300) / max(
                1.0 - abs(z) ** 2, 1e-3
            )
    found = [(poles_of(poles, weights, states), SEED), (poles_of(poles, np.abs(poles), states), SEED + 1)]
    for seed in range(SEED + 2, SEED + count):
        rng = np.random.default_rng([seed, states])
        found.append((np.diag(np.exp(-1.0 / np.exp(rng.uniform(np.log(1.5), np.log(50.0), states)))), seed))
    return found[:count]


def stretches(w: Array, target: Array, use: NDArray[np.bool_], most: int) -> list[Piece]:
    """Training pieces of one record: all of it, or evenly spread stretches of about `most` samples in all.

    `w` (LEAD + N, m), `target` and `use` (N,). A stretch starts LEAD samples early, which do not count.
    """
    whole, counts = (
        np.concatenate((np.zeros(LEAD), target)),
        np.concatenate((np.zeros(LEAD, dtype=bool), use)),
    )
    n = len(target)
    if n <= most:
        return [Piece(w, whole, counts)]
    out, length = [], most // STRETCHES
    for start in np.linspace(0, n - length, STRETCHES).astype(int):
        rows = slice(start, start + LEAD + length)
        seen = counts[rows].copy()
        seen[:LEAD] = False
        out.append(Piece(w[rows], whole[rows], seen))
    return out


def trained(
    records: Sequence[Record], runs: Sequence[Array], targets: Sequence[Array], uses: Sequence[NDArray[np.bool_]],
    scale: Scale, starts: Sequence[tuple[Array, int]], neurons: int,
) -> tuple[tuple[Network, ...], tuple[int, ...]]:  # fmt: skip
    """Networks fitted to targets (N,) of several records, and the starts that won."""
    total = sum(len(r) for r in records)
    pieces: list[Piece] = []
    for r, run, target, use in zip(records, runs, targets, uses, strict=True):
        scaled = np.where(use, (target - scale.level) / scale.size, 0.0)
        pieces += stretches(scale.inputs(r.u, run), scaled, use, max(1, LONGEST * len(r) // total))
    pieces = [p for p in pieces if p.counts.any()]
    sizes = Sizes(len(starts[0][0]), pieces[0].w.shape[1], neurons)
    return fitted(pieces, starts, sizes, PENALTY)
