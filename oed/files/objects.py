"""Records from and to pandas, xarray and python-control objects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oed.data import Record
from oed.errors import InputError
from oed.files.clock import sampling_time
from oed.files.tables import (
    Table,
    columns_of,
    numbers,
    record_of,
    says_step,
    seconds_per,
    stated_step,
)

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def from_pandas(frame: pd.DataFrame, **options: Any) -> Record:
    """Record of a DataFrame, one row per sample; the times are a column or the index called t or time, or an index of dates.

    Parameters
    ----------
    frame : DataFrame
        Columns as in `oed.files.read_record`.
    **options : object
        As for `oed.files.read_record`: inputs, outputs, dt, missing, notes.

    Returns
    -------
    Record
        A copy of the samples.

    Raises
    ------
    InputError
        If the columns, samples or times cannot be used.
    """
    import pandas as pd

    source = "the DataFrame"
    names = [str(name) for name in frame.columns]
    extra: dict[str, NDArray] = {}
    index = frame.index.to_timestamp() if isinstance(frame.index, pd.PeriodIndex) else frame.index
    if isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex):
        zoned = isinstance(index, pd.DatetimeIndex) and index.tz is not None
        # to UTC: clocks change, time does not
        extra["t"] = (index.tz_convert(None) if zoned else index).to_numpy()
    elif seconds_per(str(frame.index.name)):
        extra[str(frame.index.name)] = frame.index.to_numpy()
    elif not any(map(seconds_per, names)) and (dates := _dates(frame)):
        names[dates[0]] = "t"
    elif options.get("dt") is None and not any(map(seconds_per, names)) and _may_be_times(index.to_numpy()):
        first = ", ".join(
            f"{value:g}" if isinstance(value, float) else f"{value!r:.40}" for value in index[:2]
        )
        raise InputError(
            f"the index of {source} holds {first}, ... under no name that says what they are; call it t "
            "(frame.index.name = 't') if these are seconds, make dates of text (pandas.to_datetime), else give dt, or leave "
            "them out by reset_index(drop=True)."
        )
    extra = {name: values for name, values in extra.items() if name not in names}

    def load(wanted: Sequence[str]) -> list[NDArray[np.float64]]:
        return [
            numbers(extra[n] if n in extra else _values(frame.iloc[:, names.index(n)]), n, source)
            for n in wanted
        ]

    table = Table(source, (*names, *extra), load, dt=_stated(frame.attrs, source))
    return record_of(table, **options)


def _stated(attrs: Mapping[Any, Any], source: str) -> float | None:
    """The sampling time among the attributes of an object."""
    said = {str(name): value for name, value in attrs.items() if says_step(str(name)) and value is not None}
    return stated_step(said, f"the attributes of {source}")


def _dates(frame: pd.DataFrame) -> list[int]:
    """Where the columns of dates stand; the first is the clock, whatever it is called."""
    return [k for k, kind in enumerate(frame.dtypes) if kind.kind == "M"]


def _may_be_times(index: NDArray) -> bool:
    """Whether an index (N,) is no numbering of rows: it has fractions, or is text, or several things at once."""
    return bool(index.dtype.kind not in "iub" and (index.dtype.kind != "f" or np.any(index % 1)))


def _values(column: pd.Series) -> NDArray:
    """A column as an array; pandas' own mark of a missing number becomes NaN."""
    import pandas as pd

    if isinstance(column.dtype, pd.DatetimeTZDtype):
        column = column.dt.tz_convert(None)
    if pd.api.types.is_numeric_dtype(column.dtype) and column.dtype.kind in "biuf":
        return column.to_numpy(dtype=float, na_value=np.nan)
    return column.to_numpy(dtype=object, na_value=None) if column.isna().any() else column.to_numpy()


def to_pandas(record: Record) -> pd.DataFrame:
    """DataFrame of a record: the index t in seconds, one column per channel called name or name_unit.

    Parameters
    ----------
    record : Record
        What is converted.

    Returns
    -------
    DataFrame
        (N, nu + ny), inputs first.
    """
    import pandas as pd

    index = pd.Index(record.t, name="t")
    return pd.DataFrame(np.hstack([record.u, record.y]), index=index, columns=columns_of(record))


