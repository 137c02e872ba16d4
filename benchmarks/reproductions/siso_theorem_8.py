"""[S] Theorem 8: four properties of mu and of the limit spectrum."""

from typing import Any

import numpy as np

from benchmarks.tables.reproduced import row
from oed.plants.named import NAMES, named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.theory.limit import limit_spectrum

VARIANCES = np.geomspace(1e-6, 1e4, 21)


def rows() -> list[dict[str, Any]]:
    """Each property on every named plant with one input and one output."""
    plants = [p for p in map(named_plant, NAMES) if p.n_inputs * p.n_outputs == 1]
    above, tops, bottoms, rising, ends = [], [], [], [], []
    for plant in plants:
        gamma = peak(plant).value
        limits = [limit_spectrum(plant.replace(noise_variance=v)) for v in VARIANCES]
        excess = np.array([limit.mu2_excess for limit in limits])
        rising.append((np.diff(excess) > 0).all())
        ends.append(excess[0] < 1e-5 * gamma**2 and np.sqrt(limits[-1].mu2) > 20 * gamma)
        for share in (0.5, 1.0, 2.0):
            gain, Phi, mu2 = _iterated(plant, share * gamma**2)
            above.append(mu2 >= gamma**2)
            tops.append(gain[np.argmax(Phi)] >= gain.max() - 1e-6 * gamma)
            bottoms.append(Phi.min() > 0 and gain[np.argmin(Phi)] <= gain.min() + 1e-6 * gamma)
    count = lambda flags: f"{int(np.sum(flags))} of {len(flags)}"
    runs = "recursion (8) from a low-pass start on 8001 lines, 400 steps, noise of .5, 1 and 2 gamma^2"
    text = f"{len(plants)} plants, variances from 1e-6 to 1e4"
    properties = (
        ("(1) mu >= ||G||", above, f"{runs}; mu^2 is the power of the last output."),
        ("(2) largest where |G| is", tops, f"{runs}; same gain to 1e-6 of the peak."),
        ("(3) smallest, and not zero, where |G| is smallest", bottoms, f"{runs}; same gain to 1e-6 of the peak."),
        ("(4) mu rises strictly with the noise", rising, f"{text}; 21 variances in a row."),
        ("(4) mu tends to ||G|| and to infinity", ends, f"{text}; at 1e-6 within 1e-5, at 1e4 above 20 ||G||."),
    )  # fmt: skip
    return [
        row(name, "[S] Theorem 8", "everywhere", count(flags), None, why, bool(np.all(flags)), "statement")
        for name, flags, why in properties
    ]


def _iterated(plant: Plant, variance: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Gain, spectrum and mu^2 after 400 steps of [S] (8): nothing of (9) is used, and the start peaks elsewhere."""
    omega = np.linspace(0, np.pi, 8001)
    weight = np.full(8001, 1 / 8000)
    weight[[0, -1]] /= 2
    gain = np.abs(plant.transfer(omega)[:, 0, 0])
    Phi, mu2 = 0.01 + 1 / (1.0001 - np.cos(omega)), 0.0
    for _ in range(400):
        Phi = gain**2 * (Phi / (weight @ Phi)) + variance
        mu2 = float(weight @ Phi)
    return gain, Phi / mu2, mu2
