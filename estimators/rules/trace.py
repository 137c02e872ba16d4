"""Sequential experiments: a rule that asks for inputs, the loop that runs it, and the trace it leaves.

A *rule* is a generator function. It yields the next input, (N, nu), or a `Step` where the input has a part
to play (`kind`), and receives the measured output, (N, ny):

    def repeat(samples, n_inputs, n_outputs, rng):
        while True:
            y = yield np.ones((samples, n_inputs))

`run` is the only loop. Because a rule never sees the rig, the same generator can be driven by a simulated
plant, by a person with files, or by records played back."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from estimators.stages import stage
from oed.data import Record, as_signal
from oed.errors import ExperimentError, InputError, OedError, Status, interruption
from oed.experiments import Experiment, Usage

Rule = Callable[[int, int, int, np.random.Generator], Generator[Any, NDArray[np.float64], None]]
AnyRule = TypeVar("AnyRule", bound=Callable[..., Generator[Any, NDArray[np.float64], None]])


@dataclass(frozen=True)
class Offer:
    """A rule that the comparison has by name, in `words`: whether it is for one channel alone, and one of the iterations."""

    rule: Callable[..., Any]
    words: str
    one_channel: bool = False
    iterations: bool = False


OFFERS: dict[str, Offer] = {}
"""By name, filled where the rules are written."""


def offered(name: str, words: str, **how: bool) -> Callable[[AnyRule], AnyRule]:
    """Offer the rule that follows to the comparison."""

    def keep(rule: AnyRule) -> AnyRule:
        OFFERS[name] = Offer(rule, words, **how)
        return rule

    return keep


@dataclass(frozen=True, eq=False)
class Step:
    """An input with its part in the method. `u` (N, nu) the input to apply; `kind` what the experiment is
    for: "power", "forward", "transpose 1 2" (input 1, output 2), "white", ... One iteration of a method
    begins at every kind that is not "transpose ..."."""

    u: NDArray[np.float64]
    kind: str = ""


@dataclass(frozen=True, eq=False)
class Trace:
    """What a sequential method did and measured.

    Attributes
    ----------
    records : tuple of Record
        Input and output of every experiment, in order.
    kinds : tuple of str
        The part of each experiment in the method (`Step.kind`).
    usage : Usage
        Experiments, samples, energy and largest input.
    status : Status
        OK if the rule ended by itself, BUDGET if the experiments were used up, CONVERGED if the stopping
        rule said so, FAILED if an experiment went wrong (what was measured before is kept).
    message : str
        The sentence a user reads.
    """

    records: tuple[Record, ...]
    kinds: tuple[str, ...]
    usage: Usage
    status: Status
    message: str

    def __len__(self) -> int:
        return len(self.records)

    @property
    def iterations(self) -> list[slice]:
        """Where each iteration of the method lies among the records."""
        starts = [k for k, kind in enumerate(self.kinds) if not kind.startswith("transpose")]
        return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(self.records)], strict=True)]

    def first(self, experiments: int) -> Trace:
        """The trace as it was after its first experiments.

        Parameters
        ----------
        experiments : int
            How many to keep.

        Returns
        -------
        Trace
            With the usage of what is kept; status BUDGET if something was cut off.
        """
        if experiments >= len(self.records):
            return self
        return _trace(
            self.records[:experiments], self.kinds[:experiments], Status.BUDGET, Status.BUDGET.value
        )

    def __repr__(self) -> str:
        return (
            f"Trace of {self.usage.experiments} experiments, {self.usage.samples} samples, "
            f"input energy {self.usage.energy:.6g}: {self.message}"
        )


def run(
    rule: Rule,
    experiment: Experiment,
    *,
    samples: int,
    experiments: int,
    rng: np.random.Generator | int,
    stop: Callable[[Trace], bool] | None = None,
) -> Trace:
    """Run a sequential method on a system.

    Parameters
    ----------
    rule : callable
        Generator function of (samples, n_inputs, n_outputs, rng); options by `functools.partial`.
    experiment : Experiment
        The system.
    samples : int
        Length N of every experiment.
    experiments : int
        Budget of experiments.
    rng : numpy.random.Generator or int
        For what the rule draws at random; a number is its seed.
    stop : callable, optional
        From the trace so far to whether that is enough; asked after every experiment.

    Returns
    -------
    Trace
        All that was measured. If an experiment fails after the first, what was measured before is kept
        and the status is FAILED.

    Raises
    ------
    InputError
        If an argument breaks a rule, or the first input breaks a limit of the experiment.
    ExperimentError
        If the first experiment fails.
    """
    if not isinstance(experiment, Experiment):
        raise InputError(
            f"the system under test is given as {type(experiment).__name__}; give oed.simulated(plant) of a plant, or "
            "oed.Experiment(apply, n_inputs, n_outputs) of a function u -> y."
        )
    if not callable(rule):
        raise InputError(
            f"the method is {rule!r}; give a generator function (samples, n_inputs, n_outputs, rng), such as "
            "estimators.power_iterations."
        )
    rng = np.random.default_rng(rng)
    for name, value, least in (("samples", samples, 2), ("experiments", experiments, 1)):
        if not isinstance(value, int | np.integer) or value < least:
            raise InputError(f"{name} is {value!r}; it must be an integer of at least {least}.")
    records: list[Record] = []
    kinds: list[str] = []
    generator = rule(int(samples), experiment.n_inputs, experiment.n_outputs, rng)
    y: NDArray[np.float64] | None = None
    status = Status.BUDGET
    message = status.value
    while len(records) < experiments:
        stage("experiments", len(records), experiments)
        try:
            asked = next(generator) if y is None else generator.send(y)
        except StopIteration:
            status, message = Status.OK, Status.OK.value
            break
        except ExperimentError as error:  # the rule cannot go on from what was measured
            if not records:
                raise
            status, message = Status.FAILED, f"{error} The {len(records)} experiments before are kept."
            break
        step = asked if isinstance(asked, Step) else Step(asked)
        u = as_signal(step.u, "the input that the rule asks for")
        try:
            y = experiment(u)
            _check_varies(u, y, step.kind, len(records) + 1)
        except Exception as error:
            if ended := interruption(error):
                raise ended from None
            reason = str(error) if isinstance(error, OedError) else f"{type(error).__name__}: {error}"
            if not records:
                if isinstance(error, OedError):
                    raise
                raise ExperimentError(
                    f"experiment 1 failed with {reason}; nothing was measured: check the system and its interface."
                ) from error
            status, message = Status.FAILED, f"{reason} The {len(records)} experiments before are kept."
            break
        records.append(Record(u, y, dt=experiment.dt))
        kinds.append(step.kind)
        if stop is not None and stop(_trace(tuple(records), tuple(kinds), Status.OK, "running")):
            status, message = Status.CONVERGED, Status.CONVERGED.value
            break
    generator.close()
    # Where the system had nothing to do before, and refused nothing, it has counted already.
    fresh = experiment.used.experiments == len(records)
    return _trace(tuple(records), tuple(kinds), status, message, experiment.used if fresh else None)


def _trace(
    records: tuple[Record, ...],
    kinds: tuple[str, ...],
    status: Status,
    message: str,
    used: Usage | None = None,
) -> Trace:
    if used is None:
        used = Usage()
        for record in records:
            used = used.add(record.u)
    return Trace(records, kinds, used, status, message)


def _check_varies(u: NDArray, y: NDArray, kind: str, number: int) -> None:
    """A rig that answers a varying input by a constant has a stuck sensor or a dead actuator."""
    if y[0, 0] != y[-1, 0] or kind.startswith("transpose"):
        return  # of a transpose an input without influence is possible
    if len(y) > 2 and (y == y[0]).all() and (u != u[0]).any():
        raise ExperimentError(
            f"experiment {number} returned the constant output {y[0].tolist()} for an input that varies; "
            "check the sensor, the actuator and the wiring."
        )
