"""The certificate by cells against the level-set pencil and against itself: `oed.plants.norm_kernels` and its plain twin."""

from __future__ import annotations

import numpy as np
import pytest

from oed.plants import norm_kernels, norms
from oed.plants.named import NAMES, named_plant
from oed.plants.norm_kernels import HIGHER, OK, certified
from oed.plants.norms import peak
from oed.plants.plant import Plant

SINGLE = [name for name in NAMES if named_plant(name).n_inputs * named_plant(name).n_outputs == 1]


def drawn(seed: int, closest: float = 1e-4) -> tuple[np.ndarray, np.ndarray]:
    """A random plant of order 1 to 12 with poles up to `closest` from the circle and zeros on it and off it."""
    rng = np.random.default_rng(seed)
    sides = []
    for side in range(2):
        pairs, real = rng.integers(0, 6), rng.integers(1, 3)
        radius = 1.0 - 10 ** rng.uniform(np.log10(closest), -0.3, pairs + real)
        if side == 0:
            radius = np.where(rng.uniform(size=pairs + real) < 0.3, 1.0, radius)
        pole = radius[:pairs] * np.exp(1j * rng.uniform(0, np.pi, pairs))
        sides.append(np.real(np.poly(np.r_[pole, pole.conj(), radius[pairs:] * rng.choice([-1, 1], real)])))
    return sides[0], sides[1]


def by_pencil(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> norms.Peak:
    with monkeypatch.context() as patch:
        patch.setattr(norms, "_certified_by_cells", lambda *_: None)
        return norms._peak.__wrapped__(plant, 1e-9)


@pytest.mark.parametrize("plant", [*(named_plant(name) for name in SINGLE), *range(60)])
def test_cells_find_what_the_pencil_certifies(plant, monkeypatch) -> None:
    if isinstance(plant, int):
        plant = Plant(np.r_[np.zeros(plant % 4), drawn(plant)[0]], drawn(plant)[1])
    by_cells, twin = peak(plant), by_pencil(plant, monkeypatch)
    # Rounding of the gain: of A's terms against their sum, at the peak
    a = np.asarray(plant.den[0][0])
    loss = np.sum(np.abs(a)) / abs(np.polyval(a[::-1], np.exp(-1j * twin.frequency)))
    assert by_cells.value == pytest.approx(twin.value, rel=1e-14 * loss)
    assert by_cells.frequencies == pytest.approx(twin.frequencies, abs=1e-7)
    assert by_cells.curvatures == pytest.approx(twin.curvatures, rel=1e-6, abs=1e-9)
    assert by_cells.upper_bound == pytest.approx(by_cells.value * (1 + 1e-9), rel=1e-15 * max(loss, 10))
    u, v = by_cells.output_direction, by_cells.input_direction
    assert (u.conj() @ plant.response([by_cells.frequency])[0][0] @ v).real == pytest.approx(twin.value)
    high = [top for top in twin.local_maxima if top[1] > 1e-3 * twin.value]
    for w, height in high:
        near = min(by_cells.local_maxima, key=lambda top: abs(top[0] - w))
        assert near == pytest.approx((w, height), rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("seed", range(40))
def test_no_level_below_the_peak_is_certified(seed, monkeypatch) -> None:
    b, a = drawn(seed)
    gamma = by_pencil(Plant(b, a), monkeypatch).value
    assert certified(b, a, (gamma * (1 - 1e-8)) ** 2)[0] != OK
    status, where = certified(b, a, (0.999 * gamma) ** 2)
    assert status == HIGHER
    z = np.exp(-1j * where)
    assert abs(np.polyval(b[::-1], z) / np.polyval(a[::-1], z)) > 0.999 * gamma


def test_most_random_plants_are_decided_by_cells() -> None:
    """Where rounding of A exceeds the tolerance the pencil takes over: of poles to 0.9999 and order 12, a tenth at most."""
    sure = [norm_kernels.siso_peak(*drawn(seed), 1e-9)[-1] for seed in range(100)]
    assert np.mean(sure) > 0.9


@pytest.mark.parametrize("seed", range(20))
def test_the_bound_of_a_cell_holds_on_the_cell(seed) -> None:
    b, a = drawn(seed, closest=1e-2)
    rng, gamma2 = np.random.default_rng(seed), 10 ** np.random.default_rng(seed).uniform(-1, 3)
    for _ in range(50):
        c, h = rng.uniform(0, np.pi), 10 ** rng.uniform(-4, 0)
        q, alpha, beta = np.exp(-1j * c), np.empty(len(a), complex), np.empty(len(b), complex)
        norm_kernels._taylor(a, q, alpha)
        norm_kernels._taylor(b, q, beta)
        here, least = norm_kernels._parabola(gamma2, alpha, beta, q, h)
        z = np.exp(-1j * (c + np.linspace(-h, h, 201)))
        height = gamma2 * np.abs(np.polyval(a[::-1], z)) ** 2 - np.abs(np.polyval(b[::-1], z)) ** 2
        scale = gamma2 * np.sum(np.abs(a)) ** 2 + np.sum(np.abs(b)) ** 2
        assert here == pytest.approx(height[100], abs=1e-13 * scale)
        assert height.min() >= least - norm_kernels._majorant(gamma2, alpha, beta, h) - 1e-13 * scale


def test_flat_and_static_plants_take_the_other_way() -> None:
    assert not norm_kernels.siso_peak(np.array([-0.5, 1.0]), np.array([1.0, -0.5]), 1e-9)[-1]  # all-pass
    assert peak(Plant([-0.5, 1.0], [1.0, -0.5])).value == pytest.approx(1.0, rel=1e-14)
    assert peak(Plant([2.0], [1.0])).value == 2.0
