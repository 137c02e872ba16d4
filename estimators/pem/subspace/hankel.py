"""Block-Hankel matrices of records, by their triangular factor: all that a subspace method needs of the data.

At each sample t, the present, a row holds the future inputs u(t) ... u(t+i-1), the past inputs and outputs
u(t-i) ... u(t-1), y(t-i) ... y(t-1), and the future outputs y(t) ... y(t+i-1). The factor R of these rows has i (2 nu +
2 ny) columns however long the records are. It is Cholesky's of the products of the rows, which follow from those one sample
earlier; where these lose digits (records all but free of noise) it is found from the rows, block by block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

CHUNK = 4096
"""Rows that are factored at a time."""
APART = 1e-4
"""Least share of a column that the columns before it leave, for products of columns to tell it: its square has half the digits."""


@dataclass(frozen=True, eq=False)
class Factor:
    """Triangular factor of the rows [future inputs, past inputs and outputs, future outputs]. `R` (d, d)
    upper triangular, d = 2 i (nu + ny); `horizon` i, block rows that look back, and as many that look
    forward; `n_inputs, n_outputs` nu, ny."""

    R: NDArray[np.float64]
    horizon: int
    n_inputs: int
    n_outputs: int
    gram: NDArray[np.float64] | None = None
    """(d, d) products R' R, where the factor is of them."""

    def shorter(self, horizon: int) -> Factor:
        """The factor of fewer block rows, at the same samples."""
        if horizon == self.horizon:
            return self
        i, nu, ny = self.horizon, self.n_inputs, self.n_outputs
        begin, cut = np.cumsum([0, i * nu, i * nu, i * ny]), i - horizon
        parts = ((0, horizon * nu), (cut * nu, i * nu), (cut * ny, i * ny), (0, horizon * ny))
        at = np.concatenate([first + np.arange(*part) for first, part in zip(begin, parts, strict=True)])
        if self.gram is not None and (R := _root(gram := self.gram[at[:, None], at])) is not None:
            return Factor(R, horizon, nu, ny, gram)
        return Factor(_triangle(self.R[:, at]), horizon, nu, ny)

    def blocks(self) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray, NDArray]:
        """The blocks of R' by future inputs (1), past (2), future outputs (3)."""
        L = self.R.T
        a = self.horizon * self.n_inputs
        b = a + self.horizon * (self.n_inputs + self.n_outputs)
        return L[:a, :a], L[a:b, :a], L[a:b, a:b], L[b:, :a], L[b:, a:b], L[b:, b:]

    def divided(self, block: NDArray, right: NDArray, *, transposed: bool = False) -> NDArray[np.float64]:
        """The inverse of a diagonal block of R', or its transpose's, times a matrix: by substitution where the factor has its
        digits, else the pseudoinverse."""
        if self.gram is None:
            return np.linalg.pinv(block.T if transposed else block, rcond=1e-11) @ right
        return solve_triangular(block, right, lower=True, trans=int(transposed), check_finite=False)


def _triangle(matrix: NDArray) -> NDArray[np.float64]:
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=float)


def _root(gram: NDArray) -> NDArray[np.float64] | None:
    """Cholesky's factor of products of columns; None where they are too near to dependent for it to have digits."""
    from scipy.linalg.lapack import dpotrf

    size = np.sqrt(np.maximum(gram.diagonal(), np.finfo(float).tiny))
    # As the transpose, which is the same matrix: LAPACK's order of entries, and no copy.
    upper, failed = dpotrf((gram / size / size[:, None]).T, overwrite_a=True)
    return upper * size if not failed and upper.diagonal().min() > APART else None


