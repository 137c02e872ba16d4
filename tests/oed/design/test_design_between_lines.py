"""G and I over a whole band: against Kiefer and Wolfowitz, dense grids and scipy's quadrature, with 60 lines as the control."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad_vec

from oed.criteria import a_criterion, g_criterion
from oed.design import robust_design, solve_design
from oed.errors import InputError
from oed.plants.named import named_plant
from tests.oed.design.test_design_random import random_plant


def plant_of(name):
    plant = named_plant("reference")
    if name == "reference":
        return plant
    radius, angle = {"sharp": (0.995, 0.7), "needle": (0.9999, 2.1)}[name]
    pole = radius * np.exp(1j * angle)
    return plant.replace(den=[[np.poly([pole, pole.conjugate()]).real]])


def gradient(plant, omega):
    """dG (K, n, ny, nu) by the quotient rule, entry by entry: d/db = z^-k / A, d/da = -B z^-k / A^2."""
    z = np.exp(-1j * np.asarray(omega))
    columns = []
    for i, row in enumerate(plant.den):
        for j, A in enumerate(row):
            B = plant.num[i][j]
            bottom, top = np.polyval(A[::-1], z), np.polyval(B[::-1], z)
            for k, slope in [(k, 1 / bottom) for k in range(np.flatnonzero(B)[0], len(B))] + [
                (k, -top / bottom**2) for k in range(1, len(A))
            ]:
                columns.append(np.zeros((len(z), plant.n_outputs, plant.n_inputs), dtype=complex))
                columns[-1][:, i, j] = slope * z**k
    return np.stack(columns, axis=1)


def response_variance(plant, design, low=0.0, high=np.pi):
    """The largest variance of the response on a grid of its own, information and response computed here; white noise."""
    grid = np.linspace(low, high, 20_001)
    for den in (den for row in plant.den for den in row):
        for pole in np.roots(den):
            near = abs(np.angle(pole)) + (1 - abs(pole)) * np.linspace(-5, 5, 4001)
            grid = np.union1d(grid, near[(near >= low) & (near <= high)])
    lines = gradient(plant, design.spectrum.omega)
    noise = np.linalg.inv(plant.noise_covariance)
    M = np.einsum(
        "kipq,kqr,kjsr,ps->ij", lines, design.spectrum.power, lines.conj(), noise, optimize=True
    ).real
    flat = gradient(plant, grid).reshape(len(grid), len(M), -1)
    return np.einsum("kns,nm,kms->k", flat.conj(), np.linalg.inv(M), flat, optimize=True).real.max()


@pytest.mark.parametrize("name", ["reference", "sharp", "needle"])
def test_the_worst_variance_is_the_number_of_parameters(name):
    """Kiefer and Wolfowitz (1960): one output, white noise, power limited only: the G optimum is n, and the D design has it.

    The control: 60 lines in [0, pi] report 3.904 and 1.66 for the first two.
    """
    plant = plant_of(name)
    design = solve_design(plant, "G")
    assert design.status.ok
    assert design.loss == pytest.approx(4.0, rel=1e-7)
    assert 4.0 * (1 - 1e-7) <= design.bound <= 4.0 * (1 + 1e-9)
    assert response_variance(plant, design) == pytest.approx(4.0, rel=1e-5)
    dG = plant.response(np.linspace(0, np.pi, 60))[1][:, :, 0, 0]
    sampled = solve_design(plant, g_criterion(np.stack([dG.real, dG.imag], axis=2)))
    assert sampled.loss < 3.95
    assert response_variance(plant, sampled) > 4.01


def test_g_over_a_band_and_several_channels():
    """The loss is the maximum on a dense grid; half the band, a limit on the output, and 3 x 2 channels."""
    plant = named_plant("reference")
    whole = solve_design(plant, "G")
    part = solve_design(plant, "G:0.2:0.8", output_power=1.0, input_power=0.5)
    assert part.status.ok
    assert part.loss == pytest.approx(response_variance(plant, part, 0.2, 0.8), rel=1e-6)
    assert part.loss < part.criterion.loss(part.map.of_spectrum(whole.spectrum)) * 10
    assert whole.efficiency(part.spectrum) < 1
    several = named_plant("three-by-two")
    design = solve_design(several, "G", tolerance=1e-5)
    assert design.status.ok
    assert design.loss == pytest.approx(response_variance(several, design), rel=1e-5)


@pytest.mark.parametrize("name", ["reference", "sharp", "needle"])
def test_the_mean_variance_is_an_integral(name):
    plant = plant_of(name)
    design = solve_design(plant, "I")
    near = np.angle(np.roots(plant.den[0][0])[0])

    def squares(omega):
        d = plant.response(np.array([omega]))[1][0, :, 0, 0]
        return np.outer(d, d.conj()).real

    W = quad_vec(squares, 0, np.pi, points=[near], epsrel=1e-10, limit=20_000)[0] / np.pi
    assert design.loss == pytest.approx(np.trace(W @ np.linalg.inv(design.information)), rel=1e-6)
    assert design.loss == pytest.approx(solve_design(plant, a_criterion(4, W)).loss, rel=1e-6)
    assert design.status.ok


def test_g_is_refused_where_its_sample_would_stand_for_the_band():
    plant = named_plant("reference")
    with pytest.raises(InputError, match="available in solve_design"):
        robust_design([plant, plant], "G")
    with pytest.raises(InputError, match="available in solve_design"):
        solve_design(plant, "G", solver="clarabel")
    with pytest.raises(InputError, match="0 <= low < high"):
        solve_design(plant, "I:2:1")


def test_the_condition_number_is_bounded_between_lines():
    """Order 6 with a sharp pole: the first round's grid missed a maximum, and its bound was 6e-5 above a loss found later."""
    rng = np.random.default_rng(3)
    plant = [random_plant(rng, k % 4 == 3) for k in range(12)][11]
    design = solve_design(plant, "modified-E", tolerance=1e-9)
    assert design.status.ok
    assert design.certificate.check(points=200_001) <= 1 + 1e-9
    assert design.bound * (1 - 1e-12) <= np.linalg.cond(design.information) < 18.388
