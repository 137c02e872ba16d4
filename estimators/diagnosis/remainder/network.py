"""A small recurrent network with a stable linear part: bounded for any input, fitted by its free run."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.remainder.network_kernels import derivatives, free_run
from estimators.pem.search.levenberg_marquardt import Point, minimise

Array = NDArray[np.float64]

RADIUS = 0.9995
"""Largest magnitude of a pole of A: below 1, so that bounded neurons give bounded states."""
STIFF = {"A": 0.01, "B": 0.03, "E": 1.0, "F": 0.1, "g": 0.1, "C": 0.1, "D": 0.1, "K": 1.0, "d": 0.01}
"""Relative pull of each part to where it starts: the strengths of neurons are held most, their places less, the linear
part hardly."""
LEAN = 1.3
"""A start whose squared error ends within this factor of the best start's joins the ensemble: its optimum is another
description of the same data, and the mean of several varies less than each."""


@dataclass(frozen=True)
class Sizes:
    """States, inputs and neurons."""

    states: int
    inputs: int
    neurons: int

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each part, in the order in which they stand in the parameters."""
        n, m, h = self.states, self.inputs, self.neurons
        return {
            "A": (n, n), "B": (n, m), "E": (n, h), "F": (h, n + m), "g": (h,), "C": (n,), "D": (m,), "K": (h,), "d": (1,)
        }  # fmt: skip

    def split(self, theta: Array) -> dict[str, Array]:
        """The parts by name."""
        shapes = self.shapes
        ends = np.cumsum([int(np.prod(s)) for s in shapes.values()])[:-1]
        parts = np.split(theta, ends)
        return {
            name: np.ascontiguousarray(p.reshape(s))
            for (name, s), p in zip(shapes.items(), parts, strict=True)
        }


@dataclass(frozen=True, eq=False)
class Network:
    """Parameters in one vector; inputs and output are in units in which the training data have unit size."""

    sizes: Sizes
    theta: Array

    def run(self, w: Array) -> Array:
        """(N,) output under inputs w (N, m), from the state zero."""
        return free_run(*[*self.sizes.split(self.theta).values(), w])


@dataclass(frozen=True, eq=False)
class Piece:
    """A stretch to fit: inputs (N, m), target (N,), and which samples count."""

    w: Array
    target: Array
    counts: NDArray[np.bool_]


RACE, FINISH, WINNERS = 25, 80, 2
"""Steps of all starts, steps of the winners after that, and how many win: with 12 steps the race was lost by the starts
that end best, and a third winner seldom changed the mean."""
SETTLED = 1e-4
"""Relative decrease still to be had below which a search has arrived: less than any block can tell."""


def poles_of(poles: NDArray[np.complex128], weights: Array, states: int) -> Array:
    """(n, n) real block-diagonal matrix with the heaviest poles of a list; fading ones where there are too few."""
    spare = [0.9, 0.7, 0.97, 0.5, 0.3, 0.99]
    order = [complex(poles[i]) for i in np.argsort(-weights, kind="stable") if poles[i].imag >= -1e-12]
    A, i = np.zeros((states, states)), 0
    while i < states:
        z = order.pop(0) if order else complex(spare[i % len(spare)])
        if abs(z) > 0.995:  # a network's states forget within the record
            z *= 0.995 / abs(z)
        if abs(z.imag) > 1e-6 and i + 1 < states:
            A[i : i + 2, i : i + 2] = [[z.real, z.imag], [-z.imag, z.real]]
            i += 2
        else:
            A[i, i] = z.real if abs(z.imag) <= 1e-6 else abs(z)
            i += 1
    return A


def _start(A: Array, w: Array, sizes: Sizes, rng: np.random.Generator) -> Array:
    """Parameters with states and neurons of about unit size, whose output is zero."""
    n, m, h = sizes.states, sizes.inputs, sizes.neurons
    gain = np.sqrt(np.maximum(1.0 - np.abs(np.linalg.eigvals(A)).max() ** 2, 1e-3))
    B = gain * rng.standard_normal((n, m))
    E = 0.05 * gain * rng.standard_normal((n, h))
    none = np.zeros((n, 0)), np.zeros((0, n + m)), np.zeros(0)
    size = np.array(
        [
            free_run(A, B, none[0], none[1], none[2], row, np.zeros(m), none[2], np.zeros(1), w).std()
            for row in np.eye(n)
        ]
    )
    size = size + 1e-9
    A, B = A * size / size[:, None], B / size[:, None]
    F = 1.5 / np.sqrt(n + m) * rng.standard_normal((h, n + m))
    g = 0.7 * rng.standard_normal(h)
    return np.concatenate([x.ravel() for x in (A, B, E, F, g, np.zeros(n + m + h + 1))])


def _objective(pieces: Sequence[Piece], sizes: Sizes, start: Array, penalty: float):
    total = sum(int(p.counts.sum()) for p in pieces)
    stiff = (
        np.concatenate([np.full(int(np.prod(s)), STIFF[k]) for k, s in sizes.shapes.items()])
        * penalty
        * total
    )
    rest = np.where(
        np.arange(len(start)) < sizes.states**2, start, 0.0
    )  # A to its start, all else to nothing

    def evaluate(theta: Array, _: object) -> Point | None:
        parts = sizes.split(theta)
        if not np.all(np.isfinite(theta)) or np.abs(np.linalg.eigvals(parts["A"])).max() >= RADIUS:
            return None
        off = theta - rest
        loss, gradient, hessian = float(off @ (stiff * off)), stiff * off, np.diag(stiff)
        for p in pieces:
            y, J = derivatives(*[*parts.values(), p.w])
            e, J = (p.target - y)[p.counts], J[p.counts]
            loss, gradient, hessian = loss + float(e @ e), gradient - J.T @ e, hessian + J.T @ J
        return Point(theta, loss, gradient, hessian, lambda d: None) if np.isfinite(loss) else None

    return evaluate


def _ended(evaluate, point: Point, steps: int) -> Point:
    return minimise(evaluate, point, tolerance=SETTLED, max_iterations=steps).point


def fitted(
    pieces: Sequence[Piece], starts: Sequence[tuple[Array, int]], sizes: Sizes, penalty: float
) -> tuple[tuple[Network, ...], tuple[int, ...]]:
    """The ensemble, best first, and which starts won: (A, seed) each run a few steps, the better ones to the end."""
    longest = max(pieces, key=lambda p: len(p.w)).w
    found = []
    for i, (A, seed) in enumerate(starts):
        theta = _start(A, longest, sizes, np.random.default_rng(seed))
        evaluate = _objective(pieces, sizes, theta, penalty)
        first = evaluate(theta, None)
        if first is not None:
            found.append((_ended(evaluate, first, RACE), evaluate, i))
    found.sort(key=lambda f: f[0].loss)
    won = found[:WINNERS]
    ends = sorted(
        ((_ended(evaluate, point, FINISH), i) for point, evaluate, i in won), key=lambda e: e[0].loss
    )
    kept = tuple(Network(sizes, p.z) for p, _ in ends if p.loss <= LEAN * ends[0][0].loss)
    return kept, tuple(i for _, _, i in won)
