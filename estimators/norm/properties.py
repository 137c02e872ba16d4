"""Other system properties from experiments: smallest gain and passivity, by shifted iterations ([S] Sec. 6).

Power iterations find the largest eigenvalue of a symmetric matrix A by products with it; with A replaced by
s I - A, s not below the largest, they find the smallest:

    smallest gain     A = G' G            sigma_min^2 = s - largest eigenvalue of (s I - A)
    passivity index   A = (G + G') / 2    nu = min over u of u' G u / u' u

Both products are experiments: G' is `estimators.rules.transpose`. Over N samples the smallest gain of a strictly
proper system is zero (its last samples do not come out), and that of a nonminimum-phase one nearly so; the
passivity index tends to min over w of the smallest eigenvalue of (G + G*) / 2. The system is robustly stable
under a controller if the small-gain product stays below 1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimators.rules.transpose import apply_transpose
from oed.data import frozen
from oed.errors import InputError
from oed.experiments import Experiment

if TYPE_CHECKING:
    from oed.plants.plant import Plant


@dataclass(frozen=True, eq=False)
class ShiftedIterations:
    """Estimates of a smallest eigenvalue, one per iteration. `values` (M,) Rayleigh quotients: upper bounds
    without noise, falling to the smallest eigenvalue; `u` (N, nu) last input; `shift` s; `experiments`
    experiments used."""

    values: NDArray[np.float64]
    u: NDArray[np.float64]
    shift: float
    experiments: int

    @property
    def last(self) -> float:
        """The last estimate."""
        return float(self.values[-1])

    def __repr__(self) -> str:
        return f"smallest eigenvalue {self.last:.6g} after {len(self.values)} iterations, {self.experiments} experiments"


def _iterate(
    experiment: Experiment,
    kind: str,
    samples: int,
    iterations: int,
    shift: float,
    rng: np.random.Generator,
) -> ShiftedIterations:
    if not (np.isfinite(shift) and shift > 0):
        raise InputError(f"the shift is {shift}; it must be positive and not below the largest eigenvalue.")
    if iterations < 1:
        raise InputError(f"iterations is {iterations}; it must be at least 1.")
    before = experiment.used.experiments
    u = rng.standard_normal((samples, experiment.n_inputs))
    u *= np.sqrt(samples) / np.linalg.norm(u)
    values = []
    for _ in range(iterations):
        y = experiment(u)
        w = apply_transpose(experiment, y) if kind == "gain" else (y + apply_transpose(experiment, u)) / 2
        values.append(float(np.vdot(u, w) / np.vdot(u, u)))
        u = shift * u - w
        u = u * (np.sqrt(samples) / np.linalg.norm(u))
    return ShiftedIterations(frozen(values), frozen(u), shift, experiment.used.experiments - before)


def smallest_gain(
    experiment: Experiment, *, samples: int, iterations: int, gain: float, rng: np.random.Generator
) -> ShiftedIterations:
    """Square of the smallest gain of the system over N samples, sigma_min(G_N)^2."""
    return _iterate(experiment, "gain", samples, iterations, gain**2, rng)


def passivity_index(
    experiment: Experiment, *, samples: int, iterations: int, gain: float, rng: np.random.Generator
) -> ShiftedIterations:
    """Input passivity index of the system over N samples, min of u' G u / u' u."""
    if experiment.n_inputs != experiment.n_outputs:
        raise InputError(
            f"the system has {experiment.n_inputs} inputs and {experiment.n_outputs} outputs; passivity is "
            "defined for as many of each."
        )
    return _iterate(experiment, "passivity", samples, iterations, gain, rng)


@dataclass(frozen=True)
class SmallGain:
    """Small-gain check of a controller against an additive model error. `product` gamma of the model error
    times ||K (I + P K)^-1||_inf; `lowest, highest` the product at the ends of gamma's interval; `stable` true
    or False where the whole interval lies on one side of 1, None where the data do not decide. False says
    that the test fails, not that the loop is unstable."""

    product: float
    lowest: float
    highest: float
    stable: bool | None

    def __repr__(self) -> str:
        verdict = {True: "robustly stable", False: "not shown stable", None: "undecided"}[self.stable]
        return f"small-gain product {self.product:.4g} ({self.lowest:.4g} to {self.highest:.4g}): {verdict}"


def small_gain(
    model: Plant, controller: Plant, gamma: float, interval: tuple[float, float], *, points: int = 4000
) -> SmallGain:
    """Whether a controller stabilises every system within gamma of the model. [M] Sec. II; the condition is
    gamma ||K (I + P K)^-1||_inf < 1."""
    if (controller.n_inputs, controller.n_outputs) != (model.n_outputs, model.n_inputs):
        raise InputError(
            f"the controller has {controller.n_inputs} inputs and {controller.n_outputs} outputs; the model needs "
            f"{model.n_outputs} and {model.n_inputs}."
        )
    omega = np.linspace(0, np.pi, points)
    P, K = model.response(omega)[0], controller.response(omega)[0]
    loop = np.eye(model.n_outputs) + P @ K
    angle = np.unwrap(np.angle(np.linalg.det(loop)))
    # P and K are stable: by the Nyquist criterion the determinant must not encircle the origin.
    if abs(angle[-1] - angle[0]) > 1.0 or np.abs(np.linalg.det(loop)).min() < 1e-9:
        raise InputError("the nominal loop of model and controller is unstable; design the controller first.")
    size = float(np.linalg.norm(K @ np.linalg.inv(loop), 2, axis=(1, 2)).max())
    low, high = sorted(interval)
    stable = True if high * size < 1 else False if low * size >= 1 else None
    return SmallGain(gamma * size, low * size, high * size, stable)
