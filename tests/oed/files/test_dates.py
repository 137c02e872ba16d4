"""Times as dates: the step of the clock is the sampling time, in every format."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from oed import InputError, read_record
from oed.files.objects import as_records


@pytest.fixture
def frame(rng):
    index = pd.date_range("2024-03-30 23:59:59", periods=40, freq="50ms")
    return pd.DataFrame({"u": rng.standard_normal(40), "y": rng.standard_normal(40)}, index=index)


@pytest.mark.parametrize("zone", [None, "Europe/Amsterdam"])
@pytest.mark.parametrize("name", [None, "time", "Datum"])
def test_an_index_of_dates_is_the_clock(frame, tmp_path, name, zone):
    frame = (frame.tz_localize(zone) if zone else frame).rename_axis(name)
    frame.to_csv(tmp_path / "r.csv", sep=";")
    frame.to_parquet(tmp_path / "r.parquet")
    for record in (read_record(tmp_path / "r.csv"), read_record(tmp_path / "r.parquet"), *as_records(frame)):
        assert record.dt == pytest.approx(0.05, rel=1e-9)
        assert np.array_equal(record.u[:, 0], frame["u"])


def test_a_date_that_is_none_is_said_with_its_row(frame, tmp_path):
    frame.to_csv(tmp_path / "r.csv")
    lines = (tmp_path / "r.csv").read_text().splitlines()
    lines[7] = "yesterday," + lines[7].partition(",")[2]
    (tmp_path / "r.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match="row 6.*'yesterday'.*dates like"):
        read_record(tmp_path / "r.csv")


@pytest.mark.parametrize("suffix", [".txt", ".tsv"])
def test_text_is_read_whatever_its_suffix(tmp_path, suffix):
    (tmp_path / f"r{suffix}").write_text("u\ty\n1\t2\n3\t5\n")
    assert read_record(tmp_path / f"r{suffix}").y[:, 0].tolist() == [2, 5]
