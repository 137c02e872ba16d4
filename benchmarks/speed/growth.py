"""How cost grows with the work: exponents of time and memory of each verb, beside the peer that does the same job, in one run."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.speed.iterations import lfilter_campaign
from benchmarks.speed.pem import _case
from benchmarks.tables.timings import Call, peak_mb, speed_row
from oed.data import Record

ROUNDS = 3
"""Times that a call is repeated; the quickest counts: CPU seconds, which other work on the machine makes hardly longer."""


@dataclass(frozen=True, eq=False)
class Verb:
    """A verb and what of its work is made larger. `name` of the verb; `grows` what has the sizes; `made` size
    -> (our call, the peer's call or None); `peer` its name; `rounds` how often a call is timed."""

    name: str
    grows: str
    sizes: tuple[int, ...]
    made: Callable[[int], tuple[Call, Call | None]]
    peer: str = ""
    rounds: int = ROUNDS


def exponent(sizes: tuple[int, ...], values: list[float]) -> float:
    """The slope of log value against log size, by least squares: 1 where twice the work costs twice as much."""
    x, y = np.log(sizes), np.log(np.maximum(values, np.finfo(float).tiny))
    return float((x - x.mean()) @ y / ((x - x.mean()) @ (x - x.mean())))


def _seconds(call: Call, rounds: int) -> float:
    """CPU seconds of a call, the least of some rounds."""
    found = []
    for _ in range(rounds):
        begin = time.process_time()
        call()
        found.append(time.process_time() - begin)
    return min(found)


def measured(verb: Verb) -> dict[str, Any]:
    """One row of the table: the cost at every size, and how it grows."""
    ours, theirs, memory = [], [], []
    for size in verb.sizes:
        own, other = verb.made(size)
        for call in (own, other) if not ours else ():
            _ = call is not None and call()  # imports and compiles
        ours.append(_seconds(own, verb.rounds))
        memory.append(peak_mb(own))
        if other is not None:
            theirs.append(_seconds(other, verb.rounds))
    grown = partial(exponent, verb.sizes)
    compared = len(theirs) == len(ours)
    return speed_row(
        f"growth-{verb.name}", f"{verb.grows} {verb.sizes[0]} to {verb.sizes[-1]}", ours[-1],
        verb.peer if compared else None, theirs[-1] if compared else None, None, peak=memory[-1],
        exponent=grown(ours), memory_exponent=grown(memory), baseline_exponent=grown(theirs) if compared else None,
        points={"sizes": list(verb.sizes), "ours": ours, "peer": theirs if compared else [], "mb": memory},
    )  # fmt: skip


def _identified(order: int, samples: int) -> tuple[Call, Call]:
    """Output error with its own starts, against SciPy's least squares on lfilter begun near the truth."""
    from scipy.optimize import least_squares
    from scipy.signal import lfilter

    from estimators.pem import identify

    record, start, _ = _case(order, samples)
    u, y = record.u[:, 0], record.y[:, 0]

    def errors(x: NDArray) -> NDArray:
        return y - np.asarray(lfilter(np.r_[0.0, x[:order]], np.r_[1.0, x[order:]], u))

    return partial(identify, record, "oe", (order, order), offset=False), partial(
        least_squares, errors, start
    )


def _channels(count: int) -> tuple[Call, Call]:
    """Every output from every input, against SciPy's least squares on lfilter, output by output, begun near the truth."""
    from scipy.optimize import least_squares
    from scipy.signal import lfilter

    from estimators.pem import identify

    rng = np.random.default_rng(count)
    u, e = rng.normal(size=(2, 1000, count))
    gains = rng.uniform(0.5, 1.5, size=(count, count))
    y = np.asarray(lfilter([0, 0.2155, 0.2012], [1, -0.9854, 0.8187], u, axis=0)) @ gains + 0.3 * e

    def errors(x: NDArray, i: int) -> NDArray:
        left = y[:, i].copy()
        for (b1, b2, f1, f2), v in zip(x.reshape(count, 4), u.T, strict=True):
            left -= lfilter([0.0, b1, b2], [1.0, f1, f2], v)
        return left

    def theirs() -> list[Any]:
        near = np.column_stack(
            (0.2155 * gains.ravel(), 0.2012 * gains.ravel(), *np.tile([[-0.98], [0.81]], count**2))
        )
        return [
            least_squares(errors, near.reshape(count, count, 4)[:, i].ravel(), args=(i,))
            for i in range(count)
        ]

    return partial(identify, Record(u, y), "oe", (2, 2), offset=False), theirs


def _subspace(samples: int) -> tuple[Call, Call | None]:
    from estimators.pem import identify

    record, _, _ = _case(2, samples)
    ours = partial(identify, record, "ss", (2,), method="moesp", offset=False)
    try:
        from sippy_unipi import system_identification  # pyright: ignore[reportMissingImports]
    except ImportError:
        return ours, None
    return ours, partial(system_identification, record.y.T, record.u.T, "MOESP", SS_fixed_order=2)


def _designed(parameters: int, frequencies: int) -> tuple[Call, Call]:
    """D designs on a grid, against CVXPY with Clarabel on the same columns."""
    from benchmarks.speed.design import GAP, _all_columns, _problem
    from oed.design.solvers.column_generation import exchange
    from oed.design.solvers.whole_grid import cvxpy_weights

    problem = _problem(parameters, frequencies, "D")
    columns = _all_columns(problem)
    return (
        partial(exchange, problem, refine=False, tolerance=GAP),
        partial(cvxpy_weights, columns, problem.criterion, problem.constant, 1e-8),
    )


def _peaked(order: int) -> tuple[Call, Call | None]:
    from importlib import import_module

    from oed.plants.norms import _peak
    from oed.plants.plant import Plant
    from oed.plants.realisations import state_space

    poles = 0.9 * np.exp(1j * np.linspace(0.2, 2.9, order // 2))
    num = np.r_[0, np.random.default_rng(0).standard_normal(order // 2)]
    plant = Plant(num, np.real(np.poly(np.r_[poles, np.conj(poles)])))
    ours = partial(_peak.__wrapped__, plant, 1e-10)  # computed in every call: `peak` remembers
    control = import_module("control")
    if not import_module("control.exception").slycot_check():
        return ours, None
    return ours, partial(control.linfnorm, control.StateSpace(*state_space(plant), 1.0), tol=1e-10)


def _campaign(runs: int) -> tuple[Call, Call]:
    from estimators.montecarlo.engine import monte_carlo
    from oed.plants.named import named_plant

    plant = named_plant("reference", 4.0)
    return partial(monte_carlo, plant, 1000, 10, runs), partial(lfilter_campaign, 1000, 10, runs, 4.0)


def _diagnosed(samples: int) -> tuple[Call, None]:
    """A plant behind an input that saturates."""
    from scipy.signal import lfilter

    from estimators.diagnosis.loop import diagnose

    u, e = np.random.default_rng(samples).normal(size=(2, samples, 1))
    y = np.asarray(lfilter([0, 0.2155, 0.2012], [1, -0.9854, 0.8187], np.clip(u, -0.8, 0.8), axis=0))
    return partial(diagnose, Record(u, y + 0.05 * e)), None


def verbs() -> Iterator[Verb]:
    """What is measured: ten minutes of CPU time, most of it of diagnoses."""
    least = "scipy least_squares with lfilter"
    yield Verb("identify", "samples", (1000, 4000, 16_000, 64_000), partial(_identified, 2), least)
    yield Verb("identify", "order", (2, 4, 8), lambda order: _identified(order, 2000), least)
    yield Verb("identify", "channels", (1, 2, 3), _channels, least)
    yield Verb("subspace", "samples", (1000, 4000, 16_000), _subspace, "SIPPY")
    yield Verb("design", "lines", (250, 1000, 4000), partial(_designed, 4), "CVXPY, Clarabel")
    yield Verb("design", "parameters", (10, 20, 40), lambda n: _designed(n, 200), "CVXPY, Clarabel")
    yield Verb("norm", "order", (2, 4, 8, 20, 40), _peaked, "slycot ab13dd")
    yield Verb("diagnose", "samples", (500, 1000, 2000, 4000), _diagnosed, rounds=1)
    yield Verb("campaign", "runs", (16, 64, 256), _campaign, "loop over scipy.signal.lfilter")


def rows() -> list[dict[str, Any]]:
    """Every row of this file."""
    return [measured(verb) for verb in verbs()]
