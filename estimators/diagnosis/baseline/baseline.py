"""The best linear model of measured records: what every later stage starts from and is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline.blocks import Blocks, blocks_of
from estimators.diagnosis.baseline.choice import Trial, simplest
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior, rest_level
from estimators.diagnosis.baseline.regression import Arx
from estimators.diagnosis.baseline.search import Search
from oed.data import Record
from oed.errors import InputError

__all__ = ["Baseline", "Options", "OutputModel", "Pole", "best_linear"]

Array = NDArray[np.float64]

QUIET = 1e-4
"""Noise of a window's samples, of the output's variance: small, as a state that is too free costs less than one that is
held; records with more noise have it in every sample of the window."""


@dataclass(frozen=True)
class Options:
    """What the caller knows and wants of the linear model.

    Attributes
    ----------
    deviations : bool or None
        True: signals are deviations from a rest in which every record starts (no offset); None: the data decide.
    diagonal : bool
        Whether input i drives output i alone.
    window : int
        Samples that set the state of a free run and do not count; 20 is what the published benchmarks allow least.
    blocks : int
        Blocks of the cross-validation: each fit sees four fifths of the data, as a final fit nearly does.
    guard : int
        Samples beside a held-out block that no fit uses: above the largest order.
    """

    deviations: bool | None = None
    diagonal: bool = False
    window: int = 20
    blocks: int = 5
    guard: int = 30


@dataclass(frozen=True)
class Pole:
    """A pole, or a pair of conjugate ones: frequency (0 for a real pole), damping ratio, time constant in seconds."""

    frequency_hz: float
    damping: float
    time_constant: float
    radius: float


@dataclass(frozen=True, eq=False)
class OutputModel:
    """The linear model of one output and why it was taken.

    Attributes
    ----------
    inputs : tuple of int
        Which inputs drive it; the numerator has a row for each.
    kind, orders : str
        Structure ("ARX", "OE", ...) and its orders in words.
    delays : tuple of int
        Samples of delay of each input.
    model : LinearModel
        Fitted to all blocks.
    prior : Prior
        How its state is set.
    noise : ndarray
        AR coefficients (leading 1) of measured minus simulated output: its one-step noise model.
    noise_std : float
        Standard deviation of that model's innovations.
    why : tuple of str
        Sentences.
    folds : tuple of LinearModel
        Fitted without each block, in the order of the blocks.
    """

    inputs: tuple[int, ...]
    kind: str
    orders: str
    delays: tuple[int, ...]
    model: LinearModel
    prior: Prior
    noise: Array
    noise_std: float
    why: tuple[str, ...]
    folds: tuple[LinearModel, ...] = ()


@dataclass(frozen=True, eq=False)
class Baseline:
    """The best linear model of some training records, by blocked cross-validation of its free run.

    Attributes
    ----------
    outputs : tuple of OutputModel
        One model per output.
    blocks : Blocks
        Which samples count, and the blocks that all later stages use.
    y_model : tuple of ndarray
        Per record (N, ny): free run of the final model.
    unused : tuple of ndarray
        Per record (N, ny): free run of every block by a model fitted to the others.
    rmse_unused, rmse_unused_se : ndarray
        (ny,) error of `unused` on the samples that count, and its standard error over parts of blocks.
    ill_posed : bool
        Whether a free run hangs on its initial state, or is worse than the record's mean.
    dt : float
        Sampling time.
    """

    outputs: tuple[OutputModel, ...]
    blocks: Blocks
    y_model: tuple[Array, ...]
    unused: tuple[Array, ...]
    rmse_unused: Array
    rmse_unused_se: Array
    ill_posed: bool
    warnings: tuple[str, ...]
    dt: float

    @property
    def structure(self) -> str:
        """Structure and orders of every output's model."""
        return "; ".join(f"{m.kind}: {m.orders}" for m in self.outputs)

    @property
    def why(self) -> tuple[str, ...]:
        """Sentences: what was chosen for each output, and why."""
        return tuple(sentence for m in self.outputs for sentence in m.why)

    def poles(self, output: int = 0) -> tuple[Pole, ...]:
        """Poles of one output's model, slowest first; a conjugate pair is one row."""
        rows = []
        for z in self.outputs[output].model.poles:
            if z.imag < 0 or abs(z) < 1e-6:  # the other of a pair; a delay
                continue
            s = np.log(z) / self.dt
            rows.append(
                Pole(
                    float(abs(s.imag) / (2 * np.pi)),
                    float(-s.real / max(abs(s), 1e-300)),
                    float(-1.0 / s.real) if s.real else np.inf,
                    float(abs(z)),
                )
            )
        return tuple(sorted(rows, key=lambda p: -p.radius))

    def simulate(self, record: Record, window: int | None = None) -> Array:
        """(N, ny) free run on a record; its first `window` samples (default: the blocks') set the state."""
        w = self.blocks.window if window is None else window
        return np.stack(
            [
                m.model.free_run(m.prior, record.u[:, list(m.inputs)], record.y[:, i], w)
                for i, m in enumerate(self.outputs)
            ],
            axis=1,
        )

    def k_step(self, record: Record, k: int) -> Array:
        """(N, ny) prediction of every sample from outputs up to k samples earlier; NaN where there are too few."""
        out = np.full(record.y.shape, np.nan)
        for i, m in enumerate(self.outputs):
            u = record.u[:, list(m.inputs)]
            w = max(self.blocks.window, 2 * m.model.order)
            for s in range(len(record) - w - k + 1):
                rows = slice(s, s + w + k)
                out[s + w + k - 1, i] = m.model.free_run(m.prior, u[rows], record.y[rows, i], w)[-1]
        return out


