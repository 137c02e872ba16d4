"""A case in files: what its description says counts where nothing else does."""

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.cases import COUNTED, Columns, _in_units, diagnose_files, setting_of_meta
from oed.data import Record
from oed.errors import InputError
from tests.estimators.diagnosis.case_small import looking_for, two_poles


@pytest.fixture
def case(tmp_path, monkeypatch):
    """Two records without a clock, the second from a start out of equilibrium, and how their description is written."""
    two_poles(monkeypatch)
    rng = np.random.default_rng(1)
    for name, n, start in (("train", 400, 0.0), ("test", 300, 4.0)):
        u = rng.standard_normal(n)
        y = lfilter([0.0, 0.1], [1.0, -0.9], u, zi=[start])[0] + 0.02 * rng.standard_normal(n)
        np.savetxt(
            tmp_path / f"{name}.csv", np.column_stack((u, y)), delimiter=",", header="u,y", comments=""
        )

    def diagnosed(meta: dict, **given):
        (tmp_path / "meta.json").write_text(json.dumps(meta))
        files = [tmp_path / name for name in ("train.csv", "test.csv", "meta.json")]
        few = looking_for("saturation")
        return diagnose_files(files[0], files[1], meta=files[2], setting=few, **given)

    return diagnosed


def test_a_description_tells_the_sampling_time_of_files_without_a_clock(case) -> None:
    """ "The sampling time is 0.08 s in meta.json and 1 s by the column t" was said of files that have no column t."""
    found, notes = case({"sampling_time": 0.08})
    assert found.extra["train"].dt == 0.08
    assert not any("assumed" in note for note in notes)
    assert case({"sampling_time": 0.08}, columns=Columns(dt=0.1))[0].extra["train"].dt == 0.1


@pytest.mark.parametrize("clock", ["", "t [min],", "t,"])
def test_a_sampling_time_is_in_the_unit_of_time_that_the_description_names(case, tmp_path, clock) -> None:
    """One of 5 with `"time_unit": "min"` beside a column `t [min]` was "5 s in meta.json and 300 s by the column t"."""
    for name in ("train.csv", "test.csv"):
        header, *rows = (tmp_path / name).read_text().splitlines()
        times = [f"{5 * k}," if clock else "" for k in range(len(rows))]
        (tmp_path / name).write_text("\n".join([clock + header, *(t + row for t, row in zip(times, rows))]))
    assert case({"sampling_time": 5, "time_unit": "min"})[0].extra["train"].dt == 300.0
    if clock != "t [min],":  # a column that says its own unit is in that one
        of_five = (
            {"sampling_time": 1, "time_unit": "5 min"}
            if not clock
            else {"sampling_time": 5, "time_unit": "1 min"}
        )
        assert case(of_five)[0].extra["train"].dt == 300.0
    with pytest.raises(InputError, match="time_unit in meta.json is 'fortnights'; known are s, "):
        case({"sampling_time": 5, "time_unit": "fortnights"})
    with pytest.raises(InputError, match="a number of 401 digits"):
        case({"sampling_time": 10**400})


def test_a_description_tells_how_many_samples_set_the_state(case) -> None:
    """Their errors, of a start that nobody told, were most of a control's error."""
    told, untold = case({"skip": 20})[0], case({"note": "n", "sampling_time": 1.0})[0]
    assert told.rmse_before.value < 0.03 < untold.rmse_before.value
    assert case({"skip": 20}, skip=0)[0].rmse_before.value == untold.rmse_before.value
    with pytest.raises(InputError, match="skip"):
        case({"skip": -1})


@pytest.mark.parametrize("skip", [300, 10**20])
def test_a_test_record_of_which_nothing_is_left_is_a_line(case, skip) -> None:
    """It had been a ValueError of an empty maximum."""
    with pytest.raises(InputError, match=f"300 samples, of which the first {skip} are left out"):
        case({"skip": skip})


def test_a_description_may_count_the_channels_and_name_their_units_in_one_line() -> None:
    """ "The structure in meta.json is 'MISO'" was an error, and each of two inputs in "V, A" was in the unit `V, A`."""
    for word in COUNTED:
        assert setting_of_meta({"structure": word}, 1).structure != "diagonal"
    assert setting_of_meta({"structure": "diagonal"}, 2).structure == "diagonal"
    with pytest.raises(InputError, match="'square'; it is diagonal, full, or one of SISO, MISO"):
        setting_of_meta({"structure": "square"}, 1)
    record = Record(np.ones((3, 2)), np.ones((3, 1)))
    for said, units in (("V, A", ("V", "A")), ("V", ("V", "V")), (["V", "A"], ("V", "A")), ("", ("", ""))):
        assert _in_units(record, {"input_unit": said}).input_units == units
    assert _in_units(record, {"output_unit": "g, wet"}).output_units == ("g, wet",)
    with pytest.raises(InputError, match="for 2 inputs"):
        _in_units(record, {"input_unit": ["V", "A", "W"]})
