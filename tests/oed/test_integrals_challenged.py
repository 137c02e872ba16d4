"""Constants too small for the problem: integrals of white noise, spectra of a shape, norms, limits and masks beside sharp resonances.

Hard random plants as in `test_certificates_challenged.py`, against dense sums (tests/oracles/certificates.py) and quadrature.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, quad_vec

from oed.design import (
    autocorrelation_design,
    autoregressive_design,
    basis_design,
    masked_design,
    solve_design,
)
from oed.design.problem.grid import frequency_grid
from oed.design.problem.information_maps import information_map
from oed.design.problem.white import mean_information
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.theory.limit import limit_spectrum
from tests.oed.test_certificates_challenged import WITHIN
from tests.oracles.certificates import Challenge, dense_grid, gradient, hard_plant


@pytest.mark.parametrize("radius", [0.99, 0.9999, 0.999999])
def test_integrals_of_white_noise(radius):
    """The mean information of 1 / A is exact: its last entry is that of an AR(4) process by Lyapunov's equation."""
    from scipy.linalg import solve_discrete_lyapunov

    pole = radius * np.exp(1.1j)
    A = np.poly([pole, pole.conjugate()]).real
    plant = Plant([[[0, 1.0]]], [[A]])
    found = mean_information(information_map(plant))
    AA = np.convolve(A, A)
    F = np.vstack([-AA[1:], np.eye(4)[:-1]])
    if radius < 0.9999:
        exact = solve_discrete_lyapunov(F, np.outer(np.eye(4)[0], np.eye(4)[0]))[0, 0]
        assert found[1, 1] == pytest.approx(exact, rel=1e-6)
    one = np.vstack([-A[1:], np.eye(2)[:-1]])
    exact = solve_discrete_lyapunov(one, np.outer(np.eye(2)[0], np.eye(2)[0]), method="direct")[0, 0]
    assert found[0, 0] == pytest.approx(exact, rel=1e-8)


def sharp(radius):
    pole = radius * np.exp(0.7j)
    return Plant([[[0, 0.2, 0.1]]], [[np.poly([pole, pole.conjugate()]).real]])


@pytest.mark.parametrize("kind", ["basis", "autoregressive", "autocorrelation"])
def test_spectra_of_a_shape_beside_a_sharp_resonance(kind):
    """Poles of radius .9999: 4096 (or 32768) equal cells give another information than the density has."""
    plant = sharp(0.9999)
    if kind == "basis":
        found = basis_design(plant, "D")
        edges = np.linspace(0, np.pi, 21)
        density = lambda w: np.interp(
            np.searchsorted(edges, w, "right") - 1, range(20), found.coefficients * 20
        )
        inner = edges
    elif kind == "autoregressive":
        found = autoregressive_design(plant, "D", order=2)
        free = lambda w: 1 / np.abs(np.polyval(found.coefficients[::-1], np.exp(-1j * w))) ** 2
        total = quad(free, 0, np.pi, limit=500)[0] / np.pi
        density, inner = (lambda w: free(w) / total), np.linspace(0, np.pi, 40)
    else:
        found = autocorrelation_design(plant, "D", lags=5)
        r = found.coefficients
        density = lambda w: r[0] + 2 * np.cos(np.outer(np.atleast_1d(w), np.arange(1, 6))) @ r[1:]
        inner = np.linspace(0, np.pi, 40)

    def told(omega):
        d = gradient(plant, np.array([omega]))[0, :, 0, 0]
        return np.outer(d, d.conj()).real.ravel() * np.maximum(np.squeeze(density(omega)), 0)

    points = np.union1d(
        inner, 0.7 + 1e-4 * np.concatenate([-(3.0 ** np.arange(9)), [0], 3.0 ** np.arange(9)])
    )
    parts = [quad_vec(told, a, b, epsrel=1e-10)[0] for a, b in pairwise(points)]
    M = np.sum(parts, axis=0).reshape(4, 4) / np.pi
    assert found.loss == pytest.approx(np.exp(-np.linalg.slogdet(M)[1] / 4), rel=1e-5)
    assert solve_design(plant, "D").bound <= found.loss


