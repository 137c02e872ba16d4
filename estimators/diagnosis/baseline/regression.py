"""Least squares of many lagged models at once: triangular factors per block, so that each fit is a small problem.

All regressors that any candidate may want stand in one matrix; QR of each block's rows keeps all that least squares needs
of them. A fit without a block takes the factors of the others: no candidate touches the samples again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline.blocks import Blocks
from estimators.diagnosis.baseline.linear_model import LinearModel
from estimators.residual.algebra import least_squares
from oed.data import Record

Array = NDArray[Any]


@dataclass(frozen=True)
class Arx:
    """Orders of y(k) = -a1 y(k-1) - ... + sum_j b_j(q) u_j(k - delay_j) + c: `na`, `nb` per input, `delay` per input."""

    na: int
    nb: int
    delay: tuple[int, ...]
    offset: bool

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.na + self.nb * len(self.delay) + self.offset

    def model(self, theta: Array) -> LinearModel:
        """The model of these orders with parameters a, b by input, c."""
        num = np.zeros((len(self.delay), max(self.delay) + self.nb))
        for j, delay in enumerate(self.delay):
            at = self.na + j * self.nb
            num[j, delay : delay + self.nb] = theta[at : at + self.nb]
        constant = float(theta[self.size - 1]) if self.offset else 0.0
        return LinearModel(np.concatenate(([1.0], theta[: self.na])), num, constant)


@dataclass(frozen=True, eq=False)
class Lagged:
    """Factors of all regressors: lags 1 to `na` of the output, `lags` of each input from its first on, a
    constant.

    `na` output lags; `first` first lag of each input; `lags` lags per input; `factors` for each block, a
    triangular factor of the rows of all *other* blocks; the last is of all rows; `scale` sizes of the
    columns, in which the factors are expressed.
    """

    na: int
    first: tuple[int, ...]
    lags: int
    factors: list[Array]
    scale: Array

    def holds(self, form: Arx) -> bool:
        """Whether the candidate's regressors are all here."""
        within = zip(form.delay, self.first, strict=True)
        return form.na <= self.na and all(f <= d and d - f + form.nb <= self.lags for d, f in within)

    def columns(self, form: Arx) -> NDArray[np.int64]:
        """Where the candidate's regressors stand."""
        out = list(range(form.na))
        for j, delay in enumerate(form.delay):
            at = self.na + j * self.lags + delay - self.first[j]
            out += range(at, at + form.nb)
        return np.array(out + ([self.na + self.lags * len(self.first)] if form.offset else []), dtype=int)

    def fit(self, form: Arx, held_out: int = -1) -> LinearModel:
        """The candidate by least squares, on all blocks or without one of them."""
        return _solved(form, self.factors[held_out], self.columns(form), self.scale)

    def one_step(self, form: Arx) -> float:
        """Root mean square of the one-step error of a fit to all blocks, in units of the output's column."""
        columns, R = self.columns(form), self.factors[-1]
        rest = R[:, -1] - R[:, columns] @ least_squares(R[:, columns], R[:, -1], 1e-10)
        return float(np.linalg.norm(rest) * self.scale[-1])


def _solved(form: Arx, R: Array, columns: Any, scale: Array) -> LinearModel:
    # relative to the largest singular value: what the data do not tell apart stays at its least size
    theta = least_squares(R[:, columns], R[:, -1], 1e-10) * scale[-1] / scale[columns]
    return form.model(np.concatenate((-theta[: form.na], theta[form.na :])))


def fitted_to_all(records: Sequence[Record], output: int, form: Arx, rest: bool) -> LinearModel:
    """The candidate by least squares, on all samples that are there."""
    tables, scale = _scaled(records, output, replace(form, offset=True), rest)
    rows = np.concatenate(tables)
    columns = np.delete(np.arange(rows.shape[1] - 1), [] if form.offset else [rows.shape[1] - 2])
    return _solved(form, _factor(rows[np.isfinite(rows).all(axis=1)]), columns, scale)


def _scaled(records: Sequence[Record], output: int, widest: Arx, rest: bool) -> tuple[list[Array], Array]:
    """Each record's regressors of a form and its output, in units of the columns' sizes, and these."""
    tables = [_table(record, output, widest, rest) for record in records]
    scale = np.sqrt(np.mean(np.concatenate(tables) ** 2, axis=0, where=np.isfinite(np.concatenate(tables))))
    scale[scale == 0.0] = 1.0
    return [table / scale for table in tables], scale


def lagged(records: Sequence[Record], output: int, blocks: Blocks, widest: Arx, rest: bool) -> Lagged:
    """Factors of the regressors of the widest form (with its offset) for one output, rows with missing samples left out."""
    tables, scale = _scaled(records, output, widest, rest)
    whole = [np.asarray(np.isfinite(table).all(axis=1)) for table in tables]
    pieces = {  # the rows of a block that its neighbours' guards leave, and those at its two ends
        (b, part): _factor(tables[block.record][rows][whole[block.record][rows]])
        for b, block in enumerate(blocks.blocks)
        for part, rows in enumerate(_parts(block.start, block.stop, blocks.guard))
    }
    factors = []
    for b, block in enumerate(blocks.blocks):
        used = []
        for (c, part), factor in pieces.items():
            other = blocks.blocks[c]
            near = other.record == block.record and (
                (part == 0 and other.start == block.stop) or (part == 2 and other.stop == block.start)
            )
            if c != b and not near:
                used.append(factor)
        factors.append(_factor(np.concatenate(used)))
    factors.append(_factor(np.concatenate(list(pieces.values()))))
    return Lagged(widest.na, widest.delay, widest.nb, factors, scale)


def lagged_inputs(record: Record, form: Arx, rest: bool) -> Array:
    """(N, nu nb (+ 1)) the inputs at the lags of a form, then 1; before the record at rest (0) or at their first sample."""
    n, columns = len(record), []
    for x, delay in zip(record.u.T, form.delay, strict=True):
        most = delay + form.nb - 1
        padded = np.concatenate((np.full(most, 0.0 if rest else x[0]), x))
        columns += [padded[most - i : most - i + n] for i in range(delay, delay + form.nb)]
    return np.stack([*columns, np.ones(n)] if form.offset else columns, axis=1)


def _parts(start: int, stop: int, guard: int) -> tuple[slice, slice, slice]:
    guard = min(guard, (stop - start) // 2)
    return slice(start, start + guard), slice(start + guard, stop - guard), slice(stop - guard, stop)


def _factor(rows: Array) -> Array:
    return np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) > rows.shape[1] else rows


def _table(record: Record, output: int, widest: Arx, rest: bool) -> Array:
    """(N, na + nu nb + 2) lags of the output, of the inputs, 1, the output itself."""
    y, n, na = record.y[:, output], len(record), widest.na
    before = np.concatenate((np.full(na, 0.0 if rest else np.nan), y))
    lags = [before[na - i : na - i + n] for i in range(1, na + 1)]
    return np.concatenate(
        (np.array(lags).reshape(na, n).T, lagged_inputs(record, widest, rest), y[:, None]), axis=1
    )
