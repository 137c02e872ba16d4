"""Limit spectra: every digit of theory.md sections 1, 2 and 4, order of convergence, several peaks, colour."""

import time
from decimal import Decimal, localcontext
from fractions import Fraction
from functools import reduce

import numpy as np
import pytest

from oed.data import Spectrum
from oed.design import solve_design
from oed.errors import InputError, SolverFailure
from oed.information import information_of_spectrum
from oed.plants.named import named_plant
from oed.plants.norms import gain_gradient
from oed.plants.plant import Plant
from oed.theory import efficiency
from oed.theory.efficiency import losses, losses_of_spectrum, peak_gain_efficiency_by_experiments
from oed.theory.limit import limit_spectrum
from oed.theory.limit_on_grid import limit_spectrum_on_grid, spectra_of_iterations

REFERENCE = named_plant("reference")
TABLE_2 = {  # theory.md section 2: mu^2, E beta_2^2, max Phi, min Phi
    0.01: (5.815593201267, 5.805593201, 57250.2912, 0.0017195227),
    0.1: (5.815611048007, 5.715611048, 5548.95512, 0.0171951746),
    1: (5.818127937783, 4.818127937783, 394.491138, 0.1718773600),
    4: (6.034597847881, 2.034597847881, 18.264438, 0.6628473577),
    9: (9.831919811572, 0.831919811572, 2.2408535, 0.9153882434),
}
TABLE_4 = {  # theory.md section 4: c-efficiency after n = 1, 2, 5, 10, 50, 200 experiments, and in the limit
    0.01: (0.04944, 0.21156, 0.50697, 0.68424, 0.90301, 0.96732, 0.99810),
    0.1: (0.04944, 0.18994, 0.48645, 0.66612, 0.88638, 0.95062, 0.98105),
    1: (0.04944, 0.10965, 0.33171, 0.50952, 0.72562, 0.78548, 0.81125),
    4: (0.04944, 0.07017, 0.12181, 0.17698, 0.26485, 0.28597, 0.29307),
    9: (0.04944, 0.05934, 0.07283, 0.07964, 0.08547, 0.08657, 0.08693),
}


def digits(printed: float) -> float:
    """Half a unit of the last digit printed."""
    text = repr(printed)
    return 0.5 * 10.0 ** -len(text.split(".")[1]) if "." in text else 0.5


@pytest.mark.parametrize("variance", TABLE_2)
def test_limit_spectrum_to_the_printed_digits(variance):
    limit = limit_spectrum(REFERENCE.replace(noise_variance=variance))
    mu2, beta2, top, bottom = TABLE_2[variance]
    assert abs(limit.mu2 - mu2) <= 1e-12
    assert abs(limit.beta2_mean - beta2) <= digits(beta2)
    assert abs(limit.spectrum_max - top) <= digits(top)
    assert abs(limit.spectrum_min - bottom) <= 1e-10
    assert abs(limit.spectrum.total_power - 1) < 1e-12


@pytest.mark.parametrize("variance, tolerance", [(1.0, 0.05), (4.0, 1e-5), (9.0, 1e-6)])
def test_h_d_agrees_where_the_grid_resolves_the_spectrum(variance, tolerance):
    plant = REFERENCE.replace(noise_variance=variance)
    assert np.isclose(
        limit_spectrum_on_grid(plant).mu2_excess, limit_spectrum(plant).mu2_excess, rtol=tolerance
    )


def test_h_d_fails_as_the_noise_vanishes():
    """theory.md section 2: below gamma^2 at variance 0.1 with 1000 lines."""
    assert limit_spectrum_on_grid(REFERENCE.replace(noise_variance=0.1)).mu2_excess < 0
    wrong = limit_spectrum_on_grid(REFERENCE.replace(noise_variance=1e-4)).mu2_excess
    right = limit_spectrum(REFERENCE.replace(noise_variance=1e-4)).mu2_excess
    assert abs(wrong) > 1e6 * right


