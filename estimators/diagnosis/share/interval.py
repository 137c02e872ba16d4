"""Between which shares the explainable one lies: what a regression predicts on unused blocks, beside what it would predict of known ones.

What is predicted on unused blocks is less than what can be explained: coefficients are estimated, the linear model has taken its own
part of the noise and gives it back with the wrong sign, and both cost the more the slower the noise is. So nothing is assumed of
these squares: the same regressions, with the same choice among them, are given drawn records in which a known share can be explained,
and a share is within the interval where they predict what was predicted (a test of every share, inverted). As of the same record
measured again: inputs and blocks are the record's own.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import stdtrit

from estimators.diagnosis.share.regression import PENALTIES, Choice, Regression
from estimators.residual.algebra import FEWEST, INDEPENDENT, autoregressions, noise_filter

Array = NDArray[np.float64]

DRAWS = 40
"""Records that are drawn: their spread is good to a ninth."""
RATIOS = np.concatenate(([0.0], np.logspace(-3.0, 9.0, 97)))
"""Explained over unexplained variance of the records that are drawn: shares of nothing to all but rounding, eight in a decade."""
SETTLED, LONGEST = 1e-4, 1e5
"""Share of a filter's answer that is left when drawn noise begins, and samples of that at most."""
STEADY = 4.0
"""Largest reflection coefficient of a drawn noise, as its inverse hyperbolic tangent: a memory as long as any record's."""
ROUNDING = 1e-9
"""Size of a direction, of the largest's, below which it is rounding."""


def bounds(regression: Regression, fits: Sequence[Choice], taken: Array) -> tuple[float, float]:
    """Least and largest share that can be explained, at 95 %: the fits of all groups of columns that were tried, and orthonormal
    directions (M, k) which the linear model has taken out of the residual."""
    target, count = regression.target, len(regression.target)
    chosen, groups = min(fits, key=lambda fit: fit.error), [fit.which for fit in fits]
    left = target - chosen.predicted
    share = 1.0 - chosen.error / float(np.mean(target**2))
    noise = noise_filter([left - left.mean()])
    free = lambda x: x - taken @ (taken.T @ x)
    drawn = _drawn(noise, count, free)
    signal, size = _signals(regression, chosen, drawn * float(np.sqrt(chosen.error)))
    # Of few independent values the memory is known badly too, which moves all draws at once.
    width = float(stdtrit(max(FEWEST, count * _independent(noise) / INDEPENDENT), 0.975))
    drawn = free(drawn)
    off = [
        _off(regression, groups, s / np.maximum(s.std(axis=0), ROUNDING * size), drawn, share)
        for s in map(free, signal)
    ]
    shares = RATIOS / (1.0 + RATIOS)
    low = _crossing(shares, off[0], -width)
    high = _crossing(shares, off[1], width)
    return min(low, max(share, 0.0)), max(high, share, 0.0)


def _independent(noise: Array) -> float:
    """Independent values in a sample of autoregressive noise: the variance over that of the mean of many."""
    answer = _answer(noise)
    return float(min(1.0, (answer @ answer) * noise.sum() ** 2))


