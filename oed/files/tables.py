"""A table of named columns, whatever file or object it came from, and the record that is made of it."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import Record, as_sampling_time, the_one
from oed.errors import InputError, near
from oed.files.clock import SECONDS, sampling_time

TIME = ("t", "t_s")
HERTZ = {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6}
STEPS = (
    "dt",
    "ts",
    "deltat",
    *(f"{a}{b}" for a in ("sample", "sampling") for b in ("time", "period", "interval")),
)
RATES = ("fs", *(f"{a}{b}" for a in ("sample", "sampling") for b in ("rate", "frequency")))
"""Names, without capitals and underscores, under which sampling times and rates are kept. Not h, T, f and period: these may be all sorts of things."""
CLOCK = re.compile(r"(?i:time|date|datum|zeit|temps|tiempo|elapsed|epoch|clock)|^(T|tid)$")
"""Names of times that do not say their unit."""
UNITS = frozenset(
    [
        "V", "mV", "uV", "kV", "A", "mA", "kA", "W", "mW", "kW", "MW", "J", "kJ", "N", "mN", "kN", "Nm", "N/m",
        "Pa", "kPa", "MPa", "bar", "mbar", "psi", "m", "mm", "cm", "um", "nm", "km", "m2", "m3", "s", "ms", "us", "ns",
        "min", "rad", "deg", "rpm", "Hz", "kHz", "MHz", "K", "degC", "degF", "°C", "kg", "mol", "L", "mL", "dB",
        "m/s", "m/s2", "m/s^2", "rad/s", "rad/s2", "rad/s^2", "deg/s", "L/min", "kg/s", "m3/s", "m^3/s", "pct",
        "percent", "%", "ppm", "ohm",
    ]
)  # fmt: skip
"""Suffixes after the last underscore of a column's name that are read as its unit."""


@dataclass(frozen=True, eq=False)
class Table:
    """Columns by name, loaded only when asked for. `source` what the table is called in messages; `names`
    names of the columns; `load` takes names, gives one float array (N,) each; `units` unit by column name,
    where the source says it; `inputs, outputs` the columns that the source itself marks as inputs and
    outputs; empty where it does not; `labels` channel name by column name, where it is not the column's name;
    `dt, t0` sampling time and time of the first sample that the source itself states; `unread` what it says of its times
    that is no column."""

    source: str
    names: tuple[str, ...]
    load: Callable[[Sequence[str]], list[NDArray[np.float64]]]
    units: Mapping[str, str] = field(default_factory=dict)
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    labels: Mapping[str, str] = field(default_factory=dict)
    dt: float | None = None
    t0: float | None = None
    unread: tuple[str, ...] = ()


ASSUMED = "1 s is assumed (--dt)"
"""What is said of a record without a clock."""


def seconds_per(column: str) -> float:
    """Seconds in a unit of a column of times: t or time, with its unit as in t_ms, `Time (s)`, `time [min]`."""
    found = re.fullmatch(r"(?:t|[Tt]ime|TIME)(?:_(\w+)| ?[\[(](\w+)[\])])?", column)
    return 0.0 if found is None else SECONDS.get(found[1] or found[2] or "s", 0.0)


def says_step(name: str) -> tuple[float, int] | None:
    """Factor and power by which what stands under a name becomes a sampling time in seconds: 1e-3 and 1 of dt_ms, 1 and -1 of Fs."""
    for bare, unit in ((name, ""), split_unit(name)):
        plain = bare.lower().replace("_", "")
        if plain in STEPS and (unit or "s") in SECONDS:
            return SECONDS[unit or "s"], 1
        if plain in RATES and (unit or "Hz") in HERTZ:
            return 1 / HERTZ[unit or "Hz"], -1
    return None


def stated_step(
    found: Mapping[str, ArrayLike], source: str, *, must: bool = True, scale: float = 1.0
) -> float | None:
    """The sampling time that arrays state by their names, numbers or the same number throughout; None where none does. One
    that varies is refused, or passed over where it need not be understood; `scale` seconds in the unit of time where a name has none."""
    steps: dict[str, float] = {}
    for name, given in found.items():
        values = numbers(np.ravel(np.asarray(given)), name, source)
        values = values[~np.isnan(values)] if values.size > 1 else values  # the first of differences
        one = the_one(values) if values.size else None
        if one is None and values.size > 1 and must:
            raise InputError(
                f"{source} has {name} from {values.min():.9g} to {values.max():.9g}, where a record has one sampling time: "
                "give it (--dt, in Python dt=), or the times as t, in seconds."
            )
        factor, power = says_step(name) or (1.0, 1)
        one = values[0] if one is None and values.size == 1 else one
        if one is not None:
            if not 0 < one < np.inf:
                said = "sampling time" if power > 0 else "sampling rate"
                raise InputError(
                    f"{source} states the {said} {one} ({name}); it must be positive, in {'seconds' if power > 0 else 'Hz'}."
                )
            steps[name] = factor * one**power * (scale if power > 0 and factor == 1 else 1.0)
    if len(steps) > 1 and the_one(np.array([*steps.values()])) is None:
        said = " and ".join(f"{step:.9g} s by {name}" for name, step in steps.items())
        raise InputError(f"{source} states several sampling times, {said}; correct one or leave it out.")
    return next(iter(steps.values()), None)


