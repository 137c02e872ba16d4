"""The search for the global optimum of one output: many starts, then modes moved to where they serve better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimators.pem.extras import Settings
from estimators.pem.gauss_newton import Optimum, Point
from estimators.pem.problem import Problem
from estimators.pem.starts import (
    arma_start,
    armax_start,
    filtered,
    high_order,
    lagged_gram,
    null_space_fit,
    reflected,
    steiglitz_mcbride,
)
from oed.errors import InputError

__all__ = ["best_optimum", "candidates", "relocations"]

MANY = 20_000
"""Samples on which the search goes through all starts; more only refine what it finds."""


def best_optimum(problem: Problem, own: NDArray | None, how: Settings) -> Optimum:
    """The lowest of the optima that the starts lead to.

    Parameters
    ----------
    problem : Problem
        Of one output.
    own : ndarray, optional
        A start in scaled parameters, which then is the only one.
    how : Settings
        Its `search`: whether modes are relocated; auto does so for more than two of them on up to 20000
        samples.

    Returns
    -------
    Optimum
        The best.
    """
    max_iterations, tolerance, search = how.max_iterations, how.tolerance, how.search
    large = own is None and search == "auto" and problem.n_samples > 1.5 * MANY and not problem.variant
    zs = [own] if own is not None else candidates(problem)
    if large:  # all starts and relocations on a part first; its optimum is near that of all
        part = problem.first(MANY)
        zs.append(best_optimum(part, None, replace(how, tolerance=1e-10)).point.z)
    points = [p for z in zs if (p := problem.evaluate(problem.projected(z))) is not None]
    if not points:
        points = [
            p for p in [problem.evaluate(problem.projected(np.zeros(problem.n_parameters)))] if p is not None
        ]
    if not points:
        raise InputError("the loss is not finite at any start; are the samples of a usable size?")
    points.sort(key=lambda p: p.loss)
    if large:
        own_first = problem.evaluate(problem.projected(zs[-1]))
        points = [own_first, *points[:1]] if own_first is not None else points
    best = problem.descend(
        points[0],
        max_iterations=max_iterations,
        tolerance=tolerance,
    )
    best = _better(problem, best, points[1:], max_iterations, tolerance)
    form = problem.structure
    modes = max(form.nf.max(), form.na[0]) + form.nc[0] + form.nd[0]
    moves = bool(form.nc[0] or form.nf.any()) and own is None and search != "quick"
    if moves and (search == "thorough" or (modes > 2 and problem.n_samples <= 1.5 * MANY)):
        for _ in range(4):
            before = best.point.loss
            best = _better(problem, best, relocations(problem, best.point), max_iterations, tolerance)
            if best.point.loss > before * (1 - 1e-10):
                break
    return best


def _better(problem: Problem, best: Optimum, points: list[Point], most: int, tolerance: float) -> Optimum:
    """The best optimum, after a look along the way from each point: most run to the optimum that is known."""
    for point in points:
        if _same_basin(point, best.point, problem):
            continue
        near = problem.descend(point, max_iterations=12, tolerance=1e-5).point
        if _same_basin(near, best.point, problem):
            continue
        optimum = problem.descend(near, max_iterations=most, tolerance=tolerance)
        if optimum.point.loss < best.point.loss:
            best = optimum
    return best


def relocations(problem: Problem, point: Point, keep: int = 6) -> list[Point]:
    """Each mode of G in turn taken out and put back at another frequency, the numerators refitted.

    A local optimum differs from the global one by a mode that has settled in the wrong place, mostly on top of
    a zero. With the denominators held the residual of fir, oe and bj models is linear in the numerators.

    Parameters
    ----------
    problem : Problem
        Of one output.
    point : Point
        An optimum.
    keep : int
        How many of the best new places are returned.

    Returns
    -------
    list of Point
        Starts, lowest loss first.
    """
    form, place = problem.structure, problem.structure.places()[0]
    linear = np.zeros(problem.n_parameters, bool)
    for part in place["b"]:
        linear[part] = True
    linear[form.n :] = True
    new_modes = [(r, w) for r in (0.7, 0.9, 0.98) for w in np.linspace(0.0, np.pi, 12)]
    found: list[Point] = []
    letter = "a" if form.na[0] else "f"
    for part in place[letter]:
        for rest, degree in _without_each_mode(point.z[part]):
            for radius, angle in new_modes:
                mode = np.array([1.0, -2 * radius * np.cos(angle), radius**2])
                mode = mode if degree == 2 else np.array([1.0, -radius * np.sign(np.cos(angle))])
                if degree == 1 and angle not in (0.0, np.pi):
                    continue
                z = point.z.copy()
                z[part] = np.convolve(rest, mode)[1:]
                ways = [z]
                if letter == "a":
                    ways.append(z.copy())
                    ways[1][place["c"][0]] = _moved(point.z[place["c"][0]], mode)
                for z in ways:
                    trial = problem.evaluate(problem.projected(z))
                    if trial is None:
                        continue
                    trial = problem.descend(trial, max_iterations=2, tolerance=1e-4, free=linear).point
                    found.append(trial)
    noise = [problem.evaluate(problem.projected(z)) for z in _other_noise_models(problem, point)]
    found.sort(key=lambda p: p.loss)
    return found[:keep] + sorted((p for p in noise if p is not None), key=lambda p: p.loss)[:keep]


def _other_noise_models(problem: Problem, point: Point) -> list[NDArray]:
    """The same G with C and D found anew from what G leaves, or with a mode of both moved elsewhere."""
    form, place = problem.structure, problem.structure.places()[0]
    nc, nd = int(form.nc[0]), int(form.nd[0])
    if form.na[0] or not nc + nd:
        return []
    bs, fs = ([point.z[s] for s in place[x] if x == "f" or s.stop > s.start] for x in "bf")
    fs = [f for f, s in zip(fs, place["b"], strict=True) if s.stop > s.start]
    pairs = [_noise_start(_signals(problem), bs, fs, nc, nd, order) for order in (8, 15, 30, 60)]
    c, d = point.z[place["c"][0]], point.z[place["d"][0]]
    for rest_c, taken_c in _without_each_mode(c):
        for rest_d, taken_d in _without_each_mode(d):
            if taken_c == taken_d:
                turns = np.linspace(0, np.pi, 9) if taken_c == 2 else np.array([0.0, np.pi])
                for angle in turns:
                    mode = np.array([1.0, -1.8 * np.cos(angle), 0.81])
                    mode = mode if taken_c == 2 else np.array([1.0, -0.9 * np.cos(angle)])
                    pairs.append((np.convolve(rest_c, mode)[1:], np.convolve(rest_d, mode)[1:]))
    moved = []
    for c, d in pairs:
        z = point.z.copy()
        z[place["c"][0]], z[place["d"][0]] = c, d
        moved.append(z)
    return moved


def _without_each_mode(tail: NDArray) -> list[tuple[NDArray, int]]:
    """The polynomial without one pair of roots, or without one real root, each in turn: (rest, degree taken)."""
    roots = np.roots(np.concatenate([[1.0], tail])).astype(complex)
    pairs = [k for k in range(len(roots)) if roots[k].imag > 1e-9]
    real = [k for k in range(len(roots)) if abs(roots[k].imag) <= 1e-9]
    taken: list[tuple[int, ...]] = [(k, int(np.argmin(np.abs(roots - roots[k].conj())))) for k in pairs]
    taken += [(k,) for k in real]
    taken += [(a, b) for n, a in enumerate(real) for b in real[n + 1 :]]
    return [(np.atleast_1d(np.real(np.poly(np.delete(roots, list(t))))), len(t)) for t in taken]


def _moved(tail: NDArray, mode: NDArray) -> NDArray:
    """C with the roots nearest to a mode replaced by it, so that A / C keeps its shape elsewhere."""
    degree = len(mode) - 1
    if len(tail) < degree:
        return tail
    target = np.roots(mode)[0]
    choices = [(rest, degree_out) for rest, degree_out in _without_each_mode(tail) if degree_out == degree]
    if not choices:
        return tail
    whole = np.concatenate([[1.0], tail])
    away = [abs(np.polyval(whole, target)) / max(abs(np.polyval(rest, target)), 1e-12) for rest, _ in choices]
    return reflected(np.convolve(choices[int(np.argmin(away))][0], mode)[1:], 0.995)


def _same_basin(point: Point, best: Point, problem: Problem) -> bool:
    """Whether a start lies within a standard error of an optimum already found, or a step leads there."""
    near = best.loss / problem.n_samples
    away = point.z - best.z
    distance = float(away @ best.hessian @ away)
    if distance > near * len(away):
        try:
            away = away - np.linalg.solve(point.hessian, point.gradient)
        except np.linalg.LinAlgError:
            return False
        distance = float(away @ best.hessian @ away)
    return distance < near and point.loss >= best.loss


def _signals(problem: Problem) -> list[tuple[NDArray, NDArray]]:
    width = problem.data.shape[1] - 2
    return [(d[:, width], d[:, :width]) for d in problem.records()]


def candidates(problem: Problem) -> list[NDArray[np.float64]]:
    """Starts for one output, by linear algebra alone.

    Parameters
    ----------
    problem : Problem
        Of one output.

    Returns
    -------
    list of ndarray
        (n + levels,) scaled parameters each.
    """
    form, signals = problem.structure, _signals(problem)
    place, width = form.places()[0], problem.n_parameters
    nb, nf = (
        [int(k) for k in form.nb[0] if k],
        [int(k) for k, m in zip(form.nf[0], form.nb[0], strict=True) if m],
    )
    present = [j for j in range(form.n_inputs) if form.nb[0, j]]
    na, nc, nd = int(form.na[0]), int(form.nc[0]), int(form.nd[0])
    if not (nc or nd or any(nf)):
        return [np.zeros(width)]
    shortest = min(len(y) for y, _ in signals)
    total = sum(len(y) for y, _ in signals)
    most = max(2, min(shortest // 3, total // (4 * (1 + len(nb)))))
    orders = sorted({min(most, p) for p in (2 * (sum(nf[:1]) + na) + 4, 20, 40)})
    found: list[NDArray] = []
    if na or not any(nf):
        for order in orders[1:] or orders:
            for theta in armax_start(signals, na, nb, nc, order):
                z = np.zeros(width)
                z[: len(theta)] = theta
                found.append(z)
        return found + [np.zeros(width)]
    channels = [np.column_stack([y, u]) for y, u in signals]
    gram = lagged_gram(channels, orders[-1] + 1)
    systems: list[tuple[list[NDArray], list[NDArray]]] = []
    for order in orders:
        A, B, spread = high_order(gram, order, 1)
        bs, fs = [], []
        for j, b_long in enumerate(B):
            at = np.r_[0:order, (j + 1) * order : (j + 2) * order]
            b, f = null_space_fit(A, b_long, spread[np.ix_(at, at)], nb[j], nf[j])
            bs.append(b)
            fs.append(f)
        systems.append((bs, fs))
    if len(nb) == 1:
        for _, fs in systems[:1] + systems[-1:]:
            b, f = steiglitz_mcbride(signals, nb[0], fs[0])
            systems.append(([b], [f]))
    for bs, fs in systems:
        z = np.zeros(width)
        for j, b, f in zip(present, bs, fs, strict=True):
            z[place["b"][j]], z[place["f"][j]] = b, f
        if nc or nd:
            z[place["c"][0]], z[place["d"][0]] = _noise_start(signals, bs, fs, nc, nd)
        found.append(z)
    return found


def _noise_start(
    signals: list, bs: list, fs: list, nc: int, nd: int, order: int = 30
) -> tuple[NDArray, NDArray]:
    noise = []
    for y, u in signals:
        v = y
        for j, (b, f) in enumerate(zip(bs, fs, strict=True)):
            v = v - filtered(b, np.concatenate([[1.0], reflected(f)]), u[:, j])
        noise.append(v)
    return arma_start(noise, nc, nd, order)
