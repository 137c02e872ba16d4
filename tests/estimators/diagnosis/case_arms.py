"""Records of two axes that push each other: arms that turn and slide, or turn and bend, 20 Euler-Cromer steps a sample."""

from __future__ import annotations

import numpy as np

from oed.data import Record

__all__ = ["polar_arm", "two_links"]

STEPS = 20


def _moved(step, start, h, dt, holds, n, noise, seed) -> Record:
    """Two axes from rest at `start`; `step` makes their speeds after h seconds of the inputs, which are held for so many samples."""
    rng = np.random.default_rng(seed)
    u = np.column_stack([np.repeat(rng.uniform(-2, 2, n // k + 1), k)[:n] for k in holds])
    (a, b), va, vb = start, 0.0, 0.0
    y = np.zeros((n, 2))
    for k in range(n):
        y[k] = a, b
        for _ in range(STEPS):
            va, vb = step(u[k], a, va, b, vb)
            a, b = a + h * va, b + h * vb
    return Record(u, y + noise * y.std(axis=0) * rng.standard_normal((n, 2)), dt)


def polar_arm(coupled: float, n=900, noise=0.02, seed=0) -> Record:
    """An arm that turns and slides, each on a spring; `coupled` 0 leaves two linear axes."""

    def step(u, a, va, r, vr):
        force_a = 2.5 * u[0] - 5 * a - va - coupled * 0.8 * vr * va
        va += 0.005 * force_a / (1 + coupled * (0.4 * r + 0.1 * r * r))
        vr += 0.005 * (2 * u[1] - 6 * r - 1.5 * vr + coupled * 0.4 * (1 + 0.5 * r) * va * va)
        return va, vr

    return _moved(step, (0.0, 0.0), 0.005, 0.1, (9, 7), n, noise, seed)


def two_links(n=900, noise=0.01, seed=0) -> Record:
    """A link that turns and carries another that bends: how far it is bent sets the inertia of the first."""

    def step(u, a, va, b, vb):
        turned = 1.2 * np.sin(2 * b) * va
        va += 0.002 * (11 * u[0] - 1.6 * va - 22 * a + turned * vb) / (1 + 1.2 * np.cos(b) ** 2)
        vb += 0.002 * (5 * u[1] - vb - 18 * (b - 0.4) - 0.5 * turned * va) / 0.6
        return va, vb

    return _moved(step, (0.0, 0.4), 0.002, 0.04, (11, 8), n, noise, seed)
