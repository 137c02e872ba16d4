"""Block-Hankel matrices of records, by their triangular factor: all that a subspace method needs of the data.

At each sample t, the present, a row holds the future inputs u(t) ... u(t+i-1), the past inputs and outputs
u(t-i) ... u(t-1), y(t-i) ... y(t-1), and the future outputs y(t) ... y(t+i-1). The factor R of these rows has i (2 nu +
2 ny) columns however long the records are; it is found block by block, in memory that does not grow with them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

CHUNK = 4096
"""Rows that are factored at a time."""


@dataclass(frozen=True, eq=False)
class Factor:
    """Triangular factor of the rows [future inputs, past inputs and outputs, future outputs]. `R` (d, d)
    upper triangular, d = 2 i (nu + ny); `horizon` i, block rows that look back, and as many that look
    forward; `n_inputs, n_outputs` nu, ny."""

    R: NDArray[np.float64]
    horizon: int
    n_inputs: int
    n_outputs: int

    def shorter(self, horizon: int) -> Factor:
        """The factor of fewer block rows, at the same samples."""
        i, nu, ny = self.horizon, self.n_inputs, self.n_outputs
        begin, cut = np.cumsum([0, i * nu, i * nu, i * ny]), i - horizon
        parts = ((0, horizon * nu), (cut * nu, i * nu), (cut * ny, i * ny), (0, horizon * ny))
        at = np.concatenate([first + np.arange(*part) for first, part in zip(begin, parts, strict=True)])
        return Factor(_triangle(self.R[:, at]), horizon, nu, ny)

    def blocks(self) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray, NDArray]:
        """The blocks of R' by future inputs (1), past (2), future outputs (3)."""
        L = self.R.T
        a = self.horizon * self.n_inputs
        b = a + self.horizon * (self.n_inputs + self.n_outputs)
        return L[:a, :a], L[a:b, :a], L[a:b, a:b], L[b:, :a], L[b:, a:b], L[b:, b:]


def _triangle(matrix: NDArray) -> NDArray[np.float64]:
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=float)


def windows(signal: NDArray, rows: int, first: int, count: int) -> NDArray[np.float64]:
    """Rows of a block-Hankel matrix, transposed: what a signal does over some samples, at each of several
    times; signal (N, k) -> (count, rows k)."""
    view = sliding_window_view(signal[first : first + count + rows - 1], rows, axis=0)
    return view.transpose(0, 2, 1).reshape(count, -1)


def lagged(signal: NDArray, lags: int, first: int, count: int) -> NDArray[np.float64]:
    """The past of a signal at each of several times, the last sample first: signal (N, k) -> (count, lags k)."""
    past = windows(signal, lags, first, count).reshape(count, lags, -1)
    return past[:, ::-1].reshape(count, -1)


def factored(signals: list[tuple[NDArray, NDArray]], horizon: int, centred: bool) -> Factor:
    """Factor of all records together."""
    nu, ny = signals[0][0].shape[1], signals[0][1].shape[1]
    R = np.zeros((0, 2 * horizon * (nu + ny) + centred))
    for u, y in signals:
        count = len(u) - 2 * horizon + 1
        for a in range(0, max(count, 0), CHUNK):
            n = min(CHUNK, count - a)
            parts = [(u, a + horizon), (u, a), (y, a), (y, a + horizon)]
            rows = [windows(signal, horizon, first, n) for signal, first in parts]
            R = _triangle(np.vstack([R, np.column_stack([np.ones((n, int(centred))), *rows])]))
    # where there is a constant it comes first: what is below its row is orthogonal to it
    return Factor(R[1:, 1:] if centred else R, horizon, nu, ny)


def autoregressive_order(signals: list[tuple[NDArray, NDArray]], most: int, centred: bool) -> int:
    """Order of the autoregression with inputs that Akaike's criterion takes: how far back the data look."""
    nu, ny = signals[0][0].shape[1], signals[0][1].shape[1]
    R, total = np.zeros((0, 1 + nu + most * (nu + ny) + ny)), 0
    for u, y in signals:
        joint = np.column_stack([u, y])
        count = len(u) - most
        for a in range(0, max(count, 0), CHUNK):
            n = min(CHUNK, count - a)
            now = slice(most + a, most + a + n)
            rows = [np.full(n, centred), u[now], lagged(joint, most, a, n), y[now]]
            R = _triangle(np.vstack([R, np.column_stack(rows)]))
            total += n
    outputs = R[:, -ny:]
    floor = np.finfo(float).eps ** 2 * np.trace(outputs.T @ outputs) * np.eye(ny)
    values = []
    for order in range(1, most + 1):
        left = outputs[1 + nu + order * (nu + ny) :]
        values.append(total * np.linalg.slogdet(left.T @ left + floor)[1] + 2 * order * (nu + ny) * ny)
    return int(np.argmin(values)) + 1
