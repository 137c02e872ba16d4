"""The result of a diagnosis: causes, evidence, the models before and after, and their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.result.words import in_units, named_plainly, spoken
from oed.models.poles import Pole

if TYPE_CHECKING:
    from estimators.diagnosis.result.model import DiagnosedModel

Array = NDArray[Any]


@dataclass(frozen=True)
class ErrorFigure:
    """A root mean square error with its interval.

    `value` in units of the output; `low, high` 95 % interval: of the same record, measured again.
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis:
    """What a linear model of a record lacks, and what adding it does to the error on data not used.

    `detected` whether something is missing; `effect` the first cause, "none" or "unknown"; `variant` A finer
    name of the cause; `nature` the kind of cause; `ranked` causes, best first; `p_value` smallest corrected
    p-value: false alarms over all tests together are at most this frequent; `rmse_before, rmse_after`
    simulation errors on the test record, all outputs; `pred_rmse_before, pred_rmse_after` one-step-ahead
    errors; `difference` paired difference before - after of the simulation error; `noise_floor` estimated
    error of a perfect model; `room` fraction of the removable error removed with the floor as it is, and its
    95 % interval; `yhat_before, yhat_after` (N, ny) simulated test output; `evidence`
    sentences; `parameters` effect parameters: name -> (value, standard error, unit); `confusable` causes that
    this record cannot tell from the first; `remaining` what the final residual still shows; `refinements`
    causes that the search had put into the model and that are not claimed; `floor_is_bound` whether the noise
    floor may hold model error, as something remains or a noise model stands beside a nonlinearity; `held_out`
    what the errors were measured on; `system, data` the headline on the system, and the findings about the
    record, which are no answer to what is missing; `warnings` what limits the errors: a free run that
    explodes, a test record that leaves the range of the training data; `linear` structure, orders, delay and
    poles of the linear model, and why it was taken; `ladder` one row per kind of model: step, adds,
    rmse_unused with its interval low to high, rmse_test with its own; `explainable` share of the linear
    model's residual that can be explained, low, high, by variable; empty where not asked; `model` the answer
    as a model to be used; `equation` terms that were discovered, in the units of the record; `extra` fits and
    tables for figures, not part of the JSON.
    """

    detected: bool
    effect: str
    variant: str
    nature: str
    ranked: tuple[str, ...]
    p_value: float
    rmse_before: ErrorFigure
    rmse_after: ErrorFigure
    pred_rmse_before: ErrorFigure
    pred_rmse_after: ErrorFigure
    difference: ErrorFigure
    noise_floor: float
    room: ErrorFigure
    yhat_before: Array
    yhat_after: Array
    evidence: tuple[str, ...] = ()
    parameters: dict[str, tuple[float, float, str]] = field(default_factory=dict)
    confusable: tuple[str, ...] = ()
    remaining: str = ""
    refinements: tuple[str, ...] = ()
    floor_is_bound: bool = False
    held_out: str = "test record"
    system: str = ""
    data: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    linear: dict[str, Any] = field(default_factory=dict)
    ladder: tuple[dict[str, Any], ...] = ()
    explainable: dict[str, Any] = field(default_factory=dict)
    equation: str = ""
    model: DiagnosedModel | None = field(default=None, repr=False)
    extra: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def removed(self) -> float:
        """Fraction of the removable error removed, (before - after)/(before - noise floor), at most 1."""
        return min(self.room.value, 1.0)

    @property
    def removed_interval(self) -> tuple[float, float]:
        """95 % interval of `removed`; from the smallest possible floor, zero, where the floor is only a bound."""
        low, high = min(self.room.low, 1.0), min(self.room.high, 1.0)
        if self.floor_is_bound and self.rmse_before.value > 0:
            low = min(low, 1.0 - self.rmse_after.value / self.rmse_before.value)
        return low, high

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON: the fields of the results file, and more."""
        one = self.yhat_before.shape[1] == 1

        def signal(y: Array) -> list:
            return (y[:, 0] if one else y).tolist()

        return {
            "detected": self.detected,
            "effect": self.effect,
            "variant": self.variant,
            "nature": self.nature,
            "ranked": list(self.ranked),
            "p_value": self.p_value,
            "rmse_before": self.rmse_before.value,
            "rmse_after": self.rmse_after.value,
            "rmse_before_interval": [self.rmse_before.low, self.rmse_before.high],
            "rmse_after_interval": [self.rmse_after.low, self.rmse_after.high],
            "difference": self.difference.value,
            "difference_interval": [self.difference.low, self.difference.high],
            "pred_rmse_before": self.pred_rmse_before.value,
            "pred_rmse_after": self.pred_rmse_after.value,
            "pred_rmse_after_interval": [self.pred_rmse_after.low, self.pred_rmse_after.high],
            "noise_floor": self.noise_floor,
            "noise_floor_is_bound": self.floor_is_bound,
            "removed": self.removed,
            "removed_interval": list(self.removed_interval),
            "evidence": list(self.evidence),
            "parameters": {k: [v, se] for k, (v, se, _) in self.parameters.items()},
            "units": {k: unit for k, (_, _, unit) in self.parameters.items()},
            "confusable": list(self.confusable),
            "refinements": list(self.refinements),
            "remaining": self.remaining,
            "held_out": self.held_out,
            "system": self.system,
            "data": list(self.data),
            "warnings": list(self.warnings),
            "linear": self.linear,
            "ladder": list(self.ladder),
            "explainable": self.explainable,
            "equation": self.equation,
            "yhat_before": signal(self.yhat_before),
            "yhat_after": signal(self.yhat_after),
        }

    def __repr__(self) -> str:
        """What a console and a notebook show: the sentences, not the signals."""
        return str(self)

    def __str__(self) -> str:
        # what the residual still shows, or a noise model has taken, counts as noise in the floor
        bound = "at most " if self.floor_is_bound else ""
        record = self.extra.get("train")
        unit = in_units("y", record)
        floor = f"noise floor {bound}{self.noise_floor:.4g} {unit}"
        lines = [
            f"{self.system}; {floor}",
            *(f"the data: {words}" for words in self.data),
            *(f"WARNING: {w}" for w in self.warnings),
        ]
        lines += [f"  - {sentence}" for sentence in self.evidence]
        if self.equation and not any(self.equation in sentence for sentence in self.evidence):
            lines.append(f"  in the units of the record: {self.equation}")
        lines += [f"  {named_plainly(k)} = {spoken(*row, record)}" for k, row in self.parameters.items()]
        if self.linear:
            poles = ", ".join(str(Pole(*row, radius=0.0)) for row in self.linear["poles"])
            lines.append(f"linear model: {self.linear['structure']}; poles: {poles or 'none'}")
        lines.append(
            f"simulation error on the {self.held_out}: {self.rmse_before} -> {self.rmse_after} {unit}"
        )
        for row in self.ladder:
            adds = f" ({_plain(row['adds'])})" if row["adds"] else ""
            mark = " <- the answer" if row["answer"] else ""
            lines.append(f"  {row['step']}{adds}: {row['rmse_unused']:.4g} [{row['low']:.4g}, {row['high']:.4g}] on unused "
                         f"blocks, {row['rmse_test']:.4g} on the {self.held_out}{mark}")  # fmt: skip
        lines.append(f"one-step error: {self.pred_rmse_before} -> {self.pred_rmse_after} {unit}; {floor}")
        if np.isfinite(self.removed):
            low, high = self.removed_interval
            if self.floor_is_bound:
                share = f"between {100 * low:.3g} % (were there no noise) and {100 * high:.3g} %"
            else:
                share = f"{100 * self.removed:.3g} % [{100 * low:.3g}, {100 * high:.3g}]"
            below = "; the error after lies below the estimated floor" if self.room.value > 1 else ""
            lines.append(f"removed {share} of the removable error{below}")
        if self.confusable:
            lines.append("this record cannot tell it from: " + _plain(self.confusable))
        if len(self.ranked) > 1:
            lines.append("likeliest causes, the best first: " + _plain(self.ranked[:6]))
        if self.remaining:
            lines.append(self.remaining)
        return "\n".join(lines)


def _plain(keys: Sequence[str]) -> str:
    return ", ".join(key.replace("_", " ") for key in keys)
