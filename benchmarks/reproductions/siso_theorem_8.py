"""[S] Theorem 8: four properties of mu and of the limit spectrum."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.tables.reproduced import row
from oed.plants.named import NAMES, named_plant
from oed.plants.norms import peak
from oed.theory.limit import limit_spectrum

__all__ = ["rows"]

VARIANCES = np.geomspace(1e-6, 1e4, 21)


def rows() -> list[dict[str, Any]]:
    """Each property on every named plant with one input and one output.

    Returns
    -------
    list of dict
        Rows of `benchmarks.tables.reproduced`.
    """
    plants = [p for p in map(named_plant, NAMES) if p.n_inputs * p.n_outputs == 1]
    omega = np.linspace(0, np.pi, 8001)
    above, tops, bottoms, rising, ends = [], [], [], [], []
    for plant in plants:
        gamma = peak(plant).value
        gain = np.abs(plant.response(omega)[0][:, 0, 0])
        limits = [limit_spectrum(plant.replace(noise_variance=v)) for v in VARIANCES]
        excess = np.array([limit.mu2_excess for limit in limits])
        above.append(excess.min() >= 0)
        rising.append((np.diff(excess) > 0).all())
        ends.append(excess[0] < 1e-5 * gamma**2 and np.sqrt(limits[-1].mu2) > 20 * gamma)
        for limit in limits[::5]:
            density = limit.density(omega)
            tops.append(np.argmax(density) == np.argmax(gain))
            bottoms.append(density.min() > 0 and gain[np.argmin(density)] <= gain.min() + 1e-6 * gamma)
    published = "on every plant"
    count = lambda flags: f"{int(np.sum(flags))} of {len(flags)}"
    text = f"{len(plants)} plants, variances from 1e-6 to 1e4"
    properties = (
        ("(1) mu >= ||G||", above, "the excess mu^2 - gamma^2 is solved for directly, so its sign is exact."),
        ("(2) largest where |G| is", tops, "same line of a grid of 8001."),
        ("(3) smallest, and not zero, where |G| is smallest", bottoms, "same gain to 1e-6 of the peak."),
        ("(4) mu rises strictly with the noise", rising, "21 variances in a row."),
        ("(4) mu tends to ||G|| and to infinity", ends, "at 1e-6 within 1e-5, at 1e4 above 20 ||G||."),
    )
    return [
        row(name, "[S] Theorem 8", published, count(flags), None, f"{text}; {why}", bool(np.all(flags)))
        for name, flags, why in properties
    ]
