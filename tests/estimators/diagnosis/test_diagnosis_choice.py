"""Linear candidates are compared with what the record cannot show charged: poles slower than a block, answers that hang on one."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnosis.baseline import blocks_of
from estimators.diagnosis.baseline.choice import Candidate, Trial, simplest, tried, undetermined
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.baseline.regression import Arx
from oed.data import Record


def test_models_that_differ_without_a_block_must_be_better_by_what_a_simpler_may_cost():
    """A resonance at half the sampling rate that the input hardly reaches, against the same model without it."""
    rng = np.random.default_rng(3)
    ringing = [
        LinearModel(np.convolve([1.0, -0.8], [1.0, 0.97]), b * np.ones((1, 2))) for b in (0.19, 0.2, 0.21)
    ]
    settled = [LinearModel(np.array([1.0, -0.8]), b * np.ones((1, 1))) for b in (0.1995, 0.2, 0.2005)]
    record = Record(rng.standard_normal(300), rng.standard_normal(300))
    spread = [undetermined(models, [record]) for models in (ringing, settled)]
    assert spread[0] > 20 * spread[1] > 0
    form = Arx(1, 1, (0,), False)
    trials = [
        Trial(Candidate("OE", "", size, [], form), [], square * np.ones(20), False, False, each)
        for size, square, each in ((4, 1e-3, spread[0]), (5, 1.02e-3, 0.0))
    ]
    assert simplest(trials).candidate.size == 5
    assert simplest([replace(t, spread=0.0) for t in trials]).candidate.size == 4


@pytest.mark.parametrize(("size", "taken"), [(6, True), (14, False)])
def test_a_model_of_a_quarter_of_the_parameters_may_cost_twice_as_much(size: int, taken: bool) -> None:
    """A boat: 27 parameters were 4 % better than 6 on unused blocks, well within the error, and 45 % worse on the rest of the day."""
    form, rng = Arx(1, 1, (0,), False), np.random.default_rng(0)
    trial = lambda size, squares: Trial(Candidate("OE", "", size, [], form), [], squares, False, False)
    squares = rng.uniform(0.2, 1.8, 20)
    other = squares * (1.0 + rng.uniform(-0.7, 0.7, 20))
    many, few = trial(27, squares / squares.mean()), trial(size, 1.035**2 * other / other.mean())
    assert (simplest([many, few]) is few) is taken


def test_a_pole_that_outlives_the_record_must_gain_twice_what_a_slow_one_must():
    """Gyroscopes to a tilt: a pole at 1.00000 was 1.5 times better on unused blocks and twice as bad on the test record."""
    form = Arx(1, 1, (0,), False)
    trial = lambda size, error, *slow: Trial(
        Candidate("OE", "", size, [], form), [], error**2 * np.ones(20), *slow
    )
    quick, slow, endless = trial(2, 1.0, False, False), (True, False), (True, True)
    for error, kind, taken in (
        (0.68, slow, True),
        (0.68, endless, False),
        (0.48, endless, True),
        (0.75, slow, False),
    ):
        assert (simplest([quick, trial(4, error, *kind)]).candidate.size == 4) is taken
    record = Record(np.ones(500), np.ones(500))
    for radius, kind in ((0.98, (False, False)), (0.995, slow), (0.999, endless)):
        models = [LinearModel(np.array([1.0, -radius]), np.full((1, 1), 1.0 - radius))] * 6
        found = tried(
            Candidate("OE", "", 2, models, form),
            [record],
            0,
            blocks_of([record], 5, 20, 0),
            Prior(1.0, 0.5 ** np.arange(8), 1.0),
        )
        assert found is not None
        assert (found.slow, found.endless) == kind
