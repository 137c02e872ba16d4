"""The model error on the rig: power iterations on the difference of model and rig, before and after an effect is added."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.model.fitting import Fit
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.result.report import Diagnosis
from estimators.norm.peak_estimates import corrected
from estimators.rules.limits import Limits
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import Trace, run
from oed.errors import InputError, Status
from oed.experiments import Experiment

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class ModelErrorGain:
    """Gain of the model error P_model - P_rig, and where it is reached.

    `gamma` estimate of its norm at the input power used, outputs per input, with its `standard_error`; `frequency` of
    the last input, rad/sample; `status` whether the estimate can be trusted; `direction` (nu,) complex unit vector, the
    last input at that frequency; `trace` all that was measured.
    """

    gamma: float
    standard_error: float
    frequency: float
    status: Status
    direction: Array
    trace: Trace

    def __str__(self) -> str:
        tail = "" if self.status.ok else f" ({self.status.value})"
        return f"gamma {self.gamma:.4g} +- {self.standard_error:.2g} at {self.frequency:.4g} rad/sample{tail}"


def _models(fits: list[Fit]) -> Callable[[Array], Array]:
    def apply(u: Array) -> Array:
        clock = Clock(np.arange(len(u), dtype=float), max(len(u), len(fits[0].residual)))
        return np.stack([simulate(f.structure, f.p, u, clock, rest=True) for f in fits], axis=1)

    return apply


def models_of(result: Diagnosis) -> Callable[[Array], Array]:
    """The augmented model of a diagnosis as a function u -> y, from rest and without noise.

    Shapes: returns (N, nu).
    """
    if any(
        out.thin_of(f) != 1 for out, f in zip(result.extra["outputs"], result.extra["finals"], strict=True)
    ):
        raise InputError(
            "the model was fitted to a thinned record; resample the rig to its sampling time first."
        )
    return _models(result.extra["finals"])


def linear_models(result: Diagnosis) -> Callable[[Array], Array]:
    """The linear model before anything was added, as a function u -> y.

    Shapes: returns (N, nu).
    """
    if any(out.thin != 1 for out in result.extra["outputs"]):
        raise InputError(
            "the model was fitted to a thinned record; resample the rig to its sampling time first."
        )
    return _models([out.naive for out in result.extra["outputs"]])


def error_experiment(rig: Experiment, model: Callable[[Array], Array]) -> Experiment:
    """The rig with the model in parallel: u -> P_model u - P_rig u, [M] Section V.

    Shapes: model (N, nu).
    """
    return Experiment(
        lambda u: model(u) - rig(u), rig.n_inputs, rig.n_outputs, dt=rig.dt, amplitude=rig.amplitude
    )


def model_error_gain(
    rig: Experiment,
    model: Callable[[Array], Array],
    *,
    samples: int,
    iterations: int,
    rng: np.random.Generator,
    power: float = 1.0,
    amplitude: float | None = None,
) -> ModelErrorGain:
    """Norm of the model error by power iterations on the rig itself.

    Shapes: model (N, nu).

    [M] Section V. The gains of the inputs themselves stay below the norm by the bias of [S] Theorem 12, and depend on
    each other; the peak of a local model of all records has neither fault.
    """
    if iterations < 4:
        raise InputError(f"iterations is {iterations}; the model of the peak needs at least 4.")
    error = error_experiment(rig, model)
    limits = Limits(power=power, amplitude=amplitude)
    one = (rig.n_inputs, rig.n_outputs) == (1, 1)
    rule = partial(power_iterations if one else procedure_2, limits=limits)
    count = iterations if one else iterations * (1 + rig.n_inputs * rig.n_outputs)
    trace = run(rule, error, samples=samples, experiments=count, rng=rng)
    found = corrected(trace)
    u = trace.records[trace.iterations[-1]][0].u
    spectrum = np.fft.rfft(u, axis=0)
    k = int(np.argmax(np.sum(np.abs(spectrum) ** 2, axis=1)))
    direction = spectrum[k] / (np.linalg.norm(spectrum[k]) + 1e-300)
    return ModelErrorGain(
        found.value, found.standard_error, 2 * np.pi * k / len(u), found.status, direction, trace
    )
