"""What to measure next: the input that best tells two fitted models apart, and how surely it will."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.model.fitting import Fit
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.result.report import Diagnosis
from oed.errors import InputError

Array = NDArray[Any]
BANDS = 8


@dataclass(frozen=True, eq=False)
class Discrimination:
    """A designed experiment that decides between two models.

    `u` (N,) input, within the limits; `distance` squared distance of the models' outputs in noise variances,
    after each has been refitted: twice the expected log-likelihood ratio; `power` predicted probability of
    the right decision with this experiment, Phi(sqrt(distance)/2); `samples` samples of this kind of input
    for the right decision with probability 0.99; `white, multisine` distances of white noise and of a flat
    multisine of the same length and limits, for comparison; `white_input, multisine_input` (N,) those inputs.
    """

    u: Array
    distance: float
    power: float
    samples: float
    white: float
    multisine: float
    white_input: Array
    multisine_input: Array

    def __str__(self) -> str:
        return (
            f"{len(self.u)} samples decide rightly with probability {self.power:.3f} (white noise "
            f"{norm.cdf(np.sqrt(self.white) / 2):.3f}, flat multisine {norm.cdf(np.sqrt(self.multisine) / 2):.3f}); "
            f"0.99 needs {self.samples:.0f} samples"
        )


def _jacobian(f: Fit, u: Array, clock: Clock, y: Array) -> Array:
    J = np.zeros((len(u), len(f.p)))
    for i in range(len(f.p)):
        q = f.p.copy()
        step = 1e-5 * f.scales[i]
        q[i] += step
        moved = simulate(f.structure, q, u, clock, rest=True)
        if np.all(np.isfinite(moved)):
            J[:, i] = (moved - y) / step
    return J


def distance(a: Fit, b: Fit, u: Array) -> float:
    """Squared distance of two models' outputs to an input, after refitting: the smaller of both directions.

    min over delta of |y_a - y_b - J_b delta|^2/s^2 + |J_train delta|^2/s_train^2: each model may move as far
    as its training record allows.

    Shapes: u (N,).
    """
    u = u[:, None] if u.ndim == 1 else u
    clock = Clock(len(a.residual) + np.arange(len(u), dtype=float), len(a.residual))
    outputs = [simulate(f.structure, f.p, u, clock, rest=True) for f in (a, b)]
    if not all(np.all(np.isfinite(y)) for y in outputs):
        return 0.0
    gap = outputs[0] - outputs[1]
    values = []
    for f, y in ((a, outputs[0]), (b, outputs[1])):
        variance = max(min(a.variance, b.variance), 1e-300)
        J = _jacobian(f, u, clock, y)
        size = np.sqrt(np.sum(J**2, axis=0) + np.sum(f.jacobian**2, axis=0)) + 1e-300
        stacked = np.concatenate((J / size / np.sqrt(variance), f.jacobian / size / np.sqrt(f.variance)))
        target = np.concatenate((gap / np.sqrt(variance), np.zeros(len(f.jacobian))))
        delta = np.linalg.lstsq(stacked, target, rcond=None)[0]
        values.append(float(np.sum((target - stacked @ delta) ** 2)))
    return min(values)


def _signal(x: Array, length: int, amplitude: float, power: float, phases: Array) -> Array:
    """Multisine of BANDS band powers, clipped to the amplitude; the last entry is its strength."""
    t = np.arange(length)
    edges = np.linspace(0.0, 0.5, BANDS + 1)
    lines = np.arange(1, length // 2)
    band = np.minimum(np.searchsorted(edges, lines / length, side="right") - 1, BANDS - 1)
    weight = np.exp(x[:BANDS])[band]
    spectrum = np.zeros(length // 2 + 1, dtype=complex)
    spectrum[1 : length // 2] = np.sqrt(weight) * np.exp(1j * phases[: len(lines)])
    u = np.fft.irfft(spectrum, length)[: len(t)]
    u = u / (np.std(u) + 1e-300) * amplitude * float(np.exp(min(x[BANDS], 1.5)))
    u = np.clip(u, -amplitude, amplitude)
    return u * min(1.0, np.sqrt(power) / (float(np.sqrt(np.mean(u**2))) + 1e-300))


def _held_levels(x: Array, length: int, amplitude: float, power: float, draws: Array) -> Array:
    """Random levels, each held for a while: x[0] is the log of the hold, x[1] how often the level is extreme."""
    hold = int(np.clip(round(float(np.exp(x[0]))), 1, length // 4))
    levels = np.sign(draws) * np.abs(draws) ** float(np.exp(np.clip(x[1], -3, 3)))
    u = np.repeat(levels[: length // hold + 1], hold)[:length] * amplitude
    return u * min(1.0, np.sqrt(power) / (float(np.sqrt(np.mean(u**2))) + 1e-300))


def discriminate(
    a: Fit,
    b: Fit,
    *,
    length: int,
    amplitude: float,
    power: float | None = None,
    rng: np.random.Generator,
    rounds: int = 6,
    size: int = 16,
) -> Discrimination:
    """Input that tells two fitted single-input models apart best, under a rig's limits.

    Multisines with free band powers and strengths, and random levels with free hold and distribution, are
    searched by mutation of the best; every input keeps the limits by construction.
    """
    if length < 20:
        raise InputError(f"the new experiment has {length} samples; give at least 20.")
    if not amplitude > 0 or (power is not None and not power > 0):
        raise InputError(f"the limits are amplitude {amplitude} and power {power}; they must be positive.")
    most = float(amplitude) ** 2 if power is None else float(power)
    phases, draws = rng.uniform(0, 2 * np.pi, length), rng.uniform(-1, 1, length + 1)
    makers: tuple[Callable[[Array], Array], ...] = (
        lambda x: _signal(x, length, amplitude, most, phases),
        lambda x: _held_levels(x, length, amplitude, most, draws),
    )
    pool: list[tuple[float, int, Array]] = []
    trials: list[tuple[int, Array]] = [(0, np.zeros(BANDS + 1)), (1, np.array([1.0, 0.0]))]
    while len(trials) < 2 * size:
        trials.append((0, np.append(2.0 * rng.standard_normal(BANDS), rng.uniform(-1, 1))))
        trials.append((1, np.array([rng.uniform(0, 4), rng.uniform(-2, 2)])))
    for _ in range(rounds):
        pool += [(distance(a, b, makers[kind](x)), kind, x) for kind, x in trials]
        pool.sort(key=lambda entry: -entry[0])
        pool = pool[:6]
        trials = []
        for i in range(size):
            _, kind, x = pool[i % len(pool)]
            trials.append((kind, x + 0.6 * rng.standard_normal(len(x))))
    best, kind, x = pool[0]
    white = np.clip(rng.standard_normal(length) * min(amplitude / 2, np.sqrt(most)), -amplitude, amplitude)
    flat = _signal(np.append(np.zeros(BANDS), np.log(0.4)), length, amplitude, most, phases)
    needed = (2 * norm.ppf(0.99)) ** 2
    return Discrimination(
        makers[kind](x), best, float(norm.cdf(np.sqrt(best) / 2)), float(length * needed / max(best, 1e-300)),
        distance(a, b, white), distance(a, b, flat), white, flat,
    )  # fmt: skip


def deciding_experiment(
    result: Diagnosis, *, length: int, rng: np.random.Generator, amplitude: float | None = None
) -> tuple[tuple[str, str], Discrimination] | None:
    """The experiment that separates the first cause from the one that the record cannot tell it from."""
    train = result.extra["train"]
    if not result.confusable or train.n_inputs != 1:
        return None
    for out in result.extra["outputs"]:
        fits = {claim.cause: claim.fit for claim in reversed(out.attribution.claims)}
        if out.thin == 1 and result.effect in fits and result.confusable[0] in fits:
            limit = float(np.max(np.abs(train.u))) if amplitude is None else amplitude
            pair = (result.effect, result.confusable[0])
            return pair, discriminate(fits[pair[0]], fits[pair[1]], length=length, amplitude=limit, rng=rng)
    return None
