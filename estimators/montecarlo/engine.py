"""Monte-Carlo campaigns of the iterations: thousands of runs in seconds, memory independent of their number.

The compiled kernels run any stable rational plant; a plant that is a Python callable runs through the plain loop.
Both meet the noise of `oed.signals.noise`, so run r is the same run on either path, in any order and on any number of
threads; the starts are white noise of exactly unit power from the same source (`counter_start`)."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.norm.gains import Gains
from estimators.rules.by_name import algorithm_rule
from estimators.rules.limits import Limits, scaled
from estimators.rules.procedure2 import SCALINGS
from estimators.rules.trace import run
from oed.data import frozen
from oed.errors import InputError, check_names
from oed.experiments import Experiment, noise_factor
from oed.plants.plant import Plant
from oed.signals.noise import START, noise_key, standard_noise

BATCH = 64
"""Runs of a batch, over which means are taken together: another number would move their last digits."""


@dataclass(frozen=True, eq=False)
class Batch:
    """A few runs. `first` number of the first replicate; `gain_squares` (R, M) squares of [S] (7) or [M]
    (12); the first of [S] (7) is NaN; `mu_squares` (R, M) squares of mu; `rayleigh` (R, M) [S] (4); NaN for
    Procedure 2; `energy` (R, M) input energy of each iteration."""

    first: int
    gain_squares: NDArray[np.float64]
    mu_squares: NDArray[np.float64]
    rayleigh: NDArray[np.float64]
    energy: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Campaign:
    """Means and standard deviations over the runs, per iteration. `replicates` number of runs; `mean,
    deviation` by estimator (gain, mu, rayleigh, gain_square, mu_square): (M,) over the runs that have a
    value; `negative` (M,) how many runs had a negative square of the gain (and so no value); `energy` (M,)
    mean input energy of each iteration; `gain_first` (M,) gains of the first run, NaN where it has none;
    `samples` length of every experiment; `plant` what was simulated (None for a callable)."""

    replicates: int
    mean: dict[str, NDArray[np.float64]]
    deviation: dict[str, NDArray[np.float64]]
    negative: NDArray[np.float64]
    energy: NDArray[np.float64]
    gain_first: NDArray[np.float64]
    samples: int
    plant: Plant | None = None

    @property
    def gain_mean(self) -> NDArray[np.float64]:
        """Mean of the gain over the runs that have one, (M,)."""
        return self.mean["gain"]

    @property
    def finite_norm(self) -> float:
        """Norm of the plant over the samples of one experiment (NaN for a callable)."""
        from oed.theory.finite import finite_norm

        return finite_norm(self.plant, self.samples) if self.plant else float("nan")

    def error(self, name: str) -> NDArray[np.float64]:
        """Monte-Carlo standard error of the mean of an estimator: returns (M,)."""
        lost = self.negative if name == "gain" else 0
        return self.deviation[name] / np.sqrt(np.maximum(self.replicates - lost, 1))

    def __repr__(self) -> str:
        lines = [f"{self.replicates} runs of {len(self.negative)} iterations; at the last:"]
        for name in ("gain", "mu", "rayleigh"):
            if np.isfinite(self.mean[name][-1]):
                lines.append(f"  {name} {self.mean[name][-1]:.6g} +- {self.error(name)[-1]:.2g}")
        lines.append(f"  negative squares {self.negative.sum() / (self.replicates * len(self.negative)):.3%}")
        return "\n".join(lines)


def counter_start(
    plant: Plant, samples: int, *, seed: int = 0, replicate: int = 0, limits: Limits | None = None
) -> NDArray[np.float64]:
    """White start from the counter-based noise, scaled to the limits: returns (N, nu)."""
    key = noise_key(seed, plant.name)
    return scaled(standard_noise(key, replicate, START, samples, plant.n_inputs), limits or Limits())


def batches(
    system: Plant | Callable[[int], Experiment], *, algorithm: str = "siso", samples: int, iterations: int,
    replicates: int, seed: int = 0, first: int = 0, scaling: str = "none", threads: int = 1,
) -> Iterator[Batch]:  # fmt: skip
    """Run the iterations many times, a few runs at a time."""
    check_names([scaling], SCALINGS, "scaling")
    for name, value, least in (
        ("samples", samples, 2),
        ("iterations", iterations, 1),
        ("replicates", replicates, 1),
        ("first", first, 0),
        ("threads", threads, 1),
    ):
        if not isinstance(value, int | np.integer) or value < least:
            raise InputError(f"{name} is {value!r}; it must be an integer of at least {least}.")
    if not isinstance(system, Plant):
        for r in range(first, first + replicates):
            yield plain_batch(system(r), algorithm, samples, iterations, seed, r, scaling)
        return
    algorithm_rule(algorithm, system.n_inputs, system.n_outputs)  # refuses what does not fit
    if algorithm in ("siso", "procedure-1") and (system.n_inputs, system.n_outputs) != (1, 1):
        raise InputError(
            f"power iterations need one input and one output, and {system.name} has {system.n_inputs} and "
            f"{system.n_outputs}; use the algorithm mimo."
        )
    work = _compiled_work(system, algorithm, samples, iterations, seed, SCALINGS.index(scaling))
    parts = [(r, min(BATCH, first + replicates - r)) for r in range(first, first + replicates, BATCH)]
    if threads == 1:
        for part in parts:
            yield work(*part)
        return
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(threads) as pool:  # a window of tasks, so that memory stays flat
        waiting = [pool.submit(work, *part) for part in parts[: 2 * threads]]
        for k in range(len(parts)):
            yield waiting.pop(0).result()
            if k + 2 * threads < len(parts):
                waiting.append(pool.submit(work, *parts[k + 2 * threads]))


def _compiled_work(
    plant: Plant, algorithm: str, samples: int, iterations: int, seed: int, scaling: int
) -> Callable[[int, int], Batch]:
    """What runs the batch of a first replicate and a number of them; all that batches share is made once."""
    from estimators.montecarlo.engine_kernels import power_block, procedure_block
    from estimators.montecarlo.noise_kernels import B, aligned

    k0, k1 = (np.uint64(word) for word in noise_key(seed, plant.name))
    length = max(3, *(len(c) for side in (plant.num, plant.den) for row in side for c in row))
    single = algorithm in ("siso", "procedure-1")
    num, den = (_padded(side, length) for side in (plant.num, plant.den))
    h = max(len(plant.noise_num), len(plant.noise_den)) if not plant.white_noise else 1
    noise = [np.pad(np.array(c)[:h], (0, h - len(c[:h]))) for c in (plant.noise_num, plant.noise_den)]
    factor = np.ascontiguousarray(noise_factor(plant))
    rows = 4 if single else 2 * plant.n_inputs + plant.n_outputs + 1
    block: Callable[..., None] = power_block if single else procedure_block
    channels: list[Any] = [num[0, 0], den[0, 0], *noise, factor[0]] if single else [num, den, *noise, factor]
    size: list[Any] = [samples, iterations]
    local = threading.local()  # fresh pages of memory for every batch would cost more than they hold

    def work(first: int, replicates: int) -> Batch:
        gain, mu, third = (np.full((BATCH, iterations), np.nan) for _ in range(3))
        energy = np.full((BATCH, iterations), float(samples))
        if getattr(local, "signals", None) is None:
            local.signals = aligned(rows, samples * B)
        for r in range(0, replicates, B):
            side = slice(r, r + B)
            coordinates: list[Any] = [k0, k1, START, first + r, local.signals]
            found = [gain[side], mu[side], *([third[side]] if single else [energy[side], scaling])]
            arguments = [*size, *channels, *coordinates, *found]
            block(*arguments)
        keep = slice(replicates)
        return Batch(first, gain[keep], mu[keep], third[keep], energy[keep])

    return work


def _padded(matrix: Any, length: int) -> NDArray[np.float64]:
    return np.array([[np.pad(c, (0, length - len(c))) for c in row] for row in matrix])


def plain_batch(
    experiment: Experiment, algorithm: str, samples: int, iterations: int, seed: int, replicate: int,
    scaling: str = "none", start: Any = None,
) -> Batch:  # fmt: skip
    """One run by the plain loop: the slow path, and the twin of the kernels."""
    from estimators.norm.gains import gain, mu, rayleigh

    rule: Any
    rule, each = algorithm_rule(algorithm, experiment.n_inputs, experiment.n_outputs, scaling=scaling)
    rng = np.random.default_rng([seed, replicate])
    trace = run(
        partial(rule, start=start), experiment, samples=samples, experiments=iterations * each, rng=rng
    )
    values: list[Gains] = [gain(trace), mu(trace)]
    energy = [sum(float(np.sum(r.u**2)) for r in trace.records[part]) for part in trace.iterations]
    third = rayleigh(trace).values if each == 1 else np.full(len(energy), np.nan)
    rows = [np.array(v)[None] for v in (values[0].squares, values[1].squares, third, energy)]
    return Batch(replicate, *rows)


def monte_carlo(
    system: Plant | Callable[[int], Experiment], samples: int, iterations: int, replicates: int, seed: int = 0, *,
    algorithm: str = "siso", scaling: str = "none", threads: int = 1,
) -> Campaign:  # fmt: skip
    """Mean and spread of the iterations' estimates over many runs."""
    from estimators.montecarlo.engine_kernels import accumulate

    names: list[str] = ["gain", "mu", "rayleigh", "gain_square", "mu_square"]
    sums = [np.zeros((len(names), iterations)) for _ in range(3)]
    negative, energy = np.zeros(iterations), np.zeros(iterations)
    gain_first = np.full(iterations, np.nan)
    parts = batches(
        system, algorithm=algorithm, samples=samples, iterations=iterations, replicates=replicates, seed=seed,
        scaling=scaling, threads=threads,
    )  # fmt: skip
    for batch in parts:
        square = batch.gain_squares
        gain = np.sqrt(np.where(square >= 0, square, np.nan))
        if batch.first == 0:
            gain_first = gain[0]
        negative += np.sum(square < 0, axis=0)
        energy += batch.energy.sum(axis=0)
        for k, values in enumerate(
            (gain, np.sqrt(batch.mu_squares), batch.rayleigh, square, batch.mu_squares)
        ):
            accumulate(values, sums[0][k], sums[1][k], sums[2][k])
    count, average, squares = sums
    with np.errstate(divide="ignore", invalid="ignore"):
        tables = (
            np.where(count > 0, average, np.nan),
            np.where(count > 1, np.sqrt(squares / (count - 1)), np.nan),
        )
    mean, deviation = (dict(zip(names, map(frozen, table), strict=True)) for table in tables)
    return Campaign(
        replicates, mean, deviation, frozen(negative), frozen(energy / replicates), frozen(gain_first), samples,
        system if isinstance(system, Plant) else None,
    )  # fmt: skip
