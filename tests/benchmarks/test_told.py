"""What every input and estimator is told: declared in one place, and no more than that is handed over."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.campaign.one_part import seed_for
from benchmarks.campaign.registry import (
    ESTIMATORS,
    METHODS,
    Structure,
    Told,
    compatible,
    method_for,
    of_the_iterations,
    tell,
    told,
    words_of,
)
from benchmarks.campaign.settings import Settings
from estimators.pem.choice import from_records
from oed.errors import ExperimentError
from oed.experiments import replayed, simulated
from oed.plants.named import named_plant

SCRIPT = Path(__file__).with_name("recompute_blind.py")
BLIND_INPUTS = ("white", "power", "sequential-selected")
BLIND_ESTIMATORS = ("gain", "corrected", "fir-selected", "fir-regularised", "frf", "pem-selected")


def trace_of(method: str, plant, replicate: int = 0, samples: int = 300, experiments: int = 6):
    experiment = simulated(plant, seed=0, replicate=replicate)
    names = (0, plant.name, method, replicate)
    return method_for(method, plant)(
        experiment, samples=samples, iterations=experiments, rng=seed_for(*names)
    )


def test_the_default_comparison_has_blind_inputs_and_estimators():
    settings = Settings()
    assert set(BLIND_INPUTS) < set(settings.methods)
    assert {"corrected", "fir-selected", "fir-regularised", "pem-selected"} < set(settings.estimators)


@pytest.mark.parametrize("name", [*METHODS, *ESTIMATORS])
def test_what_is_told_is_declared_and_is_all_that_is_handed_over(name):
    entry = METHODS.get(name) or ESTIMATORS[name]
    assert (entry.told is Told.NOTHING) == (entry.details == "")
    assert entry.words in words_of(name)
    handed = tell(named_plant("reference"), entry.told)
    kinds = {Told.NOTHING: [], Told.STRUCTURE: [Structure], Told.PLANT: [type(named_plant("reference"))]}
    assert [type(value) for value in handed] == kinds[entry.told]
    function = entry.build if name in METHODS else entry.estimate
    inspect.signature(function).bind(*([] if name in METHODS else [None]), *handed)


def test_a_structure_holds_no_value_of_a_parameter():
    """Plants of one structure and different values are told as the same."""
    one, other = named_plant("reference"), named_plant("nonminimum-phase")
    (mine,), (theirs,) = tell(one, Told.STRUCTURE), tell(other, Told.STRUCTURE)
    assert (mine.orders, mine.delay) == (theirs.orders, theirs.delay)
    assert mine.taps != theirs.taps  # the length is of the response itself, so that fir-known is told more


def test_what_both_are_told_is_the_larger():
    assert told("white", "pem-selected") is Told.NOTHING
    assert told("white", "pem") is told("sequential", "fir-selected") is Told.STRUCTURE
    assert told("oracle-D", "fir-selected") is Told.PLANT
    assert told("FILE.py:mine") is Told.NOTHING
    assert told("white", "FILE.py:mine") is Told.PLANT
    assert of_the_iterations("power", "corrected")
    assert not of_the_iterations("power", "pem")
    assert not of_the_iterations("white")


@pytest.mark.slow
def test_blind_decisions_are_the_same_without_any_plant(tmp_path):
    """Records in, decision out, in a process of its own; and a column that is told something cannot be had so."""
    plant = named_plant("reference")
    expected = {}
    for method in BLIND_INPUTS:
        trace = trace_of(method, plant)
        u, y = (np.array([getattr(r, side) for r in trace.records]) for side in ("u", "y"))
        seed = json.dumps([0, plant.name, method, 0])
        np.savez(tmp_path / f"{method}.npz", u=u, y=y, kinds=np.array(trace.kinds), seed=seed)
        expected[method] = {
            name: ESTIMATORS[name](trace, plant).value
            for name in BLIND_ESTIMATORS
            if compatible(method, name)
        } | {"applied": trace.usage.energy}
    said = subprocess.run(
        [sys.executable, str(SCRIPT), str(tmp_path), ",".join(BLIND_ESTIMATORS)],
        capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    assert json.loads(said.stdout) == expected
    with pytest.raises(TypeError, match="structure"):
        ESTIMATORS["pem"].estimate(trace)


def test_another_measurement_makes_another_decision():
    """The control of the test above: a replay that differs in its outputs is noticed in the next input asked for."""
    plant = named_plant("reference")
    one, other = trace_of("power", plant, 0), trace_of("power", plant, 1)
    mixed = [a.replace(y=b.y) for a, b in zip(one.records, other.records, strict=True)]
    again = METHODS["power"].build()
    with pytest.raises(ExperimentError, match="differs from that of record 1"):
        again(replayed(other.records), samples=300, iterations=6, rng=seed_for(0, plant.name, "power", 0))
    found = again(replayed(mixed), samples=300, iterations=6, rng=seed_for(0, plant.name, "power", 0))
    assert "differs from that of record 2" in found.message
    assert len(found) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, orders, delay",
    [("reference", 2, 1), ("delay", 2, 5), ("nonminimum-phase", 2, 1), ("peak-at-zero", 1, 1)],
)
def test_orders_and_delay_from_records_alone(name, orders, delay):
    """At little noise the Bayesian criterion finds the orders and the delay of the plant."""
    trace = trace_of("white", named_plant(name).replace(noise_variance=0.1), samples=500, experiments=10)
    form = from_records(trace.records).model.structure
    assert (form.nf[0, 0], form.nk[0, 0]) == (orders, delay)


@pytest.mark.slow
def test_several_channels_need_no_structure_either():
    """3 x 2: sequential design with the order chosen runs, and its estimate holds the norm (it was refused before)."""
    plant = named_plant("three-by-two").replace(noise_variance=0.01)
    trace = trace_of("sequential-selected", plant, samples=200, experiments=5)
    assert {"white", "designed"} == set(trace.kinds)
    found = ESTIMATORS["pem-selected"].estimate(trace)
    from oed.plants.norms import peak

    assert abs(found.value - peak(plant).value) < 4 * found.standard_error
