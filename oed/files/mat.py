"""MAT files: v5 by our own reader, v7.3 through h5py; plain arrays, or a struct with iddata's fields.

A damaged HDF5 file can make the library loop for ever or end the process, so h5py reads in a process of its own."""

import io
import json
import math
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.data import Record
from oed.errors import InputError
from oed.files.arrays import TEXTS, arrays_of, first_line, scalar, table_of_arrays, texts
from oed.files.clock import SECONDS, sampling_time
from oed.files.limits import check_limit
from oed.files.mat5 import is_mat5, read_mat5
from oed.files.tables import CLOCK, Table, numbers, says_step, stated_step
from oed.lazily import MissingExtra

FIELDS = {
    "u": ("inputdata", "u"), "y": ("outputdata", "y"), "t0": ("tstart", "t0"), "t": ("samplinginstants", "t", "time"), "input_names": ("inputname", "input_names"),
    "output_names": ("outputname", "output_names"), "input_units": ("inputunit", "input_units"),
    "output_units": ("outputunit", "output_units"), "time_unit": ("timeunit",),
}  # fmt: skip
"""Our names, and the names of iddata's fields in lower case that stand for them."""


def mat_table(content: bytes, source: str) -> Table:
    """Table of a MAT file: its arrays, or its one struct with the fields InputData and OutputData (or u and
    y)."""
    # where HDF5 allows its signature to stand; MATLAB writes 512 bytes of text first
    hdf5 = any(content[k : k + 8] == b"\x89HDF\r\n\x1a\n" for k in (0, 512, 1024, 2048))
    reader = _read_hdf5 if hdf5 else _read_v5
    try:
        variables = reader(content, source)
    except InputError:
        raise
    except Exception as error:  # the parsers raise many kinds on damaged files
        raise InputError(
            f"{source} is not a whole MAT file ({first_line(error)}); save it again with save(..., '-v7')."
        ) from None
    structs = {name: v for name, v in variables.items() if isinstance(v, Mapping) and _has_signals(v)}
    if len(structs) > 1:
        raise InputError(f"{source} holds several records ({', '.join(structs)}); save one per file.")
    if structs:
        return _struct_table(*structs.popitem(), source)
    arrays = {name: v for name, v in variables.items() if isinstance(v, np.ndarray)}
    if not arrays:
        raise InputError(
            f"{source} holds no arrays of numbers (its variables: {', '.join(variables) or 'none'}); iddata objects "
            "cannot be read outside MATLAB: save the arrays u, y and Ts, or struct('InputData', z.u, 'OutputData', "
            "z.y, 'Ts', z.Ts)."
        )
    return table_of_arrays({name: array.shape for name, array in arrays.items()}, arrays.__getitem__, source)


def _field(struct: Mapping[str, Any], name: str) -> Any:
    by_lower = {key.lower(): value for key, value in struct.items()}
    return next((by_lower[field] for field in FIELDS[name] if field in by_lower), None)


def _has_signals(struct: Mapping[str, Any]) -> bool:
    return _field(struct, "u") is not None and _field(struct, "y") is not None


