"""Files that are refused by name, each written by hand: those that broke the first version, other files, bombs, pipes."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import resource
import struct
from pathlib import Path

import numpy as np
import pytest

from benchmarks.campaign.plants import content_of, load_plant
from benchmarks.tables.formats import from_parquet
from estimators.diagnosis.result.model import DiagnosedModel
from estimators.sessions import open_session
from oed.data import Record
from oed.errors import CampaignError, InputError
from oed.files import read_record, writing
from oed.files.lock import locked
from oed.files.writing import append_line, write_whole
from oed.models.model import saved_model
from oed.plants.json import plant_from_json
from tests.fuzz.test_fuzz_readers import read, v5

HOSTILE = ("decimal_comma.csv", "ragged.csv", "ragged2.csv", "stopiteration.csv", "h5_index.mat", "laughs.mat", "segv.mat",
           "sigbus.mat", "sparse.mat", "meta_overflow.parquet", "meta_recursion.parquet")  # fmt: skip


@pytest.mark.skipif("OED_CASES" not in os.environ, reason="OED_CASES names no folder of cases")
@pytest.mark.parametrize("name", HOSTILE)
def test_the_files_that_broke_the_first_version(name):
    with pytest.raises(InputError, match=name.replace(".", "[.]")):
        read_record(Path(os.environ["OED_CASES"]) / "hostile" / name)


@pytest.mark.parametrize(
    "text", ["t,u,y,z\n0,1,2,3,9\n1,1,2\n2,1,2,3\n", "t;u;y;z\n0;1;2;3;9\n1;7;8\n2;1;2;3\n"]
)
def test_rows_too_long_and_too_short_do_not_cancel(text):
    assert "row 0 (counting from 0) of x.csv has 5 entries where the header has 4" in read(
        text.encode(), ".csv"
    )


def test_other_files_are_not_opened(tmp_path):
    import h5py

    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["u"] = np.arange(5.0)
    (tmp_path / "raw").write_bytes(np.arange(5.0).tobytes())
    layout = h5py.VirtualLayout(shape=(5,), dtype="f8")
    layout[:] = h5py.VirtualSource(str(secret), "u", shape=(5,))
    for kind in ("link", "storage", "virtual"):
        path = tmp_path / f"{kind}.mat"
        with h5py.File(path, "w") as file:
            file["y"] = np.arange(5.0)
            if kind == "link":
                file["u"] = h5py.ExternalLink(str(secret), "u")
            elif kind == "storage":
                file.create_dataset("u", (5,), "f8", external=[(str(tmp_path / "raw"), 0, 40)])
            else:
                file.create_virtual_dataset("u", layout)
        with pytest.raises(InputError, match="another file, which is not (followed|opened)"):
            read_record(path)


def test_a_file_in_which_hdf5_loops_for_ever_or_dies(tmp_path, monkeypatch):
    import h5py

    import oed.files.mat as module

    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        file["u"] = file["y"] = np.arange(5.0)
        file["text"] = "text"  # of variable length: it is kept in the global heap
    content = bytearray(stream.getvalue())
    heap = content.find(b"GCOL")
    content[heap + 24 : heap + 32] = bytes(
        8
    )  # the size of its first object: HDF5 2.0 never comes to the next
    path = tmp_path / "x.mat"
    path.write_bytes(content)
    with monkeypatch.context() as patch:
        patch.setenv("OED_MOST_SECONDS", "2")
        with pytest.raises(InputError, match="more than 2 seconds, and at most 2 .* set OED_MOST_SECONDS"):
            read_record(path)
        patch.setenv("OED_MOST_SECONDS", "20")
        die = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"
        run = module.subprocess.run
        patch.setattr(module.subprocess, "run", lambda command, **how: run([command[0], "-c", die], **how))
        with pytest.raises(InputError, match="x.mat is not a whole MAT file .HDF5 ended with status -11"):
            read_record(path)
    path.write_bytes(stream.getvalue())
    assert read_record(path).u.ravel().tolist() == [0, 1, 2, 3, 4]


def test_bombs_are_refused_and_the_limit_can_be_raised(tmp_path, monkeypatch):
    wide = ",".join(f"u{k}" for k in range(10_001)) + ",y\n"
    assert "asks for 10,001 columns" in read(wide.encode(), ".csv")
    zeros = gzip.compress(bytes(2**22))
    stream = io.BytesIO()
    np.savez_compressed(stream, u=np.zeros(2**19), y=np.zeros(2**19))
    deep = b"".join(struct.pack("<II", 14, 8 * (k + 1)) for k in range(3))
    assert "not a whole MAT file" in read(v5(False)[:128] + deep, ".mat")
    monkeypatch.setenv("OED_MOST_BYTES", "3000000")
    for content, suffix in ((zeros, ".csv.gz"), (stream.getvalue(), ".npz")):
        assert "bytes, and at most 3,000,000 are read; if that is meant, set OED_MOST_BYTES" in read(
            content, suffix
        )
    monkeypatch.setenv("OED_MOST_BYTES", "20000000")
    assert isinstance(read(stream.getvalue(), ".npz"), Record)
    monkeypatch.setenv("OED_MOST_COLUMNS", "20000")
    assert "asks for" not in read(wide.encode(), ".csv")
    monkeypatch.setenv("OED_MOST_BYTES", "many")
    assert "OED_MOST_BYTES is 'many'; give a whole number" in read(stream.getvalue(), ".npz")


@pytest.mark.parametrize("kind", ["text", "category", "lists"])
def test_gigabytes_of_one_text_or_list_are_not_expanded(kind):
    """Twenty gigabytes in a file of some kilobytes: a word of a million letters, or a long list, twenty thousand times."""
    import pyarrow as pa
    from pyarrow import parquet

    rows = 20_000
    value = [0.0] * 100_000 if kind == "lists" else "9" * 10**6
    of = pa.list_(pa.float64()) if kind == "lists" else pa.string()
    u = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, dtype=np.int32)), pa.array([value], type=of))
    table = pa.table({"u": pa.array([value] * 50, type=of) if kind == "lists" else u})
    table = table.append_column("y", pa.array(np.zeros(table.num_rows)))
    stream = io.BytesIO()
    parquet.write_table(table, stream, store_schema=kind == "category", compression="zstd")
    assert len(stream.getvalue()) < 100_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "samples must be real numbers" in read(stream.getvalue(), ".parquet")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 400_000  # kilobytes


@pytest.mark.parametrize(
    "name", ["x" * 300 + ".csv", "x\0.csv", "nowhere/x.csv", "", "/dev/zero.csv", "x.csv[0:3"]
)
def test_names_that_no_file_has(name):
    with pytest.raises(InputError):
        read_record(name)


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "p.csv")
    with pytest.raises(InputError, match="a device or a pipe"):
        read_record(tmp_path / "p.csv")


def test_no_document_is_waited_for_or_endless(tmp_path):
    """A plant, a session, a part or a report that is a pipe was waited for for ever; /dev/zero filled the memory."""
    os.mkfifo(tmp_path / "session.json")
    for read_one in (plant_from_json, load_plant, saved_model, DiagnosedModel.load, from_parquet, content_of):
        for path in (str(tmp_path / "session.json"), "/dev/zero"):
            with contextlib.suppress(InputError):  # a model may be something else
                assert read_one(path) is None
    with pytest.raises(InputError, match="a device or a pipe"):
        plant_from_json("/dev/zero")
    with pytest.raises(CampaignError, match="there is no session"):
        open_session(tmp_path)


def test_nothing_is_written_through_a_link(tmp_path):
    """A folder from somebody else may hold links in place of what is written there in place: to a shell's start, say."""
    precious = tmp_path / "precious"
    precious.write_text("kept")
    (tmp_path / "link").symlink_to(precious)
    with pytest.raises(InputError, match="it is a link to another file"), locked(tmp_path / "link", "it"):
        pass
    with pytest.raises(InputError, match="it is a link to another file"):
        append_line(tmp_path / "link", "x")
    assert not list(tmp_path.glob(".*"))
    for number in range(1000):  # the next temporary names
        (tmp_path / f".{writing._HERE}-{os.getpid()}-{number}.tmp").symlink_to(precious)
    write_whole(tmp_path / "link", "new")
    assert (precious.read_text(), (tmp_path / "link").read_text()) == ("kept", "new")