def test_a_resonance_that_nobody_stated_is_seen():
    """An object with only `response`: the grid finds its poles of radius .9999 by itself."""

    class Silent:
        response = staticmethod(lambda omega: sharp(0.9999).response(omega))

    stated, silent = solve_design(sharp(0.9999), "D"), solve_design(Silent(), "D")
    assert silent.loss == pytest.approx(stated.loss, rel=1e-6)
    assert silent.bound == pytest.approx(stated.bound, rel=1e-6)
    assert len(frequency_grid(information_map(Silent()), ((0.0, np.pi),), 400)) > 420


@pytest.mark.parametrize("seed", range(8))
def test_norms_of_hard_plants(seed):
    plant = hard_plant(np.random.default_rng(seed), channels=1 + seed % 3, most=20 if seed % 3 == 0 else 4)
    top = peak(plant)
    grid = dense_grid(plant)
    z = np.exp(-1j * grid)
    G = np.empty((len(grid), plant.n_outputs, plant.n_inputs), dtype=complex)
    for i, row in enumerate(plant.den):
        for j, A in enumerate(row):
            bottom = np.prod(1 - np.roots(A)[:, None] * z, axis=0) if len(A) > 1 else 1.0
            G[:, i, j] = np.polyval(plant.num[i][j][::-1], z) / bottom
    dense = np.linalg.norm(G, 2, axis=(1, 2)).max()
    assert dense <= top.upper_bound * (1 + 1e-7)
    assert top.value >= dense * (1 - 1e-7)
    assert top.value <= dense * (1 + 1e-3)


@pytest.mark.parametrize("seed", range(8))
def test_limit_spectra_of_hard_plants(seed):
    """(1/2pi) int Phi dw = 1 by sums on a grid around every pole and peak, where the spectrum is not too sharp for it."""
    plant = hard_plant(np.random.default_rng(seed), most=10)
    gain = peak(plant)
    plant = plant.replace(noise_covariance=10 * gain.value**2)
    found = limit_spectrum(plant)
    points = np.concatenate(
        [
            [0, np.pi],
            *(
                abs(np.angle(p)) + np.array([-1, 1])[:, None] * (1 - abs(p)) * np.geomspace(1e-3, 1e4, 60)
                for p in [*np.roots(plant.den[0][0]), *(1 - 1e-6) * np.exp(1j * np.array(gain.frequencies))]
            ),
        ],
        axis=None,
    )
    edges = np.unique(points[(points >= 0) & (points <= np.pi)])
    x, w = np.polynomial.legendre.leggauss(12)
    half = np.diff(edges)[:, None] / 2
    omega = (edges[1:] + edges[:-1])[:, None] / 2 + half * x
    G = np.abs(plant.response(omega.ravel())[0][:, 0, 0]) ** 2
    phi = plant.noise_covariance[0, 0] / (found.mu2 - G)
    assert float((half * w).ravel() @ phi) / np.pi == pytest.approx(1, rel=1e-6)


@pytest.mark.parametrize("seed", [3, 4])
def test_masks_on_hard_plants(seed):
    """Loss from the lines by the dense oracle's gradient; the bound against spectra on the dense grid within the mask."""
    rng = np.random.default_rng(seed)
    plant = hard_plant(rng, most=4)
    height = 10 ** rng.uniform(0.1, 2)
    design = masked_design(plant, "D", input_mask=lambda w: np.full(w.shape, height))
    oracle = Challenge(plant)
    assert design.loss == pytest.approx(oracle.loss("D", oracle.information(design.spectrum)), rel=WITHIN)
    grid = oracle.omega
    cell = np.gradient(grid) / np.pi
    M = oracle.information(design.spectrum)
    # The dense grid's own knapsack at the design's price: no admissible density tells more, to the accuracy of its cells.
    price = np.sum(np.abs(np.linalg.solve(np.linalg.cholesky(M), oracle.D[:, :, 0, 0].T)) ** 2, axis=0)
    order = np.argsort(-price)
    cap = height * cell[order]
    used = np.clip(1 - np.concatenate([[0.0], np.cumsum(cap)[:-1]]), 0, cap)
    assert used @ price[order] <= oracle.n * (1 + 1e-2)
    assert design.gap < 2e-6
