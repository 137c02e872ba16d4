"""Files that nobody meant to write: a record that a slow, strict reader gives too, or one line; never anything else.

`make test` runs a fixed thousand inputs over all tests here, `make fuzz` a hundred thousand new ones.
"""

from __future__ import annotations

import csv
import gzip
import io
import math
import struct
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oed.data import Record
from oed.errors import OedError
from oed.files import read_record, write_record
from oed.files.mat5 import read_mat5
from tests.fuzz.test_fuzz_documents import in_time, quick

RECORD = Record(np.arange(12.0).reshape(6, 2) / 7, np.arange(6.0)[:, None] ** 2 - 3, dt=0.5, t0=1.0)


def read(content: bytes, suffix: str) -> Record | str:
    """The record, or the one line that refuses it; anything else that is raised fails the test."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"x{suffix}"
        path.write_bytes(content)
        try:
            with in_time():
                return read_record(path)
        except OedError as error:
            said = str(error)
    assert 10 < len(said) < 2000
    return " ".join(said.split())  # as the command prints it: a column may be named so


# ------------------------------------------------------------------ CSV, by its structure

plain_numbers = st.floats(-1e9, 1e9, allow_nan=False).map(repr) | st.integers(-999, 999).map(str)
entries = st.one_of(
    plain_numbers, plain_numbers, plain_numbers,
    st.sampled_from(["", " ", "nan", "NA", "inf", "1,5", "1.234,5", "1_000", "0x1p3", "1e999", "\"2\"", "x", "\u0661", "-", "1 2"]),
)  # fmt: skip
names = st.sampled_from(["t", "time", "u", "y", "u1", "y_V", "y [m]", "z", "", " ", "Time (s)", '"u"', "u y"])


@st.composite
def tables(draw):
    delimiter = draw(st.sampled_from([",", ",", ";", "\t"]))
    usual = st.lists(st.sampled_from(["z", "w", "x_V"]), unique=True, max_size=2).map(
        lambda more: ["u", "y", *more]
    )
    header = draw(usual | usual | st.lists(names, min_size=2, max_size=5))
    width = len(header)
    lengths = draw(
        st.sampled_from(
            [[width] * 3, [width + 1, width, width - 1], [width, width + 2, width - 2], [width, 0]]
        )
    )
    kind = draw(st.sampled_from([plain_numbers, plain_numbers, entries]))
    rows = [draw(st.lists(kind, min_size=n, max_size=n)) for n in lengths]
    end = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    lines = [delimiter.join(row) for row in [header, *rows]]
    return (
        draw(st.sampled_from(["", "# made by hand\n", "\ufeff"]))
        + end.join(lines)
        + draw(st.sampled_from(["", end]))
    )


def strict(text: str) -> dict[str, list[float]] | None:
    """Columns by a slow reader that accepts only what cannot be meant otherwise; None where it refuses."""
    lines = [line for line in text.lstrip("\ufeff").splitlines() if line.strip() and not line.startswith("#")]
    delimiter = next((mark for mark in (",", ";", "\t") if mark in lines[0]), ",")
    parsed = [[entry.strip() for entry in row] for row in csv.reader(lines, delimiter=delimiter)]
    header, body = parsed[0], [row for row in parsed[1:] if any(row)]
    commas = delimiter != "," and not any("." in entry for row in body for entry in row)
    columns: dict[str, list[float]] = {name: [] for name in header if name}
    for row in body:
        if len(row) < len(header) or any(row[len(header) :]):
            return None
        for name, entry in zip(header, row):
            entry = entry.replace(",", ".") if commas else entry
            blank = entry.lower() in ("", "na", "n/a", "nan", "null", "none", "-nan")
            try:
                if "_" in entry:
                    raise ValueError
                value = math.nan if blank else float(entry)
            except ValueError:
                value = math.inf  # what no record may hold
            if name:
                columns[name].append(value)
    return columns


@quick
@given(tables())
def test_csv_is_what_a_strict_reader_reads(text):
    found = read(text.encode(), ".csv")
    if isinstance(found, str):
        return
    columns = strict(text)
    assert columns is not None, "the strict reader refuses it"
    for name, signal in [*zip(found.input_names, found.u.T), *zip(found.output_names, found.y.T)]:
        longer = (v for k, v in columns.items() if k.startswith((f"{name}_", f"{name} [")))
        wanted = columns[name] if name in columns else next(longer)
        assert wanted == signal.tolist()


@quick
@given(
    st.binary(max_size=80) | st.text(max_size=80).map(str.encode),
    st.sampled_from([".csv", ".mat", ".npz", ".parquet", ".csv.gz"]),
)
def test_any_bytes_under_any_name(content, suffix):
    read(content, suffix)


# ------------------------------------------------------------------ binary files: whole ones, damaged


def v73() -> bytes:
    import h5py

    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        for name, values in (("u", RECORD.u.T), ("y", RECORD.y.T), ("Ts", np.array([[0.5]]))):
            data = file.create_dataset(name, data=values)
            data.attrs["MATLAB_class"] = np.bytes_("double")
        group = file.create_group("z")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        group["OutputData"] = RECORD.y.T
    return stream.getvalue()


def v5(compressed: bool) -> bytes:
    from scipy.io import savemat

    stream = io.BytesIO()
    struct_of = {
        "InputData": RECORD.u,
        "OutputData": RECORD.y,
        "Ts": 0.5,
        "InputName": np.array(["a", "b"], dtype=object),
    }
    savemat(stream, {"z": struct_of, "n": np.int8([[1, 2]]), "c": "text"}, do_compression=compressed)
    return stream.getvalue()


class Corpus(list):
    """Files with their suffixes, shown in few words."""

    def __repr__(self) -> str:
        return f"{len(self)} files"


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    found = [
        (write_record(RECORD, folder / f"r{suffix}").read_bytes(), suffix)
        for suffix in (".mat", ".npz", ".parquet")
    ]
    return Corpus([*found, (v73(), ".mat"), (v5(True), ".mat"), (v5(False), ".mat"), (v5(False), ".mat")])


changes = st.lists(
    st.tuples(
        st.sampled_from(["flip", "byte", "word", "cut", "double", "drop"]),
        st.floats(0, 1, exclude_max=True),
        st.sampled_from([0, 1, 2, 4, 5, 7, 14, 15, 255, 2**31 - 1, 2**32 - 1, 1033, 65536, 8, 16]),
    ),
    min_size=1, max_size=4,
)  # fmt: skip


def damaged(content: bytes, how) -> bytes:
    data = bytearray(content)
    for kind, where, value in how:
        at = int(where * len(data))
        if kind == "flip":
            data[at : at + 1] = bytes([data[at] ^ (1 << value % 8)] if at < len(data) else [])
        elif kind == "byte":
            data[at : at + 1] = bytes([value & 255])
        elif kind == "word":
            at -= at % 4
            data[at : at + 4] = struct.pack("<I", value)
        elif kind == "cut":
            data = data[: max(at, 1)]
        elif kind == "double":
            data[at:at] = data[at : at + value % 64]
        else:
            del data[at : at + value % 64]
    return bytes(data)


@quick
@given(st.integers(0, 6), changes, st.booleans())
def test_damaged_files_are_one_line_or_a_record(corpus, which, how, zipped):
    content, suffix = corpus[which]
    content = damaged(content, how)
    read(gzip.compress(content, 1) if zipped else content, suffix + ".gz" * zipped)


@quick
@given(st.floats(0, 1, exclude_max=True), st.integers(0, 7))
def test_a_flipped_bit_of_a_checked_file_changes_no_sample(corpus, where, bit):
    """npz and compressed MAT files have checksums of their own, and Parquet's pages are written with them."""
    for content, suffix in corpus[:3]:
        changed = bytearray(content)
        changed[int(where * len(content))] ^= 1 << bit
        found = read(bytes(changed), suffix)
        if isinstance(found, Record):
            assert found.u.tobytes() == RECORD.u.tobytes()
            assert found.y.tobytes() == RECORD.y.tobytes()


