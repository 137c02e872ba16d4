"""Ridge regressions on stable filters and static maps of inputs and of the earlier model's run."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.share.signals import Bank, columns_of, late, leaky, rate
from oed.data import Record

Array = NDArray[np.float64]

PENALTIES = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""Penalties per sample on columns of unit size, from hardly any to a fit that only strong terms survive."""
MOST = 300
"""Most products of two columns: more cost more than they explain."""


class Set(StrEnum):
    """Which columns: broken lines and forces; products of two; inputs alone, without the earlier run."""

    FORCES = "forces"
    PRODUCTS = "products"
    INPUTS = "inputs"


def columns(which: Set, bank: Bank, record: Record, run: Array, output: int) -> Array:
    """(N, p) columns of a record and the earlier model's run (N, ny)."""
    if which is Set.FORCES:
        table = columns_of(bank, record, run, output)
        return table.values[:, np.isin(table.kinds, ("linear", "input", "output", "dynamic"))]
    nu = record.n_inputs
    base = []
    if which is Set.PRODUCTS:
        y, v = (
            (run[:, output] - bank.centre[nu]) / bank.spread[nu],
            rate(run[:, output]) / bank.spread[nu + 1],
        )
        base += [y, v, rate(v), *(leaky(y, t) for t in bank.taus[2::2][:3])]
    for j in range(nu):
        x = (record.u[:, j] - bank.centre[j]) / bank.spread[j]
        base += [late(x, i) for i in range(3)]
        base += [leaky(x, t) for t in bank.taus]
    X = np.stack(base, axis=1)
    every = -(-(X.shape[1] ** 2 // 2) // MOST)
    first, second = (i[::every] for i in np.triu_indices(X.shape[1]))
    parts = [X, X[:, first] * X[:, second]]
    if which is Set.INPUTS:
        table = columns_of(bank, record, run, output)
        parts.append(table.values[:, np.isin(table.kinds, ("input",))])
    return np.concatenate(parts, axis=1)


@dataclass(frozen=True, eq=False)
class Ridge:
    """A fitted regression: columns clipped to their training range, then scaled, then weighted.

    `which` its columns; `bank` filters and scales; `low, high, centre, spread` (p,) training range and scale
    of the columns; `weights` (p + 1,), the constant last; `bounds` what is predicted stays within them.
    """

    which: Set
    bank: Bank
    low: Array
    high: Array
    centre: Array
    spread: Array
    weights: Array
    bounds: tuple[float, float]

    def scaled(self, X: Array) -> Array:
        """(N, p + 1) columns as the weights take them."""
        Z = (np.clip(X, self.low, self.high) - self.centre) / self.spread
        return np.column_stack((Z, np.ones(len(Z))))

    def predicted(self, Z: Array, weights: Array) -> Array:
        """(N,) prediction within the bounds."""
        return np.clip(Z @ weights, *self.bounds)

    def run(self, record: Record, run: Array, output: int) -> Array:
        """(N,) prediction for a record: of the output where `which` has inputs only, else of the earlier run's error."""
        return self.predicted(self.scaled(columns(self.which, self.bank, record, run, output)), self.weights)


def ridge_of(which: Set, bank: Bank, X: Array, bounds: tuple[float, float]) -> Ridge:
    """An unfitted regression with the scales of columns (N, p)."""
    centre, spread = X.mean(axis=0), X.std(axis=0)
    spread = np.where(spread > 1e-12 * (np.abs(X).max(axis=0) + 1e-300), spread, 1.0)
    low, high = X.min(axis=0), X.max(axis=0)
    return Ridge(which, bank, low, high, centre, spread, np.zeros(X.shape[1] + 1), bounds)


def normal_equations(
    Zs: Sequence[Array], targets: Sequence[Array], uses: Sequence[NDArray[np.bool_]]
) -> list[Array]:
    """Weights (p + 1,) for every penalty of the list, from the samples in use of several records."""
    gram, right, total = 0.0, 0.0, 0
    for Z, r, use in zip(Zs, targets, uses, strict=True):
        gram, right, total = gram + Z[use].T @ Z[use], right + Z[use].T @ r[use], total + int(use.sum())
    p = len(right) - 1  # type: ignore[arg-type]
    out = []
    for penalty in PENALTIES:
        left = np.array(gram)
        left[np.arange(p), np.arange(p)] += penalty * total
        out.append(np.linalg.solve(left + 1e-9 * total * np.eye(p + 1), right))
    return out
