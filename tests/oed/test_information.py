"""Fisher information: two ways, additivity, singular cases, invariances."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oed import information
from oed.covariances import covariance_of_factor, real_gram
from oed.data import Spectrum
from oed.errors import InputError, NotIdentifiable
from oed.information import covariance, information_of_signal, information_of_spectrum, null_directions
from oed.plants.named import NAMES, named_plant
from oed.plants.plant import Plant
from oed.theory.efficiency import losses

REFERENCE = named_plant("reference")


def flat_spectrum(points):
    """White noise of unit power as the lines of a midpoint rule."""
    return Spectrum((np.arange(points) + 0.5) * np.pi / points, np.full((points, 1, 1), 1 / points))


def test_white_noise_losses_to_the_printed_digits():
    """theory.md section 4, column white: D, A and E at unit noise variance."""
    found = losses(information_of_spectrum(REFERENCE, flat_spectrum(20000)))
    assert np.allclose(
        [found.D, found.A, found.E], [0.220591954, 1.741356784, 1.169828904], rtol=0, atol=6e-10
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_long_periodic_signal_carries_the_information_of_its_spectrum(name):
    """Over whole periods in steady state the two agree to rounding; the transient is cut off by differencing."""
    plant = named_plant(name)
    period, nu = 64, plant.n_inputs
    rng = np.random.default_rng(5)
    u = np.zeros((period, nu))
    lines = np.arange(1, period // 2)
    power = np.zeros((len(lines), nu, nu), dtype=complex)
    t = np.arange(period)
    for k in lines:
        x = rng.standard_normal(nu) + 1j * rng.standard_normal(nu)
        u += np.real(np.exp(2j * np.pi * k * t / period)[:, None] * x)
        power[k - 1] = np.outer(x, x.conj()) / 2
    settle = int(
        60 + 40 / (1 - max(np.abs(np.roots(den)).max(initial=0) for row in plant.den for den in row))
    )
    repeats = -(-settle // period)
    long, short = np.tile(u, (repeats + 1, 1)), np.tile(u, (repeats, 1))
    per_period = information_of_signal(plant, long) - information_of_signal(plant, short)
    expected = period * information_of_spectrum(plant, Spectrum(2 * np.pi * lines / period, power))
    assert np.abs(per_period - expected).max() <= 1e-6 * np.abs(expected).max()


def test_correlated_noise_weights_the_outputs():
    plant = named_plant("three-by-two")
    L = np.array([[1.0, 0, 0], [0.5, 0.8, 0], [-0.2, 0.1, 1.5]])
    u = np.random.default_rng(1).standard_normal((300, 2))
    mixed = plant.replace(noise_covariance=L @ L.T)
    # the same information by whitening the sensitivities by hand
    from oed.information import signal_gradient

    psi = signal_gradient(plant, u)
    white = np.einsum("pr,tnr->tnp", np.linalg.inv(L), psi)
    assert np.allclose(
        information_of_signal(mixed, u), np.einsum("tnp,tmp->nm", white, white), rtol=1e-10, atol=1e-8
    )


def test_coloured_noise_of_a_signal_and_a_spectrum_agree():
    plant = REFERENCE.replace(noise_num=(1.0, 0.4), noise_den=(1.0, -0.6))
    u = np.random.default_rng(2).standard_normal((40000, 1))
    per_sample = information_of_signal(plant, u) / len(u)
    expected = information_of_spectrum(plant, flat_spectrum(4000))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    # sample spectrum of 40000 samples: relative errors of about 2/sqrt(N) times the resonance's correlation time
    assert np.abs((per_sample - expected) / scale).max() < 0.05


def test_singular_information_names_its_null_directions():
    information = information_of_spectrum(REFERENCE, Spectrum([1.0], [1.0]))
    assert len(null_directions(information, REFERENCE.free)) == 2  # one sinusoid determines two of four
    with pytest.raises(NotIdentifiable, match=r"no information on .*b1.*hold some of these parameters"):
        covariance(information, REFERENCE.free)
    found = losses(information)
    assert np.isinf(found.D)
    assert np.isinf(found.A)


def test_noise_free_outputs_are_refused():
    with pytest.raises(InputError, match="noise covariance is singular"):
        information_of_signal(REFERENCE.replace(noise_variance=0), np.ones(10))


@given(st.floats(0.1, 10), st.floats(0.1, 10))
def test_units_of_input_and_noise(input_factor, noise_factor):
    u = np.random.default_rng(7).standard_normal((50, 1))
    plain = information_of_signal(REFERENCE, u)
    scaled = information_of_signal(REFERENCE.replace(noise_variance=noise_factor), input_factor * u)
    assert np.allclose(scaled, plain * input_factor**2 / noise_factor, rtol=1e-9)


@given(st.permutations(range(2)), st.permutations(range(3)))
def test_relabelling_channels_permutes_the_information(inputs, outputs):
    plant = named_plant("three-by-two")
    relabelled = Plant(
        [[plant.num[i][j] for j in inputs] for i in outputs],
        [[plant.den[i][j] for j in inputs] for i in outputs],
    )
    u = np.random.default_rng(8).standard_normal((80, 2))
    a, b = information_of_signal(plant, u), information_of_signal(relabelled, u[:, list(inputs)])
    assert np.allclose(np.linalg.eigvalsh(a), np.linalg.eigvalsh(b), rtol=1e-8, atol=1e-6)


def test_the_real_part_of_a_gram_matrix(rng):
    """Complex, real, extended and not contiguous factors."""
    F = rng.normal(size=(5, 3)) + 1j * rng.normal(size=(5, 3))
    for factor in (
        F,
        F.T,
        F.real,
        F.astype(np.clongdouble),
        np.moveaxis(np.stack([F, F]), 1, 0).reshape(5, -1),
    ):
        np.testing.assert_allclose(real_gram(factor), (factor @ factor.conj().T).real, rtol=0, atol=1e-14)
        assert real_gram(factor).dtype == factor.real.dtype


@pytest.mark.parametrize("little", [1e-6, 1e-10, 1e-13, 1e-14])
def test_a_direction_that_is_known_a_little_counts(little):
    """By the triangle itself: v1^2 + ((v2 - v1) / little)^2. What is known to 1e-13 was taken for rounding and left out."""
    factor, V = np.array([[1.0, 0.0], [1.0, little]]), np.array([[1.0], [1.0 + 2e-7]])
    found = covariance_of_factor(factor, V)
    assert found is not None
    assert found[0, 0] == pytest.approx(1 + ((V[1, 0] - 1) / little) ** 2, rel=0.05)
    nothing = covariance_of_factor(np.array([[1.0, 0.0], [1.0, 0.0]]), np.ones((2, 1)))
    assert nothing is not None
    assert nothing[0, 0] == pytest.approx(1)  # what is not known at all is not asked for


def test_many_lines_take_the_memory_of_a_few(monkeypatch, rng):
    """150,000 lines in the memory of a few copies of what is at once in it; the parts of a spectrum are its information."""
    plant, lines = named_plant("three-by-two"), 150_000
    power = np.full((lines, 1, 1), 1 / lines) * np.eye(2)
    spectrum = Spectrum(np.sort(rng.uniform(0.01, 3.1, lines)), power)
    tracemalloc.start()
    whole = information_of_spectrum(plant, spectrum)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * 16 * information.ENTRIES  # dG whole is 173 MB, and its copies
    monkeypatch.setattr(information, "ENTRIES", 10**9)
    assert information_of_spectrum(plant, spectrum) == pytest.approx(
        whole, rel=1e-10, abs=1e-12 * np.abs(whole).max()
    )
