"""The answer of a diagnosis as a model to be used: simulated, predicted with intervals, kept in a file, handed on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.diagnosis.effects import CATALOGUE, Effect
from estimators.diagnosis.result.answers import Answer, RemainderAnswer, read_answer
from oed.data import Record
from oed.errors import InputError
from oed.files.limits import file_content
from oed.files.writing import write_whole

if TYPE_CHECKING:
    from estimators.diagnosis.ladder.steps import Ladder, Step

Array = NDArray[Any]
NORMAL = 1.96
"""Two-sided 95 % of a normal deviate."""
SCHEMA = 1
"""Of the file: one that is not known is refused."""


@dataclass(frozen=True, eq=False)
class DiagnosedModel:
    """The model that a diagnosis ends with.

    `answers` one model per output; `errors` (ny,) root mean square error of each on blocks that its
    parameters did not see: what it does not know of the plant, its parameters' errors and the noise, all
    together; `dt` sampling time in seconds; `inputs, outputs` names of the channels; `coverage` (ny,) share of the
    samples of those blocks that lie within the 95 % interval made of the errors, NaN where it was not measured: what is
    beyond .95 by much is wide for most samples, as the errors are then of few.

    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> from estimators import diagnose
    >>> from oed.data import Record
    >>> u = np.random.default_rng(0).standard_normal(200)
    >>> y = lfilter([0, 0.5], [1, -0.5], u) + 0.1 * np.random.default_rng(1).standard_normal(200)
    >>> model = diagnose(Record(u, y)).model
    >>> model.simulate(np.ones(50)).shape
    (50, 1)
    """

    answers: tuple[Answer, ...]
    errors: Array
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    coverage: Array = field(default_factory=lambda: np.full(1, np.nan))

    def __post_init__(self) -> None:
        if len(self.coverage) != len(self.outputs):
            object.__setattr__(self, "coverage", np.full(len(self.outputs), np.nan))

    def _record(self, given: Record | ArrayLike) -> Record:
        if isinstance(given, Record):
            return given
        u = np.asarray(given, dtype=float)
        u = u[:, None] if u.ndim == 1 else u
        if u.ndim != 2 or u.shape[1] != len(self.inputs):
            raise InputError(
                f"the input has shape {u.shape}; the model takes (N, {len(self.inputs)}): {', '.join(self.inputs)}."
            )
        return Record(u, np.full((len(u), len(self.outputs)), np.nan), dt=self.dt)

    def simulate(self, given: Record | ArrayLike, window: int = 0) -> Array:
        """Free run.

        Shapes: returns (N, ny).
        """
        record = self._record(given)
        return np.stack([a.simulate(record, window) for a in self.answers], axis=1)

    def predict(self, given: Record | ArrayLike, window: int = 0) -> tuple[Array, Array, Array]:
        """Free run with a 95 % interval for the measured output.

        The interval is of one width: `NORMAL` times the error on unused blocks. `coverage` says how often it held there.

        Parameters
        ----------
        given : Record or array_like of shape (N, nu)
            Inputs in their units, and the outputs that set the state where there is a window.
        window : int
            Measured samples that may set the state; without, the run starts at rest or settled under its first input.

        Returns
        -------
        y, low, high : ndarray
            (N, ny) each, in the outputs' units.

        Raises
        ------
        InputError
            If the inputs have another shape.
        """
        y = self.simulate(given, window)
        half = NORMAL * self.errors
        return y, y - half, y + half

    def to_json(self) -> str:
        """The model as text."""
        return json.dumps(
            {"schema": SCHEMA, "answers": [a.to_dict() for a in self.answers], "errors": self.errors.tolist(),
             "dt": self.dt, "inputs": list(self.inputs), "outputs": list(self.outputs),
             "coverage": [None if np.isnan(c) else c for c in self.coverage.tolist()]}
        )  # fmt: skip

    @classmethod
    def from_json(cls, text: str, effects: tuple[Effect, ...] = CATALOGUE) -> DiagnosedModel:
        """The model that `to_json` wrote."""
        try:
            data = json.loads(text)
            if data["schema"] != SCHEMA:
                raise InputError(f"the model has schema {data['schema']!r}; this version reads {SCHEMA}.")
            answers = tuple(read_answer(a, effects) for a in data["answers"])
            errors, coverage = (np.array(data[key], dtype=float) for key in ("errors", "coverage"))
            return cls(
                answers, errors, float(data["dt"]), tuple(data["inputs"]), tuple(data["outputs"]), coverage
            )
        except (ValueError, KeyError, TypeError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"the text is no diagnosed model ({error}); give what `to_json` or `save` wrote."
            ) from None

    def save(self, path: Path | str) -> None:
        """Write the model to a file."""
        write_whole(Path(path), self.to_json() + "\n")

    @classmethod
    def load(cls, path: Path | str) -> DiagnosedModel:
        """Read the model from a file."""
        try:
            text = file_content(Path(path)).decode()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path} cannot be read ({error}); give a file that `save` wrote.") from None
        return cls.from_json(text)

    def without_remainder(self) -> DiagnosedModel:
        """The model without its black-box part, with the larger errors that it then has on unused blocks.

        Returns
        -------
        DiagnosedModel
            Itself where it has none. The coverage of its interval was not measured: NaN.

        Examples
        --------
        >>> import numpy as np
        >>> from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
        >>> from estimators.diagnosis.result.answers import LinearAnswer
        >>> lag = LinearAnswer(0, (0,), LinearModel(np.array([1, -0.5]), np.array([[0, 0.5]])), Prior(0.0, np.ones(9), 0.1))
        >>> DiagnosedModel((lag,), np.array([0.1]), 0.5, ("u",), ("y",)).without_remainder().errors
        array([0.1])
        """
        errors, coverage, answers = self.errors.copy(), self.coverage.copy(), list(self.answers)
        for i, a in enumerate(self.answers):
            if isinstance(a, RemainderAnswer):
                errors[i] = np.sqrt(errors[i] ** 2 + max(a.rest.gain.value, 0.0))
                coverage[i], answers[i] = np.nan, a.below
        return replace(self, answers=tuple(answers), errors=errors, coverage=coverage)

    def to_casadi(self, settled: ArrayLike | None = None) -> tuple[Any, Array]:
        """The model as a CasADi function of one step, for predictive control, estimators and trajectories.

        The step is exact: repeated over a record that begins with the inputs `settled`, it gives what `simulate` gives
        without a window. Only a sensor's rounding is left out, as it has no slope.

        Parameters
        ----------
        settled : array_like of shape (nu,), optional
            Constant inputs before the first sample, in the inputs' units; zero where it is not given.

        Returns
        -------
        step : casadi.Function
            (x, u, k) -> (x_next, y): state (n,), inputs (nu,) in their units at sample k, its number from time 0 on (only
            models that vary with time read it), and outputs (ny,) at that sample.
        start : ndarray
            (n,) the state at k = 0: at rest, or settled under the inputs.

        Raises
        ------
        InputError
            If a part of the model has no twin, with its name and what to do instead, or the inputs have another shape.

        Notes
        -----
        The terms are those that the compiled recursions are held to, see `estimators/diagnosis/effects/symbols`. Many have
        corners (dead zones, plays, limits): solvers that need smooth functions may ask for several starts. The receding
        horizon that such a step is made for: J. B. Rawlings, D. Q. Mayne, M. M. Diehl, Model Predictive Control, 2nd ed.,
        2017, section 1.

        Examples
        --------
        >>> import numpy as np
        >>> from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
        >>> from estimators.diagnosis.result.answers import LinearAnswer
        >>> lag = LinearAnswer(0, (0,), LinearModel(np.array([1, -0.5]), np.array([[0, 0.5]])), Prior(0.0, np.ones(9), 0.1))
        >>> step, x = DiagnosedModel((lag,), np.array([0.1]), 0.5, ("u",), ("y",)).to_casadi()
        >>> for k in range(3):
        ...     x, y = step(x, 1.0, k)
        >>> float(y)
        0.75
        """
        from estimators.diagnosis.effects.symbols.wiring import Wiring

        level = (
            np.zeros(len(self.inputs)) if settled is None else np.atleast_1d(np.asarray(settled, dtype=float))
        )
        if level.shape != (len(self.inputs),) or not np.all(np.isfinite(level)):
            raise InputError(
                f"the settled inputs are {settled}; give {len(self.inputs)} finite numbers: {', '.join(self.inputs)}."
            )
        w, y = Wiring(level), []
        for name, answer in zip(self.outputs, self.answers, strict=True):
            w.output = name
            y.append(answer.symbols(w))
        return w.step(y), w.start

    def to_control(self) -> Any:
        """The model as a python-control state-space system, where it is linear.

        Offsets and disturbances are left out: its inputs and outputs are deviations from them.

        Returns
        -------
        control.StateSpace
            In discrete time, with the names of the channels; delays and filters are among its states.

        Raises
        ------
        InputError
            If the model is not linear in its states and inputs, or has a part that `to_casadi` refuses.

        Examples
        --------
        >>> import numpy as np
        >>> from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
        >>> from estimators.diagnosis.result.answers import LinearAnswer
        >>> lag = LinearAnswer(0, (0,), LinearModel(np.array([1, -0.5]), np.array([[0, 0.5]])), Prior(0.0, np.ones(9), 0.1))
        >>> plant = DiagnosedModel((lag,), np.array([0.1]), 0.5, ("u",), ("y",)).to_control()
        >>> round(float(plant.dcgain()), 6)
        1.0
        """
        import control

        from estimators.diagnosis.effects.symbols.wiring import linear_matrices

        matrices = linear_matrices(self.to_casadi()[0])
        if matrices is None:
            raise InputError(
                "the model has effects that no linear system holds; simulate it, or export it with `to_casadi`."
            )
        A, B, C, D = matrices
        return control.StateSpace(A, B, C, D, self.dt, inputs=list(self.inputs), outputs=list(self.outputs))


def diagnosed_model(
    records: Sequence[Record], steps: Sequence[Step], ladders: Sequence[Ladder]
) -> DiagnosedModel:
    """The answers of all outputs, each with its error on unused blocks, and how often that error's interval held there."""
    errors, coverage = [], []
    for i, (step, ladder) in enumerate(zip(steps, ladders, strict=True)):
        errors.append(next(r.value for r in ladder.rungs if r.step is step))
        e = np.concatenate([r.y[:, i] - run for r, run in zip(records, step.unused, strict=True)])
        coverage.append(np.mean(np.abs(e[np.isfinite(e)]) < NORMAL * errors[-1]))
    first = records[0]
    return DiagnosedModel(tuple(step.answer for step in steps), np.array(errors), first.dt, first.input_names,
                          first.output_names, np.array(coverage))  # fmt: skip
