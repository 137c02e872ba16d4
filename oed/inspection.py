"""What a record may suffer from: offsets, trends, outliers, saturation, slower sampling, poor excitation.

Everything here is reported and nothing is changed: whether a mean is an operating point, or a sample a fault, is
known to those who measured it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.data import Record

SIGNIFICANT = 4.0
"""Standard errors from which a mean or a slope is reported."""
FAR = 8.0
"""Robust standard deviations from its neighbours from which a sample is an outlier."""


@dataclass(frozen=True)
class Defect:
    """One thing to know about a channel before a model is fitted to it. `kind` missing, constant, offset,
    trend, outliers, saturation, slow sampling, sampling or excitation; `channel` name of the channel; empty
    where it is about the records as a whole; `size` number of samples (missing, outliers, saturation), the
    mean (offset), the change from the first to the last sample (trend), the samples between two changes (slow
    sampling), the order reached (excitation), the ratio of sampling times (sampling), the value (constant);
    `sentence` what was seen, with its numbers, and what can be done; `record` which record, from 1; 0 for all
    of them."""

    kind: str
    channel: str
    size: float
    sentence: str
    record: int = 0

    def to_dict(self) -> dict:
        """Plain values."""
        return {name: getattr(self, name) for name in ("kind", "channel", "size", "sentence", "record")}

    def __str__(self) -> str:
        where = f"record {self.record}, " if self.record else ""
        return f"{where}{self.channel + ': ' if self.channel else ''}{self.sentence}"


def defects(records: Record | Sequence[Record], *, order: int = 0) -> list[Defect]:
    """Everything in records that a linear model with white or coloured noise does not foresee."""
    from oed.files.objects import as_records

    given = as_records(records, missing=True)
    found = []
    for k, record in enumerate(given):
        which = k + 1 if len(given) > 1 else 0
        sides = (record.input_names, record.u, True), (record.output_names, record.y, False)
        for names, signals, is_input in sides:
            for name, x in zip(names, signals.T, strict=True):
                found += _of_channel(name, x, which, is_input)
    steps = [r.dt for r in given]
    if max(steps) > min(steps) * (1 + 1e-6):
        words = (
            f"the records are sampled every {', '.join(f'{s:g}' for s in steps)} s; one model needs one sampling "
            "time: resample them to the slowest."
        )
        found.append(Defect("sampling", "", max(steps) / min(steps), words))
    if order:
        for j, name in enumerate(given[0].input_names):
            reached = excitation_order([r.u[:, j] for r in given], order + 1)
            if reached < order:
                words = (
                    f"persistently exciting of order {reached} to 1e-9 of its power, and {order} is needed: what lies "
                    "beyond is all but undetermined; excite more frequencies, or lower the orders."
                )
                found.append(Defect("excitation", name, reached, words))
    return found


def _of_channel(name: str, x: NDArray, which: int, is_input: bool) -> list[Defect]:
    found, seen = [], np.isfinite(x)
    note = lambda kind, size, words: found.append(Defect(kind, name, float(size), words, which))
    if not seen.all():
        lost = int((~seen).sum())
        note("missing", lost, f"{lost} of {len(x)} samples are missing.")
    whole, t = x[seen], np.flatnonzero(seen)
    if len(whole) < 8:
        return found
    if np.ptp(whole) == 0:
        note("constant", whole[0], f"constant at {whole[0]:g}.")
        return found
    mean, deviation = float(whole.mean()), float(whole.std())
    memory = _memory(whole - mean)
    spread = deviation * np.sqrt(memory / len(whole))
    if abs(mean) > min(max(SIGNIFICANT * spread, 0.1 * deviation), deviation):
        note(
            "offset", mean,
            f"the mean is {mean:.4g}, {abs(mean) / deviation:.2g} standard deviations from zero: let the offset be "
            "estimated, or say that it is an operating point.",
        )  # fmt: skip
    time = (t - t.mean()) / np.ptp(t)
    slope = float(time @ whole / (time @ time))
    rest = whole - mean - slope * time
    error = np.sqrt(float(rest @ rest) / len(rest) * _memory(rest) / float(time @ time))
    share = slope**2 * float(time @ time) / (len(whole) * deviation**2)
    if abs(slope) > SIGNIFICANT * error and share > 0.05:
        note(
            "trend", slope,
            f"changes by {slope:.4g} from start to end on a straight line, {100 * share:.0f} % of the variance: if "
            "that is drift, take it out; if it is the response, keep it.",
        )  # fmt: skip
    spikes = _outliers(whole)
    if spikes.size:
        at = t[spikes]
        shown = ", ".join(map(str, at[:5])) + (", ..." if len(at) > 5 else "")
        note(
            "outliers", len(at),
            f"{len(at)} samples jump off their neighbours by more than {FAR:g} robust standard deviations (samples "
            f"{shown}): look at them; a robust loss, or marking them as missing, withstands them.",
        )  # fmt: skip
    found += _limits(name, whole, which, is_input)
    held = _held(whole)
    if held > 1:
        what = "it is held" if is_input else "it was sampled"
        note(
            "slow sampling",
            held,
            f"changes only every {held} samples: {what} {held} times slower than recorded.",
        )
    return found


def _memory(x: NDArray) -> float:
    """Integrated autocorrelation time: how many samples count as one, from the first-order correlation."""
    power = float(x @ x)
    r = float(x[1:] @ x[:-1]) / power if power > 0 else 0.0
    r = min(max(r, 0.0), 1 - 1.0 / len(x))
    return (1 + r) / (1 - r)


def _outliers(x: NDArray) -> NDArray[np.int64]:
    """One or two samples that leave the median of seven and come back, by much more than their neighbours
    move. Edges of steps and peaks of slow signals stay: the neighbours, too, move there."""
    if len(np.unique(x)) <= 10 or len(x) < 20:
        return np.zeros(0, dtype=np.int64)
    windows = np.lib.stride_tricks.sliding_window_view
    away = np.abs(x - np.median(windows(np.pad(x, 3, mode="reflect"), 7), axis=1))
    scale = float(np.median(away)) / 0.6745
    moves = np.abs(np.diff(np.pad(x, 7, mode="reflect")))  # moves[k + 6] leads from sample k - 1 to sample k
    near = windows(moves, 14)[:, [0, 1, 2, 3, 4, 9, 10, 11, 12, 13]].max(axis=1)
    return np.flatnonzero((away > FAR * scale) & (away > 4 * near) & (away > x.std() / 2))


def _limits(name: str, x: NDArray, which: int, is_input: bool) -> list[Defect]:
    """Runs of three and more samples at the largest or smallest value, where the signal else takes many values."""
    if len(np.unique(x)) <= max(10, 0.02 * len(x)):
        return []
    found = []
    for value, end in ((x.max(), "highest"), (x.min(), "lowest")):
        at = np.concatenate([[0], (x == value).astype(int), [0]])
        edges = np.diff(at)
        runs = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
        count = int(runs[runs >= 3].sum())
        if count >= max(4, 0.002 * len(x)):
            cure = "what the actuator applied is the input" if is_input else "mark these samples as missing"
            words = f"{count} samples lie in runs at the {end} value, {value:g}: it may be saturated there; {cure}."
            found.append(Defect("saturation", name, float(count), words, which))
    return found


def _held(x: NDArray) -> int:
    """Largest k such that the signal changes at every k-th sample only; 1 where it changes freely."""
    changes = np.flatnonzero(np.diff(x)) + 1
    if len(changes) < 8 or len(np.unique(x)) <= 10:
        return 1
    return int(np.gcd.reduce(np.diff(changes)))


def excitation_order(signals: NDArray | Sequence[NDArray], most: int) -> int:
    """Largest n, up to a limit, for which an input is persistently exciting: its n-th covariance matrix is
    regular; signals (N,). Regular means that the smallest eigenvalue exceeds 1e-9 of the largest (Ljung 1999,
    definition 13.2); the mean is taken off, because it is one with an offset."""
    parts = [signals] if isinstance(signals, np.ndarray) else list(signals)
    parts = [np.asarray(p, dtype=float).ravel() for p in parts]
    mean = np.concatenate(parts).mean()
    parts = [p - mean for p in parts]
    if not max(float(np.abs(p).max()) for p in parts) > 1e-12 * abs(mean):
        return 0
    most = min(most, max(len(p) for p in parts) // 2)
    gram, sums, count = np.zeros((most, most)), np.zeros(most), 0
    for p in parts:
        if len(p) >= most:
            rows = np.lib.stride_tricks.sliding_window_view(p, most)
            gram, sums, count = gram + rows.T @ rows, sums + rows.sum(axis=0), count + len(rows)
    gram -= np.outer(sums, sums) / count
    for n in range(1, most + 1):
        values = np.linalg.eigvalsh(gram[:n, :n])
        if values[0] <= 1e-9 * values[-1]:
            return n - 1
    return most
