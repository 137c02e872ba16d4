"""The model of one output as data: what simulates any record, and is written to and read from JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline.baseline import of_output
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.discovery import DiscoveredModel
from estimators.diagnosis.effects import CATALOGUE, Clock, Effect, named
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.remainder.mixture import Remainder
from estimators.diagnosis.remainder.storage import from_json, to_json
from estimators.diagnosis.search.free_runs import Start, lead_in, on_record
from oed.data import Record
from oed.errors import InputError

if TYPE_CHECKING:
    from estimators.diagnosis.effects.symbols.wiring import Wiring

Array = NDArray[Any]


class Answer(Protocol):
    """A model of one output, whatever stage it came from."""

    @property
    def output(self) -> int:
        """Which output of the record."""
        ...

    def simulate(self, record: Record, window: int) -> Array:
        """(N,) free run; the first `window` measured samples may set the state."""
        ...

    def symbols(self, w: Wiring) -> Any:
        """Its output at sample k as a CasADi expression, its states added to the wiring."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """Plain data that `read_answer` reads."""
        ...


def early(record: Record) -> Record:
    """The record with its inputs one sample earlier: what acts without delay then acts after one, as the structures have it."""
    return record.replace(u=np.concatenate((record.u[1:], record.u[-1:])))


def _prior_of(data: dict[str, Any]) -> Prior:
    fields: dict[str, Any] = {k: np.array(v) if isinstance(v, list) else v for k, v in data.items()}
    return Prior(**fields)


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}


@dataclass(frozen=True, eq=False)
class LinearAnswer:
    """The best linear model of an output."""

    output: int
    inputs: tuple[int, ...]
    model: LinearModel
    prior: Prior
    rest: bool = (
        False  # where no sample tells its state, a record starts at rest, as the training record seems to
    )
    # time of the first training sample, and sampling time, where what is left there of a level settles by itself on that clock
    since: tuple[float, float] | None = None

    @property
    def untold(self) -> Prior:
        """The prior of a record without samples that set its state; rest is denied where the training record began away from it."""
        return replace(self.prior, rest=self.prior.rest or (self.rest and not len(self.prior.opening)))

    def simulate(self, record: Record, window: int) -> Array:
        """(N,) free run."""
        u, y = record.u[:, list(self.inputs)], record.y[:, self.output]
        prior = self.prior if np.isfinite(y[:window]).any() else self.untold
        model = self.model
        if self.since is not None:
            model, prior = model.later(prior, round((record.t0 - self.since[0]) / self.since[1]))
        return model.free_run(prior, u, y, window)

    def symbols(self, w: Wiring) -> Any:
        """A filter whose states are those of the transposed direct form."""
        from estimators.diagnosis.effects.symbols import models

        return models.linear(w, self.inputs, self.model, self.untold)

    def to_dict(self) -> dict[str, Any]:
        """Coefficients and how the state is set."""
        m = {"den": self.model.den.tolist(), "num": self.model.num.tolist(), "constant": self.model.constant,
             "moved": self.model.moved.tolist(), "begun": self.model.begun.tolist()}  # fmt: skip
        return {"kind": "linear", "output": self.output, "inputs": list(self.inputs), "model": m,
                "prior": _plain(asdict(self.prior)), "rest": self.rest, "since": self.since}  # fmt: skip


@dataclass(frozen=True, eq=False)
class NamedAnswer:
    """A linear part with named effects around and inside it, on the clock of its training record."""

    output: int
    structure: Structure
    p: Array
    start: Start
    clock: tuple[float, float, int]  # time of the first training sample, sampling time, training samples
    thin: int = 1
    step: float = 0.0  # of the sensor's rounding
    ahead: bool = False  # the input acts in the sample in which it is measured

    def simulate(self, record: Record, window: int) -> Array:
        """(N,) free run."""
        t0, dt, length = self.clock
        first = round((record.t0 - t0) / dt)
        clock = Clock(first + np.arange(len(record), dtype=float), length)
        moved = early(record) if self.ahead else record
        run = on_record(self, moved, self.output, clock, window, self.start, self.thin)
        return np.round(run / self.step) * self.step if self.step > 0 else run

    def symbols(self, w: Wiring) -> Any:
        """Its parts one after another; a sensor's rounding is left out, as it has no slope."""
        from estimators.diagnosis.effects.symbols import models

        if self.thin > 1:
            w.refuse(f"it is a model of every {self.thin}th sample, and its values between them follow from later ones",
                     "diagnose the record sampled as slowly, its inputs averaged over the samples")  # fmt: skip
        t0, dt, length = self.clock
        clock = round(-t0 / dt), length
        return models.structured(w, self.structure, self.p, clock, lead_in(self, self.start), self.ahead)

    def to_dict(self) -> dict[str, Any]:
        """Structure by the keys of its effects, parameters, start and clock."""
        s = self.structure
        parts = [
            {"effect": q.key, "channel": q.channel, "size": q.size, "first": q.first, "free": q.free}
            for q in s.parts
        ]
        form = {"order": s.order, "inputs": list(s.inputs), "layout": s.layout, "delay": s.delay, "taps": s.taps,
                "base": s.base, "steps": s.steps, "parts": parts}  # fmt: skip
        return {
            "kind": "named", "output": self.output, "structure": form, "p": self.p.tolist(),
            "prior": _plain(asdict(self.start.prior)), "rest": self.start.rest, "error": self.start.error, "clock": list(self.clock),
            "thin": self.thin, "step": self.step, "ahead": self.ahead,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class DiscoveredAnswer:
    """One output of a model whose terms were discovered, of all outputs or of that one alone."""

    output: int
    model: DiscoveredModel

    @property
    def _column(self) -> int:
        return self.output if len(self.model.form.orders) > 1 else 0

    def simulate(self, record: Record, window: int) -> Array:
        """(N,) free run."""
        alone = len(self.model.form.orders) < record.n_outputs
        return self.model.simulate(of_output(record, self.output) if alone else record, window)[
            :, self._column
        ]

    def symbols(self, w: Wiring) -> Any:
        """One output of the model, whose states stand once for all outputs that read it."""
        from estimators.diagnosis.effects.symbols import models

        key = self.model.to_json()
        if key not in w.shared:
            w.shared[key] = models.discovered(w, self.model)
        return w.shared[key][self._column]

    def to_dict(self) -> dict[str, Any]:
        """The whole model, as its outputs may drive one another."""
        return {"kind": "discovered", "output": self.output, "model": self.model.to_json()}


@dataclass(frozen=True, eq=False)
class RemainderAnswer:
    """An earlier answer and the remainder on top of it; `others` are the linear answers of all outputs, which it may read."""

    output: int
    below: Answer
    others: tuple[LinearAnswer, ...]
    rest: Remainder

    def simulate(self, record: Record, window: int) -> Array:
        """(N,) free run; that of the answer below where the remainder's is not finite."""
        own = self.below.simulate(record, window)
        earlier = np.stack(
            [own if a.output == self.output else a.simulate(record, window) for a in self.others], axis=1
        )
        if not np.all(np.isfinite(earlier)):
            return own
        run = self.rest.simulate(record, earlier)
        return run if np.all(np.isfinite(run)) else own

    def symbols(self, w: Wiring) -> Any:
        """None: neither its regressions nor its networks have a twin."""
        w.refuse("the remainder is a black box without a twin in CasADi", "take `model.without_remainder()`")

    def to_dict(self) -> dict[str, Any]:
        """The answers that it stands on, and itself."""
        others = [a.to_dict() for a in self.others]
        return {"kind": "remainder", "output": self.output, "below": self.below.to_dict(), "others": others,
                "rest": to_json(self.rest)}  # fmt: skip


@dataclass(frozen=True, eq=False)
class ThroughAnswer:
    """An output as linear dynamics `behind` the inputs and what the model `through` simulates of another output, the last input."""

    output: int
    through: Answer
    behind: LinearAnswer

    def simulate(self, record: Record, window: int) -> Array:
        """(N,) free run."""
        other = self.through.simulate(record, window)
        if not np.all(np.isfinite(other)):
            return other
        names: dict[str, Any] = {"input_names": (), "input_units": ()}
        return self.behind.simulate(record.replace(u=np.column_stack((record.u, other)), **names), window)

    def symbols(self, w: Wiring) -> Any:
        """The other output's model and the filter behind it, settled under what that shows of the constant inputs."""
        from estimators.diagnosis.effects.symbols import models

        return models.through(w, self.through.symbols(w), self.behind)

    def to_dict(self) -> dict[str, Any]:
        """Both parts."""
        return {
            "kind": "through",
            "output": self.output,
            "through": self.through.to_dict(),
            "behind": self.behind.to_dict(),
        }


def _named(data: dict[str, Any], effects: tuple[Effect, ...]) -> NamedAnswer:
    form = data["structure"]
    parts = tuple(
        Part(named(q["effect"], effects), q["channel"], q["size"], q["first"], q["free"])
        for q in form["parts"]
    )
    structure = Structure(**(form | {"inputs": tuple(form["inputs"]), "parts": parts}))
    t0, dt, length = data["clock"]
    start = Start(_prior_of(data["prior"]), data["rest"], data.get("error", 0.0))
    return NamedAnswer(data["output"], structure, np.array(data["p"]), start, (t0, dt, int(length)), data["thin"],
                       data["step"], data["ahead"])  # fmt: skip


def _linear_of(data: dict[str, Any]) -> LinearAnswer:
    """The linear answer that `to_dict` wrote."""
    m = data["model"]
    late = (np.array(m.get(name, ())) for name in ("moved", "begun"))
    model = LinearModel(np.array(m["den"]), np.array(m["num"]), m["constant"], *late)
    since = data.get("since")
    return LinearAnswer(
        data["output"], tuple(data["inputs"]), model, _prior_of(data["prior"]), data.get("rest", False),
        None if since is None else (since[0], since[1]),
    )  # fmt: skip


def read_answer(data: dict[str, Any], effects: tuple[Effect, ...] = CATALOGUE) -> Answer:
    """The answer that `to_dict` wrote; effects of one's own must be among those given."""
    if data["kind"] == "linear":
        return _linear_of(data)
    if data["kind"] == "named":
        return _named(data, effects)
    if data["kind"] == "discovered":
        return DiscoveredAnswer(data["output"], DiscoveredModel.from_json(data["model"]))
    if data["kind"] == "through":
        return ThroughAnswer(
            data["output"], read_answer(data["through"], effects), _linear_of(data["behind"])
        )
    if data["kind"] == "remainder":
        others = tuple(a for d in data["others"] if isinstance(a := read_answer(d), LinearAnswer))
        return RemainderAnswer(
            data["output"], read_answer(data["below"], effects), others, from_json(data["rest"])
        )
    raise InputError(
        f"the model of an output is of the kind {data['kind']!r}; known are linear, named, through, discovered and remainder."
    )
