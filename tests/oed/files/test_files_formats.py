"""Records from npz, MAT and Parquet files and from pandas, xarray and python-control objects as others make them."""

from __future__ import annotations

import gzip
import io
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from oed.data import Record
from oed.errors import InputError
from oed.files import (
    from_control,
    from_pandas,
    from_xarray,
    read_record,
    to_control,
    to_pandas,
    to_xarray,
    write_record,
)
from oed.files.objects import as_records
from tests.oed.files.records import assert_same, record, write


class Planted:
    """What a pickle that runs code looks like."""

    def __reduce__(self) -> tuple:
        return (os.mkdir, (os.environ["OED_TEST_PLANTED"],))


def test_pickles_are_never_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trap = tmp_path / "trap"
    monkeypatch.setenv("OED_TEST_PLANTED", str(trap))
    np.savez(tmp_path / "objects.npz", u=np.array([Planted(), 1.0], dtype=object), y=np.ones(2))
    with pytest.raises(
        InputError, match="the array u of objects.npz holds Python objects; they are never unpickled"
    ):
        read_record(tmp_path / "objects.npz")
    with pytest.raises(InputError, match="not an npz file"):
        read_record(write(tmp_path, pickle.dumps(Planted()), "pickle.npz"))
    assert not trap.exists()
    pickle.loads(pickle.dumps(Planted()))  # the negative control: unpickled, it does run
    assert trap.exists()


def test_npz_arrays(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, u=np.arange(8.0).reshape(4, 2), y=np.arange(4), t=np.arange(4) * 0.2, Ts=0.2, text="x")
    back = read_record(path)
    assert back.input_names == ("u1", "u2")
    assert back.u.tolist() == [[0, 1], [2, 3], [4, 5], [6, 7]]
    assert (back.dt, back.t0) == (0.2, 0.0)
    for arrays, message in (
        ({"u": np.ones(4), "y": np.ones(5)}, r"unequal lengths \(u 4, y 5\)"),
        ({"u": np.ones(4), "y": np.ones(4) * 1j}, "column y of b.npz holds complex128 values"),
        ({"u": np.array(["a", "b"]), "y": np.ones(2)}, "column u of b.npz holds <U1 values"),
        ({"x": np.ones(4), "y": np.ones(4)}, r"no column that begins with u \(its columns: x, y\)"),
        (
            {"u": np.ones(4), "y": np.ones(4), "Ts": 0.1, "t": np.arange(4)},
            "states .* 0.1 s, but the column t .* gives 1 s",
        ),
        ({"u": np.ones(4), "y": np.ones(4), "dt": -1.0}, "states the sampling time -1.0"),
    ):
        np.savez(tmp_path / "b.npz", **arrays)
        with pytest.raises(InputError, match=message):
            read_record(tmp_path / "b.npz")


