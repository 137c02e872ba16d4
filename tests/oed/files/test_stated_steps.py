"""A sampling time that a record says in a way of its own is used, or refused with the remedy: never 1 s in silence."""

from __future__ import annotations

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.io import savemat

from oed import InputError, Record, read_record
from oed.files.objects import as_record, from_pandas

N = 50
T = 0.02 * np.arange(N)
SIGNALS = {"u": np.sin(T), "y": np.cos(T)}
UNDERSTOOD = {
    "dt": 0.02, "Ts": 0.02, "DT": 0.02, "delta_t": 0.02, "sampling_time": 0.02, "dt_ms": 20.0, "Ts [us]": 2e4,
    "fs": 50.0, "Fs": 50.0, "f_s": 50.0, "sample_rate": 50.0, "SamplingFrequency": 50.0, "fs_kHz": 0.05,
}  # fmt: skip
UNCLEAR = {
    "timestamp": T,
    "Zeit": 20 * T,
    "elapsed": T,
    "epoch": 1.6e9 + T,
    "T": T,
    "clock": T + 1e-4 * np.sin(9 * T),
}


def npz(tmp_path, found):
    np.savez(tmp_path / "r.npz", **SIGNALS, **found)
    return read_record(tmp_path / "r.npz")


def mat(tmp_path, found):
    savemat(
        tmp_path / "r.mat", SIGNALS | {name.replace(" [", "_").rstrip("]"): v for name, v in found.items()}
    )
    return read_record(tmp_path / "r.mat")


def struct(tmp_path, found):
    savemat(
        tmp_path / "s.mat",
        {"z": SIGNALS | {name.replace(" [", "_").rstrip("]"): v for name, v in found.items()}},
    )
    return read_record(tmp_path / "s.mat")


def table(found):
    return pd.DataFrame(SIGNALS | found)


def csv(tmp_path, found):
    table(found).to_csv(tmp_path / "r.csv", index=False)
    return read_record(tmp_path / "r.csv")


def parquet(tmp_path, found):
    table(found).to_parquet(tmp_path / "r.parquet")
    return read_record(tmp_path / "r.parquet")


def frame(tmp_path, found):
    return as_record(table(found))


def dataset(tmp_path, found):
    columns = table(found)
    return as_record(xr.Dataset({name: ("k", columns[name].to_numpy()) for name in columns}))


ARRAYS, TABLES = (npz, mat, struct), (csv, parquet, frame, dataset)


@pytest.mark.parametrize("read", [*ARRAYS, *TABLES])
@pytest.mark.parametrize("name", UNDERSTOOD)
def test_a_sampling_time_is_used_under_its_usual_names(read, name, tmp_path):
    """As one number where the format has such, and as the same number in every row."""
    value = UNDERSTOOD[name]
    shapes = [np.full(N, value)] + ([value, np.full((N - 1, 1), value)] if read in ARRAYS else [])
    for given in shapes:
        assert read(tmp_path, {name: given}).dt == pytest.approx(0.02, rel=1e-15)


@pytest.mark.parametrize("read", [*ARRAYS, *TABLES])
@pytest.mark.parametrize("name", UNCLEAR)
def test_times_in_no_unit_are_refused(read, name, tmp_path):
    if read is struct and name == "T":
        return  # a field t, whatever its capitals
    with pytest.raises(InputError, match=rf"has (the column )?{name}.*sampling time .--dt, in Python dt="):
        read(tmp_path, {name: UNCLEAR[name]})


@pytest.mark.parametrize("read", [*ARRAYS, *TABLES])
def test_steps_that_vary_are_refused_unless_times_are_there(read, tmp_path):
    varying = {"dt": np.resize([0.02, 0.03], N)}
    with pytest.raises(InputError, match="has dt from 0.02 to 0.03, where a record has one sampling time"):
        read(tmp_path, varying)
    assert read(tmp_path, varying | {"t": T}).dt == 0.02
    assert from_pandas(table(varying), dt=0.5).dt == 0.5


