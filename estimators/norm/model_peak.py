"""Peak gain of a fitted model, and how well its data say where the peak is."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.plants.norms import largest_gain, refined_maximum

SURE = 2.0
"""Standard errors by which the gain must bend down at the peak: where it may be flat, the delta method says nothing."""


def peak_gain(model: Any, points: int = 512) -> tuple[float, float, NDArray[np.float64]]:
    """Largest gain over frequencies, where it is (rad/sample), and its (n,) gradient by the envelope theorem."""
    poles = np.concatenate([np.zeros(0), *model.poles()])
    poles = poles[np.abs(poles) > 0.5]
    turns, room = np.abs(np.angle(poles)), 1 - np.minimum(np.abs(poles), 1)
    near = [turns + s * room for s in (-2, -1, -0.5, 0, 0.5, 1, 2)]
    grid = np.unique(np.clip(np.concatenate([np.linspace(0, np.pi, points), *near]), 0, np.pi))

    gain = lambda w: largest_gain(model.response(w)[0])
    values = gain(grid)
    k = int(np.argmax(values))
    left, right = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
    omega = refined_maximum(gain, left, right)
    step = (right - left) / 100
    omega = refined_maximum(gain, max(omega - step, left), min(omega + step, right))
    for end in (0.0, np.pi):
        omega = end if abs(omega - end) < 1e-6 else omega  # by symmetry the slope vanishes there
    heights, slopes = _gain_and_slope(model, [omega])
    return float(heights[0]), omega, slopes[0]


def frequency_error(model: Any, covariance: NDArray[np.float64]) -> float:
    """Standard error of the peak's frequency, d omega / d theta = (d2 gain / d omega d theta) / curvature. By
    symmetry a peak at 0 or pi stays there; a curvature within SURE of its own errors of zero, or a peak that
    is uncertain by more than the frequencies there are, gives infinity."""
    _, omega, _ = peak_gain(model)
    poles = np.abs(np.concatenate([np.zeros(1), *model.poles()]))
    h = 1e-2 * float(np.clip(1 - poles.max(), 1e-5, 0.1))
    heights, slopes = _gain_and_slope(model, [omega - h, omega, omega + h])
    bend = -float(heights[0] - 2 * heights[1] + heights[2]) / h**2
    spread = lambda g: float(np.sqrt(max(g @ covariance @ g, 0.0)))
    if not bend > SURE * spread((slopes[0] - 2 * slopes[1] + slopes[2]) / h**2):
        return float("inf")
    error = 0.0 if omega in (0.0, np.pi) else spread((slopes[2] - slopes[0]) / (2 * h)) / bend
    return error if error < np.pi / 2 else float("inf")


def _gain_and_slope(model: Any, omega: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(K,) largest gains and (K, n) their gradients Re(u* dG v)."""
    g, dg = model.response(omega)
    left, singular, right = np.linalg.svd(g)
    return singular[:, 0], np.real(np.einsum("ki,knij,kj->kn", left[:, :, 0].conj(), dg, right[:, 0].conj()))