def test_h_d_is_the_eigenvector_of_the_printed_matrix():
    plant = REFERENCE.replace(noise_variance=4.0)
    limit = limit_spectrum_on_grid(plant, 200)
    omega = limit.spectrum.omega
    gain2 = np.abs(plant.response(omega)[0][:, 0, 0]) ** 2
    H = np.zeros((201, 201))
    H[:200, :200], H[:200, 200], H[200, :200], H[200, 200] = np.diag(gain2), 4.0, gain2 / 200, 4.0
    values, vectors = np.linalg.eig(H)
    k = np.argmax(values.real)
    assert np.isclose(values[k].real, limit.mu2, rtol=1e-12)
    assert np.allclose(
        (vectors[:200, k] / vectors[200, k]).real / 200, limit.spectrum.power[:, 0, 0].real, rtol=1e-9
    )


def test_theorem_9_as_a_slope():
    """theory.md section 1: delta / (2 lambda^2 / H) is 1.003, 1.035, 1.46, 7.9, 28 at .01, .1, 1, 4, 9."""
    H = limit_spectrum(REFERENCE).peak.curvature
    ratio = lambda v: limit_spectrum(REFERENCE.replace(noise_variance=v)).mu2_excess / (2 * v**2 / H)
    for variance, printed in ((0.01, 1.003), (0.1, 1.035), (1, 1.46), (4, 7.9), (9, 28)):
        assert abs(ratio(variance) / printed - 1) < 0.02
    variances = np.array([1e-3, 1e-2])
    excess = [limit_spectrum(REFERENCE.replace(noise_variance=v)).mu2_excess for v in variances]
    slope = np.diff(np.log(excess)) / np.diff(np.log(variances))
    assert abs(slope[0] - 2) < 2e-3  # the next term is of relative order lambda_e


@pytest.mark.parametrize(
    "plant, factor",
    [
        (Plant([0, 0.4], [1, -0.8]), 0.5),  # one peak at 0: delta = lambda^2 / (2 H)
        (Plant([0, 0.4], [1, 0.8]), 0.5),  # one at pi
        (Plant([0, 1, 0, 0, 0, 0.2], [1]), None),
    ],
)
def test_peaks_at_the_ends_and_several_equal_peaks(plant, factor):
    """theory.md section 1: delta = lambda^2/2 (sum over the peaks in (-pi, pi] of H^-1/2)^2."""
    plant = plant.replace(noise_variance=1e-5)
    limit = limit_spectrum(plant)
    count = [
        (1 if w in (0.0, np.pi) else 2) / np.sqrt(H)
        for w, H in zip(limit.peak.frequencies, limit.peak.curvatures, strict=True)
    ]
    expected = 1e-10 / 2 * sum(count) ** 2
    assert np.isclose(limit.mu2_excess, expected, rtol=1e-3)
    if factor is not None:
        assert np.isclose(expected, factor * 1e-10 / limit.peak.curvature)
    else:
        assert len(limit.peak.frequencies) > 1


def test_coloured_noise_fixed_point():
    """Phi = lambda |H|^2 / (mu^2 - |G|^2) reproduces itself under one iteration and has unit power."""
    plant = REFERENCE.replace(noise_num=(1.0, 0.5), noise_den=(1.0, -0.7), noise_variance=0.3)
    limit = limit_spectrum(plant)
    omega = np.linspace(0.05, 3.1, 50)
    G2, H2 = np.abs(plant.response(omega)[0][:, 0, 0]) ** 2, np.abs(plant.noise_response(omega)) ** 2
    Phi = limit.density(omega)
    assert np.allclose((G2 * Phi + 0.3 * H2) / limit.mu2, Phi, rtol=1e-10)
    assert abs(limit.spectrum.total_power - 1) < 1e-12


@pytest.mark.parametrize("variance", TABLE_4)
def test_efficiency_of_the_first_experiments(variance):
    plant = REFERENCE.replace(noise_variance=variance)
    *together, in_the_limit = TABLE_4[variance]
    found = peak_gain_efficiency_by_experiments(plant, 200)[[0, 1, 4, 9, 49, 199]]
    assert np.abs(found - together).max() <= 0.5e-5 + 1e-9
    limit = losses(information_of_spectrum(plant, limit_spectrum(plant).spectrum), gain_gradient(plant))
    assert abs(variance / limit.c - in_the_limit) <= 0.5e-5 + 1e-9


