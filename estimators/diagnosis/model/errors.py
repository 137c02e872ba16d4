"""Standard errors of fitted parameters: for the weights of the fit, noise with memory, and states that few samples tell."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.model.edges import cell
from estimators.diagnosis.model.fitting import Channel, Fit, innovations
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import stable_polynomial
from oed.covariances import NORMAL

Array = NDArray[Any]
LAGS = 1.3
"""Lags of Bartlett's weights (Newey and West), in cube roots of the record's length."""
BEFORE = 200
"""Samples before the record whose noise is still heard in it: a noise model's pole of 0.98 has forgotten all but 2 % by then."""


NULL, LEANS = 1e-12, 1e-2
"""Eigenvalue of the normalised information below which a combination of parameters is not told by the samples, and a parameter's
share of it from which on it is not either: derivatives by differences are good to about a millionth."""
PARABOLA = (0.5, 2.0)
"""What the squares rise by at the ends of a 95 % interval, of what the derivatives say, within which the derivatives are believed."""
REACH = 40
"""Samples on either side of a time of change in which another may do as well: between them the squares have a minimum each."""
FARTHEST = 64.0
"""Multiple of an interval up to which its end is looked for where the squares are no parabola."""

ELSEWHERE = 2.0 ** np.arange(-2, 7)
"""Multiples of its size by which a parameter is moved of which the samples say nothing nearby: past all that it can be."""


@dataclass(frozen=True, eq=False)
class Spread:
    """What a fit's derivatives say of its parameters: `covariance` (size, size), infinite on the diagonal where the samples say
    nothing of one that was to be fitted; `curvature` (size, size) inverse of the derivatives' products."""

    covariance: Array
    curvature: Array


def spread(f: Fit) -> Spread:
    """Covariance of the parameters of a fit.

    The larger of two variances: one takes noise of a constant spectrum, however few samples tell of a parameter; the other the
    squares of these samples' own errors (Newey and West), which a fit makes small where they are few, and which are right
    where the noise changes with the input.
    """
    J = _weighted(f)
    norms = np.sqrt(np.sum(J**2, axis=0))
    told = norms > 0.0
    J, norms = J / np.where(told, norms, 1.0), np.where(told, norms, 1.0)
    values, vectors = np.linalg.eigh(J.T @ J)
    null = values < NULL
    H = (vectors[:, ~null] / values[~null]) @ vectors[:, ~null].T * np.outer(told, told)
    C, own = (H @ S @ H for S in _score_covariances(J, f))
    wider = np.sqrt(np.maximum(np.diag(own) / np.where(np.diag(C) > 0.0, np.diag(C), np.inf), 1.0)) / norms
    C = C * np.outer(wider, wider)
    lost = np.any(np.abs(vectors[:, null]) > LEANS, axis=1) & (f.scales != 0.0)
    C[lost, lost] = np.inf
    C[f.scales == 0.0], C[:, f.scales == 0.0] = 0.0, 0.0  # what is held has none, nor a rounding's
    return Spread(C, H / np.outer(norms, norms))


def _weighted(f: Fit) -> Array:
    """(N, size) the jacobian with the weight of the error whose squares the fit made least."""
    return np.asarray(lfilter(np.r_[1.0, f.weight], np.r_[1.0, f.whitened], f.jacobian, axis=0))


