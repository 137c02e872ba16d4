"""Information additivity (Lemma 13): of adaptive experiments by Monte Carlo."""

import tomllib
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from estimators.montecarlo.additivity import (
    _found_at,
    _p_values,
    additivity_by_monte_carlo,
)
from estimators.rules.inputs import white
from estimators.rules.power import power_iterations
from estimators.rules.trace import Step, run
from oed.data import Record
from oed.errors import InputError, NotIdentifiable
from oed.information import information_of_signal
from oed.plants.named import named_plant

REFERENCE = named_plant("reference")


@pytest.mark.parametrize("variance", [1.0, 9.0])
def test_adaptive_experiments_by_monte_carlo(variance):
    """300 runs of the power iterations, whose inputs depend on the noise; false-alarm rate 1e-3, seed fixed."""
    plant = REFERENCE.replace(noise_variance=variance)
    result = additivity_by_monte_carlo(plant, power_iterations, samples=100, experiments=5, replicates=300)
    assert result, result
    assert 0.22 < result.resolution < 0.24
    assert result.standard_error.min() > 0


def test_negative_control_a_wrong_sum_is_caught():
    """One experiment of five not counted (20 % too little) must fail the same check."""
    count = iter(range(10**9))

    def forgetful(plant, u):
        return (next(count) % 5 != 0) * information_of_signal(plant, u)

    result = additivity_by_monte_carlo(
        REFERENCE, white, samples=100, experiments=5, replicates=150, information=forgetful
    )
    assert not result
    assert "NOT additive" in repr(result)


def test_negative_control_an_input_that_foresees_the_noise_is_caught():
    """Without independence of the noise of experiment k from u^(k) the scores are no martingale differences."""
    from oed.signals.noise import noise_key, standard_noise

    def clairvoyant(experiment, *, samples, iterations, rng):
        replicate = clairvoyant.replicate
        clairvoyant.replicate += 1

        def rule(samples, nu, ny, rng):
            for k in range(iterations):
                e = standard_noise(noise_key(0, REFERENCE.name), replicate, k, samples)
                yield Step(e[::-1] + np.vstack([e[1:], e[:1]]))

        return run(rule, experiment, samples=samples, experiments=iterations, rng=rng)

    clairvoyant.replicate = 0
    result = additivity_by_monte_carlo(REFERENCE, clairvoyant, samples=100, experiments=3, replicates=200)
    assert not result, result


def test_refusals():
    with pytest.raises(InputError, match="replicates is 5"):
        additivity_by_monte_carlo(REFERENCE, white, replicates=5)
    with pytest.raises(InputError, match="resolution is 2"):
        additivity_by_monte_carlo(REFERENCE, white, resolution=2)

    def sinusoid(samples, nu, ny, rng):
        while True:
            yield np.zeros((samples, 1))

    with pytest.raises(NotIdentifiable, match="no information"):
        additivity_by_monte_carlo(REFERENCE, sinusoid, samples=50, experiments=1, replicates=100)


@pytest.mark.parametrize("runs, experiments, n", [(100, 3, 4), (100, 20, 4), (300, 5, 2)])
def test_the_joint_law_is_held_at_its_level(runs, experiments, n, rng):
    """Of 400 draws from the law itself each statistic is below .05 in 5 %: at most 8.6 % (binomial, 1e-3)."""
    drawn = [list(_p_values(rng.standard_normal((runs, experiments, n))).values()) for _ in range(400)]
    assert np.mean(np.array(drawn) < 0.05, axis=0).max() < 0.086


def test_the_resolution_is_found_with_the_power_that_is_promised(rng):
    """Scores whose information is wrong by r in a direction at random: found in 90 % of 300 (83 to 96: binomial, 1e-3)."""
    n, M, R = 3, 4, 400
    r, level = np.sqrt(2 * _found_at(n, 2e-4) / (M * R)), 2e-4
    found = 0
    for _ in range(300):
        v = rng.standard_normal(n)
        v /= np.linalg.norm(v)
        t = rng.standard_normal((R, M, n))
        t = t + (np.sqrt(1 + r) - 1) * (t @ v)[..., None] * v
        found += _p_values(t)["information of an experiment against its scores"] < level
    assert 0.83 < found / 300 < 0.96


@pytest.mark.parametrize("wrong", [0.8, 1.2])
def test_negative_control_an_information_wrong_by_a_fifth_is_caught_at_the_readme_setting(wrong):
    options = {"samples": 50, "experiments": 3, "resolution": 0.3}
    result = additivity_by_monte_carlo(
        REFERENCE, power_iterations, information=lambda p, u: wrong * information_of_signal(p, u), **options
    )
    assert not result, result
    assert additivity_by_monte_carlo(REFERENCE, power_iterations, **options)


def test_negative_control_noise_that_all_experiments_share_is_caught():
    """With white inputs the second moment of the summed scores is right; their sizes go together."""

    def repeated(experiment, *, samples, iterations, rng):
        e = rng.standard_normal((samples, 1))
        inputs = [rng.standard_normal((samples, 1)) for _ in range(iterations)]
        return SimpleNamespace(records=[Record(u, REFERENCE.simulate(u) + e) for u in inputs])

    result = additivity_by_monte_carlo(REFERENCE, repeated, samples=30, experiments=4, replicates=300)
    assert not result
    assert result.p_values["information of an experiment against its scores"] > 1e-3
    assert result.p_values["sizes of the scores of different experiments"] < 1e-4


def test_an_experiment_that_tells_nothing_of_some_parameters_is_no_failure():
    """Every second input is one sinusoid; J_k of rank 2 and whitened scores of the rest are made up, not tested."""

    def alternately(samples, nu, ny, rng):
        while True:
            yield np.sin(0.9 * np.arange(samples))[:, None]
            yield rng.standard_normal((samples, 1))

    assert additivity_by_monte_carlo(REFERENCE, alternately, samples=60, experiments=4, replicates=200)


def test_the_fixture_of_the_plugin(pytester):
    """As a user has it: one test that passes, one whose failure is readable, and the entry point that registers it."""
    pytester.makepyfile("""
        from oed import named_plant
        from oed.information import information_of_signal
        from estimators.rules.power import power_iterations

        OPTIONS = {"samples": 50, "experiments": 3, "replicates": 200}

        def test_right(information_adds_up):
            assert information_adds_up(named_plant("reference"), power_iterations, **OPTIONS).resolution < 0.4

        def test_wrong(information_adds_up):
            half = lambda plant, u: 0.5 * information_of_signal(plant, u)
            information_adds_up(named_plant("reference"), power_iterations, information=half, **OPTIONS)
    """)
    plugin = "estimators.montecarlo.pytest_plugin"
    registered = any(e.value == plugin for e in entry_points(group="pytest11"))
    done = pytester.runpytest_subprocess(*([] if registered else ["-p", plugin]), "-p", "no:cacheprovider")
    done.assert_outcomes(passed=1, failed=1)
    done.stdout.fnmatch_lines(["*Lemma 13 does not hold of reference*", "*information of an experiment*<-*"])
    told = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())
    assert told["project"]["entry-points"]["pytest11"] == {"oed": plugin}
