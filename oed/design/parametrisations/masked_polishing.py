"""The last digits of a design under a mask: Newton's method on the price whose own density has the information that it asks for.

The dual of the problem is smooth: least in (X, nu) is tr X'M_0 X + nu + (1/pi) int of the positive eigenvalues of the worth
T = D^* X X' D - nu I / P within the mask, less log numerator(X). Its slope is 2 M X - rise, with the information M of the density
that is all of the mask where T is positive and nothing elsewhere, and 1 less that density's share of the power. A change of X moves
the frequencies where an eigenvalue of the worth is 0, each by its change over its slope; and, with several inputs, the directions
between those that are worth something and those that are not. Both are sums of G tr(G dZ) with symmetric G, Z = X X'. So every
criterion has the same equations, also where M is singular, or the loss has a kink.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.parametrisations.densities import Density, Panels, Pricing

LARGEST = 1200
"""Unknowns: beyond them a step takes longer than a round."""
STEPS = 30
"""Newton steps; where the jumps of the density are the right ones it takes three to six, and more where power is nearly free."""
CUTS = 24
LEFT = 0.3
"""Share of the slope along a step that may be left at its end: where a peak of the worth just touches 0 it grows like a root."""
CLOSE = 1e-13
"""Norm of the conditions, in units in which a relative change of anything is a number, at which they hold."""
ROUNDING = 1e-9
"""Norm of the conditions below which a step that gains no digit is the last: rounding is all that is left."""
DEPENDENT = 1e-12
"""Combinations of unknowns that move the conditions by less than this share are left alone: X as a whole may turn."""
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


Respond = Callable[..., Response]
"""Of a price, and whether its changes are asked for too."""


def polished_price(criterion: Criterion, respond: Respond, one: Density) -> Density:
    """The price at which the information of its own density is the one that it asks for, from one that is nearly right."""
    here = respond(one)
    size = np.sqrt(np.sum(one.X * (here.information @ one.X)) + one.nu * (1 - here.power))
    one = Density(one.X / size, one.nu / size**2)
    unit = _unit(one, here)
    before = np.inf
    for _ in range(STEPS):
        residual, J = _conditions(criterion, one, here)
        norm = float(np.linalg.norm(unit * residual))
        if norm < CLOSE or (norm < ROUNDING and norm > 0.1 * before):
            break
        before = norm
        # Of an eigenvalue the dual is not convex in X: down along every direction of curvature.
        values, vectors = np.linalg.eigh(J * np.outer(unit, unit))
        told = np.abs(values) > DEPENDENT * np.abs(values).max()
        step = -unit * (vectors[:, told] @ ((unit * residual) @ vectors[:, told] / np.abs(values[told])))
        found = _least_along(criterion, respond, one, step, float(residual @ step))
        if found is None:
            break
        one, here = found
    return one


def _least_along(
    criterion: Criterion, respond: Respond, one: Density, step: NDArray[np.float64], slope: float
) -> tuple[Density, Response] | None:  # fmt: skip
    """Where the dual is nearly least along a step in all unknowns, whose slope is given, and what is answered there."""
    low, high, above, length = 0.0, np.inf, 0.0, 1.0
    for _ in range(CUTS if slope < 0 else 0):
        moved = one.X + length * step[:-1].reshape(one.X.shape)
        trial = Density(moved, max(one.nu + length * float(step[-1]), 0.0))
        there = respond(trial, False)
        then = float(_conditions(criterion, trial, there, False)[0] @ step)
        if abs(then) <= LEFT * abs(slope) or (then < 0 and high == np.inf):
            return trial, respond(trial)
        if then < 0:
            low = length
        else:
            high, above = length, then
        length = low + (high - low) * (0.5 if low > 0 else max(0.1, slope / (slope - above)))
    return None


def _unit(one: Density, here: Response) -> NDArray[np.float64]:
    """Of every unknown: its share of the curvature is 1, where it has any: a density may tell nothing of a parameter."""
    g = here.G @ one.X
    own = 2 * np.diag(here.information)[:, None] + 4 * np.einsum("b,bns->ns", here.weight, g**2)
    price = float(here.weight @ here.used**2)
    curved = np.append(own.ravel(), price)
    return np.where(curved > 0, curved, 1.0) ** -0.5


def _conditions(
    criterion: Criterion, one: Density, here: Response, derivatives: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The slope of the dual by X and by the price of power, which stays where not all of it is used; and its derivatives."""
    X, M = one.X, here.information
    priced = one.nu > 0 or here.power > 1
    rise = criterion.log_numerator(X, False)[0]
    residual = np.append((2 * M @ X - rise).ravel(), 1 - here.power if priced else 0.0)
    if not derivatives:
        return residual, np.zeros((0, 0))
    g = (here.G @ X).reshape(len(here.G), X.size)
    H = np.zeros((X.size + 1,) * 2)
    H[:-1, :-1] = (
        2 * np.kron(M, np.eye(X.shape[1])) + 4 * (g.T * here.weight) @ g - criterion.log_derivatives(X)[1]
    )
    H[-1, -1] = 1.0
    if priced:
        H[:-1, -1] = H[-1, :-1] = -2 * g.T @ (here.weight * here.used)
        H[-1, -1] = float(here.weight @ here.used**2)
    return residual, H


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


def answer(pricing: Pricing, panels: Panels, one: Density, changes: bool = True) -> Response:
    """What the density of a price has, and what it answers to changes of it, which are most of the work."""
    jumps = pricing.jumps(panels, one)
    panels = pricing.cut_at(panels, jumps)
    phi = pricing.at(panels, one)[0]
    if not changes:
        none = np.zeros(0)
        return Response(
            pricing.told(panels, phi),
            pricing.used(panels, phi),
            np.zeros((0, *one.X.shape[:1] * 2)),
            none,
            none,
        )
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
    pricing: Pricing, panels: Panels, one: Density, accuracy: float
) -> tuple[Panels, Density, NDArray] | None:
    """Panels, certificate and its own density, within the power, after Newton's method from a certificate."""
    if panels.B is not None or one.X.size > LARGEST:
        return None
    try:
        one = polished_price(pricing.problem.criterion, partial(answer, pricing, panels), one)
    except np.linalg.LinAlgError:
        return None
    panels = pricing.resolved(panels, one, accuracy)
    phi = pricing.at(panels, one)[0]
    return panels, one, phi / max(1.0, pricing.used(panels, phi))
