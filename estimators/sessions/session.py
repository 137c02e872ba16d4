"""A session: a sequential method that waits for its measurements, in memory or in a folder of files.

The state is the settings and the recorded outputs, nothing else. A method is a generator; given the same outputs it
asks for the same inputs, bit for bit, so a session that was killed is opened again by playing the records back.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.rules.trace import Step, Trace
from estimators.sessions.checking import (
    check_input,
    check_output,
    check_reference,
    check_sizes,
    faults,
    fitting_factor,
    usable,
)
from estimators.sessions.estimates import SessionEstimate, estimate_of
from estimators.sessions.layout import measured, placed, rig_samples, taper
from estimators.sessions.methods import rule_of
from estimators.sessions.settings import Settings
from oed.data import Record, frozen
from oed.errors import ExperimentError, InputError, Status
from oed.experiments import Usage

Array = NDArray[np.float64]


class FlaggedMeasurement(InputError):
    """A measurement that is not fit for use; the session waits for another one of the same step."""


@dataclass(frozen=True, eq=False)
class Asked:
    """An input that waits for its output. `step` from 1; `kind` its part in the method; `u` (N, nu) what the
    method asked for; `whole` (rows, nu) what the rig is to apply; `factor` whole is made of factor times u;
    `limit` which limit demanded a factor below 1, empty where none did."""

    step: int
    kind: str
    u: Array
    whole: Array
    factor: float
    limit: str


class Sequential(ABC):
    """A sequential method that waits for its measurements, wherever they are kept."""

    def __init__(self, settings: Settings, known: Sequence[Array] = ()) -> None:
        self.settings = settings
        self.model = _model(settings)
        s = settings
        rule = rule_of(s, known)
        self._generator = rule(s.samples, s.n_inputs, s.n_outputs, np.random.default_rng(s.seed))
        self._records: list[Record] = []
        self._own: list[Record] = []
        self._rig: list[Record] = []
        self._whole: list[Array] = []
        self._kinds: list[str] = []
        self._noise: list[Array] = []
        self._reductions = 0
        self.finished: Status | None = None
        self.message = ""
        self._waiting: Step | None = None
        self._asked: Asked | None = None
        self._found: SessionEstimate | None = None
        self._advance(None)

    @property
    def step(self) -> int | None:
        """Number of the step whose output is waited for, None when the session is finished."""
        return None if self.finished else len(self._records) + 1

    @abstractmethod
    def ask(self) -> Array:
        """The input to apply next, (rows, nu)."""

    @abstractmethod
    def tell(self, y: ArrayLike, u: ArrayLike | None = None, *, accept: bool = False) -> None:
        """Hand over the output of the input that was asked for."""

    def asked(self) -> Asked:
        """The input to apply next, with its part in the method and how it was scaled.

        Returns
        -------
        Asked
            The input.
        """
        if self._waiting is None:
            raise InputError(
                f"the session is finished ({self.message}) and has no next input; see its estimate."
            )
        if self._asked is None:
            self._asked = self._place(self._waiting)
        return self._asked

    def _checked(self, y: ArrayLike, u: ArrayLike | None, accept: bool) -> Array:
        """The output (rows, ny), fit for use."""
        asked = self.asked()
        try:
            values = np.array(y, dtype=float)
            beside = None if u is None else np.array(u, dtype=float).reshape(len(asked.whole), -1)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"the output is not an array of numbers of the input's length ({error})."
            ) from None
        values = values[:, None] if values.ndim == 1 else values
        check_output(values, len(asked.whole), self.settings)
        if beside is not None:
            if beside.shape != asked.whole.shape:
                raise InputError(f"the recorded input has the shape {beside.shape}, not {asked.whole.shape}.")
            check_reference(beside, asked.whole, self._whole, self.settings)
        self._check_new(values)
        fault = faults(values, asked.whole, self.settings, silent=asked.kind.startswith("transpose"))
        if fault and (not accept or not usable(values).all()):
            raise FlaggedMeasurement(
                f"the measurement of step {asked.step} is flagged and not used: {fault}. Apply the same input again "
                "(after an abort halved by `oed session next DIR --reduce`) and record that; the session waits."
            )
        check_sizes(values, asked.whole)
        return values

    def _check_new(self, values: Array) -> None:
        for k, record in enumerate(self._rig, start=1):
            again = np.array_equal(record.u, self.asked().whole)
            if not again and values.any() and np.array_equal(record.y, values):
                raise InputError(
                    f"this is the output of step {k}, which is recorded; the output of step {self.step} is waited for."
                )

    def run(self, apply: Callable[[Array], object]) -> SessionEstimate:
        """Go on to the end with a rig that is a Python callable.

        Parameters
        ----------
        apply : callable
            (rows, nu) -> (rows, ny).

        Returns
        -------
        SessionEstimate
            The final estimate.

        Raises
        ------
        FlaggedMeasurement
            If a measurement is unfit for use; call `run` again to go on.
        """
        while self.step:
            y: Any = apply(self.ask())
            self.tell(y)
        return self.estimate()

    def reduce(self) -> None:
        """Halve this input and all that follow, after an output went beyond its abort level.

        Raises
        ------
        InputError
            If the session is finished.
        """
        self.asked()
        self._reductions += 1
        self._asked = None

    def estimate(self) -> SessionEstimate:
        """The estimate so far.

        Returns
        -------
        SessionEstimate
            Value, interval, frequency, direction.
        """
        if self._found is None:
            scatter = np.mean(self._noise, axis=0) if self._noise and self.settings.periods > 1 else None
            self._found = estimate_of(self.settings, self.trace, self.own_trace, scatter)
        return self._found

    @property
    def trace(self) -> Trace:
        """Inputs as applied (about the level) and outputs as measured; model minus rig where there is a model."""
        return self._trace(self._records)

    @property
    def own_trace(self) -> Trace:
        """The same as the method sees it: tapered outputs against inputs without their taper."""
        return self._trace(self._own)

    @property
    def rig_records(self) -> tuple[Record, ...]:
        """Everything that was recorded, as it was: levels, ramps, warm-up and rest included."""
        return tuple(self._rig)

    def _trace(self, records: list[Record]) -> Trace:
        usage = Usage()
        for whole in self._whole:
            usage = usage.add(whole - np.asarray(self.settings.level))
        status = self.finished or Status.OK
        return Trace(tuple(records), tuple(self._kinds), usage, status, self.message or "running")

    def _place(self, step: Step) -> Asked:
        u = frozen(step.u)
        s = self.settings
        factor, limit = 0.5**self._reductions, ""
        if factor != 1:
            limit = "reduced after an abort"
        whole = placed(factor * u if factor != 1 else u, s)
        share, binding = fitting_factor(whole, s)
        if share < 1:
            factor, limit = factor * share, binding
            whole = placed(factor * u, s)
        check_input(whole, s)
        return Asked(len(self._records) + 1, step.kind, u, frozen(whole), factor, limit)

    def _use(self, asked: Asked, y: Array) -> None:
        """Use an output that has been checked: from here on nothing can fail but the method itself."""
        s = self.settings
        names: dict[str, Any] = {
            "dt": s.dt, "input_names": s.inputs, "output_names": s.outputs,
            "input_units": s.input_units, "output_units": s.output_units,
        }  # fmt: skip
        difference = y if self.model is None else self.model.simulate(asked.whole - np.asarray(s.level)) - y
        part = measured(difference, s)
        scaled = asked.u if asked.factor == 1 else asked.factor * asked.u
        tapered = s.ramp > 0 and not s.periodic
        w = taper(s)
        own = w * part.y if tapered else part.y
        self._rig.append(Record(asked.whole, y, **names))
        self._records.append(Record(w * scaled if tapered else scaled, part.y, **names))
        self._own.append(Record(scaled, own, **names))
        self._whole.append(asked.whole)
        self._kinds.append(asked.kind)
        self._noise.append(part.noise)
        self._asked = self._found = None
        self._advance(own if asked.factor == 1 else own / asked.factor)

    def _advance(self, y: Array | None) -> None:
        """Let the method say what it wants next."""
        self._waiting = None
        if len(self._records) >= self.settings.experiments:
            self.finished, self.message = Status.BUDGET, Status.BUDGET.value
            return
        try:
            step = next(self._generator) if y is None else self._generator.send(y)
        except StopIteration:
            self.finished, self.message = Status.OK, Status.OK.value
        except ExperimentError as error:  # the method cannot go on from what was measured
            self.finished, self.message = Status.FAILED, str(error)
        else:
            self._waiting = step if isinstance(step, Step) else Step(step)

    def __repr__(self) -> str:
        done = f"{len(self._records)} of {self.settings.experiments} experiments"
        return f"Session of {self.settings.method}, {done}, {rig_samples(self.settings)} rows each"


class Session(Sequential):
    """A sequential method run by whoever has the rig: ask for an input, tell the output.

    Parameters
    ----------
    settings : Settings
        Method, channels, lengths, limits.
    known : sequence of ndarray, optional
        Inputs of the first steps where they are on record (`rule_of`).

    Examples
    --------
    >>> from estimators.sessions import Session, Settings
    >>> from oed import named_plant, simulated
    >>> rig = simulated(named_plant("reference", 0.01), seed=1)
    >>> session = Session(Settings("power", samples=200, experiments=5))
    >>> while session.step:
    ...     session.tell(rig(session.ask()))
    >>> abs(session.estimate().value - 2.41) < 0.1
    True
    """

    def ask(self) -> Array:
        """The input to apply next.

        Returns
        -------
        ndarray
            (rows, nu), levels, ramps, periods and rest included; the same until its output is told.

        Raises
        ------
        InputError
            If the session is finished, or the input violates a limit and cannot be scaled to meet it.
        """
        return self.asked().whole

    def tell(self, y: ArrayLike, u: ArrayLike | None = None, *, accept: bool = False) -> None:
        """Hand over the output of the input that was asked for.

        Parameters
        ----------
        y : array_like
            (rows, ny), one row per row of the input; (rows,) for one output.
        u : array_like, optional
            (rows, nu) the input as it was recorded beside it: it is compared with what was asked for.
        accept : bool
            Whether to use the measurement although it looks saturated or held.

        Raises
        ------
        InputError
            If the output is not of this input; nothing has changed then.
        FlaggedMeasurement
            If it is unfit for use; measure again.
        """
        self._use(self.asked(), self._checked(y, u, accept))


def _model(settings: Settings) -> Any:
    """The model whose error is looked for, checked against the session."""
    if settings.model is None:
        return None
    from oed.plants.json import plant_from_json

    plant = plant_from_json(settings.model)
    if (plant.n_inputs, plant.n_outputs) != (settings.n_inputs, settings.n_outputs):
        raise InputError(
            f"the model has {plant.n_inputs} inputs and {plant.n_outputs} outputs and the session "
            f"{settings.n_inputs} and {settings.n_outputs}; name the channels in the model's order."
        )
    if abs(plant.dt - settings.dt) > 1e-6 * settings.dt:
        raise InputError(
            f"the sampling time of the model is {plant.dt:.9g} s and that of the session {settings.dt:.9g} s; "
            "resample the model."
        )
    return plant
