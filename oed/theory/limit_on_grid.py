"""The limit spectrum the second way, by the matrix H_d of [S] Sec. 5, and the spectra on the way there."""

import numpy as np
from numpy.typing import NDArray

from oed.data import Spectrum
from oed.errors import InputError
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.plants.systems import as_plant
from oed.theory.limit import LimitSpectrum, centres, check_limit, noise_shape, resolution, solve_excess
from oed.theory.quadrature import Nodes, graded_nodes


def limit_spectrum_on_grid(plant: Plant, points: int = 1000) -> LimitSpectrum:
    """Limit spectrum by the eigenvector of the matrix H_d, as [S] Sec. 5 prints it.

    The grid is w_k = (k - 1/2) pi / n, k = 1..n. It fails where the spectrum is narrower than the grid (the
    excess can even come out negative): it is here as the second, independent way.

    Parameters
    ----------
    plant : Plant
        One input, one output, white noise of positive variance.
    points : int
        n_omega.

    Returns
    -------
    LimitSpectrum
        With the grid as the lines of its spectrum.

    Notes
    -----
    Source: [S] Sec. 5. H_d is diagonal plus one row and one column, so its largest eigenvalue L solves
    1 = (1/n) sum_k lambda_e / (L - |G_k|^2) exactly; a dense eigensolver is the twin in the tests.
    """
    plant = as_plant(plant)
    check_limit(plant)
    if not plant.white_noise:
        raise InputError("H_d of [S] is for white noise; use limit_spectrum for coloured noise.")
    omega = (np.arange(points) + 0.5) * np.pi / points
    gain2 = np.abs(plant.transfer(omega)[:, 0, 0]) ** 2
    variance = float(plant.noise_covariance[0, 0])
    top = float(gain2.max())
    excess = solve_excess(lambda d: float(np.mean(variance / (d + (top - gain2)))), variance)
    Phi = variance / (excess + (top - gain2))
    found = peak(plant)
    return LimitSpectrum(plant, found, top + excess - found.value**2, Spectrum(omega, Phi / points))


def spectra_of_iterations(
    plant: Plant, experiments: int
) -> tuple[Nodes, NDArray[np.float64], NDArray[np.float64]]:
    """Input spectra of the first experiments from a white start, by the recursion of [S] Lemma 6.

    Parameters
    ----------
    plant : Plant
        One input, one output.
    experiments : int
        How many.

    Returns
    -------
    nodes : Nodes
        Frequencies and weights.
    Phi : ndarray
        (experiments, K) densities, each of unit power.
    mu2 : ndarray
        (experiments,) output power of each experiment, the square of [S] (3).
    """
    plant = as_plant(plant)
    top = peak(plant)
    nodes = graded_nodes(centres(plant, top), resolution(plant, top))
    gain2 = np.abs(plant.transfer(nodes.omega)[:, 0, 0]) ** 2
    noise = plant.noise_covariance[0, 0] * noise_shape(plant, nodes.omega)
    Phi = np.ones((experiments, len(gain2)))
    mu2 = np.zeros(experiments)
    for k in range(experiments):
        output = gain2 * Phi[k] + noise
        mu2[k] = nodes.weight @ output
        if k + 1 < experiments:
            Phi[k + 1] = output / mu2[k]
    return nodes, Phi, mu2
