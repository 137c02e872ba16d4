"""The sampling time that a column of times implies, and whether the times are uniform."""

import re

import numpy as np
from numpy.typing import NDArray

from oed.errors import InputError

SECONDS = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0), **dict.fromkeys(("ms", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "microsecond", "microseconds"), 1e-6), **dict.fromkeys(("ns", "nanosecond", "nanoseconds"), 1e-9),
    **dict.fromkeys(("min", "minute", "minutes"), 60.0), **dict.fromkeys(("h", "hour", "hours"), 3600.0),
    **dict.fromkeys(("day", "days"), 86400.0),
}  # fmt: skip
"""Seconds in a unit of time, by its names. Not d, which differences have, and not m."""
COUNTED = re.compile(r"\s*(\d+\.?\d*(?:e[-+]?\d+)?)?\s*(\D+)", re.IGNORECASE)
UNIFORM = 1e-6
"""Largest deviation from a uniform clock that needs no explanation, in steps."""
PRINTED = 12
"""Digits that a time may be printed to; from more on, its rounding is below what needs no explanation."""
CALENDAR = 1e11, 1e3
"""Seconds, three thousand years, and lengths of the record, beyond both of which a first time counts something smaller than seconds."""


def seconds_in(unit: str) -> float:
    """Seconds in a unit of time, or in several, as in "15 min"; 0 where it is none."""
    parts = COUNTED.fullmatch(unit)
    return float(parts[1] or 1.0) * SECONDS.get(parts[2].strip().lower(), 0.0) if parts else 0.0


def sampling_time(t: NDArray[np.float64], source: str, *, first_row: int = 0) -> tuple[float, float]:
    """Sampling time of uniform times t_k = t_0 + k dt, and how well the times determine it: t (N,).
    Deviations up to 1e-6 of the step are accepted, and so are larger ones that rounding to the digits printed
    explains: a line through the times exists with all of them within half a unit of the last digit."""
    bad = ~np.isfinite(t)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"{source} is {t[row]} in row {row + first_row} (counting from 0); times must be finite: "
            "fill the gaps of the clock, or leave the column out and give the sampling time."
        )
    steps = np.diff(t)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0))
        raise InputError(
            f"{source} goes from {t[row]:.12g} to {t[row + 1]:.12g} at row {row + 1 + first_row} (counting from 0); "
            "times must increase: sort the rows, or split the file where the clock restarts."
        )
    if t[0] > max(CALENDAR[0], CALENDAR[1] * (t[-1] - t[0])):
        raise InputError(
            f"{source} begins at {t[0]:.12g} s, {t[0] / (365.25 * 86400):.3g} years from its zero; times are in seconds: write their "
            "unit into the name of the column, as t [ms], t [us] or t [ns], or take it out and give the sampling time."
        )
    k = np.arange(len(t))
    mean = float((t[-1] - t[0]) / (len(t) - 1))
    floating = 4 * float(np.spacing(np.abs(t).max()))
    slack = UNIFORM * mean
    if np.abs(steps - mean).max() > slack + floating:
        units = _rounding_units(t)
        rounding = float(units.max())
        explains = 0.0 < rounding <= mean / 3  # a coarser clock cannot tell rounding from a lost sample
        if not explains or _line_deviation(t, units / 2 * (1 + 1e-6) + floating) > 1.0:
            _refuse(t, steps, max(slack, rounding if explains else 0.0) + floating, source, first_row)
        slack = max(slack, rounding)
    return _simplest(t, k, mean, floating), (slack + floating) / (len(t) - 1) + UNIFORM * mean


