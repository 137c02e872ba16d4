"""oed.theory against the oracles: 50-digit quadrature, dense H_d, recursions on the oracle's own nodes."""

from __future__ import annotations

import numpy as np
import pytest

from oed.information import information_of_spectrum
from oed.plants.named import named_plant
from oed.plants.norms import gain_gradient
from oed.plants.plant import Plant
from oed.theory.efficiency import losses, peak_gain_efficiency_by_experiments
from oed.theory.limit import limit_spectrum
from oed.theory.limit_on_grid import limit_spectrum_on_grid, spectra_of_iterations
from tests.oracles import designs, information
from tests.oracles import limit_spectrum as oracles

NAMES = ("reference", "two-peaks", "peak-at-zero", "peak-at-pi", "delay", "nonminimum-phase", "bandit-fir")


def coefficients(plant):
    return list(map(float, plant.num[0][0])), list(map(float, plant.den[0][0]))


@pytest.mark.parametrize("variance", [1e-4, 0.1, 4.0])
@pytest.mark.parametrize("name", NAMES)
def test_limit_spectrum(name, variance) -> None:
    plant = named_plant(name, variance)
    oracle = oracles.solve(*coefficients(plant), variance)
    found = limit_spectrum(plant)
    # the docstring promises 9 digits at delta / gamma^2 = 1e-12; 1e-4 of noise gives 1e-10 to 1e-12 on these plants
    assert found.mu2_excess == pytest.approx(oracle.delta, rel=1e-9, abs=0)
    assert found.mu2 == pytest.approx(oracle.mu2, rel=1e-13)
    # gamma^2 - lambda_e + delta is exact to rounding of gamma^2, not of the difference
    assert found.beta2_mean == pytest.approx(oracle.beta2_mean, abs=1e-12 * oracle.mu2)
    assert found.spectrum_max == pytest.approx(oracle.largest, rel=1e-9)
    assert found.spectrum_min == pytest.approx(oracle.smallest, rel=1e-9, abs=0)
    assert found.spectrum.total_power == pytest.approx(1.0, rel=1e-9)


def test_limit_spectrum_of_order_20() -> None:
    plant = named_plant("order-20", 1.0)
    oracle = oracles.solve(*coefficients(plant), 1.0, grid=800)
    assert limit_spectrum(plant).mu2_excess == pytest.approx(oracle.delta, rel=1e-7, abs=0)


def test_two_and_four_equal_peaks() -> None:
    """G(z^2) and G(z^4) have the delta of G; equal peaks are the hard case of dividing roots out."""
    num, den = coefficients(named_plant("reference"))
    for times in (2, 4):
        spread = [np.kron(c, np.r_[1.0, np.zeros(times - 1)])[: 1 - times] for c in (num, den)]
        for variance in (1e-3, 1.0):
            plant = Plant(*spread, noise_covariance=variance)
            delta = oracles.solve(num, den, variance).delta
            found = limit_spectrum(plant)
            assert len(found.peak.frequencies) == times
            # the peaks' heights agree only to rounding of gamma^2 = 5.8: 2e-15 on top of delta
            assert found.mu2_excess == pytest.approx(delta, rel=1e-8, abs=1e-14)


@pytest.mark.parametrize("name", ["reference", "two-peaks", "peak-at-pi"])
def test_density(name) -> None:
    plant = named_plant(name, 0.1)
    oracle = oracles.solve(*coefficients(plant), 0.1)
    at = np.linspace(0, len(oracle.omega) - 1, 40).astype(int)
    # the nodes closest to a peak are given as omega, a rounded number: H omega eps / (2 delta) of the density
    assert limit_spectrum(plant).density(oracle.omega[at]) == pytest.approx(oracle.spectrum[at], rel=1e-7)


def test_on_grid_is_the_dense_eigenproblem() -> None:
    for variance in (0.1, 4.0):
        plant = named_plant("reference", variance)
        found = limit_spectrum_on_grid(plant, 300)
        gain2 = np.abs(plant.response(found.spectrum.omega)[0][:, 0, 0]) ** 2
        mu2, spectrum = oracles.discretised(gain2, variance)
        assert found.mu2 == pytest.approx(mu2, rel=1e-11)
        values = found.spectrum.power[:, 0, 0].real * 300
        assert values == pytest.approx(spectrum, rel=1e-6)  # eigenvectors of a 301 x 301 nonsymmetric matrix


@pytest.mark.parametrize("name, variance", [("reference", 0.01), ("reference", 4.0), ("peak-at-zero", 1.0)])
def test_iterated_spectra_and_efficiency(name, variance) -> None:
    plant = named_plant(name, variance)
    s = oracles.solve(*coefficients(plant), variance)
    g = designs.atoms(([[coefficients(plant)[0]]], [[coefficients(plant)[1]]]), s.omega)
    gain2 = np.abs(plant.response(s.omega)[0][:, 0, 0]) ** 2
    spectra = oracles.iterated(gain2, s.weights, variance, 40)
    _, _, mu2 = spectra_of_iterations(plant, 40)
    assert mu2 == pytest.approx([s.weights @ (gain2 * x) + variance for x in spectra], rel=1e-11)
    c = gain_gradient(plant)
    total, expected = np.zeros((len(c), len(c))), []
    for n, spectrum in enumerate(spectra, start=1):
        total = total + designs.of_atoms(g, s.weights * spectrum) / variance
        expected.append(variance / (c @ np.linalg.solve(total / n, c)))
    # finite differences (1e-9) times the condition of the information
    assert peak_gain_efficiency_by_experiments(plant, 40) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("variance", [0.01, 1.0, 9.0])
def test_losses_of_the_limit(variance) -> None:
    plant = named_plant("reference", variance)
    s = oracles.solve(*coefficients(plant), variance)
    matrix = designs.of_atoms(designs.atoms(([[coefficients(plant)[0]]], [[coefficients(plant)[1]]]), s.omega), s.weights * s.spectrum)  # fmt: skip
    c = information.peak_gradient(([[coefficients(plant)[0]]], [[coefficients(plant)[1]]]))
    found = losses(information_of_spectrum(plant, limit_spectrum(plant).spectrum) * variance, c)
    for criterion in "DAEc":
        assert getattr(found, criterion) == pytest.approx(designs.loss(criterion, matrix, c), rel=1e-6)


# Poles within .0005 of the circle; delta / gamma^2 from 1e-12 to 1e-17, where double precision has nothing left of mu^2 - gamma^2.
SHARP = [
    ([0.0, 0.15294667794337813, 0.7890022451051026], [1.0, -1.5805005912363947, 0.9698451764651316], 0.12),
    ([0.0, -0.0203674995, 0.3086079140, -0.4772951091], [1.0, -1.8928689259495, 0.9847929948240811], 0.053),
    ([0.8791881264205803], [1.0, -1.7019402547412794, 0.9994857881825339], 480.0),
]


@pytest.mark.parametrize("num, den, variance", SHARP)
def test_sharp_peaks_at_little_noise(num, den, variance) -> None:
    plant = Plant(num, den, noise_covariance=variance)
    oracle = oracles.solve(num, den, variance, grid=1500)
    # 7 digits: gamma^2 |A|^2 - |B|^2 is a small difference of coefficients where A nearly vanishes
    assert limit_spectrum(plant).mu2_excess == pytest.approx(oracle.delta, rel=1e-7, abs=0)