def from_xarray(dataset: xr.Dataset, **options: Any) -> Record:
    """Record of a Dataset whose variables have time as their only dimension, one variable per channel.

    Parameters
    ----------
    dataset : Dataset
        The attributes `units` of the variables and, where it has them, `role` (input or output) are used, and
        the coordinate t or time, otherwise that of the dimension.
    **options : object
        As for `oed.files.read_record`: inputs, outputs (by default by role), dt, missing, notes.

    Returns
    -------
    Record
        A copy of the samples.

    Raises
    ------
    InputError
        If the variables, samples or times cannot be used.
    """
    source = "the Dataset"
    wide = [str(name) for name, v in dataset.data_vars.items() if v.ndim > 1]
    columns = {str(name): v for name, v in dataset.variables.items() if v.ndim == 1}
    if wide and not any(str(name) in columns for name in dataset.data_vars):
        raise InputError(
            f"the variables {', '.join(wide)} of {source} have more than one dimension; give one variable per channel, "
            "with time as its only dimension."
        )

    dates = [name for name, v in columns.items() if v.dtype.kind == "M"]
    for axis in [*dates, *sorted({str(v.dims[0]) for v in columns.values()} & set(columns))]:
        if not any(map(seconds_per, columns)):  # xarray's own way to say what the samples lie along
            columns["t"] = columns.pop(axis)

    def load(wanted: Sequence[str]) -> list[NDArray[np.float64]]:
        return [numbers(columns[name].values, name, source) for name in wanted]

    roles = {name: v.attrs.get("role") for name, v in columns.items()}
    start = dataset.attrs.get("t0")
    table = Table(
        source,
        tuple(columns),
        load,
        units={name: str(v.attrs["units"]) for name, v in columns.items() if "units" in v.attrs},
        inputs=tuple(name for name, role in roles.items() if role == "input"),
        outputs=tuple(name for name, role in roles.items() if role == "output"),
        dt=_stated(dataset.attrs, source),
        t0=None if start is None else float(start),
    )
    return record_of(table, **options)


def to_xarray(record: Record) -> xr.Dataset:
    """Dataset of a record: one variable per channel along t, with the attributes units and role.

    Parameters
    ----------
    record : Record
        What is converted; the names of its channels must differ.

    Returns
    -------
    Dataset
        With the attributes dt and t0 in seconds.
    """
    import xarray as xr

    names = [*record.input_names, *record.output_names]
    if len({*names, "t"}) <= len(names):
        raise InputError(
            f"the channels are called {', '.join(names)}; a Dataset needs different names, none of them t."
        )
    roles = ["input"] * record.n_inputs + ["output"] * record.n_outputs
    signals = np.hstack([record.u, record.y])
    units = [*record.input_units, *record.output_units]
    return xr.Dataset(
        {n: ("t", signals[:, k], {"units": units[k], "role": roles[k]}) for k, n in enumerate(names)},
        coords={"t": ("t", record.t, {"units": "s"})},
        attrs={"dt": record.dt, "t0": record.t0},
    )


def from_control(response: Any, *, trace: int | None = None, missing: bool = False) -> Record:
    """Record of a python-control TimeResponseData.

    Parameters
    ----------
    response : control.TimeResponseData
        With inputs; its raw arrays `u` and `y` are used, whose axes do not depend on squeezing.
    trace : int, optional
        Which trace of a response with several (a step response of a system with several inputs has one per input).
    missing : bool
        Whether NaN is allowed, as the mark of a missing sample.

    Returns
    -------
    Record
        With the labels of the response as names.

    Raises
    ------
    InputError
        If the response has no input, several traces and none is chosen, or times that are not uniform.
    """
    if response.u is None:
        raise InputError(
            "the time response has no input; give TimeResponseData(..., inputs=u) the input applied."
        )
    traces = response.ntraces
    if trace is None and traces > 1:
        raise InputError(
            f"the time response has {traces} traces; choose one with trace=0, ..., {traces - 1}."
        )
    if trace is not None and not 0 <= trace < max(traces, 1):
        raise InputError(
            f"trace {trace} is not in the time response, which has {max(traces, 1)}; they count from 0."
        )
    u, y = np.asarray(response.u), np.asarray(response.y)
    if traces:  # (channels, traces, N), the channels left out where there is one
        u = u.reshape(response.ninputs, traces, -1)[:, trace or 0]
        y = y.reshape(response.noutputs, traces, -1)[:, trace or 0]
    t = np.asarray(response.t, dtype=float)
    source = "the time of the response"
    loaded = {f"u{k}": row for k, row in enumerate(u)} | {f"y{k}": row for k, row in enumerate(y)}
    labels = [*(response.input_labels or []), *(response.output_labels or [])]
    if len(labels) != len(loaded):
        labels = [*Record(u.T, y.T).input_names, *Record(u.T, y.T).output_names]
    table = Table(
        "the time response",
        tuple(loaded),
        lambda wanted: [numbers(loaded[name], name, "the time response") for name in wanted],
        units=dict.fromkeys(loaded, ""),
        labels=dict(zip(loaded, map(str, labels))),
        dt=sampling_time(t, source)[0] if len(t) > 1 else None,
        t0=float(t[0]),
    )
    return record_of(table, missing=missing)


