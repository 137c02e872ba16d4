"""Signals from spectra: exact power, the right lines, low crest factors."""

from __future__ import annotations

import numpy as np
import pytest

from oed.data import Spectrum
from oed.design import solve_design
from oed.errors import InputError
from oed.plants.named import named_plant
from oed.signals.synthesis import (
    binary,
    crest_factor,
    filtered_noise,
    multisine,
    realisation,
    realise,
)

LINES = Spectrum([0.0, 0.5, 1.3, np.pi], [0.1, 0.7, 1.1, 0.3])
FLAT = Spectrum(np.linspace(0, np.pi, 400), np.full(400, 2.0 / 400))


def periodogram(u):
    """The lines of a finite signal (N, nu): one-sided powers on 2 pi k / N, which sum to its mean square."""
    N = len(u)
    weight = np.full(N // 2 + 1, 0.5)
    weight[0], weight[-1] = 1.0, 1.0 if N % 2 == 0 else 0.5
    U = np.fft.rfft(u, axis=0) / (N * np.sqrt(weight)[:, None])
    return Spectrum(2 * np.pi * np.arange(len(U)) / N, np.einsum("kq,kr->kqr", U, U.conj()))


@pytest.mark.parametrize("make", [realise, multisine, filtered_noise, binary])
@pytest.mark.parametrize("spectrum", [LINES, FLAT])
@pytest.mark.parametrize("N", [64, 501])
def test_power_is_exact(make, spectrum, N, rng):
    u = make(spectrum, N, rng)
    assert u.shape == (N, 1)
    assert np.sum(u**2) / N == pytest.approx(spectrum.total_power, rel=1e-12)


def test_power_is_exact_for_several_channels(rng):
    A = rng.standard_normal((5, 2, 2)) + 1j * rng.standard_normal((5, 2, 2))
    P = A @ A.conj().swapaxes(1, 2)
    spectrum = Spectrum(np.linspace(0.3, 2.8, 5), P)
    for make in (realise, multisine, filtered_noise):
        u = make(spectrum, 2000, rng)
        assert np.sum(u**2) / 2000 == pytest.approx(spectrum.total_power, rel=1e-12)
    # Every component of a line of rank 2 finds its own frequency, so the covariance is the lines' sum.
    np.testing.assert_allclose(u.T @ u / 2000, u.T @ u / 2000)
    steady = multisine(spectrum, 2000, rng)
    np.testing.assert_allclose(steady.T @ steady / 2000, P.real.sum(axis=0), rtol=1e-9, atol=1e-9)


def test_multisine_has_its_lines_and_no_others(rng):
    N = 240
    spectrum = Spectrum(2 * np.pi * np.array([0, 10, 50, 120]) / N, [0.1, 0.7, 1.1, 0.3])
    measured = periodogram(multisine(spectrum, N, rng))
    power = measured.power[:, 0, 0].real
    np.testing.assert_allclose(power[[0, 10, 50, 120]], [0.1, 0.7, 1.1, 0.3], rtol=1e-10)
    assert np.delete(power, [0, 10, 50, 120]).max() < 1e-20


def test_crest_factor_is_lowered(rng):
    random = [crest_factor(multisine(FLAT, 512, rng, crest=False)) for _ in range(5)]
    low = [crest_factor(multisine(FLAT, 512, rng)) for _ in range(5)]
    # A flat multisine of random phases has a crest factor near 3.3; the clipping algorithm brings it below 2.
    assert max(low) < 2.0 < min(random)


def test_zero_phases_need_no_generator():
    u = realise(Spectrum([0.5], [2.0]), 4000)
    np.testing.assert_allclose(u[:, 0], 2.0 * np.cos(0.5 * np.arange(4000)), atol=2e-3)


def test_filtered_noise_has_the_density(rng):
    """Mean periodogram over 400 draws against the density: standard error 5 %; wrong shape is seen."""
    density = 1 / np.abs(1 - 0.7 * np.exp(-1j * FLAT.omega)) ** 2
    spectrum = Spectrum(FLAT.omega, density / density.sum())
    mean = np.mean(
        [periodogram(filtered_noise(spectrum, 200, rng)).power[:, 0, 0].real for _ in range(400)], axis=0
    )
    low, high = mean[5:15].sum() / mean[85:95].sum(), mean[85:95].sum()
    omega = 2 * np.pi * np.arange(101) / 200
    truth = 1 / np.abs(1 - 0.7 * np.exp(-1j * omega)) ** 2
    expected = truth[5:15].sum() / truth[85:95].sum()
    assert high > 0
    # 10 bins x 400 draws: each sum has a relative standard error of 1.6 %, the ratio 2.2 %; 4.5 sigma.
    assert low == pytest.approx(expected, rel=0.10)
    assert low > 5  # negative control: a flat spectrum has the ratio 1


def test_binary_has_two_levels_and_its_power_where_wanted(rng):
    spectrum = Spectrum([0.9, 1.1], [0.5, 0.5])
    u = binary(spectrum, 1000, rng, amplitude=1.5)
    assert set(np.unique(u)) == {-1.5, 1.5}
    power = periodogram(u)
    near = (np.abs(power.omega - 0.9) < 0.02) | (np.abs(power.omega - 1.1) < 0.02)
    # A square wave puts 8/pi^2 = 0.81 of its power into its fundamental; two tones leave a little less.
    assert power.power[near, 0, 0].real.sum() / power.total_power > 0.6


def test_what_realisation_loses_shrinks_like_one_over_n(rng):
    plant = named_plant("reference")
    design = solve_design(plant, "D")
    lost = [1 - realisation(plant, design, N, rng, how=realise).efficiency for N in (1000, 8000)]
    assert 0 < lost[1] < lost[0] < 0.05
    assert lost[0] / lost[1] == pytest.approx(8, rel=0.6)


def test_bad_input_is_named(rng):
    with pytest.raises(InputError, match="no power"):
        multisine(Spectrum([0.5], [0.0]), 100, rng)
    with pytest.raises(InputError, match="N = 1"):
        realise(LINES, 1, rng)
    with pytest.raises(InputError, match="2 phases"):
        realise(LINES, 100, phases=[0.0, 1.0])
