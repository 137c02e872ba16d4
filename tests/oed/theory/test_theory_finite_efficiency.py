"""Efficiency of the first experiments at finite N: against simulated runs and against N to infinity."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from estimators.montecarlo.engine import counter_start
from estimators.rules.power import power_iterations
from estimators.rules.trace import run
from oed.errors import InputError
from oed.experiments import simulated
from oed.information import information_of_signal
from oed.plants.named import named_plant
from oed.plants.norms import gain_gradient
from oed.theory.efficiency import losses, peak_gain_efficiency_by_experiments
from oed.theory.finite_efficiency import finite_peak_gain_efficiency


@pytest.mark.slow
def test_mean_information_of_simulated_runs():
    """N = 100, variance 1, 300 runs: within 3 % (1 % is Monte Carlo, the rest of third order).

    Negative control: the theory for N to infinity is off by more than 5 %.
    """
    plant, N, M, R = named_plant("reference", 1.0), 100, 10, 300
    total = np.zeros((M, 4, 4))
    for r in range(R):
        rule = partial(power_iterations, start=counter_start(plant, N, replicate=r))
        rng = np.random.default_rng(r)
        trace = run(rule, simulated(plant, replicate=r), samples=N, experiments=M, rng=rng)
        total += np.cumsum([information_of_signal(plant, record.u) for record in trace.records], axis=0)
    c = gain_gradient(plant)
    measured = np.array([1.0 / ((k + 1) * N * losses(total[k] / R, c).c) for k in range(M)])
    predicted = finite_peak_gain_efficiency(plant, N, M)
    np.testing.assert_allclose(predicted, measured, rtol=0.03)
    infinite = peak_gain_efficiency_by_experiments(plant, M)
    assert np.abs(infinite / measured - 1).max() > 0.05


@pytest.mark.slow
def test_tends_to_the_theory_of_long_experiments_as_one_over_n():
    plant = named_plant("reference", 1.0)
    limit = peak_gain_efficiency_by_experiments(plant, 10)
    off = [np.abs(finite_peak_gain_efficiency(plant, N, 10) / limit - 1).max() for N in (250, 1000)]
    assert off[1] < 0.05
    assert off[0] / off[1] == pytest.approx(4, abs=1)


def test_what_it_is_not_for():
    with pytest.raises(InputError, match="one of each"):
        finite_peak_gain_efficiency(named_plant("avis"), 100, 2)
    with pytest.raises(InputError, match="samples is 5000"):
        finite_peak_gain_efficiency(named_plant("reference"), 5000, 2)