def test_losses_of_the_limit_spectrum():
    """theory.md section 4, second table, column 1: D 0.093712276, A 4.467589962, E 3.373062908, c 1.232664440."""
    found = losses(
        information_of_spectrum(REFERENCE, limit_spectrum(REFERENCE).spectrum), gain_gradient(REFERENCE)
    )
    assert np.allclose(
        [found.D, found.A, found.E, found.c],
        [0.093712276, 4.467589962, 3.373062908, 1.232664440],
        rtol=0,
        atol=6e-10,
    )


def test_recursion_converges_to_the_limit():
    """[S] Theorem 10, in the sup norm."""
    plant = REFERENCE.replace(noise_variance=9.0)
    nodes, Phi, mu2 = spectra_of_iterations(plant, 60)
    limit = limit_spectrum(plant)
    distance = np.abs(Phi - limit.density(nodes.omega)).max(axis=1)
    assert distance[-1] < 1e-6 * distance[0]
    assert np.isclose(mu2[-1], limit.mu2, rtol=1e-6)


@pytest.mark.parametrize(
    "plant, words",
    [
        (named_plant("three-by-two"), ["3 outputs", "2 inputs", "Procedure 2"]),
        (REFERENCE.replace(noise_variance=0), ["noise variance is 0", "positive"]),
    ],
)
def test_refusals(plant, words):
    with pytest.raises(InputError) as caught:
        limit_spectrum(plant)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("gain", [1e3, 1e6, 1e7, 1e9, 1e12])
def test_little_noise_beside_any_gain(gain):
    """g / (z - 0.5): delta = lambda^2 / (2 H) and efficiencies that fall by powers of g, from where they can be computed plainly."""
    first, plant = (Plant([0.0, g], [1.0, -0.5]) for g in (1e3, gain))
    limit = limit_spectrum(plant)
    next_term = 0.5 / gain**2
    assert np.isclose(limit.mu2_excess, (1 + next_term) * 0.5 / limit.peak.curvature, rtol=1e-10, atol=0)
    # away from the peak Phi falls as 1 / g^2, and the gradient with respect to the pole grows as g
    plain, found = (losses_of_spectrum(p, limit_spectrum(p).spectrum) for p in (first, plant))
    for k, power in (("A", 2), ("E", 2), ("D", 0)):
        assert np.isclose(getattr(found, k), getattr(plain, k) * (gain / 1e3) ** power, rtol=1e-5)


def test_the_experiments_are_compared_with_the_optimum_of_their_own_noise():
    """One unknown gain and coloured noise: the optimum is not lambda_e, and no experiment is better than it."""
    coloured = {"noise_num": (1.0, 0.5), "noise_den": (1.0, -0.3), "noise_covariance": 2.0}
    plant = Plant([0, 0.2155, 0.2012, 0, 0.2155, 0.2012], [1, -0.9854, 0.8187], free=("b1",), **coloured)
    optimum = solve_design(plant, "hinf").bound
    assert peak_gain_efficiency_by_experiments(plant, 3).max() > 1, "what it was before"
    assert 0.05 < peak_gain_efficiency_by_experiments(plant, 3, optimum).max() < 1


def test_rows_and_products_give_the_same_losses():
    limit = limit_spectrum(REFERENCE)
    c = gain_gradient(REFERENCE)
    rows, products = (
        losses_of_spectrum(REFERENCE, limit.spectrum, c),
        losses(information_of_spectrum(REFERENCE, limit.spectrum), c),
    )
    assert np.allclose(
        [rows.c, rows.D, rows.A, rows.E], [products.c, products.D, products.A, products.E], rtol=1e-9
    )
    # at little noise the products have lost what the rows keep: the control that the test above can fail
    little = Plant([0.0, 1e9], [1.0, -0.5])
    spectrum = limit_spectrum(little).spectrum
    lost, kept = losses(information_of_spectrum(little, spectrum)).A, losses_of_spectrum(little, spectrum).A
    assert not np.isclose(lost, kept, rtol=0.5)


def test_noise_that_no_double_holds_beside_the_gain():
    with pytest.raises(SolverFailure, match="too little beside the gains"):
        limit_spectrum(Plant([0.0, 1e45], [1.0, -0.5], noise_covariance=1e-90))


