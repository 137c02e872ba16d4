"""What a linear model leaves: lines that no input drives, and the one-step model of the rest."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.ndimage import median_filter

from estimators.residual.algebra import decomposed

Array = NDArray[Any]

MOST_TONES = 5
"""Lines that are taken out, largest first; more of them are no hum but a spectrum."""
FALSE = 1e-4
"""Chance of a line where there is noise only, over all frequencies."""
SHARE = 0.05
"""Of the residual's power: a smaller line cannot lead a model's poles astray."""
AROUND = 41
"""Bins whose median is the background: wide beside a line (4 bins), narrow beside a resonance."""
NARROW = 0.1
"""Largest power a few bins aside, of a line's own; Hann's window leaves 0.01 there, a resonance more than a half."""
PEAKS, FORETOLD = 12, 0.3
"""Highest places of a spectrum that are tried as waves, and the share of what the others leave by which each must foretell all parts held out."""
MOST_LAGS = 20
"""Lags of the one-step noise model, chosen by Schwarz's criterion up to here."""


def _periodogram(x: Array) -> Array:
    return np.abs(np.fft.rfft(x * np.hanning(len(x)))) ** 2


def _line(e: Array, U: Array) -> float | None:
    """Angular frequency of the strongest line of a residual (N,) that is not one of the inputs (N, nu), if there is any."""
    power = _periodogram(e)[2:]
    background = median_filter(power, AROUND, mode="nearest") / np.log(2.0) + 1e-300
    threshold = np.log(len(power) / FALSE)
    for peak in np.argsort(power)[::-1][:MOST_TONES]:
        aside = np.r_[power[max(0, peak - 6) : max(0, peak - 3)], power[peak + 4 : peak + 7]]
        if power[peak] < threshold * background[peak] or aside.max(initial=0.0) > NARROW * power[peak]:
            continue
        own = [_periodogram(u - u.mean())[2:] for u in U.T]
        if any(
            p[peak] > threshold * median_filter(p, AROUND, mode="nearest")[peak] / np.log(2.0) for p in own
        ):
            continue  # the input has this line: the model's error, or what a nonlinearity makes of it
        return float(2.0 * np.pi * (peak + 2) / len(e))
    return None


def waves(omegas: Sequence[float], length: int) -> Array:
    """(length, 1 + 2 tones) a level, then cosine and sine of each tone."""
    phase = np.outer(np.arange(length), omegas)
    return np.concatenate((np.ones((length, 1)), np.cos(phase), np.sin(phase)), axis=1)


def foretold(e: Array, W: Array, own: slice, held_out: slice) -> Array:
    """What some columns of W (N, k), fitted with all to the rest of a residual (N,), NaN where nothing is known, are in the rows
    held out."""
    use = np.isfinite(e)
    if len(e) > held_out.stop - held_out.start:
        use[held_out] = False
    theta = decomposed(W[use], e[use])
    return W[held_out, own] @ theta[own]


def set_aside(e: Array, lines: Sequence[float], dt: float) -> Array | None:
    """The tones of frequencies in Hz in a residual (N,); None where there are none."""
    W = waves([2.0 * np.pi * f * dt for f in lines], len(e))
    return foretold(e, W, slice(1, None), slice(0, len(e))) if lines else None


def tones(y: Array, run: Array, U: Array) -> list[float]:
    """Angular frequencies of lines of measured (N,) minus simulated output that the inputs (N, nu) do not have."""
    seen = np.isfinite(y)
    e = np.where(seen, y - run, 0.0)
    e[seen] -= e[seen].mean()
    whole, found = float(np.sum(e**2)), []
    rest, left = e, whole

    def after(omegas: list[float]) -> Array:
        W = waves(omegas, len(e))
        return np.where(seen, e - W @ np.linalg.lstsq(W[seen], e[seen], rcond=None)[0], 0.0)

    while len(found) < MOST_TONES and (omega := _line(rest, U)) is not None:
        width = 2.0 * np.pi / len(y)
        for _ in range(4):  # the frequency to a hundredth of a bin, by ever finer grids
            grid = [float(w) for w in omega + width * np.linspace(-1.0, 1.0, 9)]
            omega = min(grid, key=lambda w: float(np.sum(after([*found, w]) ** 2)))
            width /= 4.0
        rest = after([*found, omega])
        if left - np.sum(rest**2) < SHARE * whole:
            break
        found.append(omega)
        left = float(np.sum(rest**2))
    return found


def recurring(e: Array, held_out: Sequence[slice]) -> list[float]:
    """Angular frequencies of waves of a residual (N,) that foretell it in every part held out, when fitted to the others.

    Where noise is slow, or turns are few, no line stands out of the spectrum, as that of a day in ten days of a building.
    """
    found: list[float] = []
    tried = np.argsort(_periodogram(np.where(np.isfinite(e), e, 0.0)))[::-1][:PEAKS]
    bins = np.unique(np.round([j + d for j in tried for d in np.linspace(-0.5, 0.5, 9)], 6))

    def left(omegas: list[float]) -> Array:
        W = waves(omegas, len(e))
        rest = [e[part] - foretold(e, W, slice(0, W.shape[1]), part) for part in held_out]
        return np.array([np.nansum(x**2) for x in rest])

    best = left([])
    while len(found) < MOST_TONES:
        trials = [(left([*found, w]), w) for w in 2.0 * np.pi * bins / len(e) if 0.0 < w < np.pi]
        now, omega = min(trials, key=lambda trial: float(trial[0].sum()), default=(best, 0.0))
        if not (np.all(now < best) and now.sum() < (1.0 - FORETOLD) * best.sum()):
            break
        found, best = [*found, float(omega)], now
    return found


def noise_model(residuals: Sequence[Array]) -> tuple[Array, float]:
    """AR coefficients (leading 1) of residuals with NaN where nothing is known, and their innovations' standard deviation."""
    size = sum(int(np.isfinite(e).sum()) for e in residuals)
    filled = [np.nan_to_num(e) for e in residuals]
    lags = max(0, min(MOST_LAGS, size // 10, min(map(len, filled)) - 1))
    r = np.array([sum(float(e[: len(e) - k] @ e[k:]) for e in filled) for k in range(lags + 1)]) / max(
        size, 1
    )
    if r[0] <= 0.0:
        return np.ones(1), 0.0
    r[0] *= 1.0 + 1e-9  # rounding must not make a smooth residual's covariance indefinite
    best, cost = (np.ones(1), r[0]), size * np.log(r[0])
    for p in range(1, lags + 1):
        a = np.concatenate(([1.0], -solve_toeplitz(r[:p], r[1 : p + 1])))
        variance = max(float(a @ r[: p + 1]), 1e-12 * r[0])
        if size * np.log(variance) + p * np.log(size) < cost:
            best, cost = (a, variance), size * np.log(variance) + p * np.log(size)
    return best[0], float(np.sqrt(best[1]))