def split_unit(column: str) -> tuple[str, str]:
    """Name and unit of a column such as `vir_V` or `flow [ft^3/min]`."""
    bracket = re.fullmatch(r"(.*\S) \[(.*)\]", column)
    if bracket:
        return bracket[1], bracket[2]
    name, underscore, unit = column.rpartition("_")
    return (name, unit) if underscore and name and unit in UNITS else (column, "")


def column_name(name: str, unit: str) -> str:
    """Name of a column that `split_unit` takes apart again."""
    for column in (f"{name}_{unit}" if unit else name, f"{name} [{unit}]"):
        if split_unit(column) == (name, unit):
            return column
    raise InputError(
        f"the channel name {name!r} with the unit {unit!r} cannot be the name of a column; "
        "use names without brackets and without spaces at their ends."
    )


def columns_of(record: Record) -> list[str]:
    """The columns' names of a record's channels, inputs first."""
    names, units = (
        getattr(record, f"input_{x}") + getattr(record, f"output_{x}") for x in ("names", "units")
    )
    return list(map(column_name, names, units))


def distinct_names(table: Table) -> list[str]:
    """The names of a table's columns; refused where two have one."""
    named = [name for name in table.names if name]
    repeated = sorted({name for name in named if named.count(name) > 1})
    if repeated:
        raise InputError(
            f"{table.source} has more than one column {', '.join(map(repr, repeated))}; give each column its own name."
        )
    return named