def to_control(record: Record) -> Any:
    """The record as a python-control TimeResponseData, signals (channels, N) as it keeps them.

    Parameters
    ----------
    record : Record
        What is converted.

    Returns
    -------
    control.TimeResponseData
        With `issiso` where there is one input and one output.
    """
    from control.timeresp import TimeResponseData

    return TimeResponseData(
        record.t, record.y.T, inputs=record.u.T, issiso=record.n_inputs == record.n_outputs == 1,
        input_labels=list(record.input_names), output_labels=list(record.output_names),
    )  # fmt: skip


def as_records(given: Any, *, missing: bool = False) -> list[Record]:
    """Records of whatever holds them: records, DataFrames, Datasets, time responses, (u, y, dt), or a sequence of these."""
    one = _record_of_object(given, missing)
    if one is not None:
        return [one]
    if _is_signal(given) or isinstance(given, str | bytes | Mapping) or not isinstance(given, Iterable):
        raise InputError(f"data are given as {type(given).__name__}; {_WANTED}.")
    records: list[Record] = []
    for item in given:
        record = _record_of_object(item, missing)
        if record is None:
            raise InputError(
                f"item {len(records)} (counting from 0) of the data is a {type(item).__name__}; {_WANTED}."
            )
        records.append(record)
    if not records:
        raise InputError(f"the sequence of data is empty; {_WANTED}.")
    return records


def _is_signal(item: Any) -> bool:
    """Whether an object is one signal: an array, a column of a DataFrame, a list of numbers."""
    if isinstance(item, list | tuple):
        return bool(item) and isinstance(item[0], int | float | np.number | str)
    return isinstance(item, np.ndarray) or ("pandas", "Series") in kinds_of(item)


def kinds_of(item: Any) -> set[tuple[str, str]]:
    """Packages and names of an object's classes: what it is, without an import of what it may be."""
    return {(c.__module__.partition(".")[0], c.__name__) for c in type(item).__mro__}


def as_record(given: Any, *, missing: bool = False) -> Record:
    """The one record of whatever holds it, as `as_records` does."""
    records = as_records(given, missing=missing)
    if len(records) > 1:
        raise InputError(f"{len(records)} records are given where one is wanted; give them one by one.")
    return records[0]


_WANTED = (
    "give a Record, a pandas DataFrame, an xarray Dataset or a control TimeResponseData, (u, y, dt), or a list of "
    "these (a file: oed.read_record)"
)


def _record_of_object(item: Any, missing: bool) -> Record | None:
    """The record of one object, told by the names of its classes: none of the libraries is imported for it."""
    if isinstance(item, Record):
        return item
    if isinstance(item, tuple) and len(item) in (2, 3) and all(map(_is_signal, item[:2])):
        return Record(item[0], item[1], dt=item[2] if len(item) == 3 else 1.0)
    kinds = kinds_of(item)
    if ("control", "FrequencyResponseData") in kinds:
        raise InputError(
            "a FrequencyResponseData is given where a record is needed; a model of it is made by estimators.pem.identify_response."
        )
    other: Any = item  # what it is, is known by name only
    if ("pandas", "DataFrame") in kinds:
        return from_pandas(other, missing=missing)
    if ("xarray", "Dataset") in kinds:
        return from_xarray(other, missing=missing)
    if ("xarray", "DataArray") in kinds:
        return from_xarray(_channels_of(other), missing=missing)
    if ("control", "TimeResponseData") in kinds:
        return from_control(item, missing=missing)
    return None


def _channels_of(array: xr.DataArray) -> xr.Dataset:
    """A DataArray as a Dataset with one variable per label of the dimension that names the channels."""
    named = [d for d in array.dims if d in array.coords and array.coords[d].dtype.kind in "UOT"]
    if array.ndim != 2 or len(named) != 1:
        raise InputError(
            f"the DataArray has the dimensions {', '.join(map(str, array.dims)) or 'none'}; give two, time and one whose labels "
            "name the channels (u..., y...), or a Dataset with one variable per channel."
        )
    return array.to_dataset(dim=named[0])