def _answer(noise: Array) -> Array:
    """What 1 / noise answers to one innovation, until nothing is left."""
    length = 64
    while True:
        answer = np.asarray(lfilter([1.0], noise, np.concatenate(([1.0], np.zeros(length - 1)))))
        if length > LONGEST or np.abs(answer[length // 2 :]).max() < SETTLED * np.abs(answer).max():
            return answer
        length *= 2


def _noise(noise: Array, count: int, rng: np.random.Generator) -> Array:
    """(count,) noise of unit variance, of an autoregression."""
    answer = _answer(noise)
    innovations = rng.standard_normal(len(answer) + count)
    return np.asarray(lfilter([1.0], noise, innovations))[len(answer) :] / np.sqrt(answer @ answer)


def _drawn(noise: Array, count: int, free: Callable[[Array], Array]) -> Array:
    """(count, DRAWS) of noises that may be the one of this estimate: each as far from it as an estimate is from its own, on the other side.

    Fits make the memory of what they leave shorter; in reflection coefficients, whose every value is stable.
    """
    rng, told = np.random.default_rng(0), _reflections(noise)
    out = np.empty((count, DRAWS))
    for k in range(DRAWS):
        x = _noise(noise, count, rng)
        if len(told):
            again = free(x)
            again = again - again.mean()
            covariance = np.array([again[i:] @ again[: count - i] for i in range(len(told) + 1)])
            *_, (other, _) = autoregressions(covariance / covariance[0])
            seen = np.zeros(len(told))
            seen[: len(other) - 1] = _reflections(other)
            x = _noise(_filter(np.tanh(np.clip(2.0 * told - seen, -STEADY, STEADY))), count, rng)
        out[:, k] = x
    return out


def _reflections(noise: Array) -> Array:
    """Inverse hyperbolic tangents of the reflection coefficients of an autoregression."""
    found = []
    while len(noise) > 1:
        found.append(noise[-1])
        noise = ((noise - noise[-1] * noise[::-1]) / (1.0 - noise[-1] ** 2))[:-1]
    return np.clip(np.arctanh(np.clip(found[::-1], -1.0 + 1e-9, 1.0 - 1e-9)), -STEADY, STEADY)


def _filter(reflections: Array) -> Array:
    a = np.ones(1)
    for k in reflections:
        longer = np.append(a, 0.0)
        a = longer + k * longer[::-1]
    return a


def _signals(regression: Regression, chosen: Choice, noise: Array) -> tuple[tuple[Array, Array], float]:
    """(M, DRAWS) signals that may be what can be explained: what the chosen regression says of it, less what noise makes it say; and the
    same at the next smaller penalty, with what a penalty hides; and the size of what it says.

    Directions that a penalty suppresses hold more of the truth than of the fit, and are the harder to predict.
    """
    columns = regression.columns[:, chosen.which]
    target = regression.target - regression.target.mean()
    values, turn = np.linalg.eigh(columns.T @ columns)
    values = np.maximum(values, ROUNDING * values[-1])
    inside, other = turn.T @ (columns.T @ target), turn.T @ (columns.T @ np.roll(noise, 1, axis=1))
    out = []
    for penalty, root in ((chosen.penalty, 1.0), (max(chosen.penalty - 1, 0), 0.5)):
        shrunk = values + PENALTIES[penalty] * len(target)
        spread = values ** (root - 1.0) * shrunk ** (-root) if root < 1.0 else 1.0 / shrunk
        out.append(columns @ (turn @ ((inside / shrunk)[:, None] - spread[:, None] * other)))
    return (out[0], out[1]), float(out[0].std())


def _off(
    regression: Regression, groups: Sequence[NDArray[np.int64]], signal: Array, noise: Array, share: float
) -> Array:
    """Of every ratio, by how many standard deviations more was left than of drawn records: signals and noises (M, DRAWS)."""
    pairs = lambda squares: np.stack([RATIOS, 2.0 * np.sqrt(RATIOS), np.ones(len(RATIOS))], axis=1) @ squares
    total = pairs(
        np.stack([np.sum(signal**2, axis=0), np.sum(signal * noise, axis=0), np.sum(noise**2, axis=0)])
    )
    left = np.full(total.shape, np.inf)
    for squares in regression.errors_of(groups, signal, noise):
        left = np.minimum(left, pairs(squares))
    logs = np.log(np.maximum(left / total, np.finfo(float).tiny))
    return (np.log(max(1.0 - share, np.finfo(float).tiny)) - logs.mean(axis=1)) / logs.std(axis=1, ddof=1)


def _crossing(shares: Array, off: Array, level: float) -> float:
    """The share at which a rising curve meets a level; its first or last where it is beyond."""
    at = int(np.argmax(off >= level)) if np.any(off >= level) else len(off)
    if at in (0, len(off)):
        return float(shares[min(at, len(off) - 1)])
    part = (level - off[at - 1]) / (off[at] - off[at - 1])
    return float(shares[at - 1] + part * (shares[at] - shares[at - 1]))
