"""`oed reproduce`: every row holds, and a row that does not says so."""

from __future__ import annotations

import pytest

from benchmarks.tables.reproduced import KEYS, row, row_names, rows_of
from oed.errors import InputError


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.validate if name in ("siso-lemmas", "head-to-head") else ())
        for name in row_names()
    ],
)
def test_every_row_holds(name):
    rows = rows_of(name)
    assert rows
    for each in rows:
        assert tuple(each) == KEYS
        assert each["holds"] is not False, each
        assert each["why"]
        assert each["holds"] is True or "absent" in each["why"] or each["published"] is None


def test_a_row_is_judged_by_its_tolerance():
    assert row("a", "b", 1.0, 1.1, 0.2, "c")["holds"] is True
    assert row("a", "b", 1.0, 1.3, 0.2, "c")["holds"] is False
    assert row("a", "b", None, 1.3, None, "c")["holds"] is None
    with pytest.raises(InputError, match="no reproduction named"):
        rows_of("siso-fig-7")
