"""[M]: the transpose by experiments, Procedure 2, and its story on the vibration-isolation system."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from benchmarks.tables.reproduced import row, traced
from estimators.norm.gains import gain, transposed_output
from estimators.norm.worst_inputs import worst_case
from estimators.rules.by_name import iterate
from estimators.rules.procedure2 import procedure_2
from oed.experiments import simulated
from oed.plants.named import named_plant
from oed.theory.finite import dense, finite_norm


def rows() -> list[dict[str, Any]]:
    """Identities, convergence, and the illustration of Fig. 5 to 7."""
    return [*_identities(), *_story()]


def _identities() -> Iterator[dict[str, Any]]:
    for name in ("avis", "three-by-two"):
        plant, N = named_plant(name, 0.0), 40
        each = 1 + plant.n_inputs * plant.n_outputs
        trace, G = traced(procedure_2, plant, N, each), dense(plant, N)
        w = transposed_output(trace, trace.iterations[0]).ravel()
        u = trace.records[0].u.ravel()
        yield row(f"G' G u by 1 + pq experiments, {name}", "[M] (8)-(11), Procedure 2", 0.0,
                  float(np.abs(w - G.T @ (G @ u)).max()), 1e-11, "against the dense matrix, 40 samples; rounding only.",
                  kind="statement")  # fmt: skip
    plant, N = named_plant("three-by-two", 0.0), 12
    trace, gains = iterate(
        simulated(plant), algorithm="mimo", samples=N, iterations=600, rng=np.random.default_rng(0)
    )
    values = gains["gain"].values
    norm = finite_norm(plant, N)
    yield row("gamma_2 tends to ||Delta||_i2 without noise", "[M] (12), Sec. III-C", norm, float(values[-1]),
              1e-6 * norm, "12 samples, 600 iterations, rising at every step and never above the norm.",
              bool(abs(values[-1] / norm - 1) < 1e-6 and (np.diff(values) > -1e-12).all() and values.max() <= norm * (1 + 1e-12)),
              "statement")  # fmt: skip


def _story() -> list[dict[str, Any]]:
    source = "[M] Fig. 5-7 and Sec. IV-B, on a synthetic plant built to its numbers"
    plant, N = named_plant("avis", 0.01), 4000
    hertz = np.arange(0, 500, 18.5)
    coarse = np.linalg.norm(plant.transfer(2 * np.pi * hertz * plant.dt), 2, axis=(1, 2))
    trace = traced(partial(procedure_2, scaling="each"), plant, N, 40 * 5)
    last, worst = float(gain(trace).last), worst_case(trace)
    first_u, last_u = trace.records[0].u, trace.records[-5].u
    flat = [np.max(np.abs(np.fft.rfft(u, axis=0)) ** 2) / (N * np.mean(u**2)) for u in (first_u, last_u)]
    sizes = np.std(last_u, axis=0)
    illustration = "an illustration: the plant was built to show it."
    return [
        row("largest singular value on lines of 18.5 Hz", source, None, float(coarse.max()), None,
            f"at {hertz[np.argmax(coarse)]:g} Hz ([M]: 1.95 at 296 Hz); {illustration}"),
        row("estimate after 40 iterations", source, None, last, None,
            f"above the grid's {coarse.max():.4f} ([M]: 1.997); {illustration}"),
        row("dominant frequency in Hz", source, None, worst.frequency_hz, None,
            f"121 and not 296 Hz; {illustration}"),
        row("from white noise to a sinusoid", source, None,
            f"largest line {flat[0]:.3g} to {flat[1]:.3g} times the mean", None,
            f"[M] Fig. 5 and 6; {illustration}"),
        row("both channels of comparable size", source, None, float(sizes.min() / sizes.max()), None,
            f"ratio of the channels' standard deviations; {illustration}"),
    ]  # fmt: skip
