"""What a fading-memory regression may use of a record: signals of inputs and simulated outputs, never measured outputs.

Every column is a stable filter's or a static map's output, so that whatever is regressed on them is bounded in free
run. A column carries the variable that it speaks of and the natures of cause that it would betray.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.baseline import Baseline
from oed.data import Record

Array = NDArray[np.float64]

TAUS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Time constants in samples of the filter bank: octaves, as a sum of two neighbours stands in for what lies between."""
SLOW = (16.0, 64.0, 256.0)
"""Time constants of hidden states (heat, wear, charge): slower than most plants' dynamics."""
TURNS = 8.0
"""A filter's time constant fits at least so many times into the record: slower ones are indistinguishable from time."""
KNOTS = 5
"""Bends of a broken line at equal shares of the samples: enough for a saturation, a dead zone or a smooth curve."""
FEW = 0.02
"""Pole radii below this are delays, which the lags carry."""


@dataclass(frozen=True)
class Bank:
    """Time constants in samples, and knots and scale of every signal, as the training records set them."""

    taus: tuple[float, ...]
    slow: tuple[float, ...]
    knots: tuple[
        tuple[float, ...], ...
    ]  # of each input, then of the output's own simulation, then of its rate
    centre: tuple[float, ...]
    spread: tuple[float, ...]
    length: int  # samples of the longest record: the unit of time


@dataclass(frozen=True, eq=False)
class _Table:
    """Columns while they are gathered."""

    names: list[str] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    columns: list[Array] = field(default_factory=list)

    def add(self, variable: str, kind: str, *columns: Array) -> None:
        self.names.extend([variable] * len(columns))
        self.kinds.extend([kind] * len(columns))
        self.columns.extend(columns)


@dataclass(frozen=True, eq=False)
class Columns:
    """Regressors (N, p) with the variable that each speaks of and its kind ("linear", "input", "output", ...)."""

    values: Array
    variables: tuple[str, ...]
    kinds: tuple[str, ...]


def leaky(x: Array, tau: float) -> Array:
    """(N,) first-order low pass with time constant tau in samples, at rest at its first sample."""
    p = np.exp(-1.0 / tau)
    return np.asarray(lfilter([1.0 - p], [1.0, -p], x - x[0])) + x[0]


def late(x: Array, by: int) -> Array:
    """(N,) the signal so many samples late, at its first value before."""
    return np.concatenate((np.full(by, x[0]), x[: len(x) - by]))


def rate(x: Array) -> Array:
    """(N,) difference to the sample before, 0 at the first."""
    return np.diff(x, prepend=x[0])


def _hinges(x: Array, knots: tuple[float, ...]) -> list[Array]:
    return [np.maximum(x - k, 0.0) for k in knots]


def bank_of(base: Baseline, records: list[Record], output: int) -> Bank:
    """Filters and scales for one output: octaves of time constants and those of the fitted poles."""
    length = max(len(r) for r in records)
    radii = np.abs(base.outputs[output].model.poles)
    radii = radii[(radii > FEW) & (radii < 1.0)]
    own = -1.0 / np.log(radii) if radii.size else np.zeros(0)
    octaves = [t for t in TAUS if t * TURNS <= length]
    near = [float(t) for t in own if t > 0.5 and t * TURNS <= length]
    taus = list(octaves)
    for t in sorted(near):  # a pole within a fifth of a filter that is there adds nothing
        if all(abs(np.log(t / s)) > np.log(1.2) for s in taus):
            taus.append(t)
    runs = [y[:, output] for y in base.y_model]
    signals = [np.concatenate([r.u[:, j] for r in records]) for j in range(records[0].n_inputs)]
    signals += [np.concatenate(runs), np.concatenate([rate(y) for y in runs])]
    levels = np.linspace(0.0, 1.0, KNOTS + 2)[1:-1]
    scaled, centre, spread = [], [], []
    for x in signals:
        centre.append(float(x.mean()))
        spread.append(float(x.std()) or 1.0)
        scaled.append(tuple(np.unique(np.quantile((x - centre[-1]) / spread[-1], levels)).tolist()))
    slow = tuple(t for t in SLOW if t * TURNS <= length) or (length / TURNS,)
    return Bank(tuple(sorted(taus)), slow, tuple(scaled), tuple(centre), tuple(spread), length)


def columns_of(bank: Bank, record: Record, run: Array, output: int, start: float = 0.0) -> Columns:
    """Regressors of a record (N, p); `run` (N, ny) is the simulated output, `start` the record's begin in samples."""
    nu = record.n_inputs
    u = [(record.u[:, j] - bank.centre[j]) / bank.spread[j] for j in range(nu)]
    y = (run[:, output] - bank.centre[nu]) / bank.spread[nu]
    v = rate(run[:, output]) / bank.spread[nu + 1]
    time = (start + np.arange(len(record))) / bank.length - 0.5
    table = _Table()
    for j, x in enumerate(u):
        name = record.input_names[j]
        lags = [late(x, i) for i in range(3)]
        linear = lags + [leaky(x, t) for t in bank.taus]
        table.add(name, "linear", *linear)
        for h in _hinges(x, bank.knots[j]):
            table.add(name, "input", h, *(leaky(h, t) for t in bank.taus))
        table.add("time", "time", *(time * c for c in linear[:: max(1, len(linear) // 4)]))
    table.add("level of the output", "linear", y)
    table.add("rate of the output", "linear", v, rate(v))
    bends = _hinges(y, bank.knots[nu])
    table.add("level of the output", "output", *bends)
    table.add("level of the output", "dynamic", *(leaky(h, t) for h in bends[::2] for t in bank.taus[::2]))
    _motion(table, bank, u, y, v, bends)
    for i in range(run.shape[1]):
        if i != output:
            x = (run[:, i] - run[:, i].mean()) / bank.spread[nu]
            table.add(record.output_names[i], "dynamic", x, rate(x), x * y, x * v, x * x)
    table.add("time", "time", time * y, time * leaky(y, bank.taus[len(bank.taus) // 2]))
    table.add("time", "sampling", v * time, v * time**2, rate(v) * time)
    table.add("time", "trend", time)  # added, or what a changing gain makes of an operating level
    table.add("time", "disturbance", time**2, time**3)
    return Columns(np.stack(table.columns, axis=1), tuple(table.names), tuple(table.kinds))


def _motion(table: _Table, bank: Bank, u: list[Array], y: Array, v: Array, bends: list[Array]) -> None:
    """Terms of forces inside a plant: by rate, direction, products, and states slower than the plant."""
    middle = bank.taus[:: max(1, len(bank.taus) // 3)]
    force = [np.abs(v), v * np.abs(v), np.tanh(4.0 * v), y * v, y**2 * v, y * np.abs(v)]
    for f in force:
        name = "direction of motion" if f is force[2] else "rate of the output"
        table.add(name, "dynamic", f, *(leaky(f, t) for t in middle))
    for x in u:
        for p in (x * y, x * v):
            table.add("level of the output", "dynamic", p, *(leaky(p, t) for t in middle))
    for source, name in [(x * x, "slow state") for x in u] + [(np.abs(v), "slow state"), (y, "slow state")]:
        for t in bank.slow:
            s = leaky(source, t)
            table.add(name, "dynamic", s, s * y, *(s * x for x in u), *(s * h for h in bends[1:2]))
