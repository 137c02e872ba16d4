"""The loop: linear model, residual, cause, augmented model, and the error before and after on data not used."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.examination import Examined, Setting, examine, thinned
from estimators.diagnosis.fitting import Fit, innovations, levenberg_marquardt
from estimators.diagnosis.measurement import held_samples
from estimators.diagnosis.report import Diagnosis, ErrorFigure
from estimators.diagnosis.selection import labels_of
from estimators.diagnosis.structure import free_responses, simulate
from estimators.effects.catalogue import CATALOGUE, Clock
from oed.data import Record
from oed.errors import InputError

__all__ = ["Setting", "diagnose"]

Array = NDArray[Any]


def _test_output(f: Fit, record: Record, clock: Clock, measured: Array, skip: int, thin: int) -> Array:
    """Simulated test output; a thinned model's is interpolated between its samples."""
    if thin == 1:
        return _with_start(f, record.u, clock, measured, skip)
    from scipy.interpolate import CubicSpline

    short = thinned(record, thin)
    slow = Clock(clock.k[0] / thin + np.arange(len(short), dtype=float), clock.length // thin)
    few = max(skip // thin, 2 * f.structure.order) if skip else 0
    y = _with_start(f, short.u, slow, measured[: len(short) * thin : thin], few)
    if not np.all(np.isfinite(y)):
        return np.full(len(record), np.inf)
    return CubicSpline(thin * np.arange(len(y)), y)(np.arange(len(record)))


def _sane(y: Array, reference: Array) -> bool:
    return bool(np.all(np.isfinite(y)) and np.max(np.abs(y)) < 8 * np.max(np.abs(reference)) + 1e-300)


def _bootstrap(
    squares: Array, rng: np.random.Generator, other: Array | None = None, draws: int = 200
) -> ErrorFigure:
    """Root of the mean (or the difference of two roots) with a moving-block bootstrap interval."""
    n = len(squares)
    block = max(1, min(n // 5, int(2 * n ** (1 / 3))))
    count = int(np.ceil(n / block))
    total = np.concatenate(([0.0], np.cumsum(squares)))
    sums = total[block:] - total[:-block]
    which = rng.integers(0, len(sums), (draws, count))
    values = np.sqrt(np.maximum(sums[which].sum(axis=1) / (count * block), 0.0))
    value = float(np.sqrt(max(squares.mean(), 0.0)))
    if other is not None:
        total = np.concatenate(([0.0], np.cumsum(other)))
        sums = total[block:] - total[:-block]
        values = values - np.sqrt(np.maximum(sums[which].sum(axis=1) / (count * block), 0.0))
        value -= float(np.sqrt(max(other.mean(), 0.0)))
    low, high = np.quantile(values, (0.025, 0.975))
    return ErrorFigure(value, float(low), float(high))


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
    shared = _shared_rows(train, test)
    if shared:
        raise InputError(f"{shared} consecutive rows of the test record are also in the training record; the error on "
                         "them would prove nothing: give data that were not used.")  # fmt: skip


def _shared_rows(train: Record, test: Record, run: int = 8) -> int:
    """Length of the longest stretch of the test record that is also in the training record, 0 if below `run`.

    Single rows may agree by chance where signals are quantised; stretches with several distinct rows do not.
    """
    pieces = []
    for record in (train, test):
        rows = np.ascontiguousarray(np.concatenate((record.u, record.y), axis=1))
        marks = [row.tobytes() for row in rows]
        pieces.append([tuple(marks[k : k + run]) for k in range(len(marks) - run + 1)])
    known = {piece for piece in pieces[0] if len(set(piece)) > run // 2}
    longest = current = 0
    for piece in pieces[1]:
        current = current + 1 if piece in known else 0
        longest = max(longest, current)
    return longest + run - 1 if longest else 0


def diagnose(train: Record, test: Record | None = None, setting: Setting | None = None) -> Diagnosis:
    """Find what a linear model of measured data lacks, add it, and measure the error before and after.

    Parameters
    ----------
    train : Record
        Everything is chosen and fitted on this record.
    test : Record, optional
        Held-out record on the same clock; without it the last quarter of the training record is held out.
    setting : Setting, optional
        What is known of the system.

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
    _check(train, test)
    held_out = "test record"
    if test is None:
        cut = len(train) * 3 // 4
        train, test, held_out = train[:cut], train[cut:], "last quarter of the record"
        setting = replace(setting, skip=max(setting.skip, min(50, len(test) // 10)))
    outputs = [examine(train, i, setting) for i in range(train.n_outputs)]
    start = 0.0 if setting.separate else round((test.t0 - train.t0) / train.dt)
    clock = Clock(start + np.arange(len(test), dtype=float), len(train))
    return _assess(train, test, clock, outputs, setting, held_out)


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
    train: Record, test: Record, clock: Clock, outputs: list[Examined], setting: Setting, held_out: str
) -> Diagnosis:
    n, ny = test.y.shape
    before, after, one_before, one_after = (np.empty((n, ny)) for _ in range(4))
    weight = np.isfinite(test.y)
    floor = np.empty(ny)
    finals: list[Fit] = []
    for i, out in enumerate(outputs):
        a = out.attribution
        y = np.where(weight[:, i], test.y[:, i], 0.0)
        before[:, i] = _test_output(out.naive, test, clock, y, setting.skip, out.thin)
        options = [a.final] + [c.fit for c in a.claims if c.p_value < setting.alpha] + [a.coloured]
        if not a.chosen:
            options = [a.base if out.signatures else out.naive]
        bound = np.concatenate((train.y[np.isfinite(train.y[:, i]), i], before[:, i]))
        for f in options:
            after[:, i] = _test_output(f, test, clock, y, setting.skip, out.thin)
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
        one_before[:, i], one_after[:, i] = e0, innovations(e1, f.noise)
        floor[i] = np.sqrt(
            np.sum(f.residual[out.channel.keep] ** 2) / max(1, out.channel.keep.sum() - len(f.p))
        )
    weight[: setting.skip] = False
    rng = np.random.default_rng(20260)

    def figure(e: Array, other: Array | None = None) -> ErrorFigure:
        count = np.maximum(weight.sum(axis=1), 1)
        rows = weight.any(axis=1)
        per = np.where(weight, e**2, 0.0).sum(axis=1)[rows] / count[rows]
        if other is None:
            return _bootstrap(per, rng)
        return _bootstrap(per, rng, np.where(weight, other**2, 0.0).sum(axis=1)[rows] / count[rows])

    e0, e1 = np.nan_to_num(test.y) - before, np.nan_to_num(test.y) - after
    verdict = _verdict(outputs, setting)
    return Diagnosis(
        rmse_before=figure(e0), rmse_after=figure(e1), pred_rmse_before=figure(one_before),
        pred_rmse_after=figure(one_after), difference=figure(e0, e1), noise_floor=float(np.sqrt(np.mean(floor**2))),
        yhat_before=before, yhat_after=after, held_out=held_out,
        extra={"outputs": outputs, "finals": finals, "train": train, "test": test}, **verdict,
    )  # fmt: skip


def _verdict(outputs: list[Examined], setting: Setting) -> dict[str, Any]:
    """Causes of all outputs together."""
    evidence: list[str] = []
    order: list[tuple[float, str]] = []
    p_value = 1.0
    parameters: dict[str, tuple[float, float, str]] = {}
    pool: dict[str, float] = {}
    alpha = setting.alpha / len(outputs)
    for i, out in enumerate(outputs):
        a = out.attribution
        tag = f" on output {i + 1}" if len(outputs) > 1 else ""
        for sig in out.signatures:
            order.append((1e6, sig.key))
            evidence.append(sig.sentence)
            p_value = 0.0
        follows = a.feedback < alpha / 100
        if follows:
            order.append((5e5, "feedback"))
            p_value = min(p_value, a.feedback)
            evidence.append(
                f"past innovations help to predict the input{tag} (p = {a.feedback:.2g}): the data are from a closed loop"
            )
        by_key = {c.key: c for c in a.claims}
        for rank, key in enumerate(a.chosen):
            gain = by_key[key].gain if key in by_key else 100.0
            order.append(
                (max(gain, 1.0) if not follows or key == "coloured" else gain * 1e-3, key)
                if rank
                else (1e3 + gain, key)
            )
            p = a.p_values.get(key, by_key[key].p_value if key in by_key else 0.0)
            p_value = min(p_value, p)
            evidence.append(f"{CATALOGUE[key].sentence}{tag}: corrected p = {p:.2g}")
        for c in a.claims:
            pool[c.label] = pool.get(c.label, 0.0) + max(c.gain, 0.0)
        parameters.update(_parameters(a.final, f"y{i + 1}." if len(outputs) > 1 else ""))
    order.sort(key=lambda x: -x[0])
    keys = [k for _, k in order]
    chosen = labels_of(keys)
    detected = bool(chosen)
    rest = [
        label for label, gain in sorted(pool.items(), key=lambda x: -x[1]) if label not in chosen and gain > 0
    ]
    ranked = chosen + rest if detected else ["none"]
    confusable = _confusable(outputs, ranked[0])
    return {
        "detected": detected, "effect": ranked[0], "variant": ", ".join(dict.fromkeys(keys)), "ranked": tuple(ranked),
        "nature": CATALOGUE[keys[0]].nature if keys else "none", "p_value": p_value, "evidence": tuple(evidence),
        "parameters": parameters, "confusable": confusable,
    }  # fmt: skip


def _confusable(outputs: list[Examined], first: str) -> tuple[str, ...]:
    """Other single causes whose criterion is within 6 of the first one's."""
    names: list[str] = []
    for out in outputs:
        claims = out.attribution.claims
        mine = [c for c in claims if c.label == first]
        if not mine or len(out.attribution.final.structure.effects) != 1:
            continue
        names += [
            c.label for c in claims if c.label != first and c.gain > mine[0].gain - 6.0 and c.p_value < 0.01
        ]
    return tuple(dict.fromkeys(names))


def _parameters(f: Fit, prefix: str) -> dict[str, tuple[float, float, str]]:
    """Effect parameters with standard errors from the Jacobian."""
    out: dict[str, tuple[float, float, str]] = {}
    if not f.jacobian.size:
        return out
    norms = np.sqrt(np.sum(f.jacobian**2, axis=0)) + 1e-300
    H = (f.jacobian / norms).T @ (f.jacobian / norms)
    covariance = np.linalg.pinv(H) * f.variance / np.outer(norms, norms).clip(1e-290)
    se = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for part, sl in zip(f.structure.parts, f.structure.slices(), strict=True):
        names = part.effect.parameters * (part.size if part.key == "tones" else 1)
        units = part.effect.units * (part.size if part.key == "tones" else 1)
        for i in range(sl.stop - sl.start):
            name = names[i] if i < len(names) else f"c{i}"
            unit = units[i] if i < len(units) else ""
            label = f"{prefix}{part.key}.{name}"
            if label in out:
                label += f"_{i // len(part.effect.parameters) + 1}"
            out[label] = (float(f.p[sl.start + i]), float(se[sl.start + i]), unit)
    return out