def _rounding_units(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) unit of the last digit of times that look printed to fixed decimals or to so many digits, or stored in single precision,
    else 0."""
    largest, every = float(np.abs(t).max()), np.ones(len(t))
    for decimals in range(10):
        if (np.abs(t - np.round(t, decimals)) <= 2 * np.spacing(largest)).all():
            fixed = every * 10.0**-decimals
            break
    else:
        fixed = 0.0 * every
    for digits in range(1, PRINTED + 1):
        if all(np.array_equal(x, [float(f"{v:.{digits}g}") for v in x]) for x in (t[-PRINTED:], t)):
            top = np.floor(np.log10(np.where(t == 0.0, 10.0**-digits, np.abs(t))))
            return np.maximum(fixed, 10.0 ** (top + 1 - digits))
    single = t.astype(np.float32)
    return np.maximum(fixed, np.spacing(np.abs(single)).astype(float) if (single == t).all() else 0.0)


def _line_deviation(t: NDArray[np.float64], allowed: NDArray[np.float64]) -> float:
    """Least largest deviation of t from any line in k, of what is allowed, by exchange of the three points that support it."""
    k = np.arange(len(t), dtype=float)
    if len(t) < 3:
        return 0.0
    support = np.array([0, len(t) // 2, len(t) - 1])
    deviation = 0.0
    for _ in range(100):
        sides = np.array([1.0, -1.0, 1.0]) * allowed[support]
        system = np.stack((np.ones(3), k[support], sides), axis=1)
        start, slope, height = np.linalg.solve(system, t[support])
        residual = (t - (start + slope * k)) / allowed
        deviation = abs(height)
        worst = int(np.argmax(np.abs(residual)))
        if worst in support or abs(residual[worst]) <= deviation * (1 + 1e-9):
            return float(abs(residual[worst]))
        support = _exchange(support, residual, worst)
    return float(np.abs(residual).max())


def _exchange(support: NDArray[np.int64], residual: NDArray[np.float64], worst: int) -> NDArray[np.int64]:
    """Put the worst point into the support so that the signs of the residuals still alternate."""
    sign = np.sign(residual[worst])
    i, j, m = support
    if worst < i:
        return np.array([worst, j, m] if np.sign(residual[i]) == sign else [worst, i, j])
    if worst > m:
        return np.array([i, j, worst] if np.sign(residual[m]) == sign else [j, m, worst])
    if worst < j:
        return np.array([worst, j, m] if np.sign(residual[i]) == sign else [i, worst, m])
    return np.array([i, j, worst] if np.sign(residual[m]) == sign else [i, worst, m])


def _simplest(t: NDArray[np.float64], k: NDArray[np.int64], mean: float, floating: float) -> float:
    """The shortest number that reproduces t bit for bit, else the shortest one within rounding, else the mean."""
    shortest = [float(f"{mean:.{digits}e}") for digits in range(17)]
    near = [d for d in shortest if np.abs(t - (t[0] + d * k)).max() <= floating]
    half = np.spacing(np.abs(t[1:])) / 2
    low, high = ((t[1:] - t[0] - half) / k[1:]).max(), ((t[1:] - t[0] + half) / k[1:]).min()
    middle = float(low + (high - low) / 2)
    inside = [float(f"{middle:.{digits}e}") for digits in range(17)] if low <= high else []
    neighbours = [middle + n * float(np.spacing(middle)) for n in (0, 1, -1, 2, -2, 3, -3)]
    for candidate in (*near, *inside, float(t[1] - t[0]), *neighbours):
        if (t[0] + candidate * k == t).all():
            return candidate
    return near[0] if near else mean


def _refuse(t: NDArray, steps: NDArray, tolerance: float, source: str, first_row: int) -> None:
    usual = float(np.median(steps))
    wrong = np.abs(steps - usual) > tolerance
    if not wrong.any():  # a slow drift: no single step shows it
        line = t - (t[0] + usual * np.arange(len(t)))
        wrong = np.abs(line[1:]) > min(tolerance, np.abs(line).max() / 2)
    row = int(np.argmax(wrong))
    raise InputError(
        f"{source} is not uniform: from row {row + first_row} to row {row + 1 + first_row} (counting from 0) it goes "
        f"from {t[row]:.12g} to {t[row + 1]:.12g}, a step of {steps[row]:.9g} s where the others are {usual:.9g} s; "
        "steps must be equal to 1e-6: resample the record, or read the uniform part with FILE[a:b]; where only the "
        "clock jitters and no sample is lost, take the column out and give the sampling time (--dt, in Python dt=)."
    )
