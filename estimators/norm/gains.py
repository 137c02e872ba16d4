"""Estimates of the peak gain from the iterations' own inputs and outputs, one per iteration.

    rayleigh   beta^(n)    = u^(n)' y~^(n) / ||u^(n)||^2                           [S] (4), [M] (6)
    gain       beta_2^(n)  = sqrt( m^(n-1) u^(n-1)' y~^(n) / ||u^(n-1)||^2 )      [S] (7);  [M] (12)
    mu         ||y^(n)|| / ||u^(n)||

with y~ = T y and m^(n-1) the factor by which T y^(n-1) was divided to give u^(n), so the estimates are right
under any scaling of the inputs ([M] (13)). [S] (4) and (7) as printed lack the factors of N that make them
Rayleigh quotients. The eigenvalues of T G come in pairs of nearly equal size and opposite sign, so `rayleigh`
may settle anywhere between -gamma and gamma; `gain` is the one to use."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.rules.trace import Trace
from oed.data import Record, frozen
from oed.errors import InputError, Status

MEANS = {
    "rayleigh": " (quotient of one experiment)",
    "gain": " (root of the quotient of two)",
    "mu": " (ratio of output to input norm)",
}


@dataclass(frozen=True, eq=False)
class Gains:
    """One estimate of the peak gain per iteration. `name` name of the estimator; `values` (M,) estimates; NaN
    where the status is not ok; `statuses` one per iteration; `squares` (M,) the squared estimates before the
    root, where there is one: may be negative."""

    name: str
    values: NDArray[np.float64]
    statuses: tuple[Status, ...]
    squares: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.values)

    @property
    def last(self) -> float:
        """The last estimate (NaN if it has none)."""
        return float(self.values[-1])

    @property
    def status(self) -> Status:
        """Status of the last estimate."""
        return self.statuses[-1]

    def mean(self, discard: float = 0.5) -> float:
        """Root of the mean of the squared estimates over the last iterations."""
        rest = self.squares[int(len(self) * discard) :]
        rest = rest[np.isfinite(rest)]
        average = float(rest.mean()) if rest.size else np.nan
        return float(np.sqrt(average)) if average >= 0 else float("nan")

    def __repr__(self) -> str:
        failed = sum(not s.ok for s in self.statuses)
        tail = f", {failed} without a value" if failed else ""
        return f"{self.name}{MEANS.get(self.name, '')}: {len(self)} iterations, last {self.last:.6g}{tail}"


def from_squares(name: str, squares: NDArray[np.float64]) -> Gains:
    """Gains that are roots: NaN with a status where the square is negative or undefined; squares (M,)."""
    squares = np.asarray(squares, dtype=float)
    statuses = tuple(
        Status.NOT_FINITE if not np.isfinite(s) else Status.NEGATIVE_SQUARE if s < 0 else Status.OK
        for s in squares
    )
    values = np.sqrt(np.where(np.isfinite(squares) & (squares >= 0), squares, np.nan))
    return Gains(name, frozen(values), statuses, frozen(squares))


def rayleigh(trace: Trace) -> Gains:
    """Rayleigh quotient of T G, [S] (4) and [M] (6); signed, and unreliable by nature (see the module)."""
    _need(trace, "rayleigh", "power", "unreversed")
    reverse = -1 if trace.kinds[0] == "power" else 1
    values = np.array([_inner(r.u, r.y[::reverse]) / _inner(r.u, r.u) for r in trace.records])
    statuses = tuple(Status.OK if np.isfinite(v) else Status.NOT_FINITE for v in values)
    return Gains("rayleigh", frozen(values), statuses, frozen(values**2))


def gain(trace: Trace) -> Gains:
    """Gain over two steps, [S] (7), or over one iteration of Procedure 2, [M] (12)."""
    _need(trace, "gain", "power", "forward")
    if trace.kinds[0] == "power":
        squares = [np.nan]
        for before, now in zip(trace.records[:-1], trace.records[1:], strict=True):
            factor = _norm(before.y) / _norm(now.u)
            squares.append(factor * _inner(before.u, now.y[::-1]) / _inner(before.u, before.u))
        return from_squares("gain", np.array(squares))
    squares = []
    for part in trace.iterations:
        u, w = trace.records[part][0].u, transposed_output(trace, part)
        squares.append(_inner(u, w) / _inner(u, u))
    return from_squares("gain", np.array(squares))


def mu(trace: Trace) -> Gains:
    """Norm of the output over that of the input; for Procedure 2 the root of ||w|| / ||u||."""
    if trace.kinds[0] != "forward":
        squares = [np.square(_norm(r.y) / _norm(r.u)) if r.u.any() else np.nan for r in trace.records]
    else:
        squares = [
            _norm(transposed_output(trace, part)) / _norm(trace.records[part][0].u)
            for part in trace.iterations
        ]
    return from_squares("mu", np.array(squares))


def transposed_output(trace: Trace, part: slice) -> NDArray[np.float64]:
    """w = T z of one iteration of Procedure 2: G' G u from 1 + pq experiments; returns (N, nu)."""
    records: tuple[Record, ...] = trace.records[part]
    kinds = trace.kinds[part]
    forward = records[0]
    z = np.zeros_like(forward.u)
    if len(records) != 1 + forward.n_inputs * forward.n_outputs:
        return np.full_like(z, np.nan)
    for record, kind in zip(records[1:], kinds[1:], strict=True):
        i, j = (int(word) - 1 for word in kind.split()[1:])
        asked, applied = _norm(forward.y[:, j]), _norm(record.u[:, i])
        if applied > 0:  # the factor by which the second input was scaled
            z[:, i] += record.y[:, j] * (asked / applied)
    return z[::-1]


def _inner(a: NDArray, b: NDArray) -> float:
    return float(np.vdot(a, b))


def _norm(a: NDArray) -> float:
    return float(np.linalg.norm(a))


def _need(trace: Trace, name: str, *kinds: str) -> None:
    if not trace.kinds or trace.kinds[0] not in kinds:
        found = trace.kinds[0] if trace.kinds else "no experiments"
        raise InputError(
            f"the estimator {name} is defined on power iterations, and the trace holds {found or 'other'} "
            "experiments; use mu, a frequency response or a model on these records."
        )
