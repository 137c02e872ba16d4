"""A cell that is charged and discharged by turns: the curve of its charge, from whatever level a record begins."""

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.loop import diagnose
from oed.data import Record
from tests.estimators.diagnosis.case_small import looking_for

NOISE, CAPACITY = 0.003, 400.0
CURVES = "integral_curve", "output_exponential", "output_quadratic", "input_quadratic", "store", "drift"


def cell(samples: int, level: float, seed: int, bend: float) -> Record:
    """Voltage over current, the charge kept within its limits; `bend` of the curve, 0 for a straight one."""
    rng, u, s = np.random.default_rng(seed), [], level
    while len(u) < samples:
        current, hold = rng.choice([-3.0, -2.0, -1.0, 0.0, 1.0, 2.5]), int(rng.integers(5, 40))
        side = next((c for c in (current, -current) if 0.04 < s + c * hold / CAPACITY < 0.95), 0.0)
        part = side + 0.1 * rng.standard_normal(hold)
        u, s = [*u, *part], s + part.sum() / CAPACITY
    u = np.array(u[:samples])
    x = level + np.concatenate(([0.0], np.cumsum(u)[:-1])) / CAPACITY
    open_circuit = 3.3 + 0.5 * x + bend * (0.1 * np.exp(20.0 * (x - 1.0)) - 0.5 * np.exp(-14.0 * x))
    y = open_circuit + 0.02 * u + lfilter([0.0, 0.0015], [1.0, -0.95], u)
    return Record(u, y + NOISE * rng.standard_normal(samples), t0=5000.0 * seed)


@pytest.mark.slow
@pytest.mark.parametrize("bend", [1.0, 0.0])
def test_the_curve_of_a_cell_holds_from_another_level(bend):
    found = diagnose(cell(1500, 0.5, 5, bend), cell(1200, 0.3, 8, bend), looking_for(*CURVES, skip=20))
    if bend:
        assert found.effect == "integrated_input_curve"
        assert found.rmse_after.value < 1.5 * NOISE < 0.3 * found.rmse_before.value
    else:
        assert "integrated_input_curve" not in found.ranked
        assert found.rmse_before.value < 1.5 * NOISE