# ------------------------------------------------------------------ MAT v5 against SciPy's reader, on whole files

kinds = st.sampled_from(["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?", "c16"])
shapes = st.lists(st.integers(0, 3), min_size=2, max_size=3).map(tuple)
arrays = st.tuples(kinds, shapes, st.integers(0, 99)).map(
    lambda a: (np.arange(math.prod(a[1])) * a[2] % 120 + 0).astype(a[0]).reshape(a[1])
)
values = st.recursive(
    arrays | st.text("abc é", min_size=1, max_size=5),
    lambda inner: (
        st.dictionaries(st.sampled_from(["a", "bb", "Ts"]), inner, min_size=1, max_size=3)
        | st.lists(inner, min_size=1, max_size=3).map(lambda v: _cells(v))
    ),
    max_leaves=6,
)


def _cells(entries: list) -> np.ndarray:
    cells = np.empty((1, len(entries)), dtype=object)
    cells[0, :] = entries
    return cells


def same(ours, theirs) -> bool:
    if isinstance(ours, dict):
        entry = theirs.ravel()[0]
        return set(ours) == set(theirs.dtype.names) and all(same(ours[k], entry[k]) for k in ours)
    if ours.dtype == object:
        return ours.shape == theirs.shape and all(map(same, ours.ravel(), theirs.ravel()))
    if ours.dtype.kind == "U":
        return ours.ravel().tolist() == theirs.ravel().tolist()
    # SciPy gives a logical array as uint8, and whole numbers that were stored smaller in their own kind
    return ours.shape == theirs.shape and bool((ours == theirs).all())


@quick
@given(
    st.dictionaries(st.sampled_from(["u", "y", "z", "name"]), values, min_size=1, max_size=3), st.booleans()
)
def test_mat5_reads_what_scipy_reads(variables, compressed):
    from scipy.io import loadmat, savemat

    stream = io.BytesIO()
    savemat(stream, variables, do_compression=compressed, long_field_names=True)
    theirs = loadmat(
        io.BytesIO(stream.getvalue()), squeeze_me=False, struct_as_record=True, chars_as_strings=True
    )
    ours = read_mat5(stream.getvalue(), "x.mat")
    assert set(ours) == {name for name in theirs if not name.startswith("__")}
    assert all(same(ours[name], theirs[name]) for name in ours)