def _two_by_two(first: list[float], last: list[float]) -> Plant:
    """Two inputs and outputs, with the denominators of two of the channels."""
    num = [[[0, 1], [0, 2]], [[0, 1], [0, 3]]]
    return Plant(num, [[first, [1]], [[1, -0.2], last]], noise_covariance=[[2.0, 1], [1, 3]])


def test_noise_beyond_every_gain_leaves_white_noise():
    """mu^2 - gamma^2 is then the power of the noise itself, to rounding."""
    plant = Plant([0, 0.2155, 0.2012], [1, -0.9854, 0.8187], noise_covariance=2.0, noise_num=[1, 1e12], noise_den=[1, -0.3],
                  free=["b1"])  # fmt: skip
    limit = limit_spectrum(plant)
    assert np.isclose(limit.mu2_excess, 2 * (1 + (1e12 + 0.3) ** 2 / (1 - 0.09)), rtol=1e-9)


def test_gains_nine_decades_apart_are_a_design_or_a_line():
    """A peak on the last line of a grid leaves no maximum between lines; A has no digits left."""
    assert solve_design(_two_by_two([1, -0.5], [1, 0.999999999]), "hinf").gap < 1e-6
    with pytest.raises(SolverFailure, match="no inverse in double precision"):
        solve_design(_two_by_two([1, 0.999999999], [1, 0.3]), "A")


@pytest.mark.parametrize("gain", [1.0, 1e6, 1e9])
def test_the_bias_of_the_own_estimate_has_its_digits_at_little_noise(gain):
    """sqrt(gamma^2 - noise) - gamma had an error of 4 % at a gain of 1e7 and was 0 from 1e8 on."""
    limit = limit_spectrum(Plant([0, gain], [1, -0.5], noise_covariance=1.0))
    gamma = Fraction(2 * gain)
    square = gamma**2 + Fraction(limit.mu2_excess) - 1
    with localcontext() as context:
        context.prec = 60
        exact = (Decimal(square.numerator) / square.denominator).sqrt() - Decimal(2 * gain)
    assert np.isclose(limit.beta2_bias, float(exact), rtol=1e-9, atol=0)


@pytest.mark.parametrize("free", [("b1",), ("a2", "a1"), ("a2", "b5", "b1"), None])
def test_information_by_differences_of_powers_is_that_of_the_spectrum(free):
    """Whichever parameters are unknown, in whichever order, under coloured noise and with a delay; B and A of different lengths."""
    plant = Plant(
        [0, 0, 0.2, 0.3, 0, -0.4, 0.1],
        [1, -0.98, 0.82],
        noise_num=(1.0, 0.5),
        noise_den=(1.0, -0.3),
        noise_covariance=2.0,
    )
    names = plant.all_names if free is None else tuple(n.replace("b1", "b2") for n in free)
    plant = plant.replace(free=names)
    nodes, Phi, _ = spectra_of_iterations(plant, 3)
    for spectrum, found in zip(Phi, efficiency._informations(plant, nodes, Phi), strict=True):
        assert np.allclose(
            found,
            information_of_spectrum(plant, Spectrum(nodes.omega, nodes.weight * spectrum)),
            rtol=1e-12,
            atol=1e-13,
        )


def test_order_100_takes_seconds():
    """It took 14 s of CPU time, and 22 s and 2 GB with lighter damping: every product of two of the 200 derivatives at each of 200,000 frequencies."""
    rng, angles = np.random.default_rng(0), np.pi * (np.arange(50) + 0.5) / 50
    shuffled = rng.permutation(angles)  # in their order, the partial products would lose all digits
    section = lambda r, w: [1.0, -2 * r * np.cos(w), r * r]
    den, num = (reduce(np.convolve, [section(r, w) for w in shuffled[k:]]) for r, k in ((0.995, 0), (0.6, 1)))
    plant = Plant([0.0, *num], den, noise_covariance=1.0)
    began = time.process_time()
    assert 0 < peak_gain_efficiency_by_experiments(plant, 50)[-1] < 1
    assert time.process_time() - began < 8
