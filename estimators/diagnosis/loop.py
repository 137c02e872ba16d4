"""The loop: linear model, residual, cause, augmented model, and the error before and after on data not used."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from estimators.diagnosis.effects.effect import Clock, Effect
from estimators.diagnosis.examination import Examined, Setting, examine, thinned
from estimators.diagnosis.model.fitting import Fit, innovations, levenberg_marquardt
from estimators.diagnosis.model.simulation import free_responses, simulate
from estimators.diagnosis.record.crossvalidation import BLOCKS, blocked_simulation
from estimators.diagnosis.record.measurement import held_samples
from estimators.diagnosis.record.overlap import copied_rows
from estimators.diagnosis.report import Diagnosis, ErrorFigure
from estimators.diagnosis.verdicts import verdict
from oed.data import Record
from oed.errors import InputError

__all__ = ["Setting", "diagnose"]

Array = NDArray[Any]


def _test_output(f: Fit, record: Record, clock: Clock, measured: Array, skip: int, thin: int) -> Array:
    """Simulated test output; a thinned model's is interpolated between its samples."""
    if thin == 1:
        return _with_start(f, record.u, clock, measured, skip)
    short = thinned(record, thin)
    slow = Clock(clock.k[0] / thin + np.arange(len(short), dtype=float), clock.length // thin)
    few = max(skip // thin, 2 * f.structure.order) if skip else 0
    y = _with_start(f, short.u, slow, measured[: len(short) * thin : thin], few)
    if not np.all(np.isfinite(y)):
        return np.full(len(record), np.inf)
    return CubicSpline(thin * np.arange(len(y)), y)(np.arange(len(record)))


def _sane(y: Array, reference: Array) -> bool:
    return bool(np.all(np.isfinite(y)) and np.max(np.abs(y)) < 8 * np.max(np.abs(reference)) + 1e-300)


def _resampled(squares: list[Array], rng: np.random.Generator, draws: int = 200) -> list[Array]:
    """Roots of the means of several series over the same moving blocks, (draws,) each.

    The blocks run on from the end to the start: else the first and last samples, where a transient is, would hardly count.
    """
    n = len(squares[0])
    block = max(1, min(n // 5, int(2 * n ** (1 / 3))))
    count = int(np.ceil(n / block))
    which = rng.integers(0, n, (draws, count))
    out = []
    for series in squares:
        total = np.concatenate(([0.0], np.cumsum(np.concatenate((series, series[: block - 1])))))
        sums = total[block:] - total[:-block]
        out.append(np.sqrt(np.maximum(sums[which].sum(axis=1) / (count * block), 0.0)))
    return out


def _root(squares: Array) -> float:
    return float(np.sqrt(max(squares.mean(), 0.0)))


def _bootstrap(squares: Array, rng: np.random.Generator, other: Array | None = None) -> ErrorFigure:
    """Root of the mean (or the difference of two roots) with a moving-block bootstrap interval."""
    if other is None:
        values, value = _resampled([squares], rng)[0], _root(squares)
    else:
        first, second = _resampled([squares, other], rng)
        values, value = first - second, _root(squares) - _root(other)
    low, high = np.quantile(values, (0.025, 0.975))
    return ErrorFigure(value, float(low), float(high))


def _removed(
    before: Array, after: Array, floor: float, samples: int, rng: np.random.Generator
) -> ErrorFigure:
    """(before - after)/(before - floor) with its interval; NaN where there is hardly anything to remove.

    The floor is from other data, of so many samples: a standard deviation with its own sampling error.
    """
    value = _root(before)
    if value - floor <= 0.02 * floor:
        return ErrorFigure(*[float("nan")] * 3)
    first, second = _resampled([before, after], rng)
    floors = floor * (1.0 + rng.standard_normal(len(first)) / np.sqrt(2.0 * samples))
    room = np.maximum(first - floors, 0.02 * floor + 1e-300)
    low, high = np.quantile((first - second) / room, (0.025, 0.975))
    return ErrorFigure((value - _root(after)) / (value - floor), float(low), float(high))


def _check(train: Record, test: Record | None) -> None:
    for name, record in (("training", train), ("test", test)):
        if record is None:
            continue
        if not np.isfinite(record.u).all():
            raise InputError(
                f"the {name} input has missing samples; simulation needs every input: fill or cut them."
            )
    if len(train) < 50:
        raise InputError(
            f"the training record has {len(train)} samples; at least 50 are needed: measure longer."
        )
    spread = np.std(train.u, axis=0)
    if np.any(spread <= 1e-12 * (np.abs(train.u).max(axis=0) + 1e-300)):
        j = int(np.argmin(spread))
        raise InputError(
            f"the input {train.input_names[j]} is constant: there is no excitation; excite it and measure again."
        )
    if test is None:
        return
    if (test.n_inputs, test.n_outputs) != (train.n_inputs, train.n_outputs):
        raise InputError(f"the test record has {test.n_inputs} inputs and {test.n_outputs} outputs, the training record "
                         f"{train.n_inputs} and {train.n_outputs}; they must be of the same system.")  # fmt: skip
    if abs(test.dt - train.dt) > 1e-3 * train.dt:
        raise InputError(
            f"the sampling times are {train.dt:g} and {test.dt:g} s; resample one record to the other's."
        )
    shared = copied_rows(train, test)
    if shared:
        raise InputError(f"{shared} consecutive rows of the test record are also in the training record; the error on "
                         "them would prove nothing: give data that were not used.")  # fmt: skip


def diagnose(
    train: Record,
    test: Record | None = None,
    setting: Setting | None = None,
    *,
    effects: Iterable[Effect] | None = None,
) -> Diagnosis:
    """Find what a linear model of measured data lacks, add it, and measure the error before and after.

    Parameters
    ----------
    train : Record
        Everything is chosen and fitted on this record.
    test : Record, optional
        Held-out record on the same clock; without it the errors are those of blocked cross-validation: every
        block of the training record is simulated with parameters fitted to the other blocks.
    setting : Setting, optional
        What is known of the system.
    effects : iterable of Effect, optional
        What is looked for, `[*CATALOGUE, mine]` for one of your own; the catalogue without it.

    Returns
    -------
    Diagnosis
        Causes, evidence, errors.

    Raises
    ------
    InputError
        If the records cannot be diagnosed: no excitation, different systems, test rows in the training record.

    Notes
    -----
    The test record is never used to choose or to fit anything.
    """
    setting = Setting() if setting is None else setting
    setting = setting if effects is None else replace(setting, effects=tuple(effects))
    _check(train, test)
    outputs = [examine(train, i, setting) for i in range(train.n_outputs)]
    if test is None:
        clock = Clock(np.arange(len(train), dtype=float), len(train))
        held_out = f"held-out blocks of the record ({BLOCKS}-fold cross-validation of the parameters)"
        return _assess(train, train, clock, outputs, replace(setting, skip=0), held_out, blocked=True)
    start = 0.0 if setting.separate else round((test.t0 - train.t0) / train.dt)
    clock = Clock(start + np.arange(len(test), dtype=float), len(train))
    return _assess(train, test, clock, outputs, setting, "test record")


def _with_start(f: Fit, u: Array, clock: Clock, measured: Array, skip: int) -> Array:
    """Simulated test output, with the initial state that fits the first `skip` samples."""
    y = simulate(f.structure, f.p, u, clock, rest=True)
    if skip <= 0 or not np.all(np.isfinite(y)):
        return y
    if f.structure.layout == "tf":
        X = free_responses(f.structure, f.p, len(y))
        return y + X @ np.linalg.lstsq(X[:skip], (measured - y)[:skip], rcond=None)[0]
    head = Clock(clock.k[:skip], clock.length)
    if f.structure.layout == "tanks":
        x0 = f.p[8:10].copy()
    else:
        X = free_responses(f.structure, f.p, skip)
        x0 = np.linalg.lstsq(X, (measured - y)[:skip], rcond=None)[0]

    def errors(x: Array) -> Array:
        return measured[:skip] - simulate(f.structure, f.p, u[:skip], head, rest=True, start=x)

    x0, _, _ = levenberg_marquardt(errors, x0, np.abs(x0) + 1e-3 * np.abs(x0).max() + 1e-12)
    return simulate(f.structure, f.p, u, clock, rest=True, start=x0)


def _assess(
    train: Record,
    test: Record,
    clock: Clock,
    outputs: list[Examined],
    setting: Setting,
    held_out: str,
    blocked: bool = False,
) -> Diagnosis:
    n, ny = test.y.shape
    before, after, one_before, one_after = (np.empty((n, ny)) for _ in range(4))
    weight = np.isfinite(test.y)
    floor = np.empty(ny)
    finals: list[Fit] = []

    def output(f: Fit, out: Examined, y: Array) -> Array:
        if not blocked:
            return _test_output(f, test, clock, y, setting.skip, out.thin_of(f))
        thin = out.thin_of(f)
        held = blocked_simulation(out.last if f is out.attribution.final else out.channel, f)
        if thin == 1 or not np.all(np.isfinite(held)):
            return held if len(held) == n else np.full(n, np.inf)
        return CubicSpline(thin * np.arange(len(held)), held)(np.arange(n))

    for i, out in enumerate(outputs):
        a = out.attribution
        y = np.where(weight[:, i], test.y[:, i], 0.0)
        before[:, i] = output(out.naive, out, y)
        options = [a.final] + [c.fit for c in a.claims if c.p_value < setting.alpha] + [a.coloured]
        if not a.chosen:
            options = [a.base if out.signatures else out.naive]
        bound = np.concatenate((train.y[np.isfinite(train.y[:, i]), i], before[:, i]))
        for f in options:
            after[:, i] = before[:, i] if f is out.naive else output(f, out, y)
            if _sane(after[:, i], bound):
                break
        else:
            f, after[:, i] = a.base, before[:, i]
        finals.append(f)
        if out.channel.step > 0:
            rounded = np.round(after[:, i] / out.channel.step) * out.channel.step
            after[:, i] = rounded
        if any(sig.key == "held" for sig in out.signatures):
            weight[:, i] &= ~held_samples(test.y[:, i])
        e0, e1 = y - before[:, i], y - after[:, i]
        step = out.thin_of(f)  # the noise model's sample
        one_before[:, i], one_after[:, i] = e0, np.repeat(innovations(e1[::step], f.noise), step)[:n]
        own = out.last if f is a.final else out.channel
        rest = f.residual
        if own.step > 0:  # in the measure of the error after: rounded as the sensor rounds
            simulated = simulate(f.structure, f.p, own.u, own.clock)
            rest = own.y - np.round(simulated / own.step) * own.step
        floor[i] = np.sqrt(np.sum(rest[own.keep] ** 2) / max(1, own.keep.sum() - len(f.p)))
    weight[: setting.skip] = False
    rng = np.random.default_rng(20260)

    rows = weight.any(axis=1)

    def squares(e: Array) -> Array:
        return np.where(weight, e**2, 0.0).sum(axis=1)[rows] / weight.sum(axis=1)[rows]

    def figure(e: Array, other: Array | None = None) -> ErrorFigure:
        return _bootstrap(squares(e), rng, None if other is None else squares(other))

    e0, e1 = np.nan_to_num(test.y) - before, np.nan_to_num(test.y) - after
    perfect = float(np.sqrt(np.mean(floor**2)))
    return Diagnosis(
        rmse_before=figure(e0), rmse_after=figure(e1), pred_rmse_before=figure(one_before),
        pred_rmse_after=figure(one_after), difference=figure(e0, e1), noise_floor=perfect,
        room=_removed(squares(e0), squares(e1), perfect, len(train), rng),
        yhat_before=before, yhat_after=after, held_out=held_out,
        extra={"outputs": outputs, "finals": finals, "train": train, "test": test}, **verdict(outputs, setting),
    )  # fmt: skip