def record_of(
    table: Table, *, inputs: Sequence[str] | str | None = None, outputs: Sequence[str] | str | None = None,
    dt: float | None = None, missing: bool = False, rows: tuple[int | None, int | None] = (None, None),
    notes: list[str] | None = None,
) -> Record:  # fmt: skip
    """Record of some columns of a table; the arguments are those of `oed.files.read_record`."""
    notes = [] if notes is None else notes
    dt = None if dt is None else as_sampling_time(dt)
    named = distinct_names(table)
    u_columns = _chosen(table, inputs, "input", "u", table.inputs)
    y_columns = _chosen(table, outputs, "output", "y", table.outputs)
    both = sorted(set(u_columns) & set(y_columns))
    if both:
        raise InputError(
            f"the columns {', '.join(both)} are asked for as inputs and as outputs; choose one for each."
        )
    clocks = [name for name in named if seconds_per(name) and name not in (*u_columns, *y_columns)]
    clocks.sort(key=lambda name: name not in TIME)
    scale = {name: seconds_per(name) for name in clocks}
    rest = [name for name in named if name not in (*u_columns, *y_columns)]
    stating = [] if clocks or table.dt is not None else [name for name in rest if says_step(name)]
    if stating:
        step = stated_step(dict(zip(stating, map(_alone(table), stating))), table.source, must=dt is None)
        table = replace(table, dt=step)
    if not clocks and dt is None and table.dt is None:
        scale = _rising(table, rest)
        clocks = list(scale)
        if not clocks:
            _check_no_clock(table, rest)
    wanted = [*u_columns, *y_columns, *clocks[:1]]
    loaded = dict(zip(wanted, table.load(wanted)))
    lengths = {name: len(values) for name, values in loaded.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise InputError(f"the columns of {table.source} have unequal lengths ({listed}); make them equal.")
    length = next(iter(lengths.values()))
    if length == 0:
        raise InputError(f"{table.source} has no rows of data; at least one is needed.")
    start, stop = _rows(rows, length, table.source)
    cut = {name: values[start:stop] for name, values in loaded.items()}
    _check_finite({name: cut[name] for name in (*u_columns, *y_columns)}, missing, table.source, start)
    times = cut[clocks[0]] * scale[clocks[0]] if clocks else None
    dt, t0 = _clock(table, times, clocks, dt, start, notes)
    unused = [
        name
        for name in rest
        if name not in (*loaded, *(stating if table.dt else ())) and not seconds_per(name)
    ]
    if unused:
        notes.append(f"columns of {table.source} that are not used: {', '.join(unused)}.")
    names = _labels(table, (*u_columns, *y_columns))
    return Record(
        np.column_stack([cut[name] for name in u_columns]),
        np.column_stack([cut[name] for name in y_columns]),
        dt=dt,
        t0=t0,
        input_names=tuple(names[name][0] for name in u_columns),
        output_names=tuple(names[name][0] for name in y_columns),
        input_units=tuple(names[name][1] for name in u_columns),
        output_units=tuple(names[name][1] for name in y_columns),
    )


EVEN = 0.01
"""Spread of a column's steps, of their mean, up to which it rises as a clock does: logged times shake less, measured ones more."""


def _alone(table: Table) -> Callable[[str], NDArray[np.float64]]:
    """One column of a table by its name."""
    return lambda name: table.load([name])[0]


def _rising(table: Table, names: Sequence[str]) -> dict[str, float]:
    """Seconds in the unit of each of some columns that are times under a name of their own, as `Zeit [s]`: in a unit of time,
    rising evenly, or however where the name says it."""
    units = {}
    for name in names:
        bracket = re.search(r"[\[(](\w+)[\])]$", name)
        unit = table.units.get(name) or (bracket[1] if bracket else split_unit(name)[1])
        units |= {name: SECONDS[unit]} if unit in SECONDS else {}
    steps = dict(zip(units, map(np.diff, table.load(list(units))))) if units else {}
    even = lambda d: len(d) > 1 and d.mean() > 0 and np.abs(d - d.mean()).max() <= EVEN * d.mean()
    rises = lambda name, d: even(d) or (CLOCK.search(split_unit(name)[0]) and len(d) > 1 and (d > 0).all())
    return {name: units[name] for name, d in steps.items() if rises(name, d)}


MOST_CLOCKS = 8
"""Columns that are looked at for times of no unit: more than a record has, and few enough to read each."""


def _check_no_clock(table: Table, names: Sequence[str]) -> None:
    """Refuse a table that says its times in a way that is not understood, rather than assume 1 s."""
    remedy = "or give the sampling time (--dt, in Python dt=)"
    for name in table.unread:
        raise InputError(
            f"{table.source} has {name}, which is not understood: call times t, in seconds, and a sampling time dt, {remedy}."
        )
    for name in [name for name in names if CLOCK.search(name)][:MOST_CLOCKS]:
        try:
            t = table.load([name])[0]
        except InputError as error:
            raise InputError(
                f"the times of {table.source} are not understood: {error} Dates are times too (pandas.to_datetime), {remedy}."
            ) from None
        if len(t) > 1 and (np.diff(t) > 0).all():
            raise InputError(
                f"{table.source} has the column {name}, which rises from {t[0]:.9g} to {t[-1]:.9g} as times do, in no unit: call it t "
                f"if these are seconds, write the unit into its name, as {name} [ms], {remedy}."
            )


def _chosen(
    table: Table, asked: Sequence[str] | str | None, side: str, letter: str, marked: tuple[str, ...]
) -> list[str]:
    named = [name for name in table.names if name]
    if asked is None:
        found = list(marked) or [name for name in named if name.lower().startswith(letter)]
        if not found:
            raise InputError(
                f"{table.source} has no column that begins with {letter} (its columns: {', '.join(named) or 'none'}); "
                f"name the {side}s with --{side}s (in Python {side}s=[...])."
            )
        return found
    asked = [name.strip() for name in asked.split(",")] if isinstance(asked, str) else list(asked)
    if not asked:
        raise InputError(f"no {side} is named; name at least one of the columns {', '.join(named)}.")
    chosen = []
    for name in asked:
        fits = [column for column in named if column == name] or [
            column for column in named if name in (split_unit(column)[0], table.labels.get(column))
        ]
        if len(fits) != 1:
            what = "is not a column" if not fits else f"may be any of the columns {', '.join(fits)}"
            hint = "" if fits else near(name, named)
            raise InputError(
                f"the {side} {name!r} {what} of {table.source}{hint}; its columns are {', '.join(named)}."
            )
        if fits[0] in chosen:
            raise InputError(f"the {side} {name!r} is named twice; name each column once.")
        chosen.append(fits[0])
    return chosen


def _rows(rows: tuple[int | None, int | None], length: int, source: str) -> tuple[int, int]:
    start = 0 if rows[0] is None else rows[0]
    stop = length if rows[1] is None else rows[1]
    if not 0 <= start < stop <= length:
        asked = f"[{'' if rows[0] is None else start}:{'' if rows[1] is None else stop}]"
        raise InputError(
            f"the rows {asked} are not in {source}, which has {length} rows; [a:b] takes rows a to b-1 "
            f"with 0 <= a < b <= {length}."
        )
    return start, stop


def _check_finite(columns: dict[str, NDArray], missing: bool, source: str, start: int) -> None:
    bad = {name: np.flatnonzero(np.isinf(v) if missing else ~np.isfinite(v)) for name, v in columns.items()}
    total = sum(map(len, bad.values()))
    if total:
        row, name = min((where[0], name) for name, where in bad.items() if len(where))
        remedy = (
            "mark missing samples by NaN"
            if missing
            else "fill the gaps, or say that NaN marks missing samples (--missing, in Python missing=True)"
        )
        raise InputError(
            f"{source} has {total} samples that are not finite, the first {columns[name][row]} in row {row + start} "
            f"(counting from 0), column {name}; samples must be finite: {remedy}."
        )


def _clock(
    table: Table, t: NDArray | None, clocks: list[str], dt: float | None, start: int, notes: list[str]
) -> tuple[float, float]:
    """Sampling time and time of the first row, from what is given, what the source states and the column of times."""
    stated, tolerance, t0 = table.dt, 0.0, table.t0
    where = f"the sampling time that {table.source} states"
    # the column rules: rows may have been taken away
    if t is not None and not _follows(t, stated, t0, start):
        t0 = float(t[0])
        if len(t) > 1:
            where = f"the column {clocks[0]} of {table.source}"
            step, tolerance = sampling_time(t, where, first_row=start)
            if stated is not None and table.t0 is None and abs(step - stated) > max(tolerance, 1e-6 * step):
                raise InputError(
                    f"{table.source} states the sampling time {stated:.9g} s, but {where} gives {step:.9g} s; "
                    "they must agree: correct the one or leave it out."
                )
            stated = step
    elif t0 is not None:
        t0 += start * stated if start and stated else 0.0
    if len(clocks) > 1:
        notes.append(
            f"{table.source} has the columns {' and '.join(clocks)}; the times are those of {clocks[0]}."
        )
    if dt is not None and stated is not None and abs(dt - stated) > max(tolerance, 1e-6 * stated):
        raise InputError(
            f"the sampling time given is {dt:.9g} s, but {where} gives {stated:.9g} s; they must agree: "
            "leave one of them out or correct it."
        )
    step = dt if dt is not None else stated
    if step is None:
        step = 1.0
        notes.append(f"{table.source} has no column t or time and no sampling time is given: {ASSUMED}.")
    return step, start * step if t0 is None else t0


def _follows(t: NDArray, dt: float | None, t0: float | None, start: int) -> bool:
    """Whether times are those that the source states, bit for bit."""
    if dt is None or t0 is None:
        return False
    return bool((t0 + dt * np.arange(start, start + len(t)) == t).all())


def _labels(table: Table, columns: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Channel name and unit of each column; a name that two columns would share keeps its unit in it."""
    split = {
        c: (table.labels.get(c, c), table.units[c]) if c in table.units else split_unit(c) for c in columns
    }
    bare = [name for name, _ in split.values()]
    return {
        c: (name if c in table.labels or bare.count(name) == 1 else c, unit)
        for c, (name, unit) in split.items()
    }


def numbers(values: ArrayLike, name: str, source: str) -> NDArray[np.float64]:
    """Values of a column as float64, refused where they are not real numbers: values (N,) -> (N,)."""
    array = np.asarray(values)
    if array.dtype.kind in "biuf":
        return array.astype(float)
    if array.dtype.kind in "mM" and seconds_per(name) == 1:  # seconds; dates count from the first
        since = array - array[:1] if array.dtype.kind == "M" else array
        return since / np.timedelta64(1, "s")
    if array.dtype.kind == "O":
        for row, value in enumerate(array.ravel()):
            if not (value is None or isinstance(value, int | float | np.integer | np.floating)):
                raise InputError(
                    f"column {name} of {source} holds {value!r:.80} in row {row} (counting from 0); "
                    "samples must be real numbers: correct the entry (numbers as text: pandas.to_numeric; a cell with an experiment in each: one file each) or leave the column out."
                )
        return np.array([np.nan if value is None else float(value) for value in array.ravel()])
    raise InputError(
        f"column {name} of {source} holds {array.dtype} values; samples must be real numbers: "
        "convert it or leave the column out."
    )
