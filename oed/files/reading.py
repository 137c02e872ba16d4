"""Reading a record from a file, by its suffix."""

import gzip
import io
import os
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from oed.data import Record
from oed.errors import InputError, OedError
from oed.files.arrays import npz_table
from oed.files.csv import csv_table
from oed.files.limits import check_limit, file_content
from oed.files.mat import mat_table
from oed.files.parquet import parquet_table
from oed.files.tables import Table, record_of
from oed.lazily import MissingExtra

READERS: dict[str, Callable[[bytes, str], Table]] = dict.fromkeys((".csv", ".txt", ".tsv"), csv_table)
READERS |= {".mat": mat_table, ".npz": npz_table, ".parquet": parquet_table}


def read_record(
    spec: str | os.PathLike[str],
    *,
    inputs: Sequence[str] | str | None = None,
    outputs: Sequence[str] | str | None = None,
    dt: float | None = None,
    missing: bool = False,
    notes: list[str] | None = None,
) -> Record:
    """Record in a CSV, MAT, Parquet or npz file, gzipped or not.

    Parameters
    ----------
    spec : str or path
        The file, `FILE[a:b]` for its rows a to b-1, counted from 0 (also `FILE[a:]` and `FILE[:b]`).
    inputs, outputs : sequence of str or str, optional
        Names of the columns, with or without their units, or one string with commas between them; by default
        what the file marks as such, otherwise the columns that begin with u and with y.
    dt : float, optional
        Sampling time in seconds; by default the file's own, from the column `t` or `t_s`, a sampling time (`dt`, `Ts`) or a
        rate (`fs`) that it states, otherwise 1 with a note. Times in no unit and steps that vary are refused.
    missing : bool
        Whether NaN is allowed, as the mark of a missing sample.
    notes : list of str, optional
        Sentences on what was assumed or left out are appended to it.

    Returns
    -------
    Record
        Its names and units are those of the columns: `vir_V` is the channel vir in V.

    Raises
    ------
    InputError
        If the file, its columns, its samples or its times cannot be used; the message says where.
    """
    path, rows = _split_spec(spec)
    return record_of(
        read_table(path), inputs=inputs, outputs=outputs, dt=dt, missing=missing, rows=rows, notes=notes
    )


def _split_spec(spec: str | os.PathLike[str]) -> tuple[Path, tuple[int | None, int | None]]:
    if not isinstance(spec, str | os.PathLike):
        raise InputError(f"a file is given as {type(spec).__name__}; give its name as text or as a Path.")
    text = str(spec)
    if os.path.exists(text):
        return Path(text), (None, None)
    if re.fullmatch(r"\[?\s*-?\d*\s*:\s*-?\d*\s*\]?", text):
        raise InputError(
            f'{text} names rows of no file; write them behind its name, together in quotes: "record.csv[0:500]".'
        )
    if not text.rstrip().endswith("]") and "[" not in text.rpartition("]")[2]:
        return Path(text), (None, None)
    parts = re.fullmatch(r"(.*?)\s*\[\s*(-?\d*)\s*:\s*(-?\d*)\s*\]\s*", text)
    if not parts:
        raise InputError(f"the rows of {text!r} are not understood; write FILE[a:b], FILE[a:] or FILE[:b].")
    start, stop = (int(part) if part not in ("", "-") else None for part in parts.groups()[1:])
    return Path(parts[1]), (start, stop)


def read_table(path: Path) -> Table:
    """The columns of a file, whatever they are: for those who know by themselves which they want.

    Parameters
    ----------
    path : Path
        A CSV, MAT, Parquet or npz file, gzipped or not.

    Returns
    -------
    Table
        Its columns, parsed when they are loaded.

    Raises
    ------
    InputError
        If the file cannot be read or is none of these.
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    zipped = suffixes[-1:] == [".gz"]
    suffix = "".join(suffixes[-2:-1] if zipped else suffixes[-1:])
    content = _content(path) if suffix in READERS or not path.is_file() else b""
    if suffix not in READERS:
        raise InputError(
            f"{path.name!r} has the suffix {(suffix or 'none')!r}; files are read by suffix: "
            f"{', '.join(READERS)}, each also with .gz: save the record as one of these, CSV for example."
        )
    if content[:2] == b"\x1f\x8b":
        content = _unzipped(content, path.name)
    elif zipped:
        raise InputError(f"{path.name} is not gzipped although its suffix says so; rename it without .gz.")
    if not content:
        raise InputError(f"{path.name} is empty (0 bytes); it may not have been written to the end.")
    table = _understood(path.name, lambda: READERS[suffix](content, path.name))
    load = table.load
    return replace(table, load=lambda wanted: _understood(path.name, lambda: load(wanted)))


def _understood(name: str, read: Callable[[], Any]) -> Any:
    """What a reader returns; a file that it was not made for is one line, whatever the parsers below it raise."""
    try:
        return read()
    except OedError:
        raise
    except MissingExtra as error:
        raise InputError(f"{name} cannot be read here: {error}.") from None
    except MemoryError:
        raise InputError(
            f"{name} needs more memory than there is; read fewer of its columns or rows."
        ) from None
    except Exception as error:
        words = " ".join(str(error).split())[:200]
        raise InputError(
            f"{name} is not understood ({type(error).__name__}: {words}); it is damaged, or of a kind that is not read: "
            "save it again, as CSV for example."
        ) from None


def _content(path: Path) -> bytes:
    try:
        return file_content(path)
    except FileNotFoundError:
        raise InputError(f"the file {str(path)!r} does not exist; check the name and the folder.") from None
    except IsADirectoryError:
        raise InputError(f"{str(path)!r} is a folder; give a file.") from None
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"the file {str(path)[:80]!r} cannot be read: {getattr(error, 'strerror', '') or error}."
        ) from None


def _unzipped(content: bytes, name: str) -> bytes:
    try:
        most = check_limit("bytes", 0, name)
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
            whole = file.read(int(most) + 1)
        check_limit("bytes", len(whole), name)
        return whole
    except (EOFError, zlib.error, OSError) as error:
        raise InputError(
            f"{name} cannot be decompressed ({error}); it is cut off or damaged: fetch or write it again."
        ) from None
