"""Records from and to files: bit for bit there and back, and one clear line for everything that is wrong."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from oed.data import Record
from oed.errors import InputError
from oed.files import read_record, write_bytes, write_record
from oed.files.clock import sampling_time
from tests.oed.files.records import assert_same, record, write

FORMATS = [f"{suffix}{gz}" for suffix in (".csv", ".mat", ".npz", ".parquet") for gz in ("", ".gz")]


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("nu, ny, n", [(1, 1, 50), (2, 3, 7), (3, 1, 2), (1, 2, 400)])
def test_round_trip_bit_for_bit(tmp_path: Path, suffix: str, nu: int, ny: int, n: int) -> None:
    original = record(nu, ny, n, gap=True, dt=1 / 3)
    path = write_record(original, tmp_path / f"record{suffix}")
    assert_same(original, read_record(path, missing=True))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("dt, t0", [(0.08, 0.0), (1 / 3, 0.0), (0.1, 0.3), (1.953125e-05, 0.0), (4.0, 400.0)])
def test_csv_clock_comes_back(tmp_path: Path, dt: float, t0: float) -> None:
    original = record(1, 1, 3000, dt=dt, t0=t0)
    assert_same(original, read_record(write_record(original, tmp_path / "a.csv")))


def test_csv_times_come_back_for_any_clock(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for k in range(40):
        dt, t0, n = float(10 ** rng.uniform(-6, 4)), float(rng.normal() * 100), int(rng.integers(2, 400))
        original = record(1, 1, n, dt=dt, t0=t0)
        back = read_record(write_record(original, tmp_path / f"{k}.csv"))
        assert back.t.tobytes() == original.t.tobytes()
        assert abs(back.dt - dt) <= 4 * np.spacing(abs(original.t).max()) / (n - 1) + 4 * np.spacing(dt)


def test_names_units_and_extra_columns(tmp_path: Path) -> None:
    path = write(tmp_path, "t_s,vir_V,qm_m,flow [ft^3/min],U_gas_rate,Y\n0,1,2,3,4,5\n0.5,6,7,8,9,10\n")
    notes: list[str] = []
    back = read_record(path, inputs="vir_V, flow", outputs=["qm"], notes=notes)
    assert (back.input_names, back.input_units) == (("vir", "flow"), ("V", "ft^3/min"))
    assert (back.output_names, back.output_units) == (("qm",), ("m",))
    assert back.u.tolist() == [[1, 3], [6, 8]]
    assert back.dt == 0.5
    assert notes == ["columns of data.csv that are not used: U_gas_rate, Y."]
    default = read_record(path)
    assert (default.input_names, default.output_names) == (("U_gas_rate",), ("Y",))
    both = read_record(write(tmp_path, "u_V,u_A,y\n1,2,3\n"))
    assert (both.input_names, both.input_units) == (("u_V", "u_A"), ("V", "A"))


def test_names_that_look_like_units_come_back(tmp_path: Path) -> None:
    original = Record(
        np.ones((3, 2)), np.ones(3), input_names=("u_V", "x_V"), input_units=("", "V"), output_units=("",)
    )
    assert_same(original, read_record(write_record(original, tmp_path / "a.csv"), inputs="u_V [],x_V_V"))
    same = Record(np.ones(3), np.ones(3), input_names=("x",), output_names=("x",))
    for suffix in (".mat", ".npz", ".parquet"):
        assert_same(same, read_record(write_record(same, tmp_path / f"same{suffix}")))


def test_rows(tmp_path: Path) -> None:
    original = record(1, 1, 10, dt=0.1)
    for suffix in FORMATS:
        path = write_record(original, tmp_path / f"a{suffix}")
        for spec, rows in (
            ("[2:7]", slice(2, 7)),
            ("[4:]", slice(4, None)),
            ("[:3]", slice(3)),
            ("[:]", slice(None)),
        ):
            back = read_record(f"{path}{spec}")
            assert_same(original[rows], back)
    odd = write_record(original, tmp_path / "name[1:2].csv")
    assert len(read_record(odd)) == 10
    assert len(read_record(f"{odd}[0:4]")) == 4
    silent = write(tmp_path, "u,y\n" + "1,2\n" * 5, "silent.csv")
    assert read_record(f"{silent}[2:]", dt=0.5).t0 == 1.0


def test_no_clock_is_noted(tmp_path: Path) -> None:
    path = write(tmp_path, "u,y\n1,2\n3,4\n")
    notes: list[str] = []
    assert read_record(path, notes=notes).dt == 1
    assert "no column t or time" in notes[0]
    notes.clear()
    assert read_record(path, dt=0.25, notes=notes).dt == 0.25
    assert notes == []


@pytest.mark.parametrize(
    "text",
    [
        "\ufefft,u,y\r\n0,1,2\r\n0.5,3,4\r\n",
        "# made by a rig\n# twice\nt;u;y\n0;1;2\n0.5;3;4\n",
        "# t,u,y\n0,1,2\n0.5,3,4\n",
        't\t"u"\ty\n0\t1\t2\n\n0.5\t3\t"4"\n',
        "t,u,y,remark\n0,1,2,start\n0.5,3,4,\n",
        "t,u,y,\n0,1,2,\n0.5,3,4,\n",
    ],
)
def test_dialects_of_csv(tmp_path: Path, text: str) -> None:
    back = read_record(write(tmp_path, text))
    assert (back.u.tolist(), back.y.tolist(), back.dt) == ([[1], [3]], [[2], [4]], 0.5)


def test_text_of_a_spreadsheet(tmp_path: Path) -> None:
    path = tmp_path / "data.txt"
    path.write_bytes("t\tu\ty [µm]\n0\t1\t2\n0.5\t3\t4\n".encode("utf-16"))
    back = read_record(path)
    assert (back.u.tolist(), back.y.tolist(), back.output_units) == ([[1], [3]], [[2], [4]], ("µm",))


def test_missing_samples(tmp_path: Path) -> None:
    path = write(tmp_path, "u,y\n1,2\n,3\nNA,nan\n")
    back = read_record(path, missing=True)
    assert np.isnan(back.u[1:, 0]).all()
    assert np.isnan(back.y[2, 0])
    with pytest.raises(
        InputError, match=r"3 samples that are not finite, the first nan in row 1 .*, column u;"
    ):
        read_record(path)
    path = write(tmp_path, "u,y\n1,2\n3,inf\n")
    with pytest.raises(InputError, match=r"the first inf in row 1 .*, column y; .* NaN"):
        read_record(path, missing=True)


@pytest.mark.parametrize("mark", [",", ";", "\t", "|"])
def test_what_stands_between_columns(tmp_path, mark) -> None:
    path = tmp_path / "data.csv"
    path.write_text("t,u,y\n0,1.5,2\n1,2.5,3\n".replace(",", mark), encoding="utf-8")
    assert read_record(path).u[:, 0].tolist() == [1.5, 2.5]


CSV_ERRORS = {
    "empty (0 bytes)": (b"", "empty"),
    "only blanks": (b"\n\n", "is empty; a CSV file has a header row"),
    "no rows": (b"u,y\n", "has no rows of data"),
    "blanks": (b"t u y\n0 1 2\n1 2 3\n", "have blanks between them; write commas"),
    "no header": (b"1,2\n3,4\n", "has no header: its first row is '1,2'"),
    "text": (
        b"t,u,y\n0,1,2\n1,abc,3\n",
        "row 1 (counting from 0), column u of data.csv is 'abc'; entries must be numbers",
    ),
    "decimal commas": (
        b"u;y\n1,5;2.5\n",
        "column u of data.csv is '1,5'; entries must be numbers: write decimal points",
    ),
    "cut off": (
        b"t,u,y\n0,1,2\n1,2\n",
        "row 1 (counting from 0) of data.csv has 2 entries where the header has 3",
    ),
    "commas twice": (
        b"t,u,y\n0,5,1,5,2,5\n1,0,1,5,2,5\n",
        "row 0 (counting from 0) of data.csv has 6 entries where the header has 3 columns; they must be equal",
    ),
    "a row of units": (
        b"t,u,y\ns,V,rpm\n0,1,2\n",
        "the row after the header of data.csv has no number ('s,V,rpm')",
    ),
    "thousands": (
        b"t;u;y\n0;1,000.5;2\n",
        "is '1,000.5'; entries must be numbers: write them without marks between the",
    ),
    "minus of typesetting": ("t,u,y\n0,\u22121.5,2\n".encode(), "write minus as -"),
    "underscore": (b"t,u,y\n0,1_5,2\n", "without marks between the thousands"),
    "narrow space": ("t,u,y\n0,1\u202f500,2\n".encode(), "without marks between the thousands"),
    "percent": (b"t,u,y\n0,50%,2\n", "write its unit into the header, as u [V], not into the cells"),
    "units in cells": (b"t,u,y\n0,-1.5e-3 mV,2\n", "write its unit into the header"),
    "truth": (b"t,u,y\n0,True,2\n", "write 1 and 0"),
    "dates of another order": (
        b"time,u,y\n03/04/2024 10:00,1,2\n",
        "write dates like 2024-01-31 12:00:00.05, or the time",
    ),
    "duplicates": (b"u,y,u\n1,2,3\n", "more than one column 'u'"),
    "no input": (
        b"t,volt,y\n0,1,2\n",
        "no column that begins with u (its columns: t, volt, y); name the inputs with --inputs",
    ),
    "no output": (b"t,u,level\n0,1,2\n", "no column that begins with y"),
    "latin": ("u,y_°C\n1,2\n".encode("latin-1"), "save the table as CSV in UTF-8"),
    "binary": (b"u,y\n\0\0", "null characters"),
    "clock repeats": (
        b"t,u,y\n0,1,1\n1,1,1\n1,1,1\n",
        "goes from 1 to 1 at row 2 (counting from 0); times must increase",
    ),
    "clock has a gap": (b"t,u,y\n0,1,1\n0.1,1,1\n0.2,1,1\n0.4,1,1\n", "not uniform: from row 2 to row 3"),
    "clock is missing": (b"t,u,y\n0,1,1\n,1,1\n2,1,1\n", "is nan in row 1"),
}


@pytest.mark.parametrize("content, message", CSV_ERRORS.values(), ids=CSV_ERRORS.keys())
def test_bad_csv_gets_one_clear_line(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(InputError) as caught:
        read_record(write(tmp_path, content))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bad_requests_get_one_clear_line(tmp_path: Path) -> None:
    path = write(tmp_path, "t,u1,u2,y_V\n" + "".join(f"{k / 2},1,2,3\n" for k in range(6)))
    (tmp_path / "data.xlsx").write_bytes(b"PK")
    (tmp_path / "data.npz").write_bytes(b"PK and no archive: NumPy would speak of pickles")
    for spec, options, message in (
        (tmp_path / "absent.csv", {}, "does not exist"),
        (tmp_path, {}, "is a folder; give a file"),
        (tmp_path / "data.xlsx", {}, "suffix '.xlsx'; files are read by suffix: .csv"),
        (tmp_path / "data.npz", {}, "is not an npz file"),
        (f"{path}[3:9]", {}, r"rows \[3:9\] are not in data.csv, which has 6 rows"),
        (f"{path}[4:4]", {}, r"rows \[4:4\]"),
        (f"{path}[-2:]", {}, r"rows \[-2:\] are not in"),
        (f"{path}[3]", {}, "are not understood"),
        (f"{path}[0:3", {}, "are not understood"),
        ("[0:100]", {}, r"\[0:100\] names rows of no file; write them behind its name"),
        ("0:100", {}, "names rows of no file"),
        (f"{path}[1:5:2]", {}, "are not understood"),
        (path, {"inputs": "U1"}, r"'U1' is not a column of data.csv .did you mean u1"),
        (path, {"inputs": "volt"}, "'volt' is not a column of data.csv; its columns are t, u1, u2, y_V"),
        (path, {"outputs": ["y", "y_V"]}, "'y_V' is named twice"),
        (path, {"inputs": ["u1"], "outputs": ["u1"]}, "u1 are asked for as inputs and as outputs"),
        (path, {"inputs": []}, "no input is named"),
        (path, {"dt": 0.4}, "given is 0.4 s, but the column t of data.csv gives 0.5 s"),
        (path, {"dt": -1}, "sampling time is -1; it must be a positive"),
    ):
        with pytest.raises(InputError, match=message):
            read_record(spec, **options)
    assert read_record(path, dt=0.5 * (1 + 1e-8)).dt == 0.5 * (1 + 1e-8)


@pytest.mark.parametrize("suffix", FORMATS)
def test_damaged_files_get_one_clear_line(tmp_path: Path, suffix: str) -> None:
    whole = write_record(record(1, 1, 500), tmp_path / f"whole{suffix}").read_bytes()
    for k, content in enumerate((whole[: len(whole) // 2], b"", b"\0" * 300, whole[:100])):
        if suffix == ".csv" and k in (0, 3):  # a cut in the middle of a row shows, one at its end cannot
            content = content[: content.rindex(b",")]
        with pytest.raises(InputError) as caught:
            read_record(write(tmp_path, content, f"damaged{k}{suffix}"))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".csv.gz", ".mat", ".npz", ".parquet"])
def test_flipped_bytes_never_pass_for_data(tmp_path: Path, suffix: str) -> None:
    original = record(2, 1, 60)
    whole = write_record(original, tmp_path / f"whole{suffix}").read_bytes()
    rng, refused = np.random.default_rng(7), []
    for _ in range(60):
        content = bytearray(whole)
        content[rng.integers(len(whole))] ^= int(rng.integers(1, 256))
        try:
            back = read_record(write(tmp_path, bytes(content), f"damaged{suffix}"))
        except InputError as error:
            refused.append(str(error))
        else:  # the byte was in a name, a date or a filler
            assert np.array_equal(back.u, original.u)
            assert np.array_equal(back.y, original.y)
    assert len(refused) > 20
    assert not any("\n" in message for message in refused)


def test_gzip_by_content_and_by_name(tmp_path: Path) -> None:
    content = b"u,y\n1,2\n3,4\n"
    assert len(read_record(write(tmp_path, gzip.compress(content), "zipped.csv"))) == 2
    with pytest.raises(InputError, match="is not gzipped although its suffix says so"):
        read_record(write(tmp_path, content, "plain.csv.gz"))


def test_clock_accepts_rounding_and_refuses_jitter() -> None:
    n = np.arange(500)
    for step, digits in ((1 / 3, 2), (0.0016384041943147375, 5), (1 / 7, 3), (0.01, 2), (1 / 30, 3)):
        dt, tolerance = sampling_time(np.round(n * step, digits), "t")
        assert abs(dt - step) <= tolerance < 10.0**-digits
    single = (n * 0.01).astype(np.float32).astype(float)
    assert sampling_time(single, "t")[0] == pytest.approx(0.01, rel=1e-6)
    assert sampling_time(1.7e9 + n * 0.01, "t")[0] == pytest.approx(0.01, rel=1e-6)
    assert sampling_time(n * 0.1 + 5e-8 * np.sin(n), "t")[0] == pytest.approx(0.1, rel=1e-9)
    summed = np.cumsum(np.full(10**6, 0.001))  # a loop that adds the step; its rounding errors add up
    assert abs(summed[-1] - 1000) > 1e-8
    assert sampling_time(summed, "t")[0] == pytest.approx(0.001, rel=1e-10)
    jitter = np.round(n * 0.1, 2)
    jitter[250] += 0.02  # twice the last digit
    with pytest.raises(
        InputError, match="from row 249 to row 250 .* a step of 0.12 s where the others are 0.1 s"
    ):
        sampling_time(jitter, "t")
    with pytest.raises(InputError, match="from row 269 to row 270 "):
        sampling_time(jitter, "t", first_row=20)
    for gap in (np.r_[0, 1, 3.0], np.r_[n, 501.0], np.delete(n, 1).astype(float), np.delete(n * 0.25, 300)):
        with pytest.raises(InputError, match="not uniform"):
            sampling_time(gap, "t")
    with pytest.raises(InputError, match="not uniform"):  # a drift that no single step shows
        sampling_time(n * 0.1 + 2e-7 * n**2, "t")


def test_nothing_is_overwritten_or_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_record(record(1, 1, 5), tmp_path / "a.csv")
    before = path.read_bytes()
    with pytest.raises(InputError, match="exists and is not overwritten"):
        write_record(record(1, 1, 9), path)
    assert path.read_bytes() == before

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(InputError, match="cannot write .*: the disk is full"):
            write_record(record(1, 1, 9), path, overwrite=True)
    assert path.read_bytes() == before
    assert len(read_record(write_record(record(1, 1, 9), path, overwrite=True))) == 9
    for wrong, message in (
        (tmp_path / "absent" / "a.csv", "folder .* does not exist"),
        (tmp_path / "a.pkl", "suffix '.pkl'"),
        (tmp_path, "suffix"),
    ):
        with pytest.raises(InputError, match=message):
            write_record(record(1, 1, 5), wrong)
    with pytest.raises(InputError, match="is a folder"):
        write_bytes(tmp_path, b"")
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


def test_gzip_is_reproducible(tmp_path: Path) -> None:
    a, b = (write_record(record(1, 1, 50), tmp_path / f"{name}.csv.gz").read_bytes() for name in "ab")
    assert a == b


@pytest.mark.skipif(
    "OED_DATA" not in os.environ, reason="OED_DATA does not name the folder of measured records"
)
def test_measured_records() -> None:
    folder = Path(os.environ["OED_DATA"])
    for name, rows, dt, options in (
        ("cascaded_tanks/cascaded_tanks_est.csv", 1024, 4.0, {}),
        ("emps/emps_est.csv.gz", 24841, 0.001, {"inputs": "vir_V", "outputs": "qm_m"}),
        ("emps/emps_val_pulses.csv.gz", 24841, 0.001, {"inputs": "vir,pulses", "outputs": "qm"}),
        ("gas_furnace/gas_furnace.csv", 296, 9.0, {}),
        ("hair_dryer/hair_dryer.csv", 1000, 0.08, {}),
        ("silverbox/silverbox_snls80mv.csv.gz", 131072, 1.0, {}),
        ("wh2009/wiener_hammerstein_2009.csv.gz", 188000, 1.0, {}),
    ):
        back = read_record(folder / name, **options)
        assert (len(back), back.dt, back.complete) == (rows, dt, True)
    text = (
        gzip.decompress((folder / "wh2009/wiener_hammerstein_2009.csv.gz").read_bytes())
        .decode()
        .split("\n", 1)[1]
    )
    exact = [[float(entry) for entry in line.split(",")] for line in text.split()]
    assert np.hstack([back.u, back.y]).tolist() == exact


@pytest.mark.skipif("OED_CASES" not in os.environ, reason="OED_CASES does not name the folder of cases")
def test_practice_cases() -> None:
    paths = sorted(Path(os.environ["OED_CASES"]).glob("undeclared/practice/public/*/*/*.csv"))
    assert paths
    for path in paths:
        back = read_record(path, missing=True)
        assert all(name.startswith("u") for name in back.input_names)
        assert all(name.startswith("y") for name in back.output_names)


def test_heavy_libraries_are_imported_late() -> None:
    code = "import sys, oed.files; print(sorted({'pandas', 'pyarrow', 'h5py', 'xarray', 'control', 'scipy'} & set(sys.modules)))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.strip() == "[]"
