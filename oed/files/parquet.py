"""Parquet: one column per channel and t; sampling time, names and units in the file's metadata."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oed.data import Record
from oed.errors import InputError
from oed.files.arrays import first_line
from oed.files.limits import check_limit, plain_file
from oed.files.tables import Table, numbers, seconds_per

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow import parquet

KEY = b"oed.record"


def open_parquet(source: Path | bytes) -> parquet.ParquetFile:
    """The only way here into a Parquet file: its pages carry checksums, and no thread of Arrow's is started.
    Arrow's asynchronous scanner (`read_table`, `pre_buffer`, `use_threads`) leaves a thread that may still
    free a Python buffer when the interpreter ends; that thread then asks for the GIL, and the process aborts."""
    import pyarrow as pa
    from pyarrow import parquet

    file = pa.BufferReader(source) if isinstance(source, bytes) else str(plain_file(source))
    return parquet.ParquetFile(file, pre_buffer=False, page_checksum_verification=True)


def read_columns(file: parquet.ParquetFile, columns: Sequence[str] | None = None) -> pa.Table:
    """The table of an open file, all columns or some, read by the calling thread alone."""
    names = None if columns is None else list(columns)
    return file.read(columns=names, use_threads=False, use_pandas_metadata=False)


def table_bytes(table: pa.Table) -> bytes:
    """A table as the content of a Parquet file, every page with its checksum."""
    from pyarrow import parquet

    stream = io.BytesIO()
    parquet.write_table(table, stream, write_page_checksum=True)
    return stream.getvalue()


def parquet_table(content: bytes, source: str) -> Table:
    """Table of a Parquet file."""
    import pyarrow as pa

    try:
        file = open_parquet(content)
        schema = file.schema_arrow
        check_limit("columns", len(schema.names), source)
        check_limit("bytes", 8.0 * file.metadata.num_rows * len(schema.names), source)
        _check_rows(file.metadata)
        own = json.loads((schema.metadata or {}).get(KEY, b"null"))
        marks = {} if own is None else _marks(own, schema.names)
        clock = None if any(map(seconds_per, schema.names)) else _dates(schema)
    except (pa.ArrowException, OSError, ValueError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{source} is not a whole Parquet file ({first_line(error)}); write it again."
        ) from None

    def load(wanted: Sequence[str]) -> list[NDArray[np.float64]]:
        try:
            stored = [clock if clock and name == "t" else name for name in wanted]
            return [_column(file, at, name, source) for at, name in zip(stored, wanted)]
        except (pa.ArrowException, OSError) as error:
            raise InputError(
                f"{source} cannot be read ({first_line(error)}); it is damaged: write it again."
            ) from None

    names = tuple("t" if name == clock else name for name in schema.names)
    return Table(source, names, load, **marks)


def _check_rows(metadata: parquet.FileMetaData) -> None:
    """The number of rows stands in several places of a file's end, which has no checksum; Arrow believes one of them
    and says nothing. (The columns' own numbers are left alone: on damaged ones pyarrow ends the process.)"""
    rows = sum(metadata.row_group(k).num_rows for k in range(metadata.num_row_groups))
    if rows != metadata.num_rows:
        raise ValueError(f"its numbers of rows, {rows} and {metadata.num_rows}, contradict each other")


def _dates(schema: pa.Schema) -> str | None:
    """The first column of dates: the clock, whatever it is called (pandas calls its index `__index_level_0__`)."""
    import pyarrow as pa

    return next((field.name for field in schema if pa.types.is_timestamp(field.type)), None)


def _marks(own: Any, names: list[str]) -> dict[str, Any]:
    """What `parquet_bytes` noted of the columns, where they are all still there."""
    try:
        noted = [*own["inputs"], *own["outputs"]]
        lost = [name for name in noted if name not in names]
        if lost and len(names) > len(noted):  # "t" and as many columns as were written: none was left out
            raise ValueError(f"its column {lost[0]} is there under another name")
        if lost:
            return {}
        as_kept = {
            "units": dict, "inputs": tuple, "outputs": tuple, "labels": dict, "dt": float.fromhex,
            "t0": float.fromhex,
        }  # fmt: skip
        return {name: made(own[name]) for name, made in as_kept.items()}
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"its metadata are damaged at {error}") from None


TEXTS = 100
"""Rows of text that are taken into memory at once."""


def _column(file: parquet.ParquetFile, stored: str, name: str, source: str) -> NDArray[np.float64]:
    """One column, whose type is looked at before it is read: a small file can hold gigabytes of one text or one list.
    Text, which is no number unless it is blank throughout, is read piece by piece."""
    import pyarrow as pa

    schema = file.schema_arrow
    kind = schema.field(schema.names.index(stored)).type
    blank = _values(pa.chunked_array([], type=kind), name, source)
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        pieces = file.iter_batches(TEXTS, columns=[stored], use_threads=False)
        return np.concatenate([blank, *(_values(piece.column(0), name, source) for piece in pieces)])
    return _values(read_columns(file, [stored])[stored], name, source)


def _values(column: Any, name: str, source: str) -> NDArray[np.float64]:
    import pyarrow as pa

    kind = column.type
    if pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind):
        whole = isinstance(column, pa.Array)
        return np.asarray(column.to_numpy(zero_copy_only=False) if whole else _numpy(column))
    if pa.types.is_decimal(kind):
        return numbers(_numpy(column.cast(pa.float64())), name, source)
    if seconds_per(name) == 1 and (pa.types.is_timestamp(kind) or pa.types.is_duration(kind)):
        return numbers(column.to_numpy(), name, source)
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return numbers(np.array(column.to_pylist(), dtype=object), name, source)
    raise InputError(
        f"column {name} of {source} holds values of type {kind}; samples must be real numbers: "
        "convert it or leave the column out."
    )


def _numpy(column: Any) -> NDArray[np.float64]:
    import pyarrow as pa

    return column.cast(pa.float64(), safe=False).fill_null(float("nan")).to_numpy().astype(float)


def parquet_bytes(record: Record) -> bytes:
    """A record as a Parquet file."""
    import pyarrow as pa

    channels = {}
    for side, signal in (("input", record.u), ("output", record.y)):
        names, units = getattr(record, f"{side}_names"), getattr(record, f"{side}_units")
        channels[side] = [(name, unit, signal[:, k]) for k, (name, unit) in enumerate(zip(names, units))]
    listed = [*channels["input"], *channels["output"]]
    bare = [name for name, _, _ in listed]
    unique = len({*bare, "t"}) == len(bare) + 1
    columns = bare if unique else [f"{name}_{k + 1}" for k, name in enumerate(bare)]
    n = len(channels["input"])
    own = {"dt": record.dt.hex(), "t0": float(record.t0).hex(), "inputs": columns[:n], "outputs": columns[n:]}
    own |= {"units": dict(zip(columns, (unit for _, unit, _ in listed))), "labels": dict(zip(columns, bare))}
    table = pa.table({"t": record.t, **dict(zip(columns, (np.ascontiguousarray(v) for _, _, v in listed)))})
    return table_bytes(table.replace_schema_metadata({KEY: json.dumps(own).encode()}))
