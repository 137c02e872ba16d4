"""Where the iterations' last input is strongest: the worst case that they have found, frequency and directions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.rules.trace import Trace
from oed.data import frozen


@dataclass(frozen=True, eq=False)
class WorstCase:
    """The strongest line of the last input, and the directions there. The peak's frequency with a standard
    error is that of `estimators.norm.peak_estimates.corrected`: the inputs of one run depend on each other,
    so that their spread says nothing about their common distance from the peak. `frequency` in rad/sample;
    `input_direction` (nu,) complex, unit norm, its largest component real and positive; `output_direction`
    (ny,) likewise; `dt` sampling time in seconds."""

    frequency: float
    input_direction: NDArray[np.complex128]
    output_direction: NDArray[np.complex128]
    dt: float = 1.0

    @property
    def frequency_hz(self) -> float:
        """The frequency in Hz."""
        return self.frequency / (2 * np.pi * self.dt)

    def __repr__(self) -> str:
        return (
            f"last input strongest at {self.frequency:.6g} rad/sample ({self.frequency_hz:.6g} Hz), "
            f"input direction {np.round(self.input_direction, 4).tolist()}"
        )


def dominant_frequency(u: NDArray[np.float64]) -> float:
    """Frequency of the largest periodogram value, refined between the lines: u (N, channels)."""
    from scipy.optimize import minimize_scalar

    N = len(u)
    size = 8 * N
    power = np.sum(np.abs(np.fft.rfft(u, size, axis=0)) ** 2, axis=1)
    k = int(np.argmax(power))
    omega, step = 2 * np.pi * k / size, 2 * np.pi / size
    depth = lambda w: -float(np.sum(np.abs(_transform(u, w)) ** 2))
    bounds = max(omega - step, 0.0), min(omega + step, np.pi)
    result = minimize_scalar(depth, bounds=bounds, method="bounded", options={"xatol": 1e-10})
    return omega if -result.fun < power[k] else float(result.x)


def worst_case(trace: Trace) -> WorstCase:
    """Strongest line of the last iteration's input and directions there."""
    record = trace.records[trace.iterations[-1]][0]
    omega = dominant_frequency(record.u)
    u, y = (frozen(_direction(_transform(side, omega)), complex) for side in (record.u, record.y))
    return WorstCase(omega, u, y, record.dt)


def _transform(x: NDArray[np.float64], omega: float) -> NDArray[np.complex128]:
    return np.asarray(np.exp(-1j * omega * np.arange(len(x))) @ x, complex)


def _direction(v: NDArray[np.complex128]) -> NDArray[np.complex128]:
    largest = v[np.argmax(np.abs(v))]
    turned = v * (np.conj(largest) / abs(largest)) if abs(largest) > 0 else v
    return np.asarray(turned / max(float(np.linalg.norm(v)), 1e-300) + 0.0, complex)