def _struct_table(name: str, struct: Mapping[str, Any], source: str) -> Table:
    source = f"the struct {name} of {source}"
    arrays: dict[str, Any] = {}
    for side in ("u", "y"):
        signal = np.asarray(_field(struct, side))
        if signal.dtype.kind == "O" and signal.size > 1:
            raise InputError(f"{source} holds {signal.size} experiments; save one per file.")
        if signal.dtype.kind == "O" and signal.size == 1:
            signal = np.asarray(signal.ravel()[0])
        signal = signal.T if signal.ndim == 2 and signal.shape[0] == 1 else signal
        arrays[side] = numbers(signal.ravel(), side, source).reshape(signal.shape)
        if signal.size == 0:
            raise InputError(
                f"{source} has no {'input' if side == 'u' else 'output'} samples; a record needs both."
            )
    for side, letter in (("input", "u"), ("output", "y")):
        n = 1 if arrays[letter].ndim == 1 else arrays[letter].shape[1]
        for what in ("names", "units"):
            value = _field(struct, f"{side}_{what}")
            entries = texts(value) if value is not None and np.size(value) else []
            default = [letter] if n == 1 else [f"{letter}{k + 1}" for k in range(n)]
            fallback = default if what == "names" else [""] * n
            arrays[f"{side}_{what}"] = np.array(entries if len(entries) == n else fallback, dtype=str)
    unit = "".join(texts(_field(struct, "time_unit"))) if _field(struct, "time_unit") is not None else ""
    if (unit or "s").lower() not in SECONDS:
        raise InputError(f"{source} has the time unit {unit!r}; known are {', '.join(SECONDS)}.")
    scale, times = SECONDS[(unit or "s").lower()], _plain(_field(struct, "t"))
    start = _plain(_field(struct, "t0"))
    if start.size == 1:
        arrays["t0"] = np.array(scalar(start, "t0", source) * scale)
    said = {name: _plain(value) for name, value in struct.items() if says_step(name)}
    step = stated_step({k: v for k, v in said.items() if v.size}, source, scale=scale, must=times.size < 2)
    arrays |= {} if step is None else {"dt": np.array(step)}
    if times.size > 1:
        arrays |= _clock(numbers(times, "t", source) * scale, len(arrays["u"]), step, source)
    elif step is None:  # what is there all the same is said to be not understood
        unread = {name: _plain(v) for name, v in struct.items() if says_step(name) or CLOCK.search(name)}
        arrays |= {name: v for name, v in unread.items() if says_step(name) or v.size == len(arrays["u"])}
        arrays |= {"t": times} if times.size else {}
    return table_of_arrays({key: array.shape for key, array in arrays.items()}, arrays.__getitem__, source)


def _clock(t: NDArray, length: int, step: float | None, source: str) -> dict[str, NDArray]:
    """Sampling time and first time of a struct's times (N,), which a sampling time stated beside them must agree with and precedes."""
    if len(t) != length:
        raise InputError(f"{source} has {len(t)} times and {length} samples; they must be equal.")
    found, tolerance = sampling_time(t, f"the clock of {source}")
    if step is None:
        return {"dt": np.array(found), "t0": t[:1]}
    if abs(found - step) > max(tolerance, 1e-6 * step):
        raise InputError(
            f"{source} states the sampling time {step:.9g} s, but its times give {found:.9g} s; they must agree."
        )
    return {}


def _plain(value: Any) -> NDArray:
    """A field as (n,), out of the cell that it may lie in; nothing is (0,)."""
    value = value[0] if isinstance(value, np.ndarray) and value.dtype.kind == "O" and value.size else value
    array = np.ravel(value if value is not None else [])
    return array[:0] if array.dtype.kind == "O" and array.size == 1 and array[0] is None else array


def _read_v5(content: bytes, source: str) -> dict[str, Any]:
    if not is_mat5(content):
        raise ValueError("it is neither of version 5 nor of version 7.3")
    return {name: value for name, value in read_mat5(content, source).items() if not name.startswith("__")}


def _read_hdf5(content: bytes, source: str) -> dict[str, Any]:
    """What `_parse_hdf5` returns or raises in a process of its own, which may hang or die of a damaged file."""
    call = "import json, sys; sys.path = json.loads(sys.argv[1]); from oed.files.mat import answer; answer(sys.argv[2])"
    command = [sys.executable, "-I", "-c", call, json.dumps(sys.path), source]
    try:
        done = subprocess.run(
            command, input=content, capture_output=True, timeout=check_limit("seconds", 0, source)
        )
    except subprocess.TimeoutExpired:
        check_limit("seconds", math.inf, source)
        raise
    if done.returncode:
        raise ValueError(f"HDF5 ended with status {done.returncode} while it read it")
    stream = io.BytesIO(done.stdout)
    kind, found = json.loads(stream.readline())
    if kind:
        raise {"InputError": InputError, "MissingExtra": MissingExtra}.get(kind, ValueError)(found)
    return _unpacked(found, stream)


def answer(source: str) -> None:
    """In the process of its own: the content comes by standard input, its variables or the error go to standard output."""
    arrays: list[Any] = []
    try:
        reply = ["", _packed(_parse_hdf5(sys.stdin.buffer.read(), source), arrays)]
    except Exception as error:
        reply = [type(error).__name__, getattr(error, "name", None) or first_line(error)]
    stream = io.BytesIO()  # NumPy asks a file where it stands, which a pipe cannot say
    stream.write(json.dumps(reply).encode() + b"\n")
    for array in arrays:
        np.save(stream, array, allow_pickle=False)
    sys.stdout.buffer.write(stream.getbuffer())


