"""Records that the tests of files write and read, and whether two are the same bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from oed.data import Record


def record(nu: int, ny: int, n: int, *, gap: bool = False, dt: float = 0.08, t0: float = 0.0) -> Record:
    rng = np.random.default_rng(100 * nu + 10 * ny + n)
    u = rng.normal(size=(n, nu)) * 10.0 ** rng.integers(-300, 300, size=(n, nu))
    y = rng.normal(size=(n, ny))
    if gap:
        y[n // 2, 0] = np.nan
    units = ("ft^3/min", "V", "")[:nu]
    return Record(u, y, dt=dt, t0=t0, input_units=units, output_units=("degC",) * ny)


def assert_same(a: Record, b: Record) -> None:
    for name in ("u", "y", "t"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
    for name in ("dt", "t0", "input_names", "output_names", "input_units", "output_units"):
        assert getattr(a, name) == getattr(b, name)


def write(folder: Path, text: str | bytes, name: str = "data.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path