def _products(signals: list[tuple[NDArray, NDArray]], rows: int, centred: bool) -> NDArray[np.float64]:
    """Sums over all windows of products of any two of their entries, (rows m, rows m) of m channels, sample by sample."""
    m = signals[0][0].shape[1] + signals[0][1].shape[1]
    gram, sums, total = np.zeros((rows, m, rows, m)), np.zeros((rows, m)), 0
    for x in (np.column_stack(pair) for pair in signals):
        count = len(x) - rows + 1
        if count <= 0:
            continue
        own, ahead = np.empty_like(gram), x[count:]
        for c in range(m):
            for d in range(m):
                own[0, c, :, d] = np.correlate(x[:, d], x[:count, c])
        own[:, :, 0, :] = own[0].transpose(1, 2, 0)
        for a in range(1, rows):
            own[a, :, 1:] = own[a - 1, :, :-1] - np.multiply.outer(x[a - 1], x[: rows - 1])
            own[a, :, 1:] += np.multiply.outer(ahead[a - 1], ahead)
        gram, total = gram + own, total + count
        sums[0] += x[:count].sum(axis=0)
        sums[1:] += x[:count].sum(axis=0) + np.cumsum(ahead[: rows - 1] - x[: rows - 1], axis=0)
    if centred:
        gram -= np.multiply.outer(sums, sums) / total
    return gram.reshape(rows * m, rows * m)


def windows(signal: NDArray, rows: int, first: int, count: int) -> NDArray[np.float64]:
    """Rows of a block-Hankel matrix, transposed: what a signal does over some samples, at each of several
    times; signal (N, k) -> (count, rows k)."""
    view = sliding_window_view(signal[first : first + count + rows - 1], rows, axis=0)
    return view.transpose(0, 2, 1).reshape(count, -1)


def lagged(signal: NDArray, lags: int, first: int, count: int) -> NDArray[np.float64]:
    """The past of a signal at each of several times, the last sample first: signal (N, k) -> (count, lags k)."""
    past = windows(signal, lags, first, count).reshape(count, lags, -1)
    return past[:, ::-1].reshape(count, -1)


def _factored(
    signals: list[tuple[NDArray, NDArray]], rows: int, order: NDArray, centred: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Triangular factor of all windows of some samples, their entries in an order, and the products that it is of."""
    gram = _products(signals, rows, centred)[order[:, None], order]
    if (R := _root(gram)) is not None:
        return R, gram
    R = np.zeros((0, len(order) + centred))
    for joint in (np.column_stack(pair) for pair in signals):
        count = len(joint) - rows + 1
        for a in range(0, max(count, 0), CHUNK):
            n = min(CHUNK, count - a)
            own = windows(joint, rows, a, n)[:, order]
            R = _triangle(np.vstack([R, np.column_stack([np.ones((n, int(centred))), own])]))
    # where there is a constant it comes first: what is below its row is orthogonal to it
    return R[centred:, centred:], None


def factored(signals: list[tuple[NDArray, NDArray]], horizon: int, centred: bool) -> Factor:
    """Factor of all records together."""
    nu, ny = signals[0][0].shape[1], signals[0][1].shape[1]
    place = np.arange(2 * horizon * (nu + ny)).reshape(2, horizon, nu + ny)
    parts = place[1, :, :nu], place[0, :, :nu], place[0, :, nu:], place[1, :, nu:]
    R, gram = _factored(signals, 2 * horizon, np.concatenate([p.ravel() for p in parts]), centred)
    return Factor(R, horizon, nu, ny, gram)


def autoregressive_order(signals: list[tuple[NDArray, NDArray]], most: int, centred: bool) -> int:
    """Order of the autoregression with inputs that Akaike's criterion takes: how far back the data look."""
    nu, ny = signals[0][0].shape[1], signals[0][1].shape[1]
    place = np.arange((most + 1) * (nu + ny)).reshape(most + 1, nu + ny)[::-1]  # the last sample first
    R, _ = _factored(
        signals, most + 1, np.concatenate([place[0, :nu], place[1:].ravel(), place[0, nu:]]), centred
    )
    total = sum(max(len(u) - most, 0) for u, _ in signals)
    outputs = R[:, -ny:]
    left = np.cumsum((outputs[:, :, None] * outputs[:, None, :])[::-1], axis=0)[::-1]  # from each row on
    floor = np.finfo(float).eps ** 2 * np.trace(left[0]) * np.eye(ny)
    orders = np.arange(1, most + 1)
    deviance = total * np.linalg.slogdet(left[nu + orders * (nu + ny)] + floor)[1]
    return int(np.argmin(deviance + 2 * orders * (nu + ny) * ny)) + 1
