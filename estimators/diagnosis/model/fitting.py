"""Fitting a structure to a record: Levenberg-Marquardt on simulation errors, whitened by an AR noise model."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.model.derivatives import exact_columns
from estimators.diagnosis.model.edges import centred
from estimators.diagnosis.model.rounding import deviance_residual, expected, rounded_deviance, told
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Structure
from estimators.residual.algebra import bridged

Array = NDArray[Any]
WHOLE = 15
"""Gauss-Newton steps from which on a fit is meant to end at its minimum, not only to tell candidates apart."""
ENDS, ROUGH = (1e-5, 2), (1e-3, 1)
"""When a fit ends: so many steps that gain less than such a share. One that only tells candidates apart ends where a step is
worth about one unit of deviance in 1000 samples."""
TRIES, SHORTER = 8, 12
"""Dampings that are tried for a step while it raises the error, and while it ends the simulation."""
IDLE = 1e-6
"""Change of a residual by a typical size of a parameter, of its norm, below which these samples say nothing of it, as of a time of
change that lies in a block left out: a step for it would be endless, and hold up all others."""
COARSE = 2
"""Integration steps per sample of what is differenced: derivatives are good to some percent, at two fifths of the work."""


@dataclass(frozen=True, eq=False)
class Channel:
    """One measured output with the inputs that may act on it.

    `u` (N, nu) inputs; `y` (N,) output; `clock` sample numbers; `keep` (N,) True where the sample counts: not
    held, not an outlier; `step` quantisation step, 0 where the output is not coarsely rounded.
    """

    u: Array
    y: Array
    clock: Clock
    keep: NDArray[np.bool_]
    step: float = 0.0

    def __len__(self) -> int:
        return len(self.y)

    def without(self, out: NDArray[np.bool_]) -> "Channel":
        """The channel where some samples (N,) more do not count."""
        keep = self.keep & ~out
        return replace(self, y=bridged(self.y, out, keep), keep=keep)


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted structure.

    `structure` its form; `p` parameters; `noise` AR coefficients of the noise, empty for white noise;
    `variance` innovation variance; `deviance` n log(variance): minus twice the log-likelihood, up to a
    constant; `residual` (N,) simulation error, 0 where a sample does not count; `n` samples that count;
    `jacobian` (N, size) derivatives of the residual at the solution; `scales` (size,) typical sizes of the
    parameters; `weight` AR coefficients by which the error was whitened whose squares the fit made least,
    `whitened` those by which the jacobian was; `unrounded` (N,) where samples are rounded: the expected error
    of what was rounded, and the jacobian's root of what rounding leaves of the information.
    """

    structure: Structure
    p: Array
    noise: Array
    variance: float
    deviance: float
    residual: Array
    n: int
    jacobian: Array = field(repr=False)
    scales: Array = field(repr=False)
    weight: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    whitened: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    unrounded: Array | None = field(default=None, repr=False)

    @property
    def size(self) -> int:
        """Number of fitted parameters, the noise model's included."""
        return len(self.p) + len(self.noise)

    @property
    def criterion(self) -> float:
        """Schwarz's criterion, with the price of the shapes that the search tried."""
        tries = sum(np.log(part.effect.tries(self.n)) for part in self.structure.effects)
        return self.deviance + self.size * np.log(self.n) + 2.0 * tries


def _innovation(r: Array, noise: Array) -> Array:
    # np.convolve: what lfilter does for a finite filter, without its cost per call
    return np.convolve(r, np.concatenate(([1.0], noise)))[: len(r)] if len(noise) else r


def innovations(r: Array, noise: Array) -> Array:
    """One-step-ahead errors A(q) r of a simulation error r."""
    return _innovation(r, noise)


