"""Every input with every estimator that fits it: a number with a status, never an exception."""

from dataclasses import asdict

import numpy as np
import pytest

from benchmarks.campaign.registry import ESTIMATORS, METHODS, Estimate, compatible, method_for, model_orders
from oed.errors import InputError
from oed.experiments import simulated
from oed.plants.named import named_plant
from oed.plants.norms import peak

REFERENCE = named_plant("reference").replace(noise_variance=0.01)
SLOW = ("sequential", "two-stage")


@pytest.mark.parametrize(
    "name", [pytest.param(m, marks=pytest.mark.slow) if m in SLOW else m for m in METHODS]
)
def test_method_and_its_estimators(name):
    """At little noise every estimator that suits the input is within 25 % of the norm."""
    trace = method_for(name, REFERENCE)(
        simulated(REFERENCE), samples=300, iterations=5, rng=np.random.default_rng(0)
    )
    assert trace.usage.experiments == 5
    assert np.isclose(trace.usage.energy, 1500, rtol=1e-9)  # equal budgets
    for estimator, estimate in ESTIMATORS.items():
        if not compatible(name, estimator) or estimator == "pem-selected":
            continue
        found = estimate(trace, REFERENCE)
        assert isinstance(found, Estimate)
        broad = name in ("white", "multisine", "prbs")
        if estimator == "pem" or (broad and estimator in ("fir-known", "frf")):
            assert abs(found.value / peak(REFERENCE).value - 1) < 0.25


def test_order_selection_finds_the_reference_plant():
    trace = method_for("white", REFERENCE)(
        simulated(REFERENCE), samples=300, iterations=3, rng=np.random.default_rng(1)
    )
    found = ESTIMATORS["pem-selected"](trace, REFERENCE)
    assert abs(found.value - peak(REFERENCE).value) < 4 * found.standard_error


def test_own_estimators_belong_to_their_inputs():
    assert compatible("power", "gain")
    assert not compatible("white", "gain")
    assert compatible("white", "pem")
    assert not compatible("white", "bandit")


def test_orders_of_a_plant_as_identify_takes_them():
    assert model_orders(named_plant("reference")) == (2, 2, 1)
    nb, nf, nk = model_orders(named_plant("three-by-two"))
    assert np.shape(nb) == np.shape(nf) == np.shape(nk) == (3, 2)


def test_single_channel_methods_are_refused_for_several():
    with pytest.raises(InputError, match="use procedure-2"):
        method_for("power", named_plant("three-by-two"))


def test_an_iteration_that_the_budget_cut_short_does_not_void_the_own_estimates():
    """3 x 2: an iteration has 7 experiments; of 17, the first 14 count for the own estimators, all for the budget."""
    plant = named_plant("three-by-two").replace(noise_variance=1e-4)
    trace = method_for("procedure-2", plant)(
        simulated(plant), samples=300, iterations=17, rng=np.random.default_rng(0)
    )
    assert trace.usage.experiments == 17
    for name in ("gain", "mu"):
        cut, whole = (asdict(ESTIMATORS[name](t, plant)) for t in (trace.first(14), trace))
        np.testing.assert_equal(
            whole, cut
        )  # errors that are not known are equal too, which Python 3.13 has them not be
        assert 0.3 < ESTIMATORS[name](trace, plant).value / peak(plant).value < 1.2