def _packed(value: Any, arrays: list[Any]) -> Any:
    """A variable as JSON knows it, its arrays of numbers and text in a list beside it."""
    if isinstance(value, dict):
        return {name: _packed(entry, arrays) for name, entry in value.items()}
    if isinstance(value, bytes | str) or value is None:
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    value = np.asarray(value)
    if value.dtype.hasobject:
        return [value.shape, *(_packed(entry, arrays) for entry in value.ravel())]
    arrays.append(value)
    return 0


def _unpacked(packed: Any, stream: io.BytesIO) -> Any:
    if isinstance(packed, dict):
        return {name: _unpacked(entry, stream) for name, entry in packed.items()}
    if packed == 0:
        return np.load(stream, allow_pickle=False)
    if isinstance(packed, list):
        cells = np.empty(packed[0], dtype=object)
        for index, entry in zip(np.ndindex(cells.shape), packed[1:]):
            cells[index] = _unpacked(entry, stream)
        return cells
    return packed


def _parse_hdf5(content: bytes, source: str) -> dict[str, Any]:
    import h5py

    with h5py.File(io.BytesIO(content), "r") as file:
        reader = _Hdf5(file, source)
        found = {str(name): reader.of(file, str(name), 0) for name in file if not str(name).startswith("#")}
        stated = {str(name): value for name, value in file.attrs.items() if says_step(str(name))}
        said = {
            name: np.asarray(value) for name, value in stated.items() if not isinstance(value, h5py.Empty)
        }
        return said | found


class _Hdf5:
    """The variables of a v7.3 file, within the limits on nodes, depth and bytes; nothing outside the file is opened."""

    def __init__(self, file: Any, source: str) -> None:
        self.file, self.source = file, source
        self.nodes, self.size = 0, 0.0

    def of(self, group: Any, name: str, depth: int) -> Any:
        """What a group holds under a name."""
        import h5py

        if isinstance(group.get(name, getlink=True), h5py.ExternalLink):
            raise InputError(
                f"{self.source} has the link {name!r} into another file, which is not followed; save the values themselves."
            )
        return self.node(group[name], depth + 1)

    def node(self, node: Any, depth: int) -> Any:
        """Axes reversed, characters as text, cells as object arrays, structs as dictionaries."""
        import h5py

        self.nodes += 1
        check_limit("columns", self.nodes, self.source)
        check_limit("depth", depth, self.source)
        kind = node.attrs.get("MATLAB_class", b"")
        kind = kind.decode() if isinstance(kind, bytes) else str(kind)
        if isinstance(node, h5py.Group):
            return {str(name): self.of(node, str(name), depth) for name in node}
        if node.attrs.get("MATLAB_empty", 0) or node.shape is None:
            return np.empty(0, dtype=str if kind == "char" else float)
        if node.external or node.is_virtual:
            raise InputError(
                f"{self.source} keeps the values of {node.name} in another file, which is not opened; save them in this one."
            )
        self.size += float(node.size or 0) * node.dtype.itemsize
        check_limit("bytes", self.size, self.source)
        if kind == "char":
            return np.array(["".join(map(chr, row)) for row in np.atleast_2d(node[()].T)], dtype=str)
        if h5py.check_ref_dtype(node.dtype) is not None:
            references = np.asarray(node[()]).T
            cells = np.empty(references.shape, dtype=object)
            for index in np.ndindex(references.shape):
                cells[index] = self.node(self.file[references[index]], depth + 1)
            return cells
        if node.attrs.get("MATLAB_object_decode", 0) or (kind not in _NUMERIC and kind):
            return None
        return np.asarray(node[()]).T


_NUMERIC = {"double", "single", "logical", *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64))}


def mat_bytes(record: Record) -> bytes:
    """A record as a MAT file of version 5, with the variables u, y, dt, t0 and the channels' names and units."""
    from scipy.io import savemat

    variables = arrays_of(record)
    variables |= {name: variables[name].astype(object)[:, None] for name in TEXTS}
    stream = io.BytesIO()
    savemat(stream, variables, do_compression=True, oned_as="column")
    return stream.getvalue()
