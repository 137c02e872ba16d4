"""Which column of a file is its clock, and in what unit it counts."""

import numpy as np
import pytest

from oed.errors import InputError
from oed.files import read_record
from oed.files.clock import sampling_time


@pytest.mark.parametrize(
    "name, step",
    [
        ("t", 0.5),
        ("t_ms", 0.5e-3),
        ("Time (s)", 0.5),
        ("time [min]", 30.0),
        ("time_us", 0.5e-6),
        ("Zeit [s]", 0.5),
        ("temps (ms)", 0.5e-3),
    ],
)
def test_units_of_the_clock(tmp_path, name, step) -> None:
    """A column of times says its unit; its decimal commas are read where semicolons part the columns."""
    path = tmp_path / "data.csv"
    path.write_text(f"{name};u;y\n0,0;1,5;2,5\n0,5;-3,25e-1;4\n1,0;7;0,125\n", encoding="utf-8")
    record = read_record(path)
    assert record.dt == pytest.approx(step, rel=1e-12)
    assert record.u[:, 0].tolist() == [1.5, -0.325, 7.0]
    assert record.y[:, 0].tolist() == [2.5, 4.0, 0.125]


@pytest.mark.parametrize("unit, begin", [("ms", 1.7e12), ("us", 1.7e15), ("ns", 1.7e18)])
def test_a_calendar_in_small_units_is_told_from_seconds(tmp_path, unit, begin) -> None:
    """A sampling time of 1e8 s had been taken from nanoseconds since 1970, in silence."""
    path = tmp_path / "data.csv"
    rows = "".join(f"{int(begin) + k * 4096},{k % 2},{k}\n" for k in range(9))
    path.write_text(f"time,u,y\n{rows}")
    with pytest.raises(
        InputError,
        match=rf"begins at 1.7e.{len(str(int(begin))) - 1} s, .*years.*as t .ms., t .us. or t .ns.",
    ):
        read_record(path)
    path.write_text(f"time [{unit}],u,y\n{rows}")
    assert read_record(path).dt == pytest.approx(4096 * {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit], rel=0.1)
    path.write_text("time,u,y\n0,1,2\n1e12,2,3\n2e12,3,4\n")  # a slow clock is none
    assert read_record(path).dt == 1e12


def test_the_line_by_which_excel_knows_the_separator_is_no_header(tmp_path) -> None:
    path = tmp_path / "data.csv"
    path.write_bytes(b"sep=;\r\nt;u;y\r\n0;1,5;2\r\n0,5;2;3\r\n")
    assert read_record(path).dt == 0.5
    assert read_record(path).u[:, 0].tolist() == [1.5, 2.0]


def test_a_signal_with_three_axes_is_named(tmp_path) -> None:
    """It had been said that there is no column u."""
    np.savez(tmp_path / "x.npz", u=np.ones((9, 2, 2)), y=np.ones(9))
    with pytest.raises(InputError, match="the array u of x.npz has 3 axes; .*time on axis 0"):
        read_record(tmp_path / "x.npz")


def test_a_channel_in_seconds_is_no_clock(tmp_path) -> None:
    """A name that nobody knows is a clock only where the column rises evenly, in a unit of time, and nothing else tells the time."""
    path = tmp_path / "data.csv"
    for rows, dt in (
        ("0;1;2\n1;2;3\n5;3;4\n", 1.0),
        ("3;1;2\n2;2;3\n1;3;4\n", 1.0),
        ("0;1;2\n2;2;3\n4;3;4\n", 2.0),
    ):
        path.write_text(f"delay_s;u;y\n{rows}", encoding="utf-8")
        assert read_record(path).dt == dt
        assert read_record(path, dt=0.1).dt == 0.1


@pytest.mark.parametrize("digits", [6, 7, 8, 10, 12])
def test_a_clock_that_is_printed_to_so_many_digits_is_uniform(digits) -> None:
    """A record at 51.2 kHz with "%.10g" was refused from the row on in which its time passed a tenth of a second."""
    dt = 1.0 / 51200.0 if digits > 8 else 1.0 / 3.0
    for t0 in (0.0, 0.09 if digits > 8 else 98.7):
        t = np.array([float(f"{t0 + k * dt:.{digits}g}") for k in range(1000)])
        step, tolerance = sampling_time(t, "t")
        assert step == pytest.approx(dt, rel=1e-4)
        assert abs(step - dt) <= tolerance
        lost = np.delete(t, 700)
        with pytest.raises(InputError, match="not uniform: from row 699 to row 700"):
            sampling_time(lost, "t")
