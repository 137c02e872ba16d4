"""What repeats by the clock is no claim where an input comes again with it: it may be the input's answer."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.model.fitting import Channel
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.search.naming import AGAIN, HARMONICS, _return, told_apart

N = 2000
TIME = np.arange(N)
SWEPT = np.abs(TIME % 250 - 125.0)  # up and down eight times
RNG = np.random.default_rng(5)
LEVELS = np.repeat(RNG.standard_normal(N // 20), 20)
MULTISINE = np.tile(
    np.fft.irfft(np.concatenate(([0.0], np.exp(2j * np.pi * RNG.uniform(size=30)), np.zeros(220)))), 4
)


def _known(key: str, u: np.ndarray, every: float, more: tuple[float, ...]) -> bool:
    part = Part(named(key), 0)
    s = Structure(1, (0,), parts=(part,))
    first = every if key == "gain_cycle" else 2.0 * np.pi / every
    p = np.concatenate((np.zeros(s.size - 1 - len(more)), [first, *more]))
    channel = Channel(u[:, None], np.zeros(N), Clock(TIME.astype(float), N), np.ones(N, bool))
    fit: Any = SimpleNamespace(structure=s, p=p)
    claim: Any = SimpleNamespace(part=part)
    return told_apart(claim, fit, channel)


def test_an_input_returns_after_its_period_and_a_random_one_never():
    assert _return(SWEPT) == 250
    assert _return(MULTISINE) == 500
    assert _return(np.sin(2.0 * np.pi * TIME / 100.0)) == 100
    assert _return(LEVELS) == 0
    assert _return(np.ones(N)) == 0


def test_a_return_is_known_to_a_part_of_a_sample_where_there_are_many():
    assert _return(np.sin(2.0 * np.pi * TIME / 37.3)) == pytest.approx(37.3, abs=0.05)
    assert not _known("gain_periodic", np.sin(2.0 * np.pi * TIME / 37.3), 37.3 / 5, (0.1, 0.2))


def test_a_return_is_of_the_whole_input_not_of_most_of_it():
    other = np.sqrt(np.var(SWEPT) * (1.0 / (AGAIN - 0.1) - 1.0)) * RNG.standard_normal(N)
    assert _return(SWEPT + other) == 0
    assert _return(SWEPT + 0.3 * other) in range(245, 256)


@pytest.mark.parametrize(
    ("key", "more"),
    [("gain_periodic", (0.1, 0.2)), ("gain_cycle", (3.0, -0.4, 0.1)), ("delay_periodic", (0.3, 0.2))],
)
def test_a_period_of_the_inputs_own_is_not_told_apart(key, more):
    for every in (250.0, 125.0, 250.0 / HARMONICS, 250.3):
        told = _known(key, SWEPT, every, more)
        assert told == (named(key).nature.value == "sampling"), every
    for every in (231.0, 170.0, 250.0 / (HARMONICS + 1), 500.0, 41.0):
        assert _known(key, SWEPT, every, more), every
    assert _known(key, LEVELS, 250.0, more)


def test_a_bend_of_the_same_input_is_known():
    part = Part(named("saturation"), 0)
    s = Structure(1, (0,), parts=(part,))
    channel = Channel(SWEPT[:, None], np.zeros(N), Clock(TIME.astype(float), N), np.ones(N, bool))
    fit: Any = SimpleNamespace(structure=s, p=np.ones(s.size))
    claim: Any = SimpleNamespace(part=part)
    assert told_apart(claim, fit, channel)
