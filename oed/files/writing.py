"""Writing a record to a file, by its suffix: all of it or nothing, and never over another file unasked."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

from oed.data import Record
from oed.errors import InputError
from oed.files.arrays import npz_bytes
from oed.files.mat import mat_bytes
from oed.files.parquet import parquet_bytes
from oed.files.text import csv_bytes

__all__ = ["write_bytes", "write_record"]

WRITERS = {".csv": csv_bytes, ".mat": mat_bytes, ".npz": npz_bytes, ".parquet": parquet_bytes}


def write_record(record: Record, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a record so that `read_record` gives it back bit for bit.

    In CSV the sampling time is that of the column t, so that the times come back bit for bit; the sampling
    time itself does too where t0 is 0 or it has few digits.

    Parameters
    ----------
    record : Record
        What is written.
    path : str or path
        Ends in .csv, .mat, .parquet or .npz, each also with .gz.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        If the suffix is unknown, the file exists or the folder does not.
    """
    path = Path(path)
    suffixes = [suffix.lower() for suffix in path.suffixes]
    zipped = suffixes[-1:] == [".gz"]
    suffix = "".join(suffixes[-2:-1] if zipped else suffixes[-1:])
    if suffix not in WRITERS:
        raise InputError(
            f"{path.name!r} has the suffix {(suffix or 'none')!r}; records are written by suffix: "
            f"{', '.join(WRITERS)}, each also with .gz."
        )
    check_writable(path, overwrite)
    content = WRITERS[suffix](record)
    return write_bytes(path, gzip.compress(content, mtime=0) if zipped else content, overwrite=overwrite)


def check_writable(path: Path, overwrite: bool) -> None:
    """Raise if a file exists or its folder does not.

    Parameters
    ----------
    path : Path
        The file to be written.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    InputError
        With the remedy.
    """
    if path.is_dir():
        raise InputError(f"{str(path)!r} is a folder; give the name of a file.")
    if path.exists() and not overwrite:
        raise InputError(
            f"the file {str(path)!r} exists and is not overwritten; give another name or remove it."
        )
    if not path.parent.is_dir():
        raise InputError(f"the folder {str(path.parent)!r} does not exist; make it first.")


def write_bytes(path: str | os.PathLike[str], content: bytes, *, overwrite: bool = False) -> Path:
    """Write a whole file or nothing: under a temporary name first, which then replaces the file at once.

    Parameters
    ----------
    path : str or path
        The file.
    content : bytes
        What it will hold.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        If the file exists, its folder does not, or the system refuses to write.
    """
    path = Path(path)
    check_writable(path, overwrite)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"the file {str(path)!r} cannot be written: {error.strerror or error}.") from None
    finally:
        temporary.unlink(missing_ok=True)
    return path
