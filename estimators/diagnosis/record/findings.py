"""What the data themselves show, apart from the system: the first of the two headlines of a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chi2

from estimators.diagnosis.baseline import Baseline
from estimators.diagnosis.baseline.disturbances import noise_model
from estimators.diagnosis.record.measurement import (
    at_reversals,
    held_samples,
    resting_samples,
    rounding_step,
    wild_samples,
)
from oed.data import Record

__all__ = ["Fault", "Finding", "cleaned", "data_findings"]

Array = NDArray[Any]

FEWEST = 3
"""Samples below which a fault is no finding: two can be chance."""
SHARE = 0.004
"""Of all samples, repeats below which they are no dropouts: rounding of a file repeats a few."""
COARSE = 0.8
"""Rounding step, of the residual's standard deviation, from which on it shapes the residual."""
FAR = 4.0
"""Median distance of outliers, in standard deviations of the other samples; below it they are the noise's own tail."""
MOST = 0.05
"""Share of samples beyond which they are no outliers but what the model lacks."""
LAGS = 10
"""Lags over which the input may answer the output's noise."""
MEMORY = 40
"""Past inputs that foretell an input before the output's noise may."""
SURE = 1e-6
"""Significance of feedback, and with it `CLOSED`: residuals of a wrong model are no white noise."""
CLOSED = 0.02
"""Share of the input's own innovation that earlier noise of the output must explain."""
NEW = 0.1
"""Innovation of an input, of its standard deviation, below which it foretells itself (a sweep, a few sines): what is left
then is the misfit of its own linear prediction, which any signal of the plant may share."""


class Fault(Enum):
    """Kinds of findings; the value says it in words. REST and ROUNDING do no harm by themselves."""

    GAPS = "missing samples"
    REST = "rest before the input starts"
    ROUNDING = "rounded samples"
    REPEATS = "repeated samples"
    OUTLIERS = "outliers"
    FEEDBACK = "feedback from output to input"


@dataclass(frozen=True, eq=False)
class Finding:
    """One finding about one output of one record.

    `fault` what it is; `record, output` where; `rows` (N,) the samples that show it; `size` rounding step,
    distance of outliers, share of repeats or of the input's innovation; `sentence` what was seen.
    """

    fault: Fault
    record: int
    output: int
    rows: NDArray[np.bool_]
    size: float
    sentence: str

    @property
    def harmful(self) -> bool:
        """Whether its samples are no measurement of the output, and may not count."""
        return self.fault in (Fault.REPEATS, Fault.OUTLIERS)


def cleaned(records: Sequence[Record], found: Sequence[Finding]) -> list[Record]:
    """The records with the samples of harmful findings marked as missing."""
    out = []
    for k, record in enumerate(records):
        y = record.y.copy()
        for f in found:
            if f.harmful and f.record == k:
                y[f.rows, f.output] = np.nan
        out.append(record.replace(y=y))
    return out


def data_findings(records: Sequence[Record], base: Baseline) -> tuple[Finding, ...]:
    """All findings, by record and output; `base` is a linear model of these records, with their faults as they are."""
    found = []
    for k, record in enumerate(records):
        for i in range(record.n_outputs):
            y, run = record.y[:, i], base.y_model[k][:, i]
            own = _samples(record.u, y, run)
            held = sum(
                (rows for fault, rows, *_ in own if fault is Fault.REPEATS), np.zeros(len(y), dtype=bool)
            )
            y = np.where(held, np.nan, y)
            own += _outliers(record.u, y, run) + _feedback(record.u, y, run, record.input_names)
            found += [Finding(fault, k, i, rows, size, f"{record.output_names[i]}: {sentence}")
                      for fault, rows, size, sentence in own]  # fmt: skip
    return tuple(found)


_Row = tuple[Fault, NDArray[np.bool_], float, str]