def test_mat_arrays_and_structs_of_v5(tmp_path: Path) -> None:
    from scipy.io import savemat

    u, y = np.arange(5.0), np.arange(5.0) ** 2
    path = tmp_path / "a.mat"
    savemat(path, {"u": u[None, :], "y": y[:, None], "Ts": 0.1})  # a row and a column
    back = read_record(path)
    assert (back.u[:, 0].tolist(), back.y[:, 0].tolist(), back.dt) == (u.tolist(), y.tolist(), 0.1)
    savemat(path, {"vir": u, "qm": y, "t": np.arange(5) * 0.001, "note": "rig"})
    assert read_record(path, inputs="vir", outputs="qm").dt == 0.001
    names = np.array(["heater", "fan"], dtype=object)
    data = {"InputData": np.column_stack([u, -u]), "OutputData": y[:, None], "Ts": 2.0, "Tstart": 6.0}
    data |= {"InputName": names, "OutputName": "level", "OutputUnit": "cm", "TimeUnit": "minutes"}
    savemat(path, {"z": data, "other": {"a": 1.0}})
    back = read_record(path)
    assert (back.input_names, back.output_names, back.output_units) == (
        ("heater", "fan"),
        ("level",),
        ("cm",),
    )
    assert (back.dt, back.t0, back.n_inputs) == (120.0, 360.0, 2)
    assert read_record(path, inputs="fan").u[:, 0].tolist() == (-u).tolist()
    assert len(read_record(f"{path}[1:3]")) == 2
    savemat(path, {"z": {"u": u, "y": y, "SamplingInstants": np.arange(5) * 0.5}})
    assert read_record(path).dt == 0.5
    cells = np.empty(2, dtype=object)
    cells[:] = [u, u]
    for variables, message in (
        ({"z": {"u": u, "y": y[:4]}}, r"unequal lengths \(u 5, y 4\)"),
        ({"z": {"u": cells, "y": cells}}, "the struct z of a.mat holds 2 experiments; save one per file"),
        ({"z": {"u": u, "y": y}, "w": {"u": u, "y": y}}, r"holds several records \(z, w\)"),
        ({"z": {"u": u, "y": np.zeros((0, 0))}}, "has no output samples"),
        ({"z": {"u": u, "y": y, "Ts": 1.0, "TimeUnit": "weeks"}}, "time unit 'weeks'; known are"),
        ({"z": {"a": u}}, "holds no arrays of numbers"),
    ):
        savemat(path, variables)
        with pytest.raises(InputError, match=message):
            read_record(path)


def hdf5(variables: dict) -> bytes:
    """A MAT file of version 7.3 as MATLAB lays it out: 512 bytes of text, axes reversed, classes as attributes."""
    import h5py

    stream = io.BytesIO()

    def put(group: h5py.Group, name: str, value: object) -> None:
        if isinstance(value, dict):
            inner = group.create_group(name)
            inner.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, entry in value.items():
                put(inner, key, entry)
        elif isinstance(value, str):
            codes = np.array([[ord(c)] for c in value] or [0, 0], dtype=np.uint16 if value else np.uint64)
            group[name] = codes
            group[name].attrs["MATLAB_class"] = np.bytes_("char")
            if not value:
                group[name].attrs["MATLAB_empty"] = np.uint8(1)
        elif isinstance(value, list):
            refs = group.file.require_group("#refs#")
            names = [f"c{len(refs)}_{k}" for k in range(len(value))]
            for key, entry in zip(names, value):
                put(refs, key, entry)
            group[name] = np.array([[refs[key].ref for key in names]], dtype=h5py.ref_dtype)
            group[name].attrs["MATLAB_class"] = np.bytes_("cell")
        else:
            group[name] = np.atleast_2d(np.asarray(value)).T
            group[name].attrs["MATLAB_class"] = np.bytes_("double")

    with h5py.File(stream, "w", userblock_size=512) as file:
        for name, value in variables.items():
            put(file, name, value)
    return b"MATLAB 7.3 MAT-file".ljust(512) + stream.getvalue()[512:]


@pytest.mark.parametrize("gz", [False, True])
def test_mat_arrays_and_structs_of_v73(tmp_path: Path, gz: bool) -> None:
    u, y = np.arange(10.0).reshape(5, 2), np.arange(5.0)[:, None]

    def read(variables: dict) -> Record:
        content = hdf5(variables)
        name = "a.mat.gz" if gz else "a.mat"
        return read_record(write(tmp_path, gzip.compress(content) if gz else content, name))

    back = read({"u": u, "y": y, "Ts": 0.25})
    assert (back.u.tolist(), back.y.tolist(), back.dt) == (u.tolist(), y.tolist(), 0.25)
    data = {
        "InputData": u,
        "OutputData": y,
        "Ts": 0.5,
        "InputName": ["heater", "fan"],
        "OutputName": ["level"],
    }
    back = read({"z": data | {"InputUnit": ["V", ""], "TimeUnit": "seconds", "Notes": ""}})
    assert (back.input_names, back.output_names, back.dt) == (("heater", "fan"), ("level",), 0.5)
    assert back.input_units == ("V", "")
    assert back.u.tolist() == u.tolist()
    with pytest.raises(InputError, match="holds 2 experiments"):
        read({"z": {"InputData": [u, u], "OutputData": [y, y]}})


