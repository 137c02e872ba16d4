"""The best linear model of measured records: what every later stage starts from and is compared with."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline.blocks import Blocks
from estimators.diagnosis.baseline.linear_model import REACH, LinearModel, Prior
from oed.data import Record
from oed.models.poles import Pole, poles_in_hz

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Options:
    """What the caller knows and wants of the linear model.

    `deviations` true: signals are deviations from a rest in which every record starts, so that there is no
    offset; else one is fitted, and the data tell where a record starts; `diagonal` whether input i drives
    output i alone; `window` samples that set the state of a free run and do not count; 20 is what the
    published benchmarks allow least; `blocks` blocks of the cross-validation: each fit sees four fifths of
    the data, as a final fit nearly does; `guard` samples beside a held-out block that no fit uses: above the
    largest order; `moving` whether the records are known to begin in a state away from rest: what rings from there
    on is then dynamics; `asked` (M, nu) inputs on which the model is wanted: one that hangs there on single blocks gives way; `later`
    outputs on which no input acts in its own sample.
    """

    deviations: bool | None = None
    diagonal: bool = False
    window: int = 20
    blocks: int = 5
    guard: int = 30
    moving: bool = False
    asked: tuple[Array, ...] = ()
    later: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class OutputModel:
    """The linear model of one output and why it was taken.

    `inputs` which inputs drive it; the numerator has a row for each; `kind, orders` structure ("ARX", "OE",
    ...) and its orders in words; `delays` samples of delay of each input; `model` fitted to all blocks;
    `prior` how its state is set; `noise` AR coefficients (leading 1) of measured minus simulated output: its
    one-step noise model; `noise_std` standard deviation of that model's innovations; `why` sentences; `folds`
    fitted without each block, in the order of the blocks; `tones` frequencies in Hz of disturbances that were
    set aside before the order was chosen; `warnings` where its free run is not to be trusted; `together` order and
    delays of the best model in which all inputs share their poles, where this one's have poles of their own.
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
    tones: tuple[float, ...] = ()
    warnings: tuple[str, ...] = ()
    together: tuple[int, tuple[int, ...]] | None = None

    @property
    def shared(self) -> tuple[int, tuple[int, ...]]:
        """Order and delays of a model in which all inputs share their poles: what effects inside a plant start from."""
        return (self.model.order, self.delays) if self.together is None else self.together

    def ill_posed(self, blocks: Blocks) -> bool:
        """Whether a pole remembers the initial state for longer than the records are."""
        return 1.0 - self.model.radius < 1.0 / max(blocks.lengths)


@dataclass(frozen=True, eq=False)
class Baseline:
    """The best linear model of some training records, by blocked cross-validation of its free run.

    `outputs` one model per output; `blocks` which samples count, and the blocks that all later stages use;
    `y_model` per record (N, ny): free run of the final model; `unused` per record (N, ny): free run of every
    block by a model fitted to the others; `rmse_unused, rmse_unused_se` (ny,) error of `unused` on the
    samples that count, and its standard error over parts of blocks; `dt` sampling time.
    """

    outputs: tuple[OutputModel, ...]
    blocks: Blocks
    y_model: tuple[Array, ...]
    unused: tuple[Array, ...]
    rmse_unused: Array
    rmse_unused_se: Array
    dt: float

    def alone(self, output: int) -> "Baseline":
        """Of one output, for records that have no other."""
        one = [output]
        return replace(
            self, outputs=(self.outputs[output],), y_model=tuple(y[:, one] for y in self.y_model), unused=tuple(y[:, one] for y in self.unused),
            rmse_unused=self.rmse_unused[one], rmse_unused_se=self.rmse_unused_se[one],
        )  # fmt: skip

    @property
    def ill_posed(self) -> bool:
        """Whether a free run hangs on its initial state, which a window of samples cannot tell well enough."""
        return any(m.ill_posed(self.blocks) for m in self.outputs)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences: where a free run is ill-posed, or worse than the record's mean."""
        return tuple(sentence for m in self.outputs for sentence in m.warnings)

    @property
    def structure(self) -> str:
        """Structure and orders of every output's model."""
        return "; ".join(f"{m.kind}: {m.orders}" for m in self.outputs)

    @property
    def why(self) -> tuple[str, ...]:
        """Sentences: what was chosen for each output, and why."""
        return tuple(sentence for m in self.outputs for sentence in m.why)

    @property
    def described(self) -> dict[str, Any]:
        """The linear model in words: one entry where there is one output."""
        poles = [
            [p.frequency_hz, p.damping, p.time_constant]
            for i in range(len(self.outputs))
            for p in self.poles(i)
        ]
        return {
            "structure": self.structure, "orders": [m.orders for m in self.outputs],
            "delay": [list(m.delays) for m in self.outputs], "poles": poles, "why": list(self.why),
        }  # fmt: skip

    def poles(self, output: int = 0) -> tuple[Pole, ...]:
        """Poles of one output's model, slowest first; a conjugate pair is one row."""
        return poles_in_hz(self.outputs[output].model.poles, self.dt)

    def simulate(self, record: Record, window: int | None = None) -> Array:
        """Free run on a record.

        Shapes: returns (N, ny).
        """
        w = self.blocks.window if window is None else window
        return np.stack(
            [
                m.model.free_run(m.prior, record.u[:, list(m.inputs)], record.y[:, i], w)
                for i, m in enumerate(self.outputs)
            ],
            axis=1,
        )

    def opening(self, length: int) -> int:
        """How many samples of a training record set its state."""
        return min(length, REACH) if self.ill_posed else self.blocks.window

    def k_step(self, record: Record, k: int) -> Array:
        """Every sample from outputs up to k samples earlier.

        Shapes: returns (N, ny).
        """
        out = np.full(record.y.shape, np.nan)
        for i, m in enumerate(self.outputs):
            u, y = record.u[:, list(m.inputs)], record.y[:, i]
            w = max(self.blocks.window, 2 * m.model.order + 2)
            prior = replace(m.prior, rest=False)
            for s in range(0, len(record) - w, k):
                out[s + w : s + w + k, i] = m.model.free_run(prior, u[s : s + w + k], y[s : s + w + k], w)[w:]
        return out


def of_output(record: Record, i: int) -> Record:
    """A record with one of its outputs alone."""
    names, units = record.output_names, record.output_units
    return record.replace(y=record.y[:, [i]], output_names=(names[i],), output_units=(units[i],))
