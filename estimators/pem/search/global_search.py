"""The search for the global optimum of one output: many starts, then modes moved to where they serve better."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimators.pem.search.confirmation import LAGS, Standing, confirmed, first_start, nothing_left, standing
from estimators.pem.search.extras import Settings
from estimators.pem.search.levenberg_marquardt import Optimum, Point, determined
from estimators.pem.search.moving_modes import drawn, integrating, relocations
from estimators.pem.search.problem import APART, Problem, determining
from estimators.pem.search.starts import (
    arma_start,
    armax_start,
    filtered,
    lagged_gram,
    low_order_fits,
    reflected,
    steiglitz_mcbride,
)
from oed.errors import InputError

MANY = 20_000
"""Samples on which the search goes through all starts; more only refine what it finds."""
FEW, SOME = 400, 3000
"""Samples up to which models of one or two modes are searched for at all, and those of more closely: noise makes
more optima of few samples."""
ENOUGH = 5000
"""Samples of several records that the iterated starts take, spread over the records."""
MOST = 12
"""Modes up to which a model is searched for closely: with more every evaluation costs too much for that."""
DRAWS = 12
"""Random starts for every mode on up to 1000 samples."""


def best_optimum(problem: Problem, own: NDArray | None, how: Settings) -> Optimum:
    """The lowest of the optima that the starts lead to, and the lowest that the data determine where the order is too high."""
    best = _lowest(problem, own, how)
    if own is not None or determined(best.point.hessian):
        return best
    # A mode too many may end where it is a level and an initial state too: models that do as well stand beside it.
    points = [
        p for p in problem.points(candidates(problem, first_start(problem))) if determined(p.hessian, APART)
    ]
    ends = [
        problem.descend(
            point, max_iterations=how.max_iterations, tolerance=how.tolerance,
            evaluate=determining(problem.evaluate, point),
        )
        for point in points
    ]  # fmt: skip
    ends = [end for end in ends if nothing_left(problem, end.point)]
    return min(ends, key=lambda end: end.point.loss, default=best)


def _lowest(problem: Problem, own: NDArray | None, how: Settings) -> Optimum:
    """The lowest of the optima that the starts lead to."""
    max_iterations, tolerance, search = how.max_iterations, how.tolerance, how.search
    first = begun = None
    if own is None and search != "thorough" and (begun := first_start(problem)) is not None:
        for point in problem.points([begun]):
            first = problem.descend(point, max_iterations=max_iterations, tolerance=tolerance)
            if confirmed(problem, first):
                return first
    large = own is None and search == "auto" and problem.n_samples > 1.5 * MANY and not problem.variant
    zs = [own] if own is not None else candidates(problem, begun)
    if large:  # all starts and relocations on a part first; its optimum is near that of all
        part = problem.first(MANY)
        zs.append(best_optimum(part, None, replace(how, tolerance=1e-10)).point.z)
    points = problem.points(zs) or problem.points([np.zeros(problem.n_parameters)])
    if not points:
        raise InputError("the loss is not finite at any start; are the samples of a usable size?")
    if own is None:
        points += problem.points(integrating(problem, points))
    points.sort(key=lambda p: p.loss)
    if large:
        own_first = problem.points(zs[-1:])
        points = [*own_first, *points[:1]] if own_first else points
    if first is not None and first.status.ok and not large:
        best = first
    else:
        best = problem.descend(points.pop(0), max_iterations=max_iterations, tolerance=tolerance)
    best, _ = _better(problem, best, points, how)
    if first is not None and first.point.loss < best.point.loss:
        best = first
    moves = own is None and search != "quick" and bool(problem.structure.nc[0] or problem.structure.nf.any())
    if moves and (search == "thorough" or problem.n_samples <= 1.5 * MANY):
        best = _explored(problem, best, how)
    return best


def _explored(problem: Problem, best: Optimum, how: Settings) -> Optimum:
    """The best optimum after modes were moved about it until that no longer helps, and then drawn at random."""
    form = problem.structure
    modes, hard = int(form.nf[0].sum() + form.nc[0] + form.nd[0]), how.search == "thorough"
    if modes <= 2 and problem.n_samples > FEW and not hard:
        return best
    known = Standing.OPEN if hard else standing(problem, best)
    if known is Standing.CONFIRMED:
        return best
    # Else the modes that are too many fit noise, wherever they are put.
    real = known is not Standing.OVER_ORDERED
    closely = hard or (problem.n_samples <= SOME and modes <= MOST and real)
    draws = int(modes * DRAWS * min(1.0, 1000 / problem.n_samples)) * closely * (4 if hard else 1)
    rng, width, told = np.random.default_rng(0), 3 if closely else 1, best
    for _ in range(4):
        before = best.point.loss
        for _ in range(6 if real else 1):
            start = best.point.loss
            points = relocations(problem, best.point, width, closely)
            points += _other_noise_models(problem, best.point)
            best, _ = _better(problem, best, points, how)
            if best.point.loss > start * (1 - 1e-7):
                break
        # Where nothing was left and moved modes found nothing, draws found nothing in 139 of 139 records either.
        if not draws or (known is Standing.UNTOLD and best.point.loss > before * (1 - 1e-7)):
            break
        best, rivals = _better(problem, best, drawn(problem, best.point, draws, rng), how)
        for rival in rivals:
            best, _ = _better(problem, best, relocations(problem, rival, 1, closely), how)
        if best.point.loss > before * (1 - 1e-7):
            break
    # Such a mode put at 1 is a level and an initial state too: no gain in loss is worth parameters that nothing determines.
    return best if real or determined(best.point.hessian) or not determined(told.point.hessian) else told


def _better(
    problem: Problem, best: Optimum, points: list[Point], how: Settings
) -> tuple[Optimum, list[Point]]:
    """The best optimum, after a look along the way from each point, and the two next best that were met."""
    rivals: list[Point] = []
    for point in points:
        near, lost = point, False
        for steps in (0, 4, 10):
            if steps:
                end = problem.descend(near, max_iterations=steps, tolerance=1e-5)
                near, left = end.point, 3 * end.decrement
                lost = left < 0.3 and near.loss * (1 - left) > best.point.loss
                if lost:
                    rivals.append(near)
            lost = lost or _same_basin(near, best.point, problem)
            if lost:
                break
        if lost:
            continue
        optimum = problem.descend(near, max_iterations=how.max_iterations, tolerance=how.tolerance)
        if optimum.point.loss < best.point.loss:
            best, optimum = optimum, best
        rivals.append(optimum.point)
    return best, _apart(rivals, best.point, problem)


def _apart(points: list[Point], best: Point, problem: Problem) -> list[Point]:
    """The two lowest points in other basins than the best and than each other."""
    kept: list[Point] = []
    for point in sorted(points, key=lambda p: p.loss):
        if len(kept) < 2 and not any(_same_basin(point, other, problem) for other in [best, *kept]):
            kept.append(point)
    return kept


def _other_noise_models(problem: Problem, point: Point) -> list[Point]:
    """The same G with C and D found anew from what G leaves."""
    form, place = problem.structure, problem.structure.places()[0]
    nc, nd = int(form.nc[0]), int(form.nd[0])
    if form.na[0] or not nc + nd:
        return []
    bs, fs = ([point.z[s] for s in place[x] if x == "f" or s.stop > s.start] for x in "bf")
    fs = [f for f, s in zip(fs, place["b"], strict=True) if s.stop > s.start]
    found = []
    for order in (8, 15, 30, 60):
        z = point.z.copy()
        z[place["c"][0]], z[place["d"][0]] = _noise_start(_signals(problem), bs, fs, nc, nd, order)
        found.append(z)
    return sorted(problem.points(found), key=lambda p: p.loss)


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


def candidates(problem: Problem, known: NDArray | None = None) -> list[NDArray[np.float64]]:
    """Starts for one output, by linear algebra alone: returns (n + levels,)."""
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
    least = max([*nb, *nf]) + 1
    several = sum(nf) > 2  # optima are many: so are the starts
    orders = (2 * (sum(nf[:1]) + na) + 4, 20, 40, *((10, 30) if several else ()))
    orders = sorted({min(most, max(least, p)) for p in orders})
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
    systems = [
        ([known[place["b"][j]] for j in present], [known[place["f"][j]] for j in present])
        if known is not None and order == LAGS
        else low_order_fits(gram, order, nb, nf)
        for order in orders
    ]
    if len(nb) == 1:
        few = signals[:: max(1, total // ENOUGH)]
        for _, fs in systems[:] if several else systems[:1] + systems[-1:]:
            b, f = steiglitz_mcbride(few, nb[0], fs[0])
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
