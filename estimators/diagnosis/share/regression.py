"""Ridge regression with whole blocks left out: one Gram matrix a fold serves every choice of columns and penalty."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline import Block, Blocks

Array = NDArray[np.float64]

PENALTIES = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""Ridge penalties per sample on columns of unit size: from hardly any to a fit that only strong terms survive."""


@dataclass(frozen=True)
class Folds:
    """Parts of the records that are held out together: every sample in exactly one."""

    parts: tuple[tuple[Block, ...], ...]
    lengths: tuple[int, ...]
    guard: int

    def masks(self, fold: int) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
        """Per record (N,) which samples a fit may use, and which it then predicts; fold -1: all, none."""
        use = [np.ones(n, dtype=bool) for n in self.lengths]
        out = [np.zeros(n, dtype=bool) for n in self.lengths]
        for b in self.parts[fold] if fold >= 0 else ():
            use[b.record][max(0, b.start - self.guard) : b.stop + self.guard] = False
            out[b.record][b.rows] = True
        return use, out


def folds_of(blocks: Blocks, halves: int = 2) -> Folds:
    """As many folds as blocks, each of `halves` pieces far apart: what is held out has neighbours that were seen.

    Free runs go through a held-out piece without a stop, so that it need not be long; a whole fifth of a record is
    often a level or a kind of motion that no other part has, which asks for extrapolation.
    """
    count = len(blocks.blocks)
    pieces = []
    for b in blocks.blocks:
        edges = np.linspace(b.start, b.stop, halves + 1).astype(int)
        pieces += [Block(b.record, i, j) for i, j in itertools.pairwise(edges)]
    parts = tuple(tuple(pieces[k::count]) for k in range(count))
    return Folds(parts, blocks.lengths, blocks.guard)


@dataclass(frozen=True, eq=False)
class Choice:
    """Fits of `which` columns at one penalty, by its index, without each fold: `predicted` (M,) there, and its mean square `error`."""

    which: NDArray[np.int64]
    penalty: int
    predicted: Array
    error: float


@dataclass(frozen=True, eq=False)
class Regression:
    """Columns (M, p) and target (M,) of all samples that count, with the Gram matrix of each fold's samples."""

    columns: Array
    target: Array
    use: list[NDArray[np.bool_]]  # per fold (M,)
    held: list[NDArray[np.bool_]]  # per fold (M,)
    grams: list[Array]  # per fold, of [columns, 1, target]

    @classmethod
    def of(
        cls,
        columns: Sequence[Array],
        target: Sequence[Array],
        counts: Sequence[NDArray[np.bool_]],
        folds: Folds,
    ) -> Regression:
        """From per-record columns (N, p), target (N,) and counting samples (N,)."""
        X = np.concatenate([c[k] for c, k in zip(columns, counts, strict=True)])
        r = np.concatenate([t[k] for t, k in zip(target, counts, strict=True)])
        size = X.std(axis=0)
        X = (X - X.mean(axis=0)) / np.where(size > 1e-12 * np.abs(X).max(axis=0, initial=0.0), size, np.inf)
        use, held, grams = [], [], []
        whole = np.column_stack([X, np.ones(len(X)), r])
        for f in range(len(folds.parts)):
            may, out = (
                np.concatenate([m[k] for m, k in zip(side, counts, strict=True)]) for side in folds.masks(f)
            )
            use.append(may)
            held.append(out)
            grams.append(whole[may].T @ whole[may])
        return cls(X, r, use, held, grams)

    def unused(self, which: NDArray[np.int64]) -> Choice:
        """The fits of some columns without each fold, at the penalty that predicts best."""
        error = lambda out: float(np.mean((self.target - out) ** 2))
        tried = (Choice(which, k, out, error(out)) for k, out in enumerate(self._predictions(which)))
        return min(tried, key=lambda choice: choice.error)

    def _predictions(self, which: NDArray[np.int64]) -> Iterator[Array]:
        """(M,) predictions of every sample by a fit without its fold, penalty by penalty."""
        p = len(self.columns[0])
        rows = np.append(which, p)
        for penalty in PENALTIES:
            out = np.empty(len(self.target))
            for may, held, gram in zip(self.use, self.held, self.grams, strict=True):
                weights = np.linalg.solve(_penalised(gram, rows, penalty * may.sum()), gram[rows, -1])
                out[held] = self.columns[np.ix_(held, which)] @ weights[:-1] + weights[-1]  # pyright: ignore[reportCallIssue]
            yield out

    def errors_of(self, groups: Sequence[NDArray[np.int64]], first: Array, second: Array) -> Iterator[Array]:
        """(3, B) sums of squares and products of what fits without its fold leave of signals (M, B) in pairs, by group and penalty."""
        whole = np.column_stack((self.columns, np.ones(len(self.columns))))
        both, n = np.concatenate((first, second), axis=1), first.shape[1]
        parts = []
        for may, held, gram in zip(self.use, self.held, self.grams, strict=True):
            own, x = whole[held], both[held]
            parts.append(
                (may.sum(), gram, whole[may].T @ both[may], own.T @ own, own.T @ x, _products(x, x, n))
            )
        for which in groups:
            rows = np.append(which, whole.shape[1] - 1)
            for penalty in PENALTIES:
                squares = np.zeros((3, n))
                for count, gram, seen, own, cross, power in parts:
                    W = np.linalg.solve(_penalised(gram, rows, penalty * count), seen[rows])
                    left = own[np.ix_(rows, rows)] @ W - cross[rows]
                    # |x - Z W|^2 = |x|^2 + W' (Z'Z W - Z'x) - W' Z'x, of pairs the symmetric half of it
                    squares += power + _products(W, left, n) - _products(W, cross[rows], n)
                yield squares


def _penalised(gram: Array, rows: NDArray[np.int64], penalty: float) -> Array:
    """The rows and columns of a Gram matrix with a penalty on all but the last of them, the constant."""
    left = gram[np.ix_(rows, rows)].copy()  # pyright: ignore[reportCallIssue]
    own = np.arange(len(rows) - 1)
    left[own, own] += penalty
    return left


def _products(a: Array, b: Array, n: int) -> Array:
    """(3, n) of two (., 2 n): first by first, first by second, second by second, the middle one symmetric."""
    one, two = slice(None, n), slice(n, None)
    dot = lambda i, j: np.einsum("ij,ij->j", a[:, i], b[:, j])
    return np.stack([dot(one, one), 0.5 * (dot(one, two) + dot(two, one)), dot(two, two)])
