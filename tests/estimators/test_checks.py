"""Information additivity (Lemma 13): of spectra, of records, and of adaptive experiments by Monte Carlo."""

import numpy as np
import pytest

from estimators.montecarlo.additivity import (
    additivity_by_monte_carlo,
    additivity_of_records,
    additivity_of_spectra,
)
from estimators.rules.inputs import white
from estimators.rules.power import power_iterations
from estimators.rules.trace import Step, run
from oed.data import Spectrum
from oed.errors import InputError, NotIdentifiable
from oed.information import information_of_signal
from oed.plants.named import NAMES, named_plant

REFERENCE = named_plant("reference")


@pytest.mark.parametrize("name", NAMES)
def test_spectra(name):
    plant = named_plant(name)
    rng = np.random.default_rng(1)
    spectra = []
    for _ in range(3):
        x = rng.standard_normal((6, plant.n_inputs, 1)) + 1j * rng.standard_normal((6, plant.n_inputs, 1))
        spectra.append(Spectrum(np.sort(rng.uniform(0.1, 3.0, 6)), x @ np.conj(np.swapaxes(x, 1, 2))))
    result = additivity_of_spectra(plant, spectra)
    assert result, result


@pytest.mark.parametrize("name", ["reference", "delay", "three-by-two"])
def test_records_of_different_lengths(name):
    plant = named_plant(name)
    rng = np.random.default_rng(2)
    result = additivity_of_records(plant, [rng.standard_normal((n, plant.n_inputs)) for n in (50, 120, 80)])
    assert result, result


def test_records_in_coloured_noise():
    plant = REFERENCE.replace(noise_num=(1.0, 0.3), noise_den=(1.0, -0.5))
    rng = np.random.default_rng(3)
    result = additivity_of_records(plant, [rng.standard_normal(60), rng.standard_normal(90)])
    assert result, result


@pytest.mark.parametrize("variance", [1.0, 9.0])
def test_adaptive_experiments_by_monte_carlo(variance):
    """1000 runs of the power iterations, whose inputs depend on the noise; false-alarm rate 1e-3, seed fixed."""
    plant = REFERENCE.replace(noise_variance=variance)
    result = additivity_by_monte_carlo(plant, power_iterations, samples=100, experiments=5, replicates=1000)
    assert result, result
    assert result.standard_error.min() > 0


def test_negative_control_a_wrong_sum_is_caught():
    """One experiment of five not counted (20 % too little) must fail the same check."""
    count = iter(range(10**9))

    def forgetful(plant, u):
        return (next(count) % 5 != 0) * information_of_signal(plant, u)

    result = additivity_by_monte_carlo(
        REFERENCE, white, samples=100, experiments=5, replicates=1000, information=forgetful
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
    result = additivity_by_monte_carlo(REFERENCE, clairvoyant, samples=100, experiments=3, replicates=600)
    assert not result, result


def test_refusals():
    with pytest.raises(InputError, match="replicates is 5"):
        additivity_by_monte_carlo(REFERENCE, white, replicates=5)
    with pytest.raises(InputError, match="at least two"):
        additivity_of_spectra(REFERENCE, [])

    def sinusoid(samples, nu, ny, rng):
        while True:
            yield np.zeros((samples, 1))

    with pytest.raises(NotIdentifiable, match="no information"):
        additivity_by_monte_carlo(REFERENCE, sinusoid, samples=50, experiments=1, replicates=100)