def _samples(u: Array, y: Array, run: Array) -> list[_Row]:
    """What the samples show without a model: gaps, rest, rounding, repeats."""
    n, missing, found = len(y), ~np.isfinite(y), list[_Row]()
    if missing.any():
        edges = np.flatnonzero(np.diff(np.concatenate(([0], missing, [0]))))
        longest = int(np.max(edges[1::2] - edges[::2]))
        found.append((Fault.GAPS, missing, float(missing.mean()),
                      f"{int(missing.sum())} of {n} samples are missing, {longest} in a row at most."))  # fmt: skip
    moved = np.flatnonzero((u != u[:1]).any(axis=1))
    before = int(moved[0]) if len(moved) else n
    if before >= LAGS:
        rows = np.arange(n) < before
        found.append((Fault.REST, rows, float(before), f"the input rests for the first {before} samples."))
    filled = np.where(missing, 0.0, y)
    step, spread = rounding_step(y), float(np.nanstd(y - run))
    if step > COARSE * spread:
        found.append((Fault.ROUNDING, ~missing, step,
                      f"all samples lie on a lattice of step {step:.5g}, {step / max(spread, 1e-300):.2g} times the "
                      "residual's standard deviation."))  # fmt: skip
    if step == 0.0:
        held = held_samples(filled) & ~resting_samples(u, filled) & ~missing
        held[: int(np.argmax(filled != filled[0]))] = False  # the first answer to the input is late
        if held.sum() >= max(FEWEST, SHARE * n):
            found.append((Fault.REPEATS, held, float(held.mean()),
                          f"{int(held.sum())} of {n} samples repeat the one before exactly while the input moves."))  # fmt: skip
    return found


def _outliers(u: Array, y: Array, run: Array) -> list[_Row]:
    """Samples far off their neighbours' residual, unless they lie where a wrong model errs: at reversals and input steps."""
    seen = np.isfinite(y)
    e = np.where(seen, y - run, 0.0)
    wild = wild_samples(e, seen) & ~resting_samples(u, np.nan_to_num(y))
    n, count = len(y), int(wild.sum())
    spread = float(np.std(e[seen & ~wild])) if (seen & ~wild).any() else 0.0
    steps = np.abs(np.diff(u, axis=0, prepend=u[:1])).max(axis=1)
    early = int(np.sum(wild[: max(2 * LAGS, n // 50)]))  # a transient from the start is no fault
    if (
        not max(FEWEST, 0.001 * n) <= count <= MOST * n
        or early > 0.7 * count
        or np.median(np.abs(e[wild])) < FAR * spread
        or at_reversals(wild, run)
        or _follow(wild, steps)
    ):
        return []
    size = float(np.median(np.abs(e[wild])))
    return [(Fault.OUTLIERS, wild, size,
             f"{count} isolated samples are off by about {size:.3g}, {size / max(spread, 1e-300):.0f} standard "
             "deviations of the others.")]  # fmt: skip


def _follow(wild: NDArray[np.bool_], steps: Array) -> bool:
    """Whether wild samples come within `LAGS` samples after a large step of the input more often than chance lets them."""
    large = steps > 4.0 * np.median(steps) + 1e-300
    if not 0.0 < large.mean() < 0.2:  # steps all the time, or none, tell nothing
        return False
    near = np.convolve(large, np.ones(LAGS))[: len(wild)] > 0
    share, hits = float(near.mean()), float(np.mean(near[wild]))
    return hits > share + 4.0 * np.sqrt(share * (1.0 - share) / wild.sum())


def _late(x: Array, lags: range) -> Array:
    """(N, lags) a signal that is zero before it starts, at each of the lags."""
    return np.stack([np.concatenate((np.zeros(k), x[: len(x) - k])) for k in lags], axis=1)


def _feedback(u: Array, y: Array, run: Array, names: Sequence[str]) -> list[_Row]:
    """Inputs whose own innovation follows earlier innovations of the output's noise."""
    rows, found = np.isfinite(y), list[_Row]()
    e = np.where(rows, y - run, 0.0)
    e = e - e[rows].mean()
    a, _ = noise_model([np.where(rows, e, np.nan)])
    noise = np.asarray(lfilter(a, [1.0], e))
    for j, x in enumerate(u.T):
        own = _late(x - x.mean(), range(MEMORY + 1))[MEMORY:]
        X = np.concatenate((own[:, 1:], _late(noise, range(1, LAGS + 1))[MEMORY:]), axis=1)
        alone, both = (own[:, 0] - Z @ np.linalg.lstsq(Z, own[:, 0], rcond=1e-10)[0] for Z in (own[:, 1:], X))
        if not float(alone @ alone) > NEW**2 * len(alone) * float(np.var(x)):
            continue
        now, share = alone, 1.0 - float(both @ both) / float(alone @ alone)
        if share > CLOSED and chi2.sf(len(now) * share, LAGS) < SURE:
            found.append((Fault.FEEDBACK, rows, share,
                          f"the input {names[j]} follows earlier noise of this output ({share:.0%} of what is new in "
                          "it): the record was taken in closed loop."))  # fmt: skip
    return found
