"""Where else the optimum may lie: modes moved to other frequencies, or drawn anew, all that is linear solved for.

A local optimum differs from the global one by modes that have settled in the wrong place, mostly on top of a zero.
With some polynomials held the residual is affine in the others (Golub, Pereyra 1973, SIAM J. Numer. Anal. 10, 413):
in B and the levels given F, C, D; in A and B given C; in D given B, F, C. So one evaluation tells the loss at the best
of these, and only the places of few modes are searched."""

import itertools

import numpy as np
from numpy.typing import NDArray

from estimators.pem.search.levenberg_marquardt import Point, units
from estimators.pem.search.problem import Problem
from estimators.pem.search.starts import reflected

RINGS = (0.0, 0.8, 0.94, 0.98, 0.995, 2.0)
"""Moduli of new modes between which the best are kept."""
NEAR = 0.05
"""A mode this near to 1 may stand for an integrator."""
Trial = tuple[float, NDArray[np.float64]]
"""The loss foretold, and the parameters."""


def _affine(problem: Problem, letters: str) -> NDArray[np.bool_]:
    """Which scaled parameters belong to these polynomials and may move; levels go with b where there is no A."""
    form, mask = problem.structure, np.zeros(problem.n_parameters, bool)
    for place in form.places():
        for letter in letters:
            for part in place[letter]:
                mask[part] = True
    if "b" in letters and not form.na.any():
        mask[form.n :] = True
    if problem.lower is not None and problem.upper is not None:
        mask &= problem.lower < problem.upper
    return mask


def solved(problem: Problem, z: NDArray, free: NDArray) -> Trial | None:
    """The best values of parameters in which the residual is affine, all others held: one evaluation."""
    # In D alone the residual is not affine together with the states, which D filters too.
    together = not free[problem.structure.places()[0]["d"][0]].any()
    point = problem.evaluate(problem.projected(z), affine=together)
    if point is None:
        return None
    moves = np.flatnonzero(free)
    hessian, gradient = point.hessian[moves[:, None], moves], point.gradient[moves]
    scale = units(hessian)
    with np.errstate(over="ignore"):  # the check below tells
        scaled = hessian * np.outer(scale, scale)
    scaled.flat[:: len(moves) + 1] += 1e-10
    if not np.isfinite(scaled).all():
        return None
    step = -scale * np.linalg.solve(scaled, scale * gradient)
    z = point.z.copy()
    z[moves] += step
    return point.loss + float(gradient @ step), z


def _searched(problem: Problem) -> list[tuple[slice, list[NDArray[np.bool_]]]]:
    """The polynomials whose modes are moved, each with what is solved for in turn."""
    form, place = problem.structure, problem.structure.places()[0]
    if form.na[0]:
        return [(place["c"][0], [_affine(problem, "ab")])] if form.nc[0] else []
    by_b, found = _affine(problem, "b"), []
    for b, f in zip(place["b"], place["f"], strict=True):
        if b.stop > b.start and f.stop > f.start:
            found.append((f, [by_b]))
    if form.nc[0]:
        found.append((place["c"][0], [_affine(problem, "d")] if form.nd[0] else []))
    return found


def integrating(problem: Problem, points: list[Point]) -> list[NDArray[np.float64]]:
    """Starts whose slowest mode is all but an integrator: linear algebra seldom finds a pole that near to 1."""
    form, found = problem.structure, []
    if form.na[0] or not form.nf.any():
        return found
    free = _affine(problem, "b")
    for point in sorted(points, key=lambda p: p.loss)[:3]:
        for part in form.places()[0]["f"]:
            roots = np.roots(np.concatenate([[1.0], point.z[part]])).astype(complex)
            if not roots.size or np.abs(roots - 1).min() > NEAR:
                continue
            k = int(np.argmin(np.abs(roots - 1)))
            if abs(roots[k].imag) > 1e-9:  # a slow pair: the other one becomes real
                other = int(np.argmin(np.abs(roots - roots[k].conj())))
                roots[other] = abs(roots[k])
            roots[k] = 1 - 1e-5
            z = point.z.copy()
            z[part] = np.real(np.poly(roots))[1:]
            trial = solved(problem, z, free)
            found += [] if trial is None else [trial[1]]
    return found


def relocations(problem: Problem, point: Point, keep: int = 3, fine: bool = True) -> list[Point]:
    """Each mode in turn taken out and put back elsewhere, the modes that matter least first."""
    pairs, singles, found = _places(fine, problem.n_samples), _reals(fine), list[Point]()
    for part, solves in _searched(problem):
        out = []
        for rest, degree in without_each_mode(point.z[part]):
            bare = point.z.copy()
            bare[part] = np.concatenate([rest, np.zeros(degree)])[1:]
            trial = _through(problem, bare, solves)
            if trial is not None:
                out.append((trial[0], rest, degree))
        out.sort(key=lambda row: row[0])
        trials: list[tuple[float, NDArray, complex]] = []
        for _, rest, degree in out[:4]:
            for mode, pole in pairs if degree == 2 else singles:
                z = point.z.copy()
                z[part] = np.convolve(rest, mode)[1:]
                trial = _through(problem, z, solves)
                if trial is not None:
                    trials.append((*trial, pole))
        for ring in _apart(trials, 4 * keep):
            near = [problem.descend(p, max_iterations=2, tolerance=1e-5).point for p in problem.points(ring)]
            found += sorted(near, key=lambda p: p.loss)[:keep]
    return sorted(found, key=lambda p: p.loss)


