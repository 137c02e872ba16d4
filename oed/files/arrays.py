"""Arrays by name, as npz and MAT files hold them: (N,) or (N, channels), split into columns."""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.data import Record
from oed.errors import InputError
from oed.files.limits import check_limit
from oed.files.tables import CLOCK, Table, numbers, says_step, seconds_per, stated_step

TEXTS = ("input_names", "input_units", "output_names", "output_units")


def table_of_arrays(shapes: Mapping[str, tuple[int, ...]], get: Callable[[str], Any], source: str) -> Table:
    """Table of named arrays; one that is not a vector gives the columns name1, name2, ..., time on axis 0. A
    vector is one channel whichever way it lies (MATLAB's 1 x N and N x 1), except in the files that
    `write_record` wrote. Numbers on their own are not columns; of these `dt` (or `Ts`, or the rate `fs`) and `t0` are used."""
    own = "input_names" in shapes and "output_names" in shapes and "u" in shapes and "y" in shapes
    place: dict[str, tuple[str, int | None]] = {}
    for name, shape in shapes.items():
        if name.lower() in ("u", "y") and len(shape) > 2 and sorted(shape)[-2] > 1:
            raise InputError(
                f"the array {name} of {source} has {len(shape)} axes; a signal is (N,) or (N, channels) with time on axis 0: "
                "save one experiment in each file."
            )
        if own and name not in ("u", "y"):
            continue
        vector = len(shape) <= 1 or (not own and sorted(shape)[:-1] == [1] * (len(shape) - 1))
        if int(np.prod(shape, dtype=np.int64)) <= 1 and not (own or name[:1].lower() in "uy"):
            continue
        if vector or shape[1:] == (1,):
            place[name] = (name, None)
        elif len(shape) == 2:
            place |= {f"{name}{k + 1}": (name, k) for k in range(shape[1])}
    channels: dict[str, dict[str, str]] = {"names": {}, "units": {}}
    marked = {}
    if own:
        marked = {side: tuple(c for c in place if place[c][0] == side) for side in ("u", "y")}
        for what, by_column in channels.items():
            for side, letter in (("input", "u"), ("output", "y")):
                if f"{side}_{what}" in shapes:
                    by_column |= dict(zip(marked[letter], texts(get(f"{side}_{what}"))))

    def load(wanted: Sequence[str]) -> list[NDArray[np.float64]]:
        whole = {name: np.asarray(get(name)) for name in dict.fromkeys(place[c][0] for c in wanted)}
        columns = []
        for column in wanted:
            name, k = place[column]
            values = whole[name].ravel() if k is None else whole[name][:, k]
            columns.append(numbers(values, column, source))
        return columns

    single = [name for name, shape in shapes.items() if _single(shape)]
    step = stated_step({name: get(name) for name in single if says_step(name)}, source)
    times = lambda name: says_step(name) or seconds_per(name) or (own and CLOCK.search(name))
    unread = [name for name in shapes if name not in place and step is None and times(name)]
    start = scalar(get("t0"), "t0", source) if "t0" in shapes and _single(shapes["t0"]) else None
    return Table(
        source, tuple(place), load, units=channels["units"], inputs=marked.get("u", ()),
        outputs=marked.get("y", ()), labels=channels["names"], dt=step, t0=start, unread=tuple(unread),
    )  # fmt: skip


def _single(shape: tuple[int, ...]) -> bool:
    return int(np.prod(shape, dtype=np.int64)) == 1


def scalar(value: Any, name: str, source: str) -> float:
    """The one number in an array."""
    return float(numbers(np.ravel(value), name, source)[0])


def texts(value: Any) -> list[str]:
    """The strings in an array of strings, a cell array, or a list of either."""
    if isinstance(value, str):
        return [value]
    array = np.asarray(value)
    if array.dtype.kind == "U" and array.ndim <= 2:
        return [str(entry) for entry in array.ravel()]
    if array.dtype.kind == "O":
        return ["".join(texts(entry)) for entry in array.ravel()]
    return [""] if array.size == 0 else [str(entry) for entry in array.ravel()]


def npz_table(content: bytes, source: str) -> Table:
    """Table of an npz file; what is pickled in it is refused."""
    if not content.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        raise InputError(f"{source} is not an npz file (a zip archive of arrays); write it with numpy.savez.")
    try:
        archive = np.load(io.BytesIO(content), allow_pickle=False)
        check_limit("columns", len(archive.files), source)
        if len(set(archive.files)) < len(archive.files):
            raise ValueError("it has two arrays of one name")
        check_limit("bytes", sum(entry.file_size for entry in archive.zip.infolist()), source)
        arrays = {name: _member(archive, name, source) for name in archive.files}
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds on damaged files
        raise InputError(
            f"{source} is not a whole npz file ({first_line(error)}); write it again with numpy.savez."
        ) from None
    return table_of_arrays({name: array.shape for name, array in arrays.items()}, arrays.__getitem__, source)


def first_line(error: Exception) -> str:
    """First line of an exception's message, its kind where it has none."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def _member(archive: Any, name: str, source: str) -> NDArray:
    try:
        array = archive[name]
    except ValueError as error:
        if "pickle" not in str(error):
            raise
        raise InputError(
            f"the array {name} of {source} holds Python objects; they are never unpickled, since that can run "
            "anything: save arrays of numbers."
        ) from None
    if not isinstance(array, np.ndarray):
        raise InputError(f"the entry {name} of {source} is not an array; write the file with numpy.savez.")
    return array


def arrays_of(record: Record) -> dict[str, Any]:
    """A record as arrays by name, the form of npz and MAT files."""
    return {
        **{name: np.asarray(getattr(record, name)) for name in ("u", "y", "dt", "t0")},
        **{name: np.array(getattr(record, name), dtype=str) for name in TEXTS},
    }


def npz_bytes(record: Record) -> bytes:
    """A record as an npz file."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays_of(record))
    return stream.getvalue()
