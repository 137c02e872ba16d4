"""How good an experiment the iterations are: efficiencies of their spectra against certified optima.

The efficiency of a spectrum for a criterion is the optimal loss over its own loss, at equal power; for the
peak gain (c) it is lambda_e / (c' I^-1 c) wherever the gain-scaling theorem holds (docs/theory/design.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.data import Spectrum
from oed.information import ENTRIES, Responding, information_rows, whitened_gradient
from oed.plants.norms import gain_gradient, peak
from oed.plants.plant import Plant
from oed.theory.limit_on_grid import spectra_of_iterations
from oed.theory.quadrature import Nodes

LOST = 1e-13
"""Share of the largest diagonal entry of a triangular factor below which an entry is rounding."""


@dataclass(frozen=True)
class Losses:
    """Losses of an information matrix under the four criteria; infinite where it is singular. `c` c' I^-1 c,
    the variance of the estimated peak gain (NaN where the peak is not unique); `D` det(I^-1)^(1/n); `A` trace
    I^-1; `E` largest eigenvalue of I^-1."""

    c: float
    D: float
    A: float
    E: float

    def efficiency(self, optimum: Losses) -> Losses:
        """Efficiencies optimum / loss, criterion by criterion."""
        return Losses(*(getattr(optimum, k) / getattr(self, k) for k in ("c", "D", "A", "E")))


def losses(information: NDArray[np.float64], c: NDArray[np.float64] | None = None) -> Losses:
    """Losses of an information matrix under c, D, A and E: information (n, n), c (n,)."""
    scale = np.sqrt(np.clip(np.diag(information), 0, None))
    if not np.all(scale > 0):
        return Losses(np.inf if c is not None else np.nan, np.inf, np.inf, np.inf)
    try:
        factor = np.linalg.cholesky(information / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return Losses(_singular_c(information, c), np.inf, np.inf, np.inf)
    return _losses(factor.T, scale, c)


def losses_of_spectrum(model: Responding, spectrum: Spectrum, c: NDArray[np.float64] | None = None) -> Losses:
    """Losses of a spectrum's information, by its rows and not their products: a peak that outweighs all other lines by
    1e18 in power leaves half of the digits, where the information matrix would have lost them all."""
    from scipy.linalg import qr

    rows = information_rows(model, spectrum)
    scale = np.linalg.norm(rows, axis=0)
    if not np.all(scale > 0):
        return losses(rows.T @ rows, c)
    rows = rows / scale
    # large first: small ones keep theirs
    rows = rows[np.argsort(-np.linalg.norm(rows, axis=1), kind="stable")]
    found = qr(rows, mode="r", pivoting=True, check_finite=False)
    triangle, order = np.asarray(found[0])[: len(scale)], np.asarray(found[-1])
    sizes = np.abs(np.diag(triangle))
    if not sizes.min() > LOST * sizes.max():
        return Losses(_singular_c(rows.T @ rows * np.outer(scale, scale), c), np.inf, np.inf, np.inf)
    return _losses(triangle, scale[order], None if c is None else c[order])


def _losses(triangle: NDArray, scale: NDArray, c: NDArray | None) -> Losses:
    """Losses of I = S T'T S with T (n, n) upper triangular and S the diagonal matrix of `scale`."""
    from scipy.linalg import solve_triangular

    root = solve_triangular(triangle, np.eye(len(scale)), trans=1) / scale  # I^-1 = root' root
    logdet = 2 * (np.log(np.abs(np.diag(triangle))).sum() + np.log(scale).sum())
    sizes = np.linalg.svd(root, compute_uv=False)
    return Losses(
        c=float(np.sum((root @ c) ** 2)) if c is not None else np.nan,
        D=float(np.exp(-logdet / len(scale))),
        A=float(np.sum(sizes**2)),
        E=float(sizes[0] ** 2),
    )