def parameters_of(f: Fit, channel: Channel, prefix: str = "") -> dict[str, tuple[float, float, str]]:
    """Parameters of a fit's parts, with standard errors that know of the noise's correlation."""
    if not f.jacobian.size:
        return {}
    known = spread(f)
    errors = _beside(f, channel, known, np.sqrt(np.maximum(np.diag(known.covariance), 0.0)))
    out: dict[str, tuple[float, float, str]] = {}
    for part, sl in zip(f.structure.parts, f.structure.slices(), strict=True):
        for i, (name, unit) in enumerate(part.parameters(f.structure.order)):
            label = f"{prefix}{part.key}.{name}"
            if label in out:  # the same effect at another input
                label += f"_{part.channel + 1}"
            at = sl.start + i
            error = _followed(f, channel, known, at, float(errors[at]))
            if part.effect.timed and unit == "sample" and f.scales[at] > 0.0:
                other = _other_times(f, channel, at)
                # where no sample beside it is a measurement, the derivatives say nothing, and those farther off do
                lost = error == np.inf and 0.0 < other < REACH / NORMAL
                error = other if lost else max(error, other)
            if part.effect.search is not None and f.scales[at] > 0.0 and len(channel) == len(f.residual):
                run = lambda q: simulate(f.structure, q, channel.u, channel.clock)
                ends = cell(run, f.p, at, float(f.scales[at]))
                if (
                    ends is not None
                ):  # where no sample is as near as a difference is wide, the derivatives say nothing
                    error = max(error if error < np.inf else 0.0, 0.5 * (ends[1] - ends[0]) / NORMAL)
            value = float(f.p[at])
            out[label] = (abs(value) if value < 0.0 and _signless(f, channel, at) else value, error, unit)
    return out


def _signless(f: Fit, channel: Channel, at: int) -> bool:
    """Whether the sign of a parameter means nothing: what takes its size runs alike with the other one."""
    there = np.where(np.arange(len(f.p)) == at, -f.p, f.p)
    run = lambda p: simulate(f.structure, p, channel.u, channel.clock)
    return np.array_equal(run(there), run(f.p))


def _followed(f: Fit, channel: Channel, known: Spread, at: int, error: float) -> float:
    """Standard error of one parameter, the others moving with it; where the squares are no parabola over its interval, as for a time
    of change, from where they have risen by as much as at the ends of one. Never less than the derivatives say."""
    if not 0.0 < error < np.inf or f.unrounded is not None or len(channel) != len(f.residual):
        return error
    least = float(np.sum(innovations(f.residual, f.weight) ** 2))
    way = known.curvature[:, at] / known.curvature[at, at] * NORMAL * error
    height = (NORMAL * error) ** 2 / known.curvature[at, at]

    def rise(t: float) -> float:
        y = simulate(f.structure, f.p + t * way, channel.u, channel.clock)
        r = np.where(channel.keep, channel.y - y, 0.0)
        with np.errstate(over="ignore"):  # of a run that is about to explode they are infinite
            return float(np.sum(innovations(r, f.weight) ** 2)) - least if np.isfinite(y[-1]) else np.inf

    low, high = PARABOLA
    if all(low * height < rise(side) < high * height for side in (1.0, -1.0)):
        return error
    return error * max(1.0, *(_end(lambda t, side=side: rise(side * t), height) for side in (1.0, -1.0)))


def _beside(f: Fit, channel: Channel, known: Spread, errors: Array) -> Array:
    """Standard errors (size,) whose 95 % intervals hold what the parameters would be beside other values, as likely, of those that the
    samples say nothing of nearby: a play that its input has moved at once says nothing of where it was, one it has not does."""
    lost = np.isinf(errors)
    if not lost.any() or f.unrounded is not None or len(channel) != len(f.residual):
        return errors
    J = _weighted(f)[:, ~lost]
    norms = np.sqrt(np.sum(J**2, axis=0))
    shifts = (
        np.linalg.pinv(J / np.where(norms > 0.0, norms, 1.0)) / np.where(norms > 0.0, norms, 1.0)[:, None]
    )
    here = innovations(f.residual, f.weight)
    widths = NORMAL * errors[~lost]
    heights = np.maximum(widths**2 / np.maximum(np.diag(known.curvature)[~lost], 1e-300), 1e-300)
    ends = widths.copy()
    for at in np.flatnonzero(lost):
        for step in np.outer(ELSEWHERE, (1.0, -1.0)).ravel() * f.scales[at]:
            q = f.p.copy()
            q[at] += step
            y = simulate(f.structure, q, channel.u, channel.clock)
            if not np.isfinite(y[-1]):
                continue
            r = innovations(np.where(channel.keep, channel.y - y, 0.0), f.weight)
            shift = shifts @ (r - here)
            rise = float(np.sum((r - J @ shift) ** 2) - here @ here)
            near = rise < heights
            wide = np.abs(shift[near]) + widths[near] * np.sqrt(1.0 - rise / heights[near])
            ends[near] = np.maximum(ends[near], wide)
    out = errors.copy()
    out[~lost] = ends / NORMAL
    return out


