"""The answer of a diagnosis as a model to be used: simulated, predicted with intervals, kept in a file, handed on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.diagnosis.effects import CATALOGUE, Effect
from estimators.diagnosis.result.answers import Answer, LinearAnswer, read_answer
from oed.data import Record
from oed.errors import InputError
from oed.files.writing import write_whole

__all__ = ["DiagnosedModel"]

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
    together; `dt` sampling time in seconds; `inputs, outputs` names of the channels.

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

        Shapes: returns (N, ny).
        """
        y = self.simulate(given, window)
        half = NORMAL * self.errors
        return y, y - half, y + half

    def to_json(self) -> str:
        """The model as text."""
        return json.dumps(
            {"schema": SCHEMA, "answers": [a.to_dict() for a in self.answers], "errors": self.errors.tolist(),
             "dt": self.dt, "inputs": list(self.inputs), "outputs": list(self.outputs)}
        )  # fmt: skip

    @classmethod
    def from_json(cls, text: str, effects: tuple[Effect, ...] = CATALOGUE) -> DiagnosedModel:
        """The model that `to_json` wrote."""
        try:
            data = json.loads(text)
            if data["schema"] != SCHEMA:
                raise InputError(f"the model has schema {data['schema']!r}; this version reads {SCHEMA}.")
            answers = tuple(read_answer(a, effects) for a in data["answers"])
            errors, names = (
                np.array(data["errors"], dtype=float),
                (tuple(data["inputs"]), tuple(data["outputs"])),
            )
            return cls(answers, errors, float(data["dt"]), *names)
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
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path} cannot be read ({error}); give a file that `save` wrote.") from None
        return cls.from_json(text)

    def to_control(self) -> Any:
        """The model as a python-control transfer function, where it is linear."""
        import control

        linear = [a for a in self.answers if isinstance(a, LinearAnswer)]
        if len(linear) < len(self.answers):
            raise InputError(
                "the model has effects that no transfer function holds; simulate it, or export it with `to_casadi`."
            )
        num = [[np.zeros(1) for _ in self.inputs] for _ in linear]
        den = [[np.ones(1) for _ in self.inputs] for _ in linear]
        for i, a in enumerate(linear):
            for j, b in zip(a.inputs, a.model.num, strict=True):
                n = max(len(b), len(a.model.den))  # in powers of z: both to the same length
                num[i][j] = np.concatenate((b, np.zeros(n - len(b))))
                den[i][j] = np.concatenate((a.model.den, np.zeros(n - len(a.model.den))))
        return control.TransferFunction(num, den, self.dt)