def test_parquet_of_others(tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    path = tmp_path / "a.parquet"
    parquet.write_table(
        pa.table({"t": [0.0, 0.5, 1.0], "u": [1, 2, 3], "y": [1.5, None, 2.5], "tag": ["a", "b", "c"]}), path
    )
    back = read_record(path, missing=True)
    assert (back.u[:, 0].tolist(), back.dt) == ([1, 2, 3], 0.5)
    assert np.isnan(back.y[1, 0])
    with pytest.raises(InputError, match="the first nan in row 1 .*, column y"):
        read_record(path)
    with pytest.raises(InputError, match="column tag of a.parquet holds 'a' in row 0"):
        read_record(path, inputs="tag", missing=True)


def test_no_bit_of_a_parquet_files_end_changes_a_record(tmp_path: Path) -> None:
    """It has no checksum, and says thrice how many rows there are: of 6 rows 4 were read in silence."""
    record = Record(np.arange(12.0).reshape(6, 2) / 7, np.arange(6.0)[:, None] ** 2 - 3, dt=0.5)
    content = write_record(record, tmp_path / "r.parquet").read_bytes()
    end = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    path, refused = tmp_path / "x.parquet", 0
    for at in range(end, len(content)):
        for bit in (1, 2):  # numbers and letters that stay such
            damaged = bytearray(content)
            damaged[at] ^= 1 << bit
            path.write_bytes(damaged)
            try:
                found = read_record(path)
            except InputError:
                refused += 1
                continue
            assert found.u.tobytes() == record.u.tobytes(), (at, bit)
            assert found.y.tobytes() == record.y.tobytes(), (at, bit)
    assert refused > 500


def test_parquet_with_dates(tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    dates = np.datetime64("2024-01-01") + np.arange(3) * np.timedelta64(20, "ms")
    parquet.write_table(
        pa.table({"t": dates, "u": [1.0, 2.0, 3.0], "y": [1.0, 2.0, 3.0]}), tmp_path / "a.parquet"
    )
    assert read_record(tmp_path / "a.parquet").dt == 0.02
    original = record(1, 1, 30, dt=0.1)
    table = parquet.read_table(write_record(original, tmp_path / "b.parquet"))
    parquet.write_table(table.take(list(range(0, 30, 3))), tmp_path / "thinned.parquet")
    assert read_record(tmp_path / "thinned.parquet").dt == pytest.approx(0.3, rel=1e-12)


def test_pandas(tmp_path: Path) -> None:
    import pandas as pd

    original = record(2, 1, 30, gap=True)
    frame = to_pandas(original)
    assert list(frame.columns) == ["u1 [ft^3/min]", "u2_V", "y_degC"]
    assert_same(original, from_pandas(frame, missing=True))
    dates = pd.DataFrame(
        {"u": [1.0, 2.0, 3.0], "y": [1, 2, 3]}, index=pd.date_range("2024-01-01", periods=3, freq="10ms")
    )
    assert from_pandas(dates).dt == 0.01
    assert from_pandas(dates.tz_localize("Europe/Brussels")).dt == 0.01
    periods = pd.period_range("2024-01-01", periods=3, freq="min")
    assert from_pandas(dates.set_index(periods)).dt == 60
    unnamed = dates.set_index(np.arange(3) * 0.1)
    assert from_pandas(unnamed, dt=0.1).dt == from_pandas(unnamed.rename_axis("t")).dt == pytest.approx(0.1)
    nullable = pd.DataFrame({"u": pd.array([1, None], dtype="Int64"), "y": [True, False]})
    assert np.isnan(from_pandas(nullable, missing=True).u[1, 0])
    for wrong, message in (
        (pd.DataFrame({"u": [1.0, 2.0], "y": ["a", "b"]}), "column y of the DataFrame holds 'a' in row 0"),
        (pd.DataFrame([[1.0, 2.0, 3.0]], columns=["u", "y", "u"]), "more than one column 'u'"),
        (pd.DataFrame({"u": [], "y": []}), "no rows of data"),
        (unnamed, "under no name that says what they are; call it t"),
    ):
        with pytest.raises(InputError, match=message):
            from_pandas(wrong)


def test_xarray() -> None:
    import xarray as xr

    original = record(2, 2, 30, gap=True, t0=3.0)
    dataset = to_xarray(original)
    assert dataset["u2"].attrs == {"units": "V", "role": "input"}
    assert_same(original, from_xarray(dataset, missing=True))
    assert_same(original[10:], from_xarray(dataset.isel(t=slice(10, None)), missing=True))
    assert from_xarray(dataset.isel(t=slice(0, None, 2)), missing=True).dt == 2 * original.dt
    dates = np.datetime64("2024-01-01") + np.arange(3) * np.timedelta64(20, "ms")
    dated = xr.Dataset({"u": ("time", np.ones(3)), "y": ("time", np.ones(3))}, coords={"time": dates})
    assert from_xarray(dated).dt == 0.02
    plain = xr.Dataset(
        {"u": ("time", [1.0, 2.0]), "y": ("time", [1.0, 2.0])}, coords={"t": ("time", [0.0, 0.2])}
    )
    assert from_xarray(plain).dt == 0.2
    array = plain.to_dataarray("channel")
    for given in (array, array.T):
        (found,) = as_records(given)
        assert found.u[:, 0].tolist() == [1.0, 2.0]
        assert found.dt == 0.2
    with pytest.raises(InputError, match="labels name the channels"):
        as_records(plain["u"])
    with pytest.raises(InputError, match="u, y of the Dataset have more than one dimension"):
        from_xarray(xr.Dataset({"u": (("t", "i"), np.ones((3, 2))), "y": (("t", "o"), np.ones((3, 2)))}))
    with pytest.raises(InputError, match="needs different names"):
        to_xarray(Record(np.ones(3), np.ones(3), input_names=("y",)))


def test_control_responses() -> None:
    import control as ct

    for nu, ny in ((1, 1), (1, 2), (2, 1), (2, 3)):
        original = record(nu, ny, 40).replace(output_units=("",) * ny, input_units=("",) * nu)
        assert_same(original, from_control(to_control(original)))
        system = ct.ss(0.5 * np.eye(2), np.ones((2, nu)), np.ones((ny, 2)), np.zeros((ny, nu)), 0.1)
        u = np.random.default_rng(0).normal(size=(nu, 40))
        for squeeze in (None, True, False):
            response = ct.forced_response(system, inputs=u if nu > 1 else u[0], squeeze=squeeze)
            back = from_control(response)
            np.testing.assert_array_equal(back.u, u.T)
            np.testing.assert_array_equal(back.y, response.y.reshape(ny, 40).T)
            assert back.dt == pytest.approx(0.1, rel=1e-12)
            assert back.input_names[0] == "u[0]"


def test_control_responses_with_traces() -> None:
    import control as ct

    system = ct.ss(0.5 * np.eye(2), np.eye(2), np.array([[1.0, 2.0]]), np.zeros((1, 2)), True)
    response = ct.step_response(system, np.arange(6))
    with pytest.raises(InputError, match="has 2 traces; choose one with trace=0, ..., 1"):
        from_control(response)
    for trace in (0, 1):
        back = from_control(response, trace=trace)
        assert back.u[:, trace].tolist() == [1.0] * 6
        assert back.u[:, 1 - trace].tolist() == [0.0] * 6
        np.testing.assert_allclose(back.y[:, 0], (trace + 1) * 2 * (1 - 0.5 ** np.arange(6)))
    with pytest.raises(InputError, match="trace 2 is not in"):
        from_control(response, trace=2)
    with pytest.raises(InputError, match="has no input"):
        from_control(ct.TimeResponseData([0.0, 1.0], [1.0, 2.0], issiso=True))
