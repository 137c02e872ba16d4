"""The transpose of the system by experiments, and experiments on a model error.

    G' x = T sum_ij I_ij G (I_ij T x)            ([M] (8), (10), (11))

A signal x on the outputs (N, ny) becomes a signal on the inputs (N, nu) by pq experiments with one active input
each."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import as_signal
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