def best_linear(records: Sequence[Record], options: Options | None = None) -> Baseline:
    """The linear model of each output with the least free-run error on unused blocks, and the simplest within its error."""
    options = Options() if options is None else options
    if not records:
        raise InputError("there is no training record; give at least one.")
    blocks = blocks_of(records, options.blocks, 0 if options.deviations else options.window, options.guard)
    found = [_output(records, i, blocks, options) for i in range(records[0].n_outputs)]
    unused = tuple(np.stack([t.unused[r] for _, t in found], axis=1) for r in range(len(records)))
    outputs = tuple(m for m, _ in found)
    squares = [t.squares for _, t in found]
    rmse = np.array([np.sqrt(s.mean()) for s in squares])
    se = np.array([s.std(ddof=1) / np.sqrt(len(s)) / (2 * r) for s, r in zip(squares, rmse, strict=True)])
    base = Baseline(outputs, blocks, (), unused, rmse, se, False, (), records[0].dt)
    return replace(base, y_model=tuple(base.simulate(record) for record in records))


def _output(records: Sequence[Record], i: int, blocks: Blocks, options: Options) -> tuple[OutputModel, Trial]:
    inputs = (i,) if options.diagonal else tuple(range(records[0].n_inputs))
    own = [r.replace(u=r.u[:, list(inputs)], input_names=(), input_units=()) for r in records]
    prior = _prior(own, i, blocks, options)
    trials = Search(own, i, blocks, prior, not options.deviations).trials()
    chosen = simplest(trials)
    c = chosen.candidate
    form: Arx = c.form  # type: ignore[assignment]
    why = (
        f"{c.kind}({c.orders}) of {len(trials)} stable candidates: error {chosen.rmse:.4g} on unused blocks",
    )
    return OutputModel(
        inputs,
        c.kind,
        c.orders,
        form.delay,
        c.models[-1],
        prior,
        np.ones(1),
        chosen.rmse,
        why,
        tuple(c.models[:-1]),
    ), chosen


def _prior(records: Sequence[Record], i: int, blocks: Blocks, options: Options) -> Prior:
    y = np.concatenate([r.y[:, i] for r in records])
    mean = float(np.nanmean(y))
    d = np.nan_to_num(y - mean)
    covariance = np.array([d[: len(d) - k] @ d[k:] for k in range(64)]) / len(d)
    level, held = rest_level(records[0].u, records[0].y[:, i], covariance[0]), records[0].u[0]
    return Prior(mean, covariance, QUIET * covariance[0], 0.0, bool(options.deviations), level, held)
