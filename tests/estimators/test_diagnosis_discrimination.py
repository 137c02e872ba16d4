"""The discriminating experiment: it keeps its limits and decides with fewer samples than other inputs."""

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.candidates import augmented
from estimators.diagnosis.discrimination import discriminate, distance
from estimators.diagnosis.fitting import Channel, fit
from estimators.diagnosis.linear import fit_linear
from estimators.diagnosis.structure import Structure, simulate
from estimators.effects.catalogue import Clock
from oed.errors import InputError

PAIRS = [("saturation", "input_cubic"), ("output_arctan", "saturation"), ("dead_zone", "backlash_input")]


def models(pair):
    rng = np.random.default_rng(8)
    n = 400
    u = np.repeat(rng.uniform(-1, 1, n // 4), 4)
    y = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], np.clip(u, -0.75, 0.75)) + 0.05 * rng.standard_normal(n)
    channel = Channel(u[:, None], y, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    base = fit_linear(channel, Structure(2))
    found = {f.structure.parts[-1].key: f for f in augmented(channel, base, only=set(pair))}
    return channel, [found[key] for key in pair]


@pytest.mark.parametrize("pair", PAIRS)
def test_designed_input_keeps_its_limits_and_beats_the_others(pair):
    _, (a, b) = models(pair)
    design = discriminate(a, b, length=200, amplitude=2.0, rng=np.random.default_rng(1), rounds=4, size=10)
    assert np.max(np.abs(design.u)) <= 2.0 + 1e-12
    assert design.distance == pytest.approx(distance(a, b, design.u))
    assert design.distance > 1.2 * max(design.white, design.multisine)
    assert "samples" in str(design)


def test_a_model_cannot_be_told_from_itself():
    _, (a, _) = models(PAIRS[0])
    assert distance(a, a, np.random.default_rng(2).standard_normal(100)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.validate
@pytest.mark.parametrize("pair", PAIRS)
def test_designed_input_decides_more_often(pair):
    # 60 experiments with each input; the designed one may lose by chance at most at 2 standard errors
    _, (a, b) = models(pair)
    rng = np.random.default_rng(3)
    design = discriminate(a, b, length=120, amplitude=2.0, rng=rng)
    rates = {}
    for name in ("designed", "white"):
        right = 0
        for _ in range(60):
            u = design.u if name == "designed" else np.clip(rng.standard_normal(120), -2, 2)
            clock = Clock(np.arange(120.0), 120)
            y = simulate(a.structure, a.p, u[:, None], clock, rest=True) + 0.3 * rng.standard_normal(120)
            data = Channel(u[:, None], y, clock, np.ones(120, dtype=bool))
            costs = [
                fit(data, f.structure, f.p, f.scales, iterations=3, colour=False).deviance for f in (a, b)
            ]
            right += costs[0] < costs[1]
        rates[name] = right / 60
    assert rates["designed"] >= rates["white"] - 2 * np.sqrt(0.25 / 60)


def test_limits_must_be_positive():
    _, (a, b) = models(PAIRS[0])
    with pytest.raises(InputError, match="must be positive"):
        discriminate(a, b, length=100, amplitude=-1.0, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="at least 20"):
        discriminate(a, b, length=5, amplitude=1.0, rng=np.random.default_rng(0))
