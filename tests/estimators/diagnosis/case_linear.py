"""Linear records of many kinds, on which nothing may be claimed: plants, inputs, noises, levels, loops, channels by a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from oed.data import Record

LOOPS = ("open", "open", "open", "late", "same sample")
INPUTS = ("steps", "prbs", "multisine", "white", "coloured", "sweep")
NOISES = ("white", "white", "slow", "resonant", "process", "swing")


@dataclass(frozen=True)
class Kind:
    """What was drawn: in the words of `LOOPS`, `INPUTS` and `NOISES`, with orders, channels, the noise's share, levels, rest at first."""

    loop: str
    inputs: tuple[str, str]
    noise: str
    orders: tuple[int, ...]
    channels: tuple[int, int]
    share: float
    logged: bool
    rest: bool


def poles(rng: np.random.Generator, order: int) -> np.ndarray:
    """A stable denominator of rates between a fiftieth and one per sample, some of its poles in pairs."""
    found: list[complex] = []
    while len(found) < order:
        rate = float(np.exp(rng.uniform(np.log(0.02), 0.0)))
        if order - len(found) > 1 and rng.random() < 0.5:
            damping = rng.uniform(0.1, 0.9)
            z = np.exp(rate * (-damping + 1j * np.sqrt(1.0 - damping**2)))
            found += [z, np.conj(z)]
        else:
            found.append(np.exp(-rate))
    return np.real(np.poly(found))


def plant(rng: np.random.Generator, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Numerator (its first coefficient 0: no input acts in its own sample) and denominator of gain about one."""
    den = poles(rng, order)
    zeros = [rng.uniform(-0.9, 0.9) for _ in range(rng.integers(0, order))]
    num = np.concatenate((np.zeros(1 + rng.integers(0, 3)), np.real(np.poly(zeros)) if zeros else [1.0]))
    return num * den.sum() / (num.sum() if abs(num.sum()) > 0.05 else 0.05), den


def signal(rng: np.random.Generator, kind: str, n: int) -> np.ndarray:
    """(n,) excitation of unit size."""
    hold = int(rng.integers(3, 30))
    if kind == "steps":
        return np.repeat(rng.uniform(-1.7, 1.7, n // hold + 1), hold)[:n]
    if kind == "prbs":
        return np.repeat(rng.choice([-1.0, 1.0], n // max(2, hold // 4) + 1), max(2, hold // 4))[:n]
    if kind == "multisine":
        lines = 2.0 * np.pi * rng.choice(np.arange(1, n // 6), 20, replace=False) / n
        return np.cos(np.outer(np.arange(n), lines) + rng.uniform(0, 6.28, 20)).sum(1) * np.sqrt(2.0 / 20)
    if kind == "sweep":
        return 1.4 * np.sin(np.cumsum(np.geomspace(0.01, 1.0, n)))
    x = rng.standard_normal(n)
    return x if kind == "white" else np.asarray(lfilter([0.45], [1.0, -0.9], x))


def disturbance(rng: np.random.Generator, kind: str, n: int, den: np.ndarray) -> np.ndarray:
    """(n,) noise of unit variance, started long before the record."""
    e = rng.standard_normal(n + 2000)
    if kind == "slow":
        e = lfilter([1.0], [1.0, -rng.uniform(0.7, 0.98)], e)
    elif kind == "resonant":
        r, w = rng.uniform(0.7, 0.97), rng.uniform(0.1, 2.0)
        e = lfilter([1.0], [1.0, -2.0 * r * np.cos(w), r * r], e)
    elif kind == "process":
        e = lfilter([1.0], den, e)
    elif kind == "swing":
        e = 0.5 * e / np.std(e) + 0.87 * (x := lfilter([1.0], [1.0, -0.99], e)) / np.std(x)
    return np.asarray(e / np.std(e))[2000:]


def _run(
    plants, r: np.ndarray, noise: np.ndarray, gains: np.ndarray | None, late: int
) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and outputs (n, .) of the plants, sample by sample; the input answers the output `late` samples after it."""
    n = len(noise)
    if gains is None:
        y = noise.copy()
        for i, row in enumerate(plants):
            for j, (num, den) in enumerate(row):
                y[:, i] += lfilter(num, den, r[:, j])
        return r, y
    u, y, x = np.zeros_like(r), np.zeros_like(noise), [[np.zeros(n) for _ in row] for row in plants]
    for k in range(n):
        for i, row in enumerate(plants):
            for j, (num, den) in enumerate(row):
                last = min(len(num) - 1, k)
                forced = num[1 : last + 1] @ u[k - last : k, j][::-1] if last else 0.0
                own = min(len(den) - 1, k)
                x[i][j][k] = forced - (den[1 : own + 1] @ x[i][j][k - own : k][::-1] if own else 0.0)
            y[k, i] = noise[k, i] + sum(part[k] for part in x[i])
        u[k] = r[k] - (gains @ y[k - late] if k >= late else 0.0)
    return u, y


def linear_case(seed: int, most: int = 1000) -> tuple[Record, Record, Kind]:
    """Training and test record of one linear rig, and what was drawn."""
    rng = np.random.default_rng([2027, seed])
    n, m = int(rng.integers(400, most + 1)), 400
    channels = ((1, 1), (1, 1), (1, 1), (2, 1), (1, 2), (2, 2))[rng.integers(6)]
    loop, noise = LOOPS[rng.integers(len(LOOPS))], NOISES[rng.integers(len(NOISES))]
    inputs = tuple(INPUTS[i] for i in rng.integers(len(INPUTS), size=2))
    share, logged = float(np.exp(rng.uniform(np.log(0.02), np.log(0.3)))), bool(rng.random() < 0.6)
    nu, ny = channels
    orders = tuple(int(v) for v in rng.integers(1, 7, size=nu * ny))
    plants = [[plant(rng, orders[i * nu + j]) for j in range(nu)] for i in range(ny)]
    level, start = (
        rng.uniform(-20, 20, nu + ny) * logged,
        int(rng.integers(2)),
    )  # at rest first, or long under way
    feedback = rng.uniform(0.2, 0.5, (nu, ny)) / ny

    def raw(
        length: int, kind: str, gains: np.ndarray | None, size: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        before = 15 if start else 500
        r = np.stack([signal(rng, kind, length + before)[:: 1 - 2 * j] for j in range(nu)], axis=1)
        r[:before] *= 1 - start
        e = np.stack([disturbance(rng, noise, length + before, plants[i][0][1]) for i in range(ny)], axis=1)
        u, y = _run(plants, r, e * size, gains, int(loop == "late"))
        return u[500 * (1 - start) :][:length], y[500 * (1 - start) :][:length]

    size = share * np.std(raw(n, inputs[0], None, np.zeros(ny))[1], axis=0)
    gains = None if loop == "open" else feedback
    for _ in range(12):  # a gain that the loop bears
        runs = [raw(length, kind, gains, size) for length, kind in ((n, inputs[0]), (m, inputs[1]))]
        if gains is None or all(np.all(np.abs(y).max(0) < 6.0 * size / share) for _, y in runs):
            break
        gains = 0.5 * gains
    train, test = (
        Record(u + level[:nu], y + level[nu:], t0=t0) for (u, y), t0 in zip(runs, (0.0, 2000.0), strict=True)
    )
    return train, test, Kind(loop, inputs, noise, orders, channels, share, logged, bool(start))
