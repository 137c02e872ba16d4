"""Poles as an engineer reads them: frequency, damping and time constant of each pair."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Pole:
    """A pole, or a pair of conjugate ones.

    `frequency_hz` 0 for a real pole; `damping` ratio, 1 for a real stable pole; `time_constant` in seconds, negative
    where it grows; `radius` magnitude in the z plane.
    """

    frequency_hz: float
    damping: float
    time_constant: float
    radius: float

    def __str__(self) -> str:
        unstable = self.time_constant < 0
        lasts = (
            f"unstable, e-fold in {-self.time_constant:.4g} s"
            if unstable
            else f"time constant {self.time_constant:.4g} s"
        )
        return (
            f"{self.frequency_hz:.4g} Hz (damping {self.damping:.2g}, {lasts})"
            if self.frequency_hz
            else lasts
        )


def poles_in_hz(z: ArrayLike, dt: float) -> tuple[Pole, ...]:
    """Poles of the z plane, slowest first; a conjugate pair is one."""
    rows = []
    for pole in map(complex, np.ravel(z)):
        if pole.imag < 0 or abs(pole) < 1e-6:  # the other of a pair; a delay
            continue
        s = complex(np.log(pole)) / dt
        constant = float(-1.0 / s.real) if s.real else np.inf
        rows.append(Pole(abs(s.imag) / (2 * np.pi), -s.real / max(abs(s), 1e-300), constant, abs(pole)))
    return tuple(sorted(rows, key=lambda p: -p.radius))
