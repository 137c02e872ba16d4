"""Every effect that the generators draw, on two random plants each: detected, named first, removed."""

import numpy as np
import pytest

from tests.estimators.diagnosis.case_table import NAMES, measured, table

pytestmark = pytest.mark.validate


def test_every_effect_is_found_named_and_removed_on_two_random_plants(record_property):
    rows = [row for name in NAMES for row in measured(name, 2201)]
    record_property("table", table(rows))
    print(table(rows))
    assert np.mean([r.detected for r in rows]) >= 26 / 27
    assert np.mean([r.right for r in rows]) >= 23 / 27
    assert np.nanmedian([r.removed for r in rows]) >= 0.9
