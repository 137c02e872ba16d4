"""Kernels of the structures by compiled loops, the same for all orders: nothing is compiled for a model of its own."""

import numpy as np
from numpy.typing import NDArray

from estimators.pem.predictors.kernel import Kernel, Sums, summed
from oed.models.model import Polynomial, StateSpace

LETTERS = "ABKD"


def initial_counts(structure: Polynomial) -> tuple[list[list[int]], list[int]]:
    """How many pulses span the effect of what came before the record."""
    paths, noise = [], []
    for i in range(structure.n_outputs):
        row, rest = [], int(structure.na[i])
        for j in range(structure.n_inputs):
            nf, nb, nk = (int(x[i, j]) for x in (structure.nf, structure.nb, structure.nk))
            reach = nb + nk - 1 if nb else 0
            row.append(max(nf, reach) if nf else 0)
            rest = max(rest, 0 if nf else reach)
        paths.append(row)
        noise.append(max(int(structure.nc[i]), int(structure.nd[i]) + rest))
    return paths, noise


def _copies(structure: Polynomial, levels: bool, paths: list[list[int]], noise: list[int]) -> NDArray:
    """The columns of the sensitivities as delayed signals, in the order in which the kernel makes these:
    returns (S, 5): row of the model, first delay, number of delays, first column, sign."""
    rows, at = [], structure.n + structure.n_outputs * levels
    for i, place in enumerate(structure.places()):
        for j, (b, f) in enumerate(zip(place["b"], place["f"], strict=True)):
            if b.stop > b.start:
                rows.append((i, 0, b.stop - b.start, b.start, -1))
                rows.append((i, 1, f.stop - f.start, f.start, 1))
                rows.append((i, 0, paths[i][j], at, -1))
                at += paths[i][j]
        for letter, sign in (("a", 1), ("c", -1), ("d", 1)):
            part = place[letter][0]
            rows.append((i, 1, part.stop - part.start, part.start, sign))
        rows += [(i, 0, int(levels), structure.n + i, -1), (i, 0, noise[i], at, 1)]
        at += noise[i]
    return np.array([row for row in rows if row[2]])


def polynomial_kernel(structure: Polynomial, levels: bool, initial: bool, weighted: bool = False) -> Kernel:
    """The predictor of a polynomial structure whose inputs have already been delayed by nk."""
    from estimators.pem.predictors.filter_kernels import fold, signals

    ny, nu = structure.n_outputs, structure.n_inputs
    paths, noise = initial_counts(structure) if initial else ([[0] * nu] * ny, [0] * ny)
    orders = np.array([structure.na, structure.nc, structure.nd, noise])
    entries = np.array([structure.nb, structure.nf, paths])
    copies = _copies(structure, levels, paths, noise)
    n = structure.n + ny * levels + sum(map(sum, paths)) + sum(noise)
    present = int((structure.nb > 0).sum())
    places = structure.n, structure.n + ny * levels, present, present + ny, int(levels)

    def trace(data: NDArray, parameters: NDArray, with_jacobian: bool) -> tuple[NDArray, NDArray | None]:
        found, e = np.empty((len(copies), len(data))), np.empty((ny, len(data)))
        signals(
            np.ascontiguousarray(data.T),
            0,
            len(data),
            np.array(parameters),
            orders,
            entries,
            places,
            found,
            e,
        )
        e = np.ascontiguousarray(e.T * data[:, -ny:] if weighted else e.T)
        if not with_jacobian:
            return e, None
        jacobian = np.zeros((len(data), ny, n))
        for signal, (i, first, count, at, sign) in zip(found, copies.tolist(), strict=True):
            for k in range(min(count, max(len(data) - first, 0))):
                jacobian[first + k :, i, at + k] = sign * signal[: len(data) - first - k]
        return e, jacobian * data[:, -ny:, None] if weighted else jacobian

    def sums(data: NDArray, lengths: NDArray, parameters: NDArray, weight: NDArray) -> Sums:
        # Copies, which can be written: numba compiles anew for arrays that cannot.
        given = np.array(data.T, order="C"), np.append(0, np.cumsum(lengths)), np.array(parameters, order="C")
        return Sums(*fold(*given, weight, orders, entries, places, copies))

    # weights of single samples leave no shift structure: the sensitivities are multiplied out
    by_trace = summed(lambda data, parameters: trace(data, parameters, True))  # pyright: ignore[reportArgumentType]
    return Kernel(by_trace if weighted else sums, trace, n)


def _root(weight: NDArray) -> NDArray[np.float64]:
    """A lower triangular root of a weight, which rounding may have left with an eigenvalue a little below zero."""
    try:
        return np.linalg.cholesky(weight)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(weight)
        return np.linalg.qr(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T, mode="r").T


def state_space_kernel(structure: StateSpace, levels: bool, initial: bool, weighted: bool = False) -> Kernel:
    """The predictor of an innovations model, with its initial state (zero where it is not unknown)."""
    from estimators.pem.predictors.state_kernels import fold, run

    order, ny, width = structure.order, structure.n_outputs, structure.n + structure.n_outputs * levels
    free = [(LETTERS.index(letter), i, j) for letter, i, j in structure.entries()]
    entries = np.array([*free, *((4, i, 0) for i in range(ny * levels))])
    n = width + order * initial

    def begun(p: NDArray) -> tuple[tuple, tuple]:
        m = structure.matrices(p[: structure.n])
        level = p[structure.n : width] if levels else np.zeros(ny)
        slope = np.zeros((order, n))
        slope[:, width:] = np.eye(order)[:, : n - width]
        state = p[width:].copy() if initial else np.zeros(order)
        return (*(m[x] for x in "ABCDK"), level.copy(), m["A"] - m["K"] @ m["C"]), (state, slope)

    def trace(data: NDArray, parameters: NDArray, with_jacobian: bool) -> tuple[NDArray, NDArray | None]:
        matrices, (state, slope) = begun(parameters)
        e, kept = np.empty((len(data), ny)), entries if with_jacobian else entries[:0]
        slope = slope if with_jacobian else slope[:, :0].copy()
        jacobian = np.empty((len(data), ny, slope.shape[1]))
        run(np.ascontiguousarray(data), state, slope, matrices, kept, e, jacobian)
        if weighted:
            e, jacobian = e * data[:, -ny:], jacobian * data[:, -ny:, None]
        return e, jacobian if with_jacobian else None

    def sums(data: NDArray, lengths: NDArray, parameters: NDArray, weight: NDArray) -> Sums:
        rows, ends, root = [], np.cumsum(lengths), _root(weight)
        for start, end, p in zip(ends - lengths, ends, parameters, strict=True):
            part = data[start:end]
            weights = np.ascontiguousarray(part[:, -ny:] if weighted else part[:0, -ny:])
            matrices, starts = begun(p)
            rows.append(fold(np.ascontiguousarray(part), starts, matrices, entries, root, weights))
        return Sums(*(np.array(part) for part in zip(*rows, strict=True)))

    return Kernel(sums, trace, n)
