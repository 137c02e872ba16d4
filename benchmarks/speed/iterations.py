"""Speed of the Monte-Carlo engine and of the norms, each beside its baseline, in turn in one run."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.tables.timings import Call, in_turn, peak_mb, speed_row, timed

if TYPE_CHECKING:
    from oed.plants.plant import Plant


def lfilter_campaign(
    samples: int, iterations: int, replicates: int, variance: float, seed: int = 0
) -> np.ndarray:
    """The baseline: Algorithm 1 on the reference plant as a loop over `scipy.signal.lfilter`; returns
    (replicates, iterations)."""
    from scipy.signal import lfilter

    num, den = np.array([0, 0.2155, 0.2012]), np.array([1, -0.9854, 0.8187])
    rng = np.random.default_rng(seed)
    deviation, root = np.sqrt(variance), np.sqrt(samples)
    squares = np.full((replicates, iterations), np.nan)
    for r in range(replicates):
        u = rng.standard_normal(samples)
        u *= root / np.linalg.norm(u)
        before, factor = u, 0.0
        for m in range(iterations):
            y = np.asarray(lfilter(num, den, u)) + deviation * rng.standard_normal(samples)
            turned = y[::-1]
            if m:
                squares[r, m] = factor * (before @ turned) / samples
            before, factor = u, np.linalg.norm(y) / root
            u = turned / factor
    return squares


def lfilter_mimo_campaign(
    plant: Plant, samples: int, iterations: int, replicates: int, seed: int = 0
) -> np.ndarray:
    """The baseline of Procedure 2: of every second-stage experiment only the output that is used is
    simulated; returns (replicates, iterations)."""
    from scipy.signal import lfilter

    p, q = plant.n_outputs, plant.n_inputs
    rng, deviation = np.random.default_rng(seed), np.sqrt(plant.noise_variance)
    squares = np.empty((replicates, iterations))
    for r in range(replicates):
        u = rng.standard_normal((samples, q))
        u *= np.sqrt(samples) / np.linalg.norm(u)
        for m in range(iterations):
            y = plant.simulate(u) + deviation * rng.standard_normal((samples, p))
            z = np.zeros_like(u)
            for i in range(q):
                for j in range(p):
                    z[:, i] += np.asarray(lfilter(plant.num[j][i], plant.den[j][i], y[::-1, j]))
                    z[:, i] += deviation * rng.standard_normal(samples)
            w = z[::-1]
            squares[r, m] = np.vdot(u, w) / samples
            u = w * (np.sqrt(samples) / np.linalg.norm(w))
    return squares


def _in_turn(ours: Call, theirs: Call, rounds: int) -> tuple[float, float]:
    """Medians of the seconds of both, after one unmeasured call of each."""
    ours()
    theirs()
    (mine, _), (other, _) = in_turn(ours, theirs, rounds=rounds)
    return mine, other


def siso_campaign() -> list[dict[str, Any]]:
    """The Fig. 3 campaign: N = 1000, 50 iterations, three variances; target 30 times the baseline."""
    from estimators.montecarlo.engine import monte_carlo
    from oed.plants.named import named_plant

    plants = [named_plant("reference", v) for v in (1.0, 4.0, 9.0)]
    theirs = lambda: [lfilter_campaign(1000, 50, 8, plant.noise_variance) for plant in plants]
    flat = peak_mb(lambda: monte_carlo(plants[0], 1000, 50, 640))
    size = "N=1000, 50 iterations, 1000 runs, 3 variances"
    found = []
    for name, threads in (("iterations-siso", 1), ("iterations-siso-threads", os.cpu_count() or 1)):
        ours = lambda threads=threads: [
            monte_carlo(plant, 1000, 50, 1000, threads=threads) for plant in plants
        ]
        a, b = _in_turn(ours, theirs, 7)
        found.append(
            speed_row(
                name, f"{size}, threads: {threads}", a, "loop over scipy.signal.lfilter", b * 125, 30.0, peak=flat,
            )
        )  # fmt: skip
    return found


def mimo_campaign() -> list[dict[str, Any]]:
    """Procedure 2 on the 3 x 2 plant, seven experiments per iteration; target 30 times the baseline."""
    from estimators.montecarlo.engine import monte_carlo
    from oed.plants.named import named_plant

    plant = named_plant("three-by-two")
    theirs = lambda: lfilter_mimo_campaign(plant, 1000, 10, 8)
    flat = peak_mb(lambda: monte_carlo(plant, 1000, 10, 320, algorithm="mimo"))
    found = []
    for name, threads in (("iterations-mimo", 1), ("iterations-mimo-threads", os.cpu_count() or 1)):
        ours = lambda threads=threads: monte_carlo(plant, 1000, 10, 256, algorithm="mimo", threads=threads)
        a, b = _in_turn(ours, theirs, 5)
        size = f"3 x 2, N=1000, 10 iterations, 256 runs, threads: {threads}"
        found.append(speed_row(name, size, a, "loop over scipy.signal.lfilter", b * 32, 30.0, peak=flat))
    return found


def finite_time_norm() -> list[dict[str, Any]]:
    """The norm over 1e5 samples; target: under a second."""
    from oed.plants.named import named_plant
    from oed.theory.finite import finite_norm

    plant = named_plant("reference")
    finite_norm(plant, 1000)
    seconds, _ = timed(lambda: finite_norm(plant, 100_000))
    flat = peak_mb(lambda: finite_norm(plant, 100_000))
    return [speed_row("finite-norm", "N=1e5", seconds, "one second", 1.0, 1.0, peak=flat)]


def hinf_norm() -> list[dict[str, Any]]:
    """The H-infinity norm of models of order 1 to 80 at 1e-10, against slycot's ab13dd; target: no slower at any order. It is computed
    in every call: `peak` remembers plants that it has seen."""
    from importlib import import_module

    from oed.plants.named import named_plant
    from oed.plants.norms import _peak
    from oed.plants.plant import Plant
    from oed.plants.realisations import state_space

    try:
        control = import_module("control")
        solver = import_module("control.exception").slycot_check()
    except ImportError:
        solver = False
    if not solver:
        return []
    rng = np.random.default_rng(0)
    many = {1: Plant([0.0, 0.5], [1.0, -0.9]), 20: named_plant("order-20")}
    for order in (2, 4, 8, 40):
        poles = 0.9 * np.exp(1j * np.linspace(0.2, 2.9, order // 2))
        numerator = np.r_[0, rng.standard_normal(order // 2)]
        many[order] = Plant(numerator, np.real(np.poly(np.r_[poles, np.conj(poles)])))
    den = rng.standard_normal(80)
    den *= 0.9 / np.abs(den).sum()  # stable, and no root of order 80 is lost to rounding
    many[80] = Plant(np.r_[0, rng.standard_normal(40)], np.r_[1, den])
    rows = []
    for order, plant in sorted(many.items()):
        A, B, C, D = state_space(plant)
        system = control.StateSpace(A, B, C, D, 1.0)
        a, b = _in_turn(
            lambda plant=plant: _peak.__wrapped__(plant, 1e-10),
            lambda system=system: control.linfnorm(system, tol=1e-10),
            99 if order < 40 else 9,
        )
        memory = peak_mb(lambda plant=plant: _peak.__wrapped__(plant, 1e-10))
        rows.append(
            speed_row(f"hinf-norm-{order}", f"order {order}, 1e-10", a, "slycot ab13dd", b, 1.0, peak=memory)
        )
    return rows


BENCHMARKS: dict[str, Callable[[], list[dict[str, Any]]]] = {
    "iterations-siso": siso_campaign,
    "iterations-mimo": mimo_campaign,
    "finite-norm": finite_time_norm,
    "hinf-norm": hinf_norm,
}
"""What `oed speed` runs from this file, by name."""


def rows() -> list[dict[str, Any]]:
    """All rows of this file."""
    return [row for benchmark in BENCHMARKS.values() for row in benchmark()]