def drawn(problem: Problem, point: Point, count: int, rng: np.random.Generator) -> list[Point]:
    """Starts whose modes are partly those of an optimum, partly drawn at random."""
    searched, points = _searched(problem), []
    for _ in range(count if searched else 0):
        z, which = point.z.copy(), rng.integers(len(searched)) if rng.random() < 0.5 else None
        for k, (part, _) in enumerate(searched):
            if which is None or k == which:
                z[part] = _redrawn(z[part], rng)
        if not problem.structure.na[0] and rng.random() < 0.3:
            for letter in "cd":
                z[problem.structure.places()[0][letter][0]] = 0.0
        trial: Trial | None = (np.inf, z)
        for _, solves in searched:
            trial = None if trial is None else _through(problem, trial[1], solves)
        points += [] if trial is None else problem.points([trial[1]])
    return sorted(points, key=lambda p: p.loss)


def _through(problem: Problem, z: NDArray, solves: list[NDArray[np.bool_]]) -> Trial | None:
    """All solves in turn; without any, the loss as it is."""
    if not solves:
        point = problem.evaluate(problem.projected(z))
        return None if point is None else (point.loss, point.z)
    trial: Trial | None = (np.inf, z)
    for free in solves:
        trial = None if trial is None else solved(problem, trial[1], free)
    return trial


def _places(fine: bool, samples: int) -> list[tuple[NDArray, complex]]:
    """Pairs of poles over the unit disc, closer together near the circle where they matter more."""
    rings = (
        ((0.6, 6), (0.85, 10), (0.95, 18), (0.985, 36), (0.998, int(np.clip(samples / 3, 60, 200))))
        if fine
        else ((0.7, 6), (0.93, 12), (0.985, 18))
    )
    poles = [r * np.exp(1j * w) for r, count in rings for w in np.pi * (np.arange(count) + 0.5) / count]
    pairs = [(np.array([1.0, -2 * p.real, abs(p) ** 2]), p) for p in poles]
    ends = (-0.98, -0.6, 0.4, 0.85, 0.98) if fine else (-0.7, 0.5, 0.9)
    for k, a in enumerate(ends):
        pairs += [(np.array([1.0, -a - b, a * b]), complex(a, -b)) for b in ends[k:]]
    return pairs


def _reals(fine: bool) -> list[tuple[NDArray, complex]]:
    some = (-0.9, -0.5, 0.0, 0.5, 0.9)
    ends = (-0.9999, -0.99, -0.7, *some, 0.7, 0.97, 0.9999) if fine else some
    return [(np.array([1.0, -a]), complex(a)) for a in ends]


def _apart(trials: list[tuple[float, NDArray, complex]], keep: int) -> list[list[NDArray]]:
    """The best trials of each ring, none side by side: near the circle the loss is low only where a mode is just right."""
    rings = []
    trials.sort(key=lambda row: row[0])
    for low, high in itertools.pairwise(RINGS):
        chosen: list[tuple[NDArray, complex]] = []
        for _, z, pole in trials:
            room = 0.03 + 0.5 * (1 - min(abs(pole), 1.0))
            if low <= abs(pole) < high and all(abs(pole - p) > room for _, p in chosen):
                chosen.append((z, pole))
                if len(chosen) == keep:
                    break
        rings.append([z for z, _ in chosen])
    return rings


def _redrawn(tail: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
    """A polynomial of the same degree, some of its modes drawn anew."""
    modes = [np.roots(np.concatenate([[1.0], tail]))][0].astype(complex)
    held = [p for p in modes if p.imag > 1e-9] + [p for p in modes if abs(p.imag) <= 1e-9]
    share, roots, left = rng.random(), [], len(tail)
    for p in held:
        width = 2 if p.imag > 1e-9 else 1
        if rng.random() < share and width <= left:
            roots += [p, p.conjugate()] if width == 2 else [p]
            left -= width
    while left:
        radius = 1 - 0.9 * rng.random() ** 2
        radius = min(radius, 0.995)
        if left > 1 and rng.random() < 0.75:
            p = radius * np.exp(1j * rng.uniform(0, np.pi))
            roots, left = [*roots, p, p.conjugate()], left - 2
        else:
            roots, left = [*roots, complex(radius * rng.choice([-1.0, 1.0]))], left - 1
    return reflected(np.real(np.poly(roots))[1:], 0.995)


def without_each_mode(tail: NDArray) -> list[tuple[NDArray, int]]:
    """The polynomial without one pair of roots, or without one real root, each in turn."""
    roots = np.roots(np.concatenate([[1.0], tail])).astype(complex)
    roots = np.concatenate([roots, np.zeros(len(tail) - len(roots))])
    pairs = [k for k in range(len(roots)) if roots[k].imag > 1e-9]
    real = [k for k in range(len(roots)) if abs(roots[k].imag) <= 1e-9]
    taken: list[tuple[int, ...]] = [(k, int(np.argmin(np.abs(roots - roots[k].conj())))) for k in pairs]
    taken += [(k,) for k in real]
    taken += [(a, b) for n, a in enumerate(real) for b in real[n + 1 :]]
    return [(np.atleast_1d(np.real(np.poly(np.delete(roots, list(t))))), len(t)) for t in taken]
