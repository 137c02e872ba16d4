"""What protects a rig and its records: an input against the limits before anybody sees it, an output when it comes back."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimators.sessions.settings import Settings
from oed.errors import CUBES, InputError, check_size, largest
from oed.files.clock import sampling_time
from oed.files.limits import file_content
from oed.files.reading import read_table
from oed.files.tables import Table, distinct_names, seconds_per, split_unit

Array = NDArray[np.float64]
HELD = 5
ROUNDING = 1e-9


def check_input(u: Array, settings: Settings) -> None:
    """Raise if a rig's input violates a limit, naming the limit, the channel and the sample: u (samples, nu)."""
    if not np.isfinite(u).all():
        raise InputError("the input has samples that are not finite; nothing was written.")
    for name, unit, values, limits in _demands(u, settings):
        over = values.max(axis=0) > np.asarray(limits) * (1 + ROUNDING)
        if over.any():
            j = int(np.argmax(over))
            t = int(np.argmax(values[:, j]))
            where = "" if name == "energy" else f" at sample {t}"
            raise InputError(
                f"the input violates the limit {name} of {settings.inputs[j]}: {values[t, j]:.6g}{where}, allowed are "
                f"{limits[j]:.6g} {unit}; lower the power or widen the limit. Nothing was written."
            )


def fitting_factor(u: Array, settings: Settings) -> tuple[float, str]:
    """By what the deviation from the levels must be multiplied so that every limit is met: u (samples, nu)."""
    factor, binding = 1.0, ""
    for name, _, values, limits in _demands(u, settings):
        largest = values.max(axis=0)
        for j, limit in enumerate(limits):
            if largest[j] > limit * (1 + ROUNDING):
                share = limit / largest[j]
                share = float(np.sqrt(share)) if name == "energy" else float(share)
                if share < factor:
                    factor, binding = share, f"{name} of {settings.inputs[j]}"
    return factor, binding


def _demands(u: Array, settings: Settings) -> Iterator[tuple[str, str, Array, tuple[float, ...]]]:
    """Name, unit, values (rows, nu) and limit per channel of every limit that is set."""
    level = np.asarray(settings.level)
    deviation = u - level
    if settings.amplitude is not None:
        yield "amplitude", "about the level", np.abs(deviation), settings.amplitude
    if settings.rate is not None:  # the rig is at its level before and after
        around = np.vstack([level, u, level])
        yield "rate", "per second", np.abs(np.diff(around, axis=0)) / settings.dt, settings.rate
    if settings.energy is not None:
        yield "energy", "in all", np.sum(np.square(deviation), axis=0)[None, :], settings.energy


@dataclass(frozen=True, eq=False)
class Reading:
    """The content of a recorded file. `y` (rows, ny) outputs; NaN where a sample is missing; `u` (rows, nu)
    the inputs as they were recorded beside them, where they were."""

    y: Array
    u: Array | None


def read_output(path: Path, settings: Settings, step: int) -> Reading:
    """Read a recorded file and check all that can be checked without the session's past."""
    named = re.fullmatch(r"(?:.*[^a-z])?(input|output)-(\d+)(?:-\d+)?\.\w+(?:\.gz)?", path.name)
    if named and (named[1] == "input" or int(named[2]) != step):
        raise InputError(
            f"{path.name} is by its name the {named[1]} of step {int(named[2])}, and the output of step {step} is "
            "waited for; give that file (or rename this one if its name is wrong)."
        )
    table = read_table(path)
    distinct_names(table)
    if path.suffix.lower() == ".csv" and not file_content(path).endswith((b"\n", b"\r")):
        raise InputError(
            f"{path.name} does not end with a line break; its last row may be half written: wait until the rig has "
            "closed the file (or add the line break if the file is whole)."
        )
    y_columns = _columns(table, settings.outputs)
    missing = [name for name, column in y_columns.items() if column is None]
    if missing:
        looks = " (it looks like an input file)" if any(_columns(table, settings.inputs).values()) else ""
        raise InputError(
            f"{path.name} has no column {', '.join(missing)}{looks}; its columns are "
            f"{', '.join(name for name in table.names if name)}: name the outputs {', '.join(settings.outputs)}."
        )
    u_columns = _columns(table, settings.inputs)
    with_inputs = all(u_columns.values())
    wanted = [*y_columns.values(), *(u_columns.values() if with_inputs else ())]
    clock = [name for name in table.names if seconds_per(name) and name not in wanted][:1]
    loaded = table.load([*[column for column in wanted if column], *clock])
    if len({len(values) for values in loaded}) > 1:
        raise InputError(f"the columns of {path.name} have unequal lengths; they must be equal.")
    if clock and len(loaded[-1]) > 1:
        t = loaded[-1] * seconds_per(clock[0])
        _check_step(*sampling_time(t, f"the time of {path.name}"), settings, path.name)
    if table.dt is not None:
        _check_step(table.dt, 0.0, settings, path.name)
    ny = settings.n_outputs
    y = np.column_stack(loaded[:ny])
    return Reading(y, np.column_stack(loaded[ny : ny + settings.n_inputs]) if with_inputs else None)


