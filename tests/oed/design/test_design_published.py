"""Optimal designs with printed numbers, through the same solver as the spectra: the region is mapped to [0, pi].

Sources: A. C. Atkinson, K. Chaloner, A. M. Herzberg, J. Juritz, "Optimum experimental designs for properties of a
compartmental model", Biometrics 49 (1993) 325-337, tables 4 and 5, as Kirstine.jl's tests quote them; Kirstine.jl's
documentation, "Locally optimal design" (sigmoid Emax); G. Elfving, Annals of Mathematical Statistics 23 (1952) 255-262;
R. K. Mehra, IEEE Transactions on Automatic Control 19 (1974) 753-768, and G. C. Goodwin, R. L. Payne, Dynamic System
Identification (1977), chapter 6, for the linear dynamic ones.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from oed.criteria import c_criterion
from oed.design import InformationMap, autocorrelation_design, information_map, solve_design
from oed.plants.plant import Plant


def _regression(rows: Callable, n: int) -> InformationMap:
    """Independent observations with the gradient rows(omega) (K, n)."""
    return InformationMap(
        tuple(f"p{k}" for k in range(n)),
        1,
        lambda omega: rows(omega)[:, :, None, None].astype(complex),
        lambda omega: np.ones((len(omega), 1, 1), dtype=complex),
        np.zeros((n, n)),
    )


# Theophylline in horses: absorption a, elimination e, scale s; times 0 to 48 hours, on a logarithmic axis.
A, E, S = 4.298, 0.05884, 21.80


def _time(omega: np.ndarray) -> np.ndarray:
    return 1e-3 * (48 / 1e-3) ** (omega / np.pi)


def _compartment(omega: np.ndarray) -> np.ndarray:
    t = _time(omega)
    return np.column_stack([S * t * np.exp(-A * t), -S * t * np.exp(-E * t), np.exp(-E * t) - np.exp(-A * t)])


def _gradient(function: Callable[[np.ndarray], float]) -> np.ndarray:
    p = np.array([A, E, S])
    steps = 1e-6 * p
    return np.array([(function(p + h) - function(p - h)) / (2 * h.max()) for h in np.diag(steps)])


def _peak_time(p: np.ndarray) -> float:
    return float(np.log(p[0] / p[1]) / (p[0] - p[1]))


def _peak_height(p: np.ndarray) -> float:
    t = _peak_time(p)
    return float(p[2] * (np.exp(-p[1] * t) - np.exp(-p[0] * t)))


@pytest.fixture(scope="module")
def compartment():
    return _regression(_compartment, 3)


def test_the_compartment_model_d_optimal(compartment):
    """Table 5 of Atkinson et al.: 0.2288, 1.3886, 18.417 hours with a third each, log det M = 7.3887."""
    design = solve_design(compartment, "D")
    np.testing.assert_allclose(_time(design.spectrum.omega), [0.2288, 1.3886, 18.417], rtol=3e-4)
    np.testing.assert_allclose(design.spectrum.power[:, 0, 0].real, 1 / 3, atol=1e-6)
    assert -3 * np.log(design.loss) == pytest.approx(7.3887, abs=6e-5)


@pytest.mark.parametrize(
    ("what", "times", "weights"),
    [
        ("time of the peak", [0.1793, 3.5671], [0.6062, 0.3938]),
        ("height of the peak", [1.0122], [1.0]),
    ],
)
def test_the_compartment_model_c_optimal(compartment, what, times, weights):
    """Table 4: singular designs, one and two points for three parameters."""
    c = _gradient(_peak_time if what == "time of the peak" else _peak_height)
    design = solve_design(compartment, c_criterion(c))
    strong = design.spectrum.strongest(1e-4)
    assert abs(design.gap) < 1e-6
    np.testing.assert_allclose(_time(strong.omega), times, rtol=3e-3)
    np.testing.assert_allclose(strong.power[:, 0, 0].real / strong.total_power, weights, atol=2e-3)


def test_the_sigmoid_emax_model():
    """Kirstine.jl: e0 = 1, emax = 2, ed50 = 0.4, h = 5 on [0, 1]: 0.00003, 0.32075, 0.48365, 1, a quarter each."""

    def rows(omega: np.ndarray) -> np.ndarray:
        x = np.maximum((1 - np.cos(omega)) / 2, 1e-12)
        up, down = x**5 / (x**5 + 0.4**5), 2 * 0.4**5 / (x**5 + 0.4**5)
        return np.column_stack([np.ones_like(x), up, -up * down * 5 / 0.4, up * down * np.log(x / 0.4)])

    design = solve_design(_regression(rows, 4), "D")
    doses = np.sort((1 - np.cos(design.spectrum.omega)) / 2)
    # A particle swarm of 50 iterations found the printed digits; its second run of 20 is off by 4e-4.
    np.testing.assert_allclose(doses, [3.1e-5, 0.32075, 0.48365, 1], atol=5e-5)
    np.testing.assert_allclose(design.spectrum.power[:, 0, 0].real, 0.25, atol=1e-6)


def test_elfving_ellipse_and_extrapolation():
    """Elfving (1952): the loss is 1 / rho^2, rho the length at which the ray along c leaves the hull of the points."""
    line = _regression(lambda w: np.column_stack([np.ones_like(w), np.cos(w)]), 2)
    # Extrapolation of a straight line to x = 3: the hull is the square |x| <= 1, the ray (1, 3) leaves it at 1 / 3.
    far = solve_design(line, c_criterion([1.0, 3.0]))
    assert far.loss == pytest.approx(9.0, rel=1e-7)
    np.testing.assert_allclose(np.sort(far.spectrum.power[:, 0, 0].real), [1 / 3, 2 / 3], atol=1e-6)
    # Points of an ellipse with half axes 2 and 0.5: every direction is best measured by itself.
    ellipse = _regression(lambda w: np.column_stack([2 * np.cos(w), 0.5 * np.sin(w)]), 2)
    for c in ([1.0, 0.0], [0.0, 1.0], [1.0, 1.0]):
        rho = 1 / np.hypot(c[0] / 2, c[1] / 0.5)
        assert solve_design(ellipse, c_criterion(c)).loss == pytest.approx(1 / rho**2, rel=1e-6)


def test_first_order_plants_have_closed_forms():
    """Static gain of any first-order plant: a constant input, loss lambda (Goodwin and Payne; gain scaling)."""
    plant = Plant([0, 0.3], [1, -0.7])
    assert solve_design(plant, "static-gain").loss == pytest.approx(1.0, rel=1e-7)
    # D-optimal for b / (1 + a z^-1): one line; its frequency by direct search over one line.
    design = solve_design(plant, "D")
    assert len(design.spectrum) == 1
    information = information_map(plant)
    omega = np.linspace(0.01, 3.1, 20001)
    D = information.factor(omega)[..., 0, 0]
    M = np.einsum("kn,km->knm", D, D.conj()).real
    best = int(np.argmax(np.linalg.det(M)))
    assert design.spectrum.omega[0] == pytest.approx(omega[best], abs=2e-4)
    assert design.loss == pytest.approx(np.linalg.det(M[best]) ** -0.5, rel=1e-6)


def test_fir_optima_are_flat_in_every_parametrisation():
    """MOOSE2's own parametrisation: for an FIR model the D- and E-optimal autocorrelation is white (Mehra, 1974)."""
    fir = Plant([0, 1.0, 0.6, 0.3], [1.0])
    for name in ("D", "A", "E"):
        found = autocorrelation_design(fir, name, lags=4)
        expected = {"D": 1.0, "A": 3.0, "E": 1.0}[name]
        assert found.loss == pytest.approx(expected, rel=1e-6)
        np.testing.assert_allclose(found.coefficients[1:3], 0.0, atol=1e-4)
