"""A fitted remainder: what its members add to an earlier run, bounded, and gone far outside the training range."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.ladder import Gain
from estimators.diagnosis.remainder.members import Networks
from estimators.diagnosis.remainder.ridge import Ridge, Set
from estimators.diagnosis.remainder.trees import Trees
from estimators.diagnosis.share.feedback import delayed
from oed.data import Record

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Remainder:
    """A fading-memory model of what an earlier model of one output leaves.

    `output` which output it corrects; `members` what is mixed; `weights` weight of each member; the rest of 1
    stays with the earlier model; `low, high` (nu,) training range of the inputs; `fade` where, in spans
    beyond that range, the correction begins to fade and is gone; `unused` per record (N,): prediction of the
    output by parameters that did not see the sample's block; `rmse_unused` its error there; `gain` what it
    gains over the earlier model there; `admitted` whether that is enough; `why` the same in words; `error`
    the 2.5 % and 97.5 % quantiles of measured minus predicted output on unused blocks; `feedback` whether the
    training input answered the noise: then inputs are taken one sample late.
    """

    output: int
    members: tuple[Ridge | Networks | Trees, ...]
    weights: Array
    low: Array
    high: Array
    fade: tuple[float, float]
    unused: tuple[Array, ...]
    rmse_unused: float
    gain: Gain
    admitted: bool
    why: str
    error: tuple[float, float]
    feedback: bool = False

    def simulate(self, record: Record, earlier: Array) -> Array:
        """Simulated output of a record.

        Shapes: earlier (N, ny), returns (N,).
        """
        own = earlier[:, self.output]
        record = delayed(record) if self.feedback else record
        change = np.zeros(len(record))
        for member, weight in zip(self.members, self.weights, strict=True):
            change += weight * _change(member, record, earlier, self.output)
        return own + self.inside(record) * change

    def inside(self, record: Record) -> Array:
        """How much of the correction applies.

        Shapes: returns (N,).
        """
        span = np.maximum(self.high - self.low, 1e-300)
        beyond = (np.maximum(np.maximum(self.low - record.u, record.u - self.high), 0.0) / span).max(axis=1)
        begin, end = self.fade
        return np.clip((end - beyond) / (end - begin), 0.0, 1.0)

    def predict(self, record: Record, earlier: Array) -> tuple[Array, Array, Array]:
        """Simulated output with a 95 % interval by the errors on unused blocks.

        Shapes: earlier (N, ny), returns (N,).
        """
        run = self.simulate(record, earlier)
        return run, run + self.error[0], run + self.error[1]


def _change(member: Ridge | Networks | Trees, record: Record, earlier: Array, output: int) -> Array:
    """(N,) what a member would add to the earlier run."""
    if isinstance(member, Networks):
        return member.run(record, earlier)
    run = member.run(record, earlier, output)
    alone = isinstance(member, Ridge) and member.which is Set.INPUTS
    return run - earlier[:, output] if alone else run