@pytest.mark.parametrize("read", ARRAYS)
def test_what_contradicts_is_refused(read, tmp_path):
    for found, said in (
        ({"fs": 50.0, "dt": 0.03}, "several sampling times, 0.02 s by fs and 0.03 s by dt"),
        ({"fs": 50.0, "t": 2 * T}, "states the sampling time 0.02 s, but"),
        ({"fs": 0.0}, r"states the sampling rate 0.0 \(fs\); it must be positive, in Hz"),
        ({"t": 0.02}, "has t, which is not understood"),
        ({"dt": np.empty(0)}, "has dt, which is not understood"),
        ({"t": T[:7]}, "7 times and 50 samples|unequal lengths"),
    ):
        with pytest.raises(InputError, match=said):
            read(tmp_path, found)
    assert read(tmp_path, {"fs": 50.0, "dt": 0.02, "t": T}).dt == 0.02


def test_what_is_no_time_stands_in_nobodys_way(tmp_path):
    """The negative control: a force Fs beside a clock, a temperature, a counter of rows, a label of the day."""
    force = {"Fs": SIGNALS["y"], "t": T}
    for read in TABLES:
        assert read(tmp_path, force).dt == 0.02
        assert read(tmp_path, {"T": SIGNALS["y"], "sample": np.arange(N), "lifetime": np.ones(N)}).dt == 1
    assert npz(tmp_path, {"date": "2024-01-31", "h": 0.3, "period": 7.0}).dt == 1


@pytest.mark.parametrize("read", TABLES)
def test_a_column_of_dates_is_the_clock_whatever_its_name(read, tmp_path):
    dates = pd.date_range("2024-01-01", periods=N, freq="20ms")
    assert read(tmp_path, {"logged": dates}).dt == pytest.approx(0.02, rel=1e-9)
    if read is frame:
        assert frame(tmp_path, {"logged": dates.tz_localize("Europe/Amsterdam")}).dt == pytest.approx(
            0.02, rel=1e-9
        )
    if read is not csv:  # CSV has no other dates
        with pytest.raises(InputError, match="the times of .* are not understood: .*pandas.to_datetime"):
            read(tmp_path, {"timestamp": dates.astype(str)})


def test_attributes_state_it_too():
    data = xr.Dataset({name: ("k", v) for name, v in SIGNALS.items()}, attrs={"fs": 50.0})
    assert as_record(data).dt == 0.02
    with pytest.raises(InputError, match="dt of the attributes of the Dataset holds"):
        as_record(data.assign_attrs(dt="twenty ms"))
    framed = table({})
    framed.attrs["Ts"] = np.array([[0.02]])
    assert as_record(framed).dt == 0.02


def test_attributes_of_an_hdf5_file_state_it_too(tmp_path):
    """They were passed over: 1 s instead of .02."""
    file = tmp_path / "r.mat"
    for said, expected in ((np.array([50]), 0.02), (h5py.Empty("f8"), 1.0), (-50.0, None), ("fifty", None)):
        with h5py.File(file, "w") as to:
            to.update(SIGNALS)
            to.attrs["fs"] = said
        if expected:
            assert read_record(file).dt == expected
        else:
            with pytest.raises(InputError, match="must be positive|must be real numbers"):
                read_record(file)


@pytest.mark.parametrize(
    "dt",
    [
        np.array([[0.02]]),
        np.diff(T),
        [0.02] * 3,
        np.array(0.02),
    ],
    ids=str,
)
def test_a_sampling_time_is_given_as_files_have_it(dt):
    assert Record(SIGNALS["u"], SIGNALS["y"], dt=dt).dt == 0.02
    assert as_record((SIGNALS["u"], SIGNALS["y"], dt)).dt == 0.02
    assert from_pandas(table({}), dt=dt).dt == 0.02


@pytest.mark.parametrize(
    "dt, said",
    [(T, "50 values from 0 to 0.98; it must be one number"), (["a"], "an array of no numbers"), ([], "an array of no numbers"),
     ("0.02", "the text '0.02'"), ([np.nan], "nan; it must be one number"), (np.timedelta64(20, "ns"), "20 nanoseconds; it must be a positive")],
)  # fmt: skip
def test_what_is_no_sampling_time_is_one_short_line(dt, said, tmp_path):
    table({}).to_csv(tmp_path / "r.csv", index=False)
    for call in (
        lambda: Record(SIGNALS["u"], SIGNALS["y"], dt=dt),
        lambda: from_pandas(table({}), dt=dt),
        lambda: read_record(tmp_path / "r.csv", dt=dt),
    ):
        with pytest.raises(InputError, match=said) as refused:
            call()
        assert len(str(refused.value)) < 200
