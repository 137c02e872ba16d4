"""`oed reproduce`: every row holds, and a row that does not says so."""

from __future__ import annotations

import pytest

from benchmarks.cli import main
from benchmarks.tables.reproduced import KEYS, KINDS, modules, row, rows_of
from oed.errors import InputError


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.validate if name in ("siso-lemmas", "head-to-head") else ())
        for name in modules()
    ],
)
def test_every_row_holds(name):
    rows = rows_of(name)
    assert rows
    for each in rows:
        assert tuple(each) == KEYS
        assert each["holds"] is not False, each
        assert each["why"]
        assert each["kind"] in KINDS
        assert (each["kind"] == "illustration") == (each["published"] is None)
        assert each["holds"] is True or "absent" in each["why"] or each["kind"] == "illustration"
        if each["tolerance"] and each["published"]:  # what is within a third of anything proves little
            assert each["tolerance"] < 0.34 * abs(each["published"])


def test_a_row_is_judged_by_its_tolerance():
    assert row("a", "b", 1.0, 1.1, 0.2, "c")["holds"] is True
    assert row("a", "b", 1.0, 1.3, 0.2, "c")["holds"] is False
    assert row("a", "b", None, 1.3, None, "c")["holds"] is None
    assert row("a", "b", None, 1.3, None, "c", holds=True)["holds"] is None  # an illustration never counts
    with pytest.raises(InputError, match="kind of row"):
        row("a", "b", 1.0, 1.3, 0.2, "c", kind="proof")
    with pytest.raises(InputError, match="no reproduction named"):
        rows_of("siso-fig-7")


def test_the_last_line_counts_what_could_have_failed(monkeypatch, capfd):
    import benchmarks.tables.reproduced as reproduced

    rows = [
        row("a", "b", 1.0, 1.1, 0.2, "c", kind="in print"),
        row("e", "b", 1.0, 1.3, 0.2, "c", kind="statement"),
        row("a", "b", 1.0, 1.0, 0.2, "c"),
        row("a", "b", None, 1.0, None, "c"),
    ]
    monkeypatch.setattr(reproduced, "rows_of", lambda name, progress=None: rows)
    assert main(["reproduce", "--quiet"]) == 0
    assert (
        capfd.readouterr()
        .out.rstrip()
        .endswith(
            "2 of 3 rows that can fail hold, 1 do not: 1 figures and 1 statements in print, 1 recomputed two ways. "
            "1 illustrations are not counted."
        )
    )
    assert main(["reproduce", "--quiet", "--strict"]) != 0
    assert "1 of 3 rows that can fail do not hold: e" in capfd.readouterr().err