def _columns(table: Table, names: tuple[str, ...]) -> Mapping[str, str | None]:
    """The column of each channel, by its name with or without a unit."""
    found = {}
    for name in names:
        fits = [c for c in table.names if c == name] or [
            c for c in table.names if name in (split_unit(c)[0], table.labels.get(c))
        ]
        found[name] = fits[0] if len(fits) == 1 else None
    return found


def _check_step(step: float, tolerance: float, settings: Settings, name: str) -> None:
    if abs(step - settings.dt) > max(tolerance, 1e-6 * settings.dt):
        raise InputError(
            f"the sampling time of {name} is {step:.9g} s and that of the session {settings.dt:.9g} s; "
            "measure with the session's, or start a session with the rig's."
        )


def check_output(y: Array, rows: int, settings: Settings) -> None:
    """Raise if an output has not the session's shape: y (N, ny)."""
    if y.ndim != 2 or y.shape[1] != settings.n_outputs:
        raise InputError(
            f"the output has the shape {y.shape}; it must be ({rows}, {settings.n_outputs}), time on axis 0."
        )
    if len(y) != rows:
        what = "few" if len(y) < rows else "many"
        raise InputError(
            f"the output has too {what} samples: {len(y)} where the input has {rows}; record one row per input "
            "row (the file may be cut off, or the rig started early)."
        )


def check_sizes(y: Array, u: Array) -> None:
    """Raise if powers of an output's size, or of its ratio to the input, are no numbers: usable y (rows, ny), u (rows, nu)."""
    sizes = [float(np.abs(x).max()) for x in (y, u)]
    check_size("the size of the outputs", sizes[0], CUBES)
    check_size(
        "the size of the outputs over that of the inputs", sizes[0] / sizes[1] if sizes[1] else 0.0, CUBES
    )