def _variance(information: NDArray, c: NDArray) -> float:
    """c' I^-1 c alone: `losses` takes three times as long."""
    from scipy.linalg import solve_triangular

    scale = np.sqrt(np.clip(np.diag(information), 0, None))
    if not np.all(scale > 0):
        return np.inf
    try:
        factor = np.linalg.cholesky(information / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return _singular_c(information, c)
    return float(np.sum(solve_triangular(factor, c / scale, lower=True, check_finite=False) ** 2))


def _singular_c(information: NDArray, c: NDArray | None) -> float:
    """c' I^+ c where c lies in the range of a singular I, infinite where it does not."""
    if c is None:
        return np.nan
    values, vectors = np.linalg.eigh(information)
    keep = values > 1e-12 * values[-1]
    along = vectors.T @ c
    if np.linalg.norm(along[~keep]) > 1e-6 * np.linalg.norm(c):
        return np.inf
    return float(np.sum(along[keep] ** 2 / values[keep]))


def peak_gain_efficiency_by_experiments(
    plant: Plant, experiments: int, optimum: float | None = None
) -> NDArray[np.float64]:
    """c-efficiency of the first k experiments of Algorithm 1 together, from a white start: returns
    (experiments,). Their information is summed (Lemma 13) and compared with k experiments at the optimum:
    lambda_e unless it is given, which holds for white noise and a free gain. Source: [S] Lemmas 6 and 13;
    table of docs/theory/design.md."""
    top = peak(plant)
    best = float(plant.noise_covariance[0, 0]) if optimum is None else optimum
    if not top.unique or np.isnan(best):
        return np.full(experiments, np.nan)
    c = gain_gradient(plant, top)
    nodes, Phi, _ = spectra_of_iterations(plant, experiments)
    efficiency, total = np.zeros(experiments), np.zeros((len(c), len(c)))
    for k, information in enumerate(_informations(plant, nodes, Phi)):
        total = total + information
        efficiency[k] = best / ((k + 1) * _variance(total, c))
    return efficiency


def _informations(plant: Plant, nodes: Nodes, Phi: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Information of each of several spectra, Phi (M, K) at the nodes, (n, n). The derivatives by the coefficients of B
    (or A) are one function of frequency times powers of the delay, so that a product of two depends on the difference
    of their powers alone: 4 n integrals instead of n^2 / 2, a tenth of the time at order 100."""
    rows = [row for row in plant._parameters() if row[0] in plant.free]
    first = {row[1]: row for row in reversed(rows)}
    psi = whitened_gradient(plant.replace(free=tuple(row[0] for row in first.values())), nodes.omega)[
        :, :, 0, 0
    ]
    of = dict(
        zip(sorted(first, reverse=True), psi.T, strict=True)
    )  # B stands before A, as among the parameters
    b, a = (of.get(letter, np.zeros(len(nodes.omega))) for letter in "ba")
    power = np.array([row[2] - first[row[1]][2] for row in rows])
    in_a = np.array([row[1] == "a" for row in rows])
    lag = power - power[:, None]  # of the product of row i, conjugated, and column j
    lag = np.where(in_a[:, None] & ~in_a, -lag, lag)
    kind = np.where(in_a[:, None] ^ in_a, 2 + (lag < 0), in_a[:, None] & in_a)
    lags, at = np.unique(np.abs(lag), return_inverse=True)
    same, both = np.stack([np.abs(b) ** 2, np.abs(a) ** 2]), b.conj() * a
    integrals = np.empty((4, len(lags), len(Phi)))
    together = max(1, ENTRIES // len(nodes.omega))
    for k in range(0, len(lags), together):
        turn = np.multiply.outer(lags[k : k + together], nodes.omega)
        cos, sin = np.cos(turn) * nodes.weight, np.sin(turn) * nodes.weight
        even, odd = cos * both.real, sin * both.imag
        integrals[:, k : k + together] = (
            np.stack([cos * same[0], cos * same[1], even + odd, even - odd]) @ Phi.T
        )
    for m in range(len(Phi)):
        yield integrals[kind, at.reshape(kind.shape), m]
