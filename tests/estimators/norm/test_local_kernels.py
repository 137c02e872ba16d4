"""The compiled loops of the local models against matrices: the plain twin of `estimators.norm.local_kernels`."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.norm.local_fits import SETTLED, STEPS, Band, Spectra, fit_band


def spectra(rng, nu, ny, experiments, samples=240):
    """Lines of a random first-order plant with a transient and noise, whose inputs favour some lines."""
    omega = 2 * np.pi * np.arange(samples // 2 + 1)[:, None] / samples
    complex_normal = lambda *shape: rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    U = (
        complex_normal(len(omega), experiments, nu)
        * (0.2 + np.exp(-(((omega - 1.0) / 0.2) ** 2)))[:, :, None]
    )
    A = 1 - 0.8 * np.exp(-1j * (omega - 1.0))
    gains = rng.standard_normal((ny, nu))
    Y = U @ gains.T / A[:, :, None] + complex_normal(1, experiments, ny) / A[:, :, None]
    return Spectra(U, Y + 0.1 * complex_normal(*Y.shape), samples)


def twin(band, orders):
    """Refined instruments by the formula: every experiment apart, transients taken out by a projection matrix."""
    nb, na, nt = orders
    nu, ny, K, M = band.n_inputs, band.n_outputs, len(band.x), band.experiments
    X = np.vander(band.x, max(orders) + 1, increasing=True)
    inner, model, a = nu * (nb + 1), band.Y, np.zeros(na, complex)
    scale, n = np.ones(ny), ny * nu * (nb + 1) + na

    def without_transients(A):
        q = np.linalg.qr(X[:, : nt + 1] / A[:, None])[0]
        return np.eye(K) - q @ q.conj().T

    P = without_transients(np.ones(K))
    for _ in range(STEPS):
        A = 1 + X[:, 1 : na + 1] @ a
        V = X / A[:, None]
        normal, information, right = (
            np.zeros((n, n), complex),
            np.zeros((n, n), complex),
            np.zeros(n, complex),
        )
        for i in range(ny):
            for m in range(band.U.shape[2]):
                regressors, instruments = np.zeros((2, K, n), complex)
                for j in range(nu):
                    at = i * inner + j * (nb + 1)
                    regressors[:, at : at + nb + 1] = V[:, : nb + 1] * band.U[j, :, m, None]
                instruments[:, : n - na] = regressors[:, : n - na]
                regressors[:, n - na :] = -V[:, 1 : na + 1] * band.Y[i, :, m, None]
                instruments[:, n - na :] = -V[:, 1 : na + 1] * model[i, :, m, None]
                normal += scale[i] * instruments.conj().T @ P @ regressors
                information += scale[i] * instruments.conj().T @ P @ instruments
                right += scale[i] * instruments.conj().T @ P @ (band.Y[i, :, m] / A)
        theta = np.linalg.solve(normal, right)
        change = np.abs(theta[n - na :] - a).max(initial=0.0)
        a = theta[n - na :]
        A = 1 + X[:, 1 : na + 1] @ a
        P = without_transients(A)
        B = theta[: n - na].reshape(ny, nu, nb + 1)
        G = np.einsum("ijp,kp->kij", B, X[:, : nb + 1]) / A[:, None, None]
        errors = np.einsum("kl,ilm->ikm", P, band.Y - np.einsum("kij,jkm->ikm", G, band.U))
        model = band.Y - errors
        noise = np.sum(np.abs(errors) ** 2, axis=(1, 2)) / (M * (K - nt - 1) - n / ny)
        change = max(change, np.abs(noise * scale - 1).max())
        scale = 1 / noise
        if change < SETTLED:
            break
    return theta, information / band.repeats, noise


@pytest.mark.parametrize("orders", [(2, 1, 2), (3, 2, 2), (2, 0, 2)])
@pytest.mark.parametrize(
    "nu, ny, experiments, centre", [(1, 1, 7, 38), (2, 3, 5, 38), (1, 1, 90, 38), (1, 1, 7, 3)]
)
def test_local_kernels_solve_the_equations_of_the_formula(rng, nu, ny, experiments, centre, orders):
    """Also with more experiments than lines times channels, which are compressed, and for a band across 0."""
    band = Band.of(spectra(rng, nu, ny, experiments), centre, 20)
    assert band.U.shape[2] == min(experiments, 41 * (nu + ny))
    found, (theta, information, noise) = fit_band(band, orders), twin(band, orders)
    assert found is not None
    np.testing.assert_allclose(found.theta, theta, atol=1e-9 * np.abs(theta).max())
    np.testing.assert_allclose(found.information, information, atol=1e-9 * np.abs(information).max())
    np.testing.assert_allclose(found.noise, noise, rtol=1e-9)


def test_equations_without_a_solution_are_none():
    band = Band(
        np.zeros((1, 41, 3), complex), np.ones((1, 41, 3), complex), 3, np.linspace(-1, 1, 41), 38, 20, 1.0
    )
    assert fit_band(band, (2, 1, 2)) is None
