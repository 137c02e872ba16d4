"""The loop closed on a real record: the hair dryer, an output-error model, and the delay that it lacks.

Identify OE(2,2) without extra delay on the first half, test its residuals, find the delay they point to, refit,
and report the errors before and after on the second half, which neither model has seen."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.campaign.plants import hair_dryer_record
from oed.covariances import of_few
from oed.data import Record

SPLIT = 500
LAGS = range(1, 11)
LEVEL = 0.01
"""p-value below which a correlation is taken seriously, one lag by itself."""


@dataclass(frozen=True, eq=False)
class HairDryerStory:
    """What was found in the hair-dryer record. `before_delay, delay` nk of the first model, and the one
    found; `suspicious_lags` lags at which input and residual of the first model are correlated (p < 0.01
    each); `rows` errors in volts on the second half, before and after; `sentences` the story; `test` the
    second half; `simulated` "before" and "after" to the simulated second half, (N, 1); `lags` lags of the
    correlations; `correlations` "before" and "after" to the correlations of input and residual on the first
    half; `bound` 99 % bound of one correlation of the first model where nothing is missing."""

    before_delay: int
    delay: int
    suspicious_lags: tuple[int, ...]
    rows: list[dict[str, Any]]
    sentences: list[str]
    test: Record
    simulated: dict[str, NDArray[np.float64]]
    lags: NDArray[np.int64]
    correlations: dict[str, NDArray[np.float64]]
    bound: float


def hair_dryer_story(record: Record | None = None) -> HairDryerStory:
    """Identify the hair dryer, find what its model lacks, add it, and report the error before and after."""
    from estimators.pem import identify
    from estimators.pem.choice import estimate_delay
    from estimators.residual.measures import fit_percent
    from estimators.residual.tests import input_correlation

    record = record or hair_dryer_record()
    train, test = record[:SPLIT], record[SPLIT:]
    found = estimate_delay(train, "oe", (2, 2), offset=True, initial="zero")
    rows, tests, simulated = [], {}, {}
    for name, delay in (("before", 1), ("after", found.delay)):
        fit = identify(train, "oe", (2, 2), delay=delay, offset=True, initial="zero")
        noise_model = identify(train, "bj", (2, 0, 2, 2), delay=delay, offset=True, initial="zero")
        tests[name] = input_correlation(fit, train, lags=LAGS)
        # The record runs through: the second half starts in the state that the first half leaves.
        simulated[name] = fit.simulate(record.u)[SPLIT:]
        one_step = noise_model.predict(record)[SPLIT:]
        rows.append({
            "model": f"{name}: OE(2,2), nk = {delay}", "delay": delay,
            "simulation_rmse": _rms(test.y - simulated[name]),
            "simulation_rmse_se": _block_error(test.y - simulated[name]),
            "one_step_rmse": _rms(test.y - one_step), "one_step_rmse_se": _block_error(test.y - one_step),
            "fit_percent": fit_percent(test.y, simulated[name]), "smallest_p_value": tests[name].p_value,
        })  # fmt: skip
    suspicious = tuple(int(lag) for lag in tests["before"].lags[tests["before"].p_values < LEVEL])
    before, after = rows
    sentences = [
        f"OE(2,2) with the usual delay of one sample, fitted to the first {SPLIT} samples, leaves residuals that depend on the "
        f"input: p = {before['smallest_p_value']:.1g} over lags {LAGS.start} to {LAGS.stop - 1}, alone below {LEVEL:g} at "
        f"lags {', '.join(map(str, suspicious))}.",
        f"Of the delays 0 to {int(found.delays[-1])}, nk = {found.delay} leaves by far the smallest residual (weight "
        f"{found.weights[list(found.delays).index(found.delay)]:.3g}): the model lacks a transport delay of "
        f"{(found.delay - 1) * record.dt:.2g} s.",
        f"With it the simulation error on the second half falls from {before['simulation_rmse']:.3f} to "
        f"{after['simulation_rmse']:.3f} V, and the one-step error (with an AR(2) noise model in both) from "
        f"{before['one_step_rmse']:.3f} to {after['one_step_rmse']:.3f} V.",
    ]
    return HairDryerStory(
        before_delay=1, delay=found.delay, suspicious_lags=suspicious, rows=rows, sentences=sentences,
        test=test, simulated=simulated, lags=np.asarray(tests["before"].lags),
        correlations={name: np.asarray(t.correlation) for name, t in tests.items()},
        bound=float(2.576 * np.mean(tests["before"].deviation)),
    )  # fmt: skip


def _rms(e: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(e))))


def _block_error(e: NDArray[np.float64], blocks: int = 10) -> float:
    """Standard error of the root mean square from blocks, which keeps the errors' correlation in time."""
    squares = np.array([np.mean(np.square(part)) for part in np.array_split(e, blocks)])
    error = float(squares.std(ddof=1) / np.sqrt(blocks) / (2 * np.sqrt(squares.mean())))
    return of_few(error, blocks - 1)
