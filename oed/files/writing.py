"""Writing a record to a file, by its suffix: all of it or nothing, and never over another file unasked."""

import contextlib
import errno
import gzip
import io
import itertools
import os
import platform
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from oed.data import Record
from oed.errors import InputError, OedError
from oed.files.arrays import npz_bytes
from oed.files.csv import csv_bytes
from oed.files.limits import own_file
from oed.files.mat import mat_bytes
from oed.files.parquet import parquet_bytes

WRITERS = {".csv": csv_bytes, ".mat": mat_bytes, ".npz": npz_bytes, ".parquet": parquet_bytes}

MESSAGES = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the disk quota is used up"}
KEPT = "What was there before is kept: make room or choose another place."
_COUNT = itertools.count()
_HERE = blake2b(platform.node().encode(), digest_size=3).hexdigest()
"""Names this machine in temporary names: of another's processes, on a shared disk, nobody here knows whether they live."""


def new_folder(path: str | os.PathLike[str], what: str = "the folder") -> Path:
    """A new or empty folder, made before any work is done for it; one line if something is there or in the way."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not any(folder.iterdir()):
            return folder
    except OSError as error:
        raise InputError(
            f"{what} {path} cannot be made ({error.strerror}); give a new folder elsewhere."
        ) from None
    raise InputError(f"{what} {path} already holds something; give a new or empty folder.")


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
        If it is no record, the suffix is unknown, the file exists or the folder does not.
    """
    if not isinstance(record, Record):
        raise InputError(
            f"a {type(record).__name__} is given where a Record is needed; make one of it: Record(u, y, dt)."
        )
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
    """Raise if a file exists or its folder does not."""
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
    return write_whole(path, content)


def in_text(words: str) -> str:
    """Words in which bytes that are no text, such as the name of a file may have, are written as JSON and a reader can have them."""
    return words.encode(errors="backslashreplace").decode()


def write_whole(
    path: Path, content: bytes | str, *, kept: str = KEPT, error: type[OedError] = InputError
) -> Path:
    """The one atomic writer: a reader sees the old file or the whole new one, also after a power cut. What
    cannot be written is raised as `error`, whose message ends with `kept`: what is safe, and the remedy. The
    temporary name is short, whatever the file's own, and ends in .tmp: what a kill left of it is removed by the
    next who writes in the folder, and by `tidy`."""
    temporary = path.with_name(f".{_HERE}-{os.getpid()}-{next(_COUNT)}.tmp")
    _sweep(path.parent)
    try:
        temporary.unlink(missing_ok=True)
        with temporary.open("xb") as file:  # never through a link that somebody laid there
            file.write(in_text(content).encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as reason:
        raise _refused(path, reason, kept, error) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    return path


def renamed(path: Path, to: Path, *, kept: str = KEPT) -> Path:
    """Give a file another name, which stays after a power cut."""
    try:
        os.rename(path, to)
        _sync_folder(to.parent)
    except OSError as reason:
        raise _refused(to, reason, kept, InputError) from None
    return to


def write_figure(path: Path, figure: Any, **options: Any) -> Path:
    """Save a matplotlib figure whole or not at all, in the format of the file's suffix."""
    stream = io.BytesIO()
    figure.savefig(stream, format=path.suffix[1:], **options)
    return write_whole(path, stream.getvalue())


def append_line(path: Path, line: str, *, kept: str = KEPT, error: type[OedError] = InputError) -> None:
    """Add a line to a file and wait until it is on the disk; a last line that a kill cut off is ended first."""
    try:
        with own_file(path).open("ab+") as stream:
            if stream.tell():
                stream.seek(-1, os.SEEK_END)
                if stream.read(1) != b"\n":
                    line = "\n" + line
            stream.write(line.encode() + b"\n")
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as reason:
        raise _refused(path, reason, kept, error) from None


def tidy(folder: Path) -> None:
    """Remove what killed processes left half written, in its folders too; only who holds the folder's lock may."""
    for file in folder.rglob(".*.tmp"):
        with contextlib.suppress(OSError):
            file.unlink(missing_ok=True)


@lru_cache(maxsize=64)
def _sweep(folder: Path) -> None:
    """Remove, once a process, what killed processes of this machine left half written in a folder."""
    for file in folder.glob(f".{_HERE}-*-*.tmp") if os.name == "posix" else ():
        with contextlib.suppress(
            OSError, ValueError, OverflowError
        ):  # gone already, not ours, or no name of ours
            try:
                os.kill(int(file.name.split("-")[1]), 0)
            except ProcessLookupError:
                file.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    # Elsewhere a folder cannot be opened, and the rename is in the file system's journal.
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _refused(path: Path, reason: OSError, kept: str, error: type[OedError]) -> OedError:
    words = MESSAGES.get(reason.errno or 0, reason.strerror or str(reason))
    return error(f"cannot write {path}: {words}. {kept}")
