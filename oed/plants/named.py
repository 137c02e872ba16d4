"""The named plants: where the iterations and the designs are tried, the paper's own first.

Each has the feature that its name says; `avis` imitates what [M] publishes of a vibration-isolation system
and is synthetic. `hair-dryer` is identified from a record and therefore lives with the comparison."""

from functools import reduce

import numpy as np

from oed.errors import check_names
from oed.plants.plant import Plant


def bandpass(frequency: float, radius: float, gain: float) -> tuple[np.ndarray, np.ndarray]:
    """z^-1 times a second-order filter whose largest gain lies exactly at the frequency (rad/sample)."""
    num = gain * (1 - radius**2) / 2 * np.array([0.0, 1.0, 0.0, -1.0])
    den = np.array([1.0, -(1 + radius**2) * np.cos(frequency), radius**2])
    return num, den


def parallel(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[list[float], list[float]]:
    """Sum of transfer functions over their common denominator."""
    den = reduce(np.convolve, [d for _, d in parts])
    terms = [
        reduce(np.convolve, [n, *(d for other, (_, d) in enumerate(parts) if other != k)])
        for k, (n, _) in enumerate(parts)
    ]
    num = np.zeros(max(map(len, terms)))
    for term in terms:
        num[: len(term)] += term
    return num.tolist(), den.tolist()


def _summed(*parts: tuple[np.ndarray, np.ndarray]) -> dict:
    num, den = parallel(list(parts))
    return {"num": num, "den": den}


def _avis() -> dict:
    """Two modes whose input and output directions are orthogonal, so their gains are the singular values.
    Largest gain 1.997 at 121 Hz, 1.95 at 296 Hz; half-power widths 10 and 24 Hz. On a coarse grid of 18.5 Hz
    (296 = 16 lines) the peak at 121 Hz falls between two lines, so the largest value is that of 296 Hz."""
    dt = 0.001
    parts = []
    for hertz, width, peak in ((121.0, 10.0, 1.997), (296.0, 24.0, 1.95)):
        half = np.tan(np.pi * width * dt)
        parts.append(bandpass(2 * np.pi * hertz * dt, np.sqrt((1 - half) / (1 + half)), peak))
    left, right = np.deg2rad(40.0), np.deg2rad(50.0)
    outputs = np.array([[np.cos(left), np.sin(left)], [-np.sin(left), np.cos(left)]])
    inputs = np.array([[np.cos(right), np.sin(right)], [-np.sin(right), np.cos(right)]])
    num, den = [], []
    for i in range(2):
        entries = [
            parallel([(n * outputs[k, i] * inputs[k, j], d) for k, (n, d) in enumerate(parts)])
            for j in range(2)
        ]
        num.append([entry[0] for entry in entries])
        den.append([entry[1] for entry in entries])
    return {"num": num, "den": den, "dt": dt}


_SLOW, _FAST = [1, -1.1, 0.72], [1, 0.4, 0.5]
_PLANTS = {
    "reference": {"num": [0, 0.2155, 0.2012], "den": [1, -0.9854, 0.8187]},
    "two-peaks": _summed(bandpass(0.7, 0.95, 2.0), bandpass(2.0, 0.9, 1.97)),
    "peak-at-zero": {"num": [0, 0.4], "den": [1, -0.8]},
    "peak-at-pi": {"num": [0, 0.4], "den": [1, 0.8]},
    "delay": {"num": [0, 0, 0, 0, 0, 0.3, 0.15], "den": [1, -1.2, 0.72]},
    "nonminimum-phase": {"num": [0, -0.3, 0.48], "den": [1, -0.6, 0.7]},
    "order-20": _summed(
        *(bandpass(0.25 + 0.28 * k, 0.93 - 0.01 * k, 2.0 / (1 + 0.35 * abs(k - 3))) for k in range(10))
    ),
    "three-by-two": {
        "num": [[[0, 0.5, 0.2], [0, -0.3]], [[0, 0.25], [0, 0, 0.4]], [[0, -0.2, 0.1], [0, 0.35, 0.15]]],
        "den": [[_SLOW, [1, -0.5]], [[1, -0.7], _SLOW], [_FAST, _FAST]],
    },
    "avis": _avis(),
    "bandit-fir": {"num": [0.0, 0.2, 0.45, 0.6, 0.35, -0.15, -0.5, -0.45, -0.1, 0.15, 0.2], "den": [1]},
}

NAMES: tuple[str, ...] = tuple(_PLANTS)


def named_plant(name: str, noise_variance: float = 1.0) -> Plant:
    """A named plant.

    Parameters
    ----------
    name : str
        One of `NAMES`.
    noise_variance : float
        Variance of the white noise on every output.

    Returns
    -------
    Plant
        The plant.

    Raises
    ------
    InputError
        If there is no plant of that name.
    """
    check_names([name], NAMES, "plant")
    return Plant(**_PLANTS[name], noise_covariance=noise_variance, name=name)


def random_fir(
    rng: np.random.Generator, taps: int = 10, decay: float = 0.75, noise_variance: float = 0.01
) -> Plant:
    """A random FIR plant, g_k = decay^k w_k with w uniform in [-1, 1]. The family of the H-infinity
    estimation head-to-head of Tu, Boczar and Recht (2018)."""
    g = rng.uniform(-1, 1, taps) * decay ** np.arange(taps)
    return Plant(g, [1.0], noise_covariance=noise_variance, name="random-fir")
