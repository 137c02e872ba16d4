"""The last digits of a design under a mask: Newton's method on the information of the density that its own price finds worth most.

The optimum has M = M_0 + M(Phi) for the density Phi that is all of the mask where worth T = D^* Z D - nu I / P is positive and
nothing elsewhere, Z = X X' as the criterion has it at M. A change of M changes Z, and by that the frequencies where an eigenvalue
of the worth is 0, each by its change over its slope; and, with several inputs, the directions between those that are worth
something and those that are not. Both are sums of G tr(G dZ) with symmetric G, so that the equations are linear in n (n + 1) / 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.parametrisations.densities import Density, Panels, Pricing
from oed.design.solvers.weights_clarabel import smat, svec

MANY = 30
"""Parameters up to which a step, of n^6, takes less than a round."""
STEPS = 12
"""Newton steps; where the jumps of the density are the right ones it takes three to six."""
HALVINGS = 6
CLOSE = 1e-13
"""Relative error of the information at which it is found."""
BESIDE = 1e-5
"""Distance at which the slope of the worth is taken, in units of the distance over which the plant changes."""


@dataclass(frozen=True, eq=False)
class Response:
    """What a density answers to a price: its information and share of the power; and for changes of the price the matrices G (b, n,
    n), what weighs each (b,), and what a jump there changes of the power, (b,)."""

    information: NDArray[np.float64]
    power: float
    G: NDArray[np.float64]
    weight: NDArray[np.float64]
    used: NDArray[np.float64]


def polished_information(
    criterion: Criterion, respond: Callable[[NDArray[np.float64], float], Response], M: NDArray[np.float64], nu: float
) -> tuple[NDArray[np.float64], float]:  # fmt: skip
    """The information and the price of power at which they are those of their own density; M (n, n), nu to begin with."""
    here = respond(criterion.direction(M), nu)
    before = float(np.linalg.norm(_residual(M, nu, here)))
    for _ in range(STEPS):
        dM, dnu = _step(criterion, M, nu, here)
        length = 1.0
        for _ in range(HALVINGS):
            trial, price = M + length * dM, nu + length * dnu
            try:
                np.linalg.cholesky(trial)
                there = respond(criterion.direction(trial), max(price, 0.0))
                after = float(np.linalg.norm(_residual(trial, price, there)))
            except np.linalg.LinAlgError:
                after = np.inf
            if after < before:
                break
            length *= 0.3
        else:
            break
        M, nu, here, gained = trial, max(price, 0.0), there, after / before
        before = after
        if before < CLOSE or gained > 0.5:
            break
    return M, nu


def _residual(M: NDArray[np.float64], nu: float, here: Response) -> NDArray[np.float64]:
    """Relative errors of the information, and of the power where it has a price."""
    half = np.linalg.cholesky(M)
    left: NDArray[Any] = np.linalg.solve(half, np.linalg.solve(half, M - here.information).T)
    return np.append(svec(left[None])[0], here.power - 1 if nu > 0 else max(here.power - 1, 0.0))


def _step(
    criterion: Criterion, M: NDArray[np.float64], nu: float, here: Response
) -> tuple[NDArray[np.float64], float]:
    """Newton's step; the price stays where the power is not all used."""
    n = len(M)
    X, Y = criterion.direction(M), np.linalg.inv(M)
    Z = X @ X.T
    basis = np.stack([smat(one, n) for one in np.eye(n * (n + 1) // 2)])
    dZ = Y @ basis @ Z
    dZ = svec((criterion.curvature or 0.0) * (Z @ basis @ Z) - dZ - dZ.swapaxes(1, 2)).T
    G = svec(here.G)
    moved = (G.T * here.weight) @ G
    bent, q = moved @ dZ, G.T @ (here.weight * here.used)
    left = np.eye(len(bent) + 1)
    left[:-1, :-1] -= bent
    right = np.append(svec((here.information - M)[None])[0], 0.0)
    if nu > 0:
        left[:-1, -1], left[-1, :-1] = q, q @ dZ
        left[-1, -1] = -float(here.weight @ here.used**2)
        right[-1] = 1 - here.power
    change: NDArray[Any] = np.linalg.solve(left, right)
    return smat(change[:-1], n), float(change[-1])


def responded(
    information: NDArray, power: float, sides: tuple[NDArray, NDArray, NDArray], nodes: tuple[NDArray, NDArray, NDArray, NDArray]
) -> Response:  # fmt: skip
    """A Response from what lies at the jumps: D r (b, n, ny) and the power (b,) of the density there, and the slopes of the worth (b,);
    and, of several inputs, from the nodes: D R (K, n, ny, q), eigenvectors (K, q, q) and eigenvalues (K, q) of the worth within the
    mask, and weights (K,)."""
    a, used, slopes = sides
    G = [np.einsum("bnr,bmr->bnm", a, a.conj()).real]
    weights = [1 / (np.pi * np.maximum(np.abs(slopes), np.finfo(float).tiny))]
    DR, vectors, values, share = nodes
    for i in range(values.shape[1]):
        for j in range(i):
            apart = (values[:, i] > 0) & (values[:, j] <= 0)
            turned = np.einsum("knrq,kqi->knri", DR[apart], vectors[apart][:, :, [j, i]])
            C = np.einsum("knr,kmr->knm", turned[..., 0], turned[..., 1].conj())
            C = (C + C.swapaxes(1, 2)) / 2
            G += [C.real, C.imag]
            weights += [2 * share[apart] / (values[apart, i] - values[apart, j])] * 2
    weight = np.concatenate(weights)
    return Response(
        information, power, np.concatenate(G), weight, np.append(used, np.zeros(len(weight) - len(used)))
    )


def answer(pricing: Pricing, panels: Panels, one: Density) -> Response:
    """What the density of a price answers to changes of it."""
    jumps = pricing.jumps(panels, one)
    panels = pricing.cut_at(panels, jumps)
    phi = pricing.at(panels, one)[0]
    step = BESIDE * pricing.problem.length_scale(jumps)
    # Among the nodes, which there always are.
    DR, R, values, vectors = pricing.within(np.append(panels.omega, jumps), one)
    k = len(panels.omega) + np.arange(len(jumps))
    least = np.argmin(np.abs(values[k]), axis=1)
    before, after = np.split(
        pricing.within(np.concatenate([panels.omega[:1], jumps - step, jumps + step]), one)[2][1:], 2
    )
    v, at = vectors[k, :, least], np.arange(len(jumps))
    sides = (
        np.einsum("knrq,kq->knr", DR[k], v), np.sum(np.abs(np.einsum("kqp,kp->kq", R[k], v)) ** 2, axis=1) / pricing.limit,
        (after[at, least] - before[at, least]) / (2 * step),
    )  # fmt: skip
    DR, values, vectors = (part[: len(panels.omega)] for part in (DR, values, vectors))
    return responded(
        pricing.told(panels, phi), pricing.used(panels, phi), sides, (DR, vectors, values, panels.weight)
    )


def polished_density(
    pricing: Pricing, panels: Panels, M: NDArray[np.float64], one: Density
) -> tuple[Panels, Density, NDArray] | None:
    """Panels, certificate and its own density, within the power, after Newton's method from an information and a certificate."""
    criterion = pricing.problem.criterion
    if criterion.curvature is None or panels.B is not None or criterion.n > MANY:
        return None
    X = criterion.direction(M)
    nu = one.nu * float(np.sum(X * (M @ X)) / np.sum(one.X * (M @ one.X)))
    try:
        M, nu = polished_information(criterion, lambda X, nu: answer(pricing, panels, Density(X, nu)), M, nu)
    except np.linalg.LinAlgError:
        return None
    one = Density(criterion.direction(M), nu)
    panels = pricing.cut(panels, one)
    phi = pricing.at(panels, one)[0]
    return panels, one, phi / max(1.0, pricing.used(panels, phi))
