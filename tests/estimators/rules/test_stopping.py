"""The stopping rule waits for the transient and stops after it."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from estimators.norm.gains import gain
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.stopping import settled
from estimators.rules.trace import run
from oed.errors import InputError, Status
from oed.experiments import simulated
from oed.plants.named import named_plant


@pytest.mark.parametrize("variance", [0.0, 0.1, 4.0])
def test_stops_after_the_transient(variance):
    plant = named_plant("reference", variance)
    trace = run(
        power_iterations,
        simulated(plant),
        samples=300,
        experiments=2000,
        rng=np.random.default_rng(2),
        stop=settled(),
    )
    assert trace.status is Status.CONVERGED
    assert 21 <= len(trace) < 1500
    if variance < 1:
        assert gain(trace).last == pytest.approx(2.38, abs=0.06)


def test_stops_between_iterations_of_procedure_2():
    plant = named_plant("three-by-two", 0.5)
    trace = run(
        partial(procedure_2, scaling="each"),
        simulated(plant),
        samples=200,
        experiments=7 * 200,
        rng=np.random.default_rng(2),
        stop=settled(window=5),
    )
    assert trace.status is Status.CONVERGED
    assert len(trace) % 7 == 0


def test_budget_comes_first():
    plant = named_plant("reference", 0.1)
    trace = run(
        power_iterations,
        simulated(plant),
        samples=100,
        experiments=15,
        rng=np.random.default_rng(2),
        stop=settled(),
    )
    assert trace.status is Status.BUDGET
    with pytest.raises(InputError, match="window is 2"):
        settled(window=2)