def check_reference(u: Array, asked: Array, before: list[Array], settings: Settings) -> None:
    """Raise if the inputs recorded beside the outputs are not those that were asked for, and say what they
    are: u (rows, nu), asked (rows, nu)."""
    close = lambda a, b: _distance(a, b, settings) <= settings.reference_tolerance
    if not np.isfinite(u).all():
        raise InputError("the recorded input has samples that are not finite; record it again.")
    if close(u, asked):
        return
    names = settings.inputs
    for order in list(permutations(range(len(names))))[1:]:
        if close(u[:, order], asked):
            swap = ", ".join(
                f"{names[k]} got the signal of {names[j]}" for j, k in enumerate(order) if k != j
            )
            raise InputError(f"the input channels are swapped: {swap}; correct the wiring and measure again.")
    for k, other in enumerate(before, start=1):
        if other.shape == u.shape and close(u, other):
            raise InputError(
                f"the recorded input is that of step {k}, and step {len(before) + 1} is waited for; give the file of "
                "this step."
            )
    level = np.asarray(settings.level)
    if close(2 * level - u, asked):
        raise InputError("the recorded input has the opposite sign; correct the wiring and measure again.")
    for shift in range(1, min(20, len(u) // 4)):
        if _distance(u[shift:], asked[:-shift], settings) <= settings.reference_tolerance:
            raise InputError(
                f"the recorded input lags the one asked for by {shift} samples; align the recording."
            )
    j = int(np.argmax(np.sum((u - asked) ** 2, axis=0)))
    raise InputError(
        f"the recorded input is not the one asked for: it deviates by {100 * _distance(u, asked, settings):.3g} % "
        f"(allowed {100 * settings.reference_tolerance:.3g} %), most in {names[j]}; this is another step's file, or "
        "the actuator did not follow."
    )


def _distance(u: Array, asked: Array, settings: Settings) -> float:
    """Largest relative deviation of a channel, relative to the whole input where the channel is silent."""
    level = np.asarray(settings.level)
    size = np.sqrt(np.sum((asked - level) ** 2, axis=0))
    size = np.where(size > 0, size, np.sqrt(np.sum(size**2)))
    error = np.sqrt(np.sum((u - asked) ** 2, axis=0))
    return float(np.max(error / np.maximum(size, 1e-300)))


def usable(signal: Array) -> NDArray[np.bool_]:
    """Which samples are numbers of which fourth powers are formed, as those of gains are."""
    return np.abs(signal) <= largest(CUBES)


def faults(y: Array, u: Array, settings: Settings, *, silent: bool = False) -> str:
    """What makes a measurement unfit for use, empty where nothing does: y (rows, ny), u (rows, nu)."""
    for i, name in enumerate(settings.outputs):
        signal = y[:, i]
        bad = ~usable(signal)
        if bad.any():
            return f"{int(bad.sum())} samples of {name} are missing, not finite or beyond {largest(CUBES):g}, the first at {int(np.argmax(bad))}"
        if settings.abort is not None and np.abs(signal).max() > settings.abort[i]:
            t = int(np.argmax(np.abs(signal) > settings.abort[i]))
            return f"{name} went beyond its abort level {settings.abort[i]:g} ({signal[t]:.6g} at sample {t})"
        if settings.sensor_range is not None:
            low, high = settings.sensor_range[i]
            at = (signal <= low) | (signal >= high)
            if at.any():
                return f"{name} is saturated in {int(at.sum())} samples, the first at {int(np.argmax(at))} (range {low:g} to {high:g})"
        else:
            flat = _flat_top(signal)
            if flat:
                return f"{name} is at its extreme {flat[0]:.6g} in {flat[1]} samples: it looks saturated"
        held = _held(signal, u)
        if held:
            return f"{name} repeats the value {held[0]:.6g} for {held[1]} samples from sample {held[2]}: samples look lost"
    constant = len(y) > 2 and not np.ptp(y, axis=0).any() and bool(np.ptp(u, axis=0).any())
    if constant and (np.abs(y).max() > 0 or not silent):
        return f"the outputs are constant ({y[0].tolist()}) while the input varies; check the sensor and the wiring"
    return ""


def _runs(signal: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where runs of equal values begin, and how long they are."""
    starts = np.flatnonzero(np.concatenate(([True], np.diff(signal) != 0)))
    return starts, np.diff(np.concatenate((starts, [len(signal)])))


def _continuous(signal: Array) -> bool:
    """Whether values hardly ever repeat: in a quantised signal a run means nothing."""
    return len(np.unique(signal)) > 0.5 * len(signal)


def _flat_top(signal: Array) -> tuple[float, int] | None:
    """An extreme that is reached again and again to the last digit: no signal with noise does that."""
    starts, lengths = _runs(signal)
    for extreme in (signal.max(), signal.min()):
        runs = lengths[signal[starts] == extreme]
        if runs.max() >= 2 and runs.sum() >= 3 and extreme != 0 and _continuous(signal[signal != extreme]):
            return float(extreme), int(runs.sum())
    return None


def _held(signal: Array, u: Array) -> tuple[float, int, int] | None:
    if not _continuous(signal):
        return None
    starts, lengths = _runs(signal)
    for start, length in zip(starts, lengths, strict=True):
        moving = np.diff(u[max(start - 1, 0) : start + length], axis=0).any()
        if length >= HELD and signal[start] != 0 and moving:
            return float(signal[start]), int(length), int(start)
    return None
