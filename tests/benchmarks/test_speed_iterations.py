"""The speed benchmarks of the iterations do the same work as their baselines (the times are not tested)."""

from __future__ import annotations

import numpy as np

from benchmarks.speed.iterations import BENCHMARKS, lfilter_campaign, lfilter_mimo_campaign
from estimators.montecarlo.engine import monte_carlo
from oed.plants.named import named_plant


def test_baseline_and_engine_do_the_same_campaign():
    """Means of beta_2^2 over 150 runs within 5 standard errors at every iteration (false alarm 1e-5)."""
    ours = monte_carlo(named_plant("reference"), 200, 12, 150)
    theirs = lfilter_campaign(200, 12, 150, 1.0)[:, 1:]
    error = np.hypot(ours.error("gain_square")[1:], theirs.std(axis=0, ddof=1) / np.sqrt(150))
    assert (np.abs(ours.mean["gain_square"][1:] - theirs.mean(axis=0)) < 5 * error).all()
    quiet = lfilter_campaign(200, 12, 150, 0.25)[:, 1:]
    assert (np.abs(ours.mean["gain_square"][1:] - quiet.mean(axis=0)) > 5 * error).any()


def test_baseline_and_engine_do_the_same_procedure_2():
    """As above, 3 x 2."""
    plant = named_plant("three-by-two")
    ours = monte_carlo(plant, 100, 6, 128, algorithm="mimo")
    theirs = lfilter_mimo_campaign(plant, 100, 6, 60)
    error = np.hypot(ours.error("gain_square"), theirs.std(axis=0, ddof=1) / np.sqrt(60))
    assert (np.abs(ours.mean["gain_square"] - theirs.mean(axis=0)) < 5 * error).all()
    quiet = lfilter_mimo_campaign(plant.replace(noise_variance=0.1), 100, 6, 60)
    assert (np.abs(ours.mean["gain_square"] - quiet.mean(axis=0)) > 5 * error).any()


def test_memory_does_not_grow_with_the_runs():
    import tracemalloc

    most = []
    for replicates in (64, 640):
        tracemalloc.start()
        monte_carlo(named_plant("reference"), 200, 5, replicates)
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert most[1] < 1.2 * most[0] + 50_000


def test_rows_have_the_keys_of_the_command():
    (row,) = BENCHMARKS["finite-norm"]()
    assert set(row) == {
        "name", "size", "seconds", "baseline", "baseline_seconds", "ratio", "target", "holds", "peak_mb",
    }  # fmt: skip