def _other_times(f: Fit, channel: Channel, at: int) -> float:
    """Standard error (samples) whose 95 % interval ends at the farthest other time of a change that fits as well, what the other
    parameters can make good of it taken out."""
    if len(channel) != len(f.residual):
        return 0.0
    J = np.delete(_weighted(f), at, axis=1)
    norms = np.sqrt(np.sum(J**2, axis=0))
    Q = np.linalg.qr(J[:, norms > 0.0] / norms[norms > 0.0])[0]
    least = float(np.sum(innovations(f.residual, f.weight) ** 2))
    most = least * (1.0 + NORMAL**2 / f.n)
    farthest, q = 0.0, f.p.copy()
    for step in range(-REACH, REACH + 1):
        q[at] = f.p[at] + step
        y = simulate(f.structure, q, channel.u, channel.clock)
        if np.isfinite(y[-1]):
            r = innovations(np.where(channel.keep, channel.y - y, 0.0), f.weight)
            if float(np.sum((r - Q @ (Q.T @ r)) ** 2)) < most:
                farthest = max(farthest, abs(step) / NORMAL)
    return farthest


def _end(rise: Callable[[float], float], height: float) -> float:
    """The farthest multiple of an interval at which the squares have not yet risen by `height`: infinite if beyond `FARTHEST`."""
    below = [t for t in FARTHEST ** np.linspace(0.0, 1.0, 9) if rise(t) < height]
    if not below:
        return 1.0
    low, high = below[-1], below[-1] * FARTHEST ** (1 / 8)
    if high > FARTHEST:
        return np.inf
    for _ in range(5):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if rise(middle) < height else (low, middle)
    return float(high)


def _score_covariances(J: Array, f: Fit) -> tuple[Array, Array]:
    """Covariance of J'r, r the error whose squares the fit made least: from stationary noise, and from each sample's own error.

    r = W A^-1 e, with the innovations e of the noise model A and the fit's weight W, so that J'r = (A^-1' W' J)' e, the
    innovations before the record included.
    """
    noise = f.noise if stable_polynomial(f.noise) else f.noise[:0]
    e = innovations(f.residual if f.unrounded is None else f.unrounded, noise)[: len(J)].copy()
    K = lfilter(np.r_[1.0, f.weight], [1.0], J[::-1], axis=0)
    K = np.r_[K, np.zeros((BEFORE if len(noise) else 0, J.shape[1]))]
    every = np.asarray(lfilter([1.0], np.r_[1.0, noise], K, axis=0))[::-1]
    e[: len(noise)] = 0.0  # errors of a noise model that knew of no past
    gamma, scores = np.correlate(e, e, "full")[len(e) - 1 :], every[len(every) - len(e) :] * e[:, None]
    stationary, own = gamma[0] * (every.T @ every), scores.T @ scores
    lags = min(int(np.ceil(LAGS * len(e) ** (1 / 3))), len(e) - 1)
    for k in range(1, lags + 1):
        for S, x, c in ((stationary, every, gamma[k]), (own, scores, 1.0)):
            C = (1.0 - k / (lags + 1.0)) * c * (x[k:].T @ x[:-k])
            S += C + C.T
    free = max(f.n - J.shape[1], 1)
    return stationary / free, own * f.n / free
