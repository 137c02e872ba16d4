"""Families of random plants, by seed: light damping, two competing peaks, delay, several channels."""

import numpy as np

from oed.errors import check_names
from oed.plants.named import bandpass, parallel
from oed.plants.norms import peak
from oed.plants.plant import Plant

NORM = 2.4
"""H-infinity norm of every random plant of a family, about the reference plant's, so that a noise variance means the same."""


def _light(rng: np.random.Generator) -> dict:
    """One resonance of a relative damping of a few thousandths to a few hundredths."""
    radius, frequency = 1 - 10 ** rng.uniform(-2.5, -1.5), rng.uniform(0.3, 2.8)
    return {"num": [0, *rng.normal(size=2)], "den": [1, -2 * radius * np.cos(frequency), radius**2]}


def _competing(rng: np.random.Generator) -> dict:
    """Two resonances whose peaks differ by 1 to 10 %."""
    first, apart = rng.uniform(0.3, 1.4), rng.uniform(0.6, 1.4)
    lower = rng.uniform(0.9, 0.99)
    num, den = parallel(
        [
            bandpass(first, rng.uniform(0.85, 0.97), 1.0),
            bandpass(first + apart, rng.uniform(0.85, 0.97), lower),
        ]
    )
    return {"num": num, "den": den}


def _late(rng: np.random.Generator) -> dict:
    """A resonance behind a delay of 3 to 10 samples."""
    radius, frequency = rng.uniform(0.7, 0.95), rng.uniform(0.2, 2.8)
    lag = [0.0] * int(rng.integers(3, 11))
    return {"num": [*lag, *rng.normal(size=2)], "den": [1, -2 * radius * np.cos(frequency), radius**2]}


def _many(rng: np.random.Generator) -> dict:
    """2 x 2 to 4 x 4, every entry of second order with poles of its own."""
    ny, nu = rng.integers(2, 5, size=2)
    shape = (int(ny), int(nu))
    radius, frequency = rng.uniform(0.6, 0.93, shape), rng.uniform(0.2, 2.8, shape)
    return {
        "num": [[[0, *rng.normal(size=2)] for _ in range(nu)] for _ in range(ny)],
        "den": [
            [[1, -2 * r * np.cos(w), r**2] for r, w in zip(*rows, strict=True)]
            for rows in zip(radius, frequency, strict=True)
        ],
    }


FAMILIES = {"light": _light, "competing": _competing, "late": _late, "many": _many}
"""Families of random plants: light damping, two competing peaks, delay, several channels."""


def random_plant(family: str, rng: np.random.Generator, noise_variance: float = 1.0) -> Plant:
    """A random plant of a family, scaled to the norm `NORM`."""
    check_names([family], tuple(FAMILIES), "family of random plants")
    polynomials = FAMILIES[family](rng)
    gain = NORM / peak(Plant(**polynomials)).value
    num = polynomials["num"]
    several = isinstance(num[0], list)
    scaled = [[[gain * b for b in B] for B in row] for row in num] if several else [gain * b for b in num]
    return Plant(scaled, polynomials["den"], noise_covariance=noise_variance, name=f"random-{family}")
