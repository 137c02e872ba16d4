"""The transpose of the system by experiments, and what it gives: adjoint iterative learning control.

    G' x = T sum_ij I_ij G (I_ij T x)            ([M] (8), (10), (11))

A signal x on the outputs (N, ny) becomes a signal on the inputs (N, nu) by pq experiments with one active input
each. Adjoint learning control needs nothing else: with the error e_k = r - y_k of trial k,

    u_(k+1) = u_k + a G' e_k,    noise-free e_(k+1) = (I - a G G') e_k,

a contraction (in the range of G) for 0 < a < 2 / ||G_N||^2, where the power iterations of [M] (14)-(15), which
feed G' G u back itself, are an expansion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import as_signal, frozen
from oed.errors import InputError
from oed.experiments import Experiment


def apply_transpose(
    experiment: Experiment, x: ArrayLike, *, power: float | None = None
) -> NDArray[np.float64]:
    """G' x by pq experiments on G: x (N, ny) -> (N, nu)."""
    x = as_signal(x, "the signal to transpose")
    if x.shape[1] != experiment.n_outputs:
        raise InputError(
            f"the signal has {x.shape[1]} channels and the system {experiment.n_outputs} outputs; "
            "the transpose takes a signal on the outputs."
        )
    z = np.zeros((len(x), experiment.n_inputs))
    for i in range(experiment.n_inputs):
        for j in range(experiment.n_outputs):
            u = np.zeros_like(z)
            u[:, i] = x[::-1, j]
            if not u.any():
                continue  # linear: zero gives zero
            factor = 1.0 if power is None else float(np.sqrt(power / np.mean(np.sum(u**2, axis=1))))
            z[:, i] += experiment(factor * u)[:, j] / factor
    return z[::-1].copy()


@dataclass(frozen=True, eq=False)
class LearningControl:
    """Trials of adjoint iterative learning control. `u` (N, nu) last input; `errors` (trials,) root mean
    square of r - y in every trial, as measured; `inputs, outputs` of every trial; `step` the learning gain a."""

    u: NDArray[np.float64]
    errors: NDArray[np.float64]
    inputs: tuple[NDArray[np.float64], ...]
    outputs: tuple[NDArray[np.float64], ...]
    step: float

    def __repr__(self) -> str:
        return (
            f"{len(self.errors)} trials with learning gain {self.step:.4g}: root mean square error "
            f"{self.errors[0]:.4g} to {self.errors[-1]:.4g}"
        )


def adjoint_learning(
    experiment: Experiment,
    reference: ArrayLike,
    *,
    trials: int,
    gain: float,
    relaxation: float = 1.0,
    decreasing: bool = False,
) -> LearningControl:
    """Learn the input that tracks a reference, without a model: reference (N, ny)."""
    r = as_signal(reference, "the reference")
    if r.shape[1] != experiment.n_outputs:
        raise InputError(
            f"the reference has {r.shape[1]} channels and the system {experiment.n_outputs} outputs."
        )
    if not (0 < relaxation < 2) or not gain > 0:
        raise InputError(
            f"relaxation is {relaxation} and gain {gain}; the trials contract only for a relaxation between 0 "
            "and 2 and a positive gain that is not below the norm of the system."
        )
    step = relaxation / gain**2
    u = np.zeros((len(r), experiment.n_inputs))
    inputs, outputs, errors = [], [], []
    for k in range(trials):
        y = experiment(u)
        error = r - y
        inputs.append(frozen(u))
        outputs.append(frozen(y))
        errors.append(float(np.sqrt(np.mean(error**2))))
        if k + 1 < trials:
            u = u + step / (1 + k / 4 if decreasing else 1) * apply_transpose(experiment, error)
    return LearningControl(frozen(u), frozen(errors), tuple(inputs), tuple(outputs), step)


def lipschitz_constant(
    mapping: Callable[[NDArray], NDArray], points: NDArray[np.float64], size: float = 1e-4
) -> float:
    """Largest measured ratio ||f(x + d) - f(x)|| / ||d||, d towards the other points and along f itself."""
    worst = 0.0
    for x in points:
        base = mapping(x)
        for d in (*(other - x for other in points if other is not x), base):
            length = np.linalg.norm(d)
            if length > 0:
                d = d / length * size * max(np.linalg.norm(x), 1e-12)
                worst = max(worst, float(np.linalg.norm(mapping(x + d) - base) / np.linalg.norm(d)))
    return worst


def model_error(model: object, experiment: Experiment) -> Experiment:
    """Experiments on the model error P_model - P_true: one experiment and one simulation each. [M] (1) and
    Sec. II."""
    shape = (getattr(model, "n_inputs", None), getattr(model, "n_outputs", None))
    if shape != (experiment.n_inputs, experiment.n_outputs):
        raise InputError(
            f"the model has {shape[0]} inputs and {shape[1]} outputs, the system {experiment.n_inputs} and "
            f"{experiment.n_outputs}; the model error needs the same of both."
        )
    simulate = model.simulate  # type: ignore[attr-defined]
    return Experiment(
        lambda u: simulate(u) - experiment(u),
        experiment.n_inputs,
        experiment.n_outputs,
        dt=experiment.dt,
        amplitude=experiment.amplitude,
    )
