"""Boosted trees as a member of a remainder: corners that no filter of broken lines has; constant outside the training range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.share.signals import Bank, late, leaky, rate
from oed.data import Record

Array = NDArray[np.float64]

TREES, SHRINKAGE, LEAVES, SMALLEST = 100, 0.1, 12, 10
"""Trees, the share of each that is added, their leaves and the least samples of one: of five settings that cost as much or more, on
seven measured records, the one that left least; half the shrinkage with twice the trees left as much."""
ROWS, COLUMNS = 0.5, 0.2
"""Shares of samples that each tree and of columns that each of its splits sees: trees that differ average their noise out."""
LONGEST = 4000
"""Samples that the trees are fitted to: work grows with them."""
SEED = 1999
"""Of the samples and columns drawn: the same record has the same answer."""


def table(bank: Bank, record: Record, run: Array, output: int) -> Array:
    """(N, p) inputs, the earlier run (N, ny), their rates, lags and slow averages."""
    y = run[:, output]
    columns = [y, rate(y), rate(rate(y)), *(leaky(y, t) for t in bank.taus[2::2])]
    for j, x in enumerate(record.u.T):
        columns += [x, late(x, 1), late(x, 2), rate(x)]
        size = np.abs(x - bank.centre[j])
        columns += [leaky(v, t) for t in bank.taus for v in (x, size)]
    return np.stack(columns, axis=1)


@dataclass(frozen=True, eq=False)
class Trees:
    """A sum of trees in one list of nodes: at a node whose `feature` is at most `threshold` it goes `left`, else `right`, from each of
    `roots`; a leaf goes to itself and adds its `value`; `level` is the mean. What is predicted stays within `bounds`."""

    bank: Bank
    roots: NDArray[np.int_]
    feature: NDArray[np.int_]
    threshold: Array
    left: NDArray[np.int_]
    right: NDArray[np.int_]
    value: Array
    level: float
    bounds: tuple[float, float]

    def predicted(self, X: Array) -> Array:
        """(N,) prediction from a table (N, p), within the bounds."""
        at = np.repeat(self.roots[:, None], len(X), axis=1)
        rows = np.arange(len(X))
        while True:
            low = X[rows, self.feature[at]] <= self.threshold[at]
            down = np.where(low, self.left[at], self.right[at])
            if np.array_equal(down, at):
                return np.clip(self.level + self.value[at].sum(axis=0), *self.bounds)
            at = down

    def run(self, record: Record, run: Array, output: int) -> Array:
        """(N,) prediction of the earlier run's error."""
        return self.predicted(table(self.bank, record, run, output))


def grown(bank: Bank, X: Array, r: Array, bounds: tuple[float, float]) -> Trees:
    """Trees fitted to a table (N, p) and its residual (N,)."""
    from sklearn.ensemble import GradientBoostingRegressor

    every = -(-len(X) // LONGEST)
    X, r = X[::every], r[::every]
    level = float(r.mean())
    model = GradientBoostingRegressor(
        n_estimators=TREES, learning_rate=SHRINKAGE, max_leaf_nodes=LEAVES, max_depth=LEAVES, min_samples_leaf=SMALLEST,
        subsample=ROWS, max_features=COLUMNS, init="zero", random_state=SEED,
    ).fit(X, r - level)  # fmt: skip
    parts: list[Sequence[Array]] = []
    roots, total = [], 0
    for tree in (row[0].tree_ for row in model.estimators_):
        own = np.arange(tree.node_count)
        leaf = tree.children_left < 0
        down = [np.where(leaf, own, c) + total for c in (tree.children_left, tree.children_right)]
        value = np.where(leaf, SHRINKAGE * tree.value[:, 0, 0], 0.0)
        parts.append((np.where(leaf, 0, tree.feature), np.where(leaf, 0.0, tree.threshold), *down, value))
        roots.append(total)
        total += tree.node_count
    feature, threshold, left, right, value = (np.concatenate(x) for x in zip(*parts, strict=True))
    return Trees(bank, np.array(roots), feature, threshold, left, right, value, level, bounds)
