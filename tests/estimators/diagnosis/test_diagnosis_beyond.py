"""Effects beyond the case generator's: general springs, hysteresis inside a plant, products, jumps."""

import pytest

from estimators.diagnosis.loop import diagnose
from estimators.diagnosis.policy import Setting
from tests.estimators.diagnosis.case_beyond import BEYOND, draw_beyond

pytestmark = pytest.mark.validate


@pytest.mark.parametrize("key", BEYOND)
def test_the_cause_or_its_nature_is_named(key):
    train, test, order = draw_beyond(key, 1)
    result = diagnose(train, test, Setting(orders=(order,), structure="SISO"))
    assert result.effect == BEYOND[key].cause
    assert result.nature == BEYOND[key].nature
    assert result.rmse_after.value < result.rmse_before.value
