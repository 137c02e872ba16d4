"""What drifts about a level: the linear model's slow pole follows it, and its residual says nothing of the cause."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.effects.sensing.folding import WRAPPED
from estimators.diagnosis.model.fitting import Channel, Fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.search.candidates import Menu, augmented
from estimators.diagnosis.search.starts import followed

N, NOISE, LEVEL = 1000, 0.1, 52.0
GAINS = {
    "gain_drift": lambda k, u: 1.0 - 0.25 * k / N,
    "gain_settles": lambda k, u: 1.0 + 0.3 * np.exp(-k / 250.0),
    "gain_worn": lambda k, u: 1.0 / (1.0 + 0.4 * np.cumsum(u) / np.sum(u)),
    "gain_periodic": lambda k, u: 1.0 + 0.1 * np.sin(2.0 * np.pi * k / 400.0),
}


def about_a_level(key: str, seed: int) -> tuple[Channel, Fit]:
    """Two lags whose gain drifts, driven about a level, and its linear model without a noise model."""
    rng = np.random.default_rng(seed)
    u = LEVEL + 11.0 * np.repeat(rng.choice([-1.0, 1.0], N // 8), 8)
    u[:15] = LEVEL
    driven = GAINS[key](np.arange(N), u) * u
    x = lfilter([0.0, 0.15], [1.0, -0.85], driven, zi=[driven[0]])[0]
    y = lfilter([0.0, 0.08], [1.0, -0.92], x, zi=[driven[0]])[0] + 205.0
    return linear(u, y + NOISE * rng.standard_normal(N), 2)


def linear(u: np.ndarray, y: np.ndarray, order: int) -> tuple[Channel, Fit]:
    n = len(y)
    channel = Channel(u[:, None], y, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    f = fit_linear(channel, replace(Structure(order).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    white = float(np.mean(f.residual**2))
    return channel, replace(f, noise=np.zeros(0), variance=white, deviance=n * np.log(white))


@pytest.mark.parametrize(("key", "seed"), [(key, seed) for key in GAINS for seed in (0, 4)])
def test_a_gain_that_drifts_about_a_level_is_found_though_a_slow_pole_has_followed_it(
    key: str, seed: int
) -> None:
    """A catalyst that ages was "unknown": its level and a slow pole went together, and its score from there was that of noise."""
    channel, base = about_a_level(key, seed)
    assert followed(channel, base)
    assert np.std(base.residual) > 5.0 * NOISE
    found = augmented(channel, base, Menu((named(key),)))
    assert min(float(np.std(f.residual)) for f in found) < 1.15 * NOISE


def test_the_lag_of_a_sensor_of_one_turn_is_told_by_its_jumps_too() -> None:
    """What is clear of the jumps had said that lags of .8 do as well as the .58 of a position loop's sensor: a turn of 800 degrees."""
    rng = np.random.default_rng(2)
    n, w, z = 1100, 0.06, 0.55
    u = 110.0 * np.repeat(rng.standard_normal(n // 18 + 1), 18)[:n]
    angle = np.zeros(n)
    x = v = 0.0
    for k in range(n):
        angle[k] = x
        for _ in range(5):
            v += (w * w * (u[k] - x) - 2.0 * z * w * v) / 5.0
            x += v / 5.0
    angle = lfilter([0.21], [1.0, -0.79], angle)
    fine = np.interp(np.arange(8 * n) / 8.0, np.arange(n), angle)
    pole = 0.58 ** (1.0 / 8.0)
    y = lfilter([1.0 - pole], [1.0, -pole], fine - 360.0 * np.floor(fine / 360.0 + 0.5))[::8]
    channel, base = linear(u, y + 0.8 * rng.standard_normal(n), 3)
    fits = list(WRAPPED.search(channel, base, ())) if WRAPPED.search is not None else []
    best = min(fits, key=lambda f: float(np.std(f.residual)))
    turn, *_, lag = best.p[-4:]
    assert abs(turn - 360.0) < 2.0
    assert abs(lag - 0.58) < 0.02
