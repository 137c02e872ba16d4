"""Which column of a file is its clock, and in what unit it counts."""

import pytest

from oed.files import read_record


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