def ar_model(r: Array, largest: int = 12) -> tuple[Array, float]:
    """AR model of a residual by least squares, its order by Schwarz's criterion (0 is white)."""
    n = len(r)
    largest = int(min(largest, n // 20))
    best, best_value, best_deviance = np.zeros(0), np.inf, np.inf
    past = np.zeros((n, largest + 1))
    for i in range(largest + 1):
        past[i:, i] = r[: n - i]
    gram = past.T @ past
    for order in range(largest + 1):
        a = np.zeros(0)
        rss = float(gram[0, 0])
        if order:
            try:
                a = -np.linalg.solve(gram[1 : order + 1, 1 : order + 1], gram[1 : order + 1, 0])
            except np.linalg.LinAlgError:
                break
            rss += float(gram[0, 1 : order + 1] @ a)
        deviance = n * np.log(max(rss / n, 1e-300))
        value = deviance + order * np.log(n) + (np.log(largest) * 2 if order else 0)
        if value < best_value - 1e-9:
            best, best_value, best_deviance = a, value, deviance
    return best, best_deviance


def finite(x: Array) -> bool:
    """Whether every value is finite: their sum is, which is quicker to ask (infinities that cancel give NaN)."""
    return math.isfinite(float(np.add.reduce(x)))


def _differences(
    residual: Callable[[Array], Array | None], r: Array, p: Array, steps: Array, known: set[int],
    rough: Callable[[Array], Array | None] | None, J: Array,
) -> None:  # fmt: skip
    """Writes finite differences into the columns of J (N, size) that are not known."""
    wanted = [i for i in np.flatnonzero(steps) if i not in known]
    here = rough(p) if wanted and rough is not None else None
    if rough is not None and here is not None and finite(here):
        residual, r = rough, here
    for i in wanted:
        J[:, i] = 0.0
        for sign in (1.0, -1.0):
            q = p.copy()
            q[i] += sign * steps[i]
            ri = residual(q)
            if ri is not None and finite(ri):
                J[:, i] = sign * (ri - r) / steps[i]
                break


def levenberg_marquardt(
    residual: Callable[[Array], Array | None],
    p: Array,
    scales: Array,
    *,
    iterations: int = 30,
    ends: tuple[float, int] = ENDS,
    steps: Array | None = None,
    rough: Callable[[Array], Array | None] | None = None,
    exact: Callable[[Array], Iterable[tuple[int, Array]]] | None = None,
) -> tuple[Array, float, Array]:
    """Minimise the sum of squares of a residual by damped Gauss-Newton steps.

    It ends after as many steps as `ends` says that each gain less than its share of the sum. `rough` is a cheaper residual
    whose differences stand for derivatives: the steps are a little off, the errors are not.
    """
    p = np.array(p, dtype=float)
    r = residual(p)
    if r is None or not np.all(np.isfinite(r)):
        return p, np.inf, np.zeros((0, len(p)))
    cost = float(r @ r)
    steps = 1e-6 * scales if steps is None else steps
    damping, small = 1e-3, 0
    J, unit = np.zeros((len(p), len(r))).T, np.eye(len(p))  # each column in one piece
    for _ in range(iterations):
        known = set()
        for i, column in () if exact is None else exact(p):
            J[:, i] = column
            known.add(i)
        _differences(residual, r, p, steps, known, rough, J)
        with np.errstate(over="ignore", invalid="ignore"):  # of a start that explodes; its step leads nowhere
            H = J.T @ J
            norms = np.sqrt(H.diagonal())
            idle = norms * scales <= IDLE * np.sqrt(cost)
            if idle.any():
                J[:, idle], H[idle], H[:, idle], norms[idle] = 0.0, 0.0, 0.0, 1.0
            H, g = H / norms / norms[:, None], J.T @ r / norms
        improved, left = False, [TRIES, SHORTER]
        while min(left) > 0:
            try:
                delta = -np.linalg.solve(H + damping * unit, g) / norms
            except np.linalg.LinAlgError:
                damping *= 10
                left[0] -= 1
                continue
            q = p + delta
            rq = residual(q)
            if rq is not None and finite(rq):
                with np.errstate(over="ignore"):
                    new = float(rq @ rq)
                if new < cost:
                    drop = (cost - new) / cost if cost > 0 else 0.0
                    p, r, cost = q, rq, new
                    damping = max(damping * 0.2, 1e-9)
                    improved = True
                    break
                left[0] -= 1
            else:  # a pole left the circle, which says nothing of the errors near here
                left[1] -= 1
            damping *= 6.0
        if not improved:
            break
        small = small + 1 if drop < ends[0] else 0
        if small >= ends[1] or cost <= 1e-300:
            break
    return p, cost, J


def _errors(channel: Channel, structure: Structure, noise: Array, q: Array) -> Array | None:
    """One-step-ahead errors (N,) of the simulated output, 0 where a sample does not count; None where it does not stay finite."""
    y = simulate(structure, q, channel.u, channel.clock)
    return _innovation(np.where(channel.keep, channel.y - y, 0.0), noise) if finite(y) else None


def _steps(structure: Structure, scales: Array) -> Array:
    """Steps of the finite differences: a quarter of a sample where nothing happens between samples."""
    steps = 1e-6 * scales
    for part, sl in zip(structure.parts, structure.slices(), strict=True):
        for i, (_, unit) in enumerate(part.parameters(structure.order)):
            if unit == "sample" and part.effect.per_sample and scales[sl.start + i] > 0.0:
                steps[sl.start + i] = 0.25
    return steps


def fit(
    channel: Channel,
    structure: Structure,
    p: Array,
    scales: Array,
    *,
    noise: Array | None = None,
    iterations: int = 30,
    colour: bool = True,
) -> Fit:
    """Fit a structure to a channel from a start."""
    noise = shape = np.zeros(0) if noise is None else noise
    if channel.step > 0:
        return _fit_rounded(channel, structure, p, scales, shape, iterations)
    keep, n = channel.keep, int(channel.keep.sum())

    def exact(q: Array) -> Iterator[tuple[int, Array]]:
        for i, d in exact_columns(structure, q, channel.u, channel.clock):
            if scales[i] != 0.0:
                yield i, -_innovation(np.where(keep, d, 0.0), shape)

    inside = any(q.effect.force is not None or q.effect.inside is not None for q in structure.parts)
    rough = partial(_errors, channel, replace(structure, steps=COARSE), shape) if inside else None
    p, cost, J = levenberg_marquardt(
        partial(_errors, channel, structure, shape), p, scales, iterations=iterations,
        steps=_steps(structure, scales), rough=rough, exact=exact,
        ends=ROUGH if iterations < WHOLE and structure.effects else ENDS,
    )  # fmt: skip
    if not np.isfinite(cost):
        return _unfitted(channel, structure, p, scales, noise)
    run = lambda q: simulate(structure, q, channel.u, channel.clock)
    if iterations >= WHOLE and structure.effects:
        p = centred(run, structure, p, scales)
    r = np.where(keep, channel.y - run(p), 0.0)
    variance = float(np.sum(_innovation(r, noise) ** 2) / n)
    deviance, whitened = n * np.log(max(variance, 1e-300)), shape
    if colour:
        again, _ = ar_model(r)
        v = float(np.sum(_innovation(r, again) ** 2) / n)
        if n * np.log(max(v, 1e-300)) + len(again) * np.log(n) < deviance + len(noise) * np.log(n):
            if not len(noise) and J.size:
                J = np.asarray(lfilter(np.concatenate(([1.0], again)), [1.0], J, axis=0))
                whitened = again
            noise, variance, deviance = again, v, n * np.log(max(v, 1e-300))
    return Fit(structure, p, noise, variance, deviance, r, n, J, scales, shape, whitened)


SHARES = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0)
"""Growing first shares of a record, each by half: what is in phase with the record in one stays so in the next. Less than a tenth
tells the parameters too little, and they go astray."""
GROWN = 8
"""Gauss-Newton steps in each of them."""


def grown(
    channel: Channel, structure: Structure, starts: Iterable[tuple[Array, Array]]
) -> list[tuple[float, Array]]:
    """Deviances and parameters, least first, of starts (parameters, typical sizes) that were fitted to growing first shares of a record.

    What swings far or turns over comes out of phase with the record from nearly every start, so that a fit to all of it ends where
    it hardly moves. Half of the starts are given up with each share.
    """
    trials, lead = [(0.0, p, scales) for p, scales in starts], channel.clock.lead
    for share in SHARES:
        m = lead + int(share * (len(channel) - lead))
        few = replace(
            channel,
            u=channel.u[:m],
            y=channel.y[:m],
            keep=channel.keep[:m],
            clock=replace(channel.clock, k=channel.clock.k[:m]),
        )
        fits = [fit(few, structure, p, scales, iterations=GROWN, colour=False) for _, p, scales in trials]
        fits = sorted((f for f in fits if np.isfinite(f.deviance)), key=lambda f: f.deviance)
        trials = [(f.deviance, f.p, f.scales) for f in fits[: max(1, -(-len(trials) // 2))]]
    return [(deviance, p) for deviance, p, _ in trials]


def _unfitted(channel: Channel, structure: Structure, p: Array, scales: Array, noise: Array) -> Fit:
    """What stands for a fit whose start does not stay finite."""
    nothing, n = np.zeros((0, len(p))), int(channel.keep.sum())
    return Fit(structure, p, noise, np.inf, np.inf, np.full(len(channel), np.inf), n, nothing, scales)


def _fit_rounded(
    channel: Channel, structure: Structure, p: Array, scales: Array, noise: Array, iterations: int
) -> Fit:
    """Fit to rounded samples: least squares, then the likelihood of their intervals, in turn with the noise level."""
    keep, n, steps = channel.keep, int(channel.keep.sum()), _steps(structure, scales)
    p, cost, _ = levenberg_marquardt(
        partial(_errors, channel, structure, noise), p, scales, iterations=iterations, steps=steps
    )
    if not np.isfinite(cost):
        return _unfitted(channel, structure, p, scales, noise)
    sigma = max(float(np.sqrt(cost / n)), channel.step / 30)

    def likelihood(q: Array) -> Array | None:
        y = simulate(structure, q, channel.u, channel.clock)
        if not finite(y):
            return None
        return np.where(keep, deviance_residual(channel.y, y, channel.step, sigma), 0.0)

    def deviance_here() -> tuple[float, float]:
        simulated = simulate(structure, p, channel.u, channel.clock)
        return rounded_deviance(channel.y[keep], simulated[keep], channel.step, sigma)

    for _ in range(3):
        p, _, _ = levenberg_marquardt(likelihood, p, scales, iterations=max(5, iterations // 3), steps=steps)
        sigma = max(float(np.sqrt(deviance_here()[1])), channel.step / 200)
    r = np.where(keep, channel.y - simulate(structure, p, channel.u, channel.clock), 0.0)
    deviance, variance = deviance_here()
    J, e = (
        np.zeros((len(p), len(channel))).T,
        np.where(keep, expected(r, np.zeros(len(r)), channel.step, np.sqrt(variance)), 0.0),
    )
    _differences(partial(_errors, channel, structure, np.zeros(0)), r, p, steps, set(), None, J)
    # Both divided so that their products are the scores: e = E[y | its interval] - simulated moves with the parameters by
    # the share of its information of what the simulation does, in the mean over what could have been read.
    share = np.sqrt(told(r, channel.step, float(np.sqrt(variance))))
    return Fit(
        structure, p, noise, variance, deviance, r, n, J * share[:, None], scales, noise, noise, e / share
    )


def leaving(f: Fit, residual: Array) -> Fit:
    """A fit with another residual in place of its own, and the noise model that this asks for."""
    noise, deviance = ar_model(residual)
    variance = float(np.sum(innovations(residual, noise) ** 2) / f.n)
    return replace(f, residual=residual, noise=noise, variance=variance, deviance=deviance)
