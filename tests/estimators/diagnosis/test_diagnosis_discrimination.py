"""The discriminating experiment: it keeps its limits and decides with fewer samples than other inputs."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.model.fitting import Channel
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Structure
from estimators.diagnosis.next_experiment import deciding_experiment, discriminate, distance
from estimators.diagnosis.search.candidates import Menu, augmented
from oed.data import Record
from oed.errors import InputError
from tests.oracles.decisions import decision_samples

PAIRS = [("saturation", "input_cubic"), ("output_arctan", "saturation"), ("dead_zone", "backlash_input")]


def models(pair):
    rng = np.random.default_rng(8)
    n = 400
    u = np.repeat(rng.uniform(-1, 1, n // 4), 4)
    y = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], np.clip(u, -0.75, 0.75)) + 0.05 * rng.standard_normal(n)
    channel = Channel(u[:, None], y, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    base = fit_linear(channel, Structure(2))
    found = list(augmented(channel, base, Menu(tuple(named(key) for key in pair))))
    of = lambda key: (f for f in found if f.structure.parts[-1].key == key)
    return channel, [min(of(key), key=lambda f: f.criterion) for key in pair]


@pytest.mark.parametrize("pair", PAIRS)
def test_designed_input_keeps_its_limits_and_beats_the_others(pair):
    _, (a, b) = models(pair)
    # play behind a lag and a dead zone that hardly acts are nearly the same: few inputs tell them apart, and a short search misses them
    design = discriminate(a, b, length=200, amplitude=2.0, rng=np.random.default_rng(1), rounds=8, size=30)
    assert np.max(np.abs(design.u)) <= 2.0 + 1e-12
    assert design.distance == pytest.approx(distance(a, b, design.u))
    assert design.distance > 1.2 * max(design.white, design.multisine)
    assert "samples" in str(design)


def test_a_model_cannot_be_told_from_itself():
    _, (a, _) = models(PAIRS[0])
    assert distance(a, a, np.random.default_rng(2).standard_normal(100)) == pytest.approx(0.0, abs=1e-9)


def study(pair, replicates, length=300):
    """Samples to decide rightly in 90 % of the cases, for the designed input and its two rivals."""
    _, (a, b) = models(pair)
    rng = np.random.default_rng(3)
    design = discriminate(a, b, length=length, amplitude=2.0, rng=rng)
    inputs = {"designed": design.u, "white": design.white_input, "multisine": design.multisine_input}
    return {
        name: decision_samples(
            a, b, u, lengths=(15, 30, 60, 100, 150, 220, 300), noise=NOISE[pair], replicates=replicates,
            rng=np.random.default_rng(4),
        )
        for name, u in inputs.items()
    }  # fmt: skip


# noise of the new experiment, so that the decision is neither certain nor hopeless within 300 samples
NOISE = {PAIRS[0]: 0.6, PAIRS[1]: 0.6, PAIRS[2]: 0.3}


@pytest.mark.validate
@pytest.mark.parametrize("pair", PAIRS)
def test_designed_input_needs_fewer_samples(pair):
    found = study(pair, 200)
    best = found["designed"]
    assert np.isfinite(best.samples)
    at = int(
        np.argmax(best.lengths >= best.samples)
    )  # where the designed input is right in 90 % of the cases
    for name in ("white", "multisine"):
        rival = found[name]
        assert best.samples < rival.samples
        error = np.hypot(best.standard_errors[at], rival.standard_errors[at])
        assert best.rates[at] - rival.rates[at] > 2 * error, name


def test_more_samples_decide_more_often():
    _, (a, b) = models(PAIRS[0])
    u = np.random.default_rng(5).choice([-2.0, 2.0, 1.0, -1.0], 120)
    found = decision_samples(
        a, b, u, lengths=(10, 120), noise=0.3, replicates=12, rng=np.random.default_rng(6)
    )
    assert found.rates[1] >= found.rates[0]
    assert found.rates[1] > 0.7


def test_limits_must_be_positive():
    _, (a, b) = models(PAIRS[0])
    with pytest.raises(InputError, match="must be positive"):
        discriminate(a, b, length=100, amplitude=-1.0, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="at least 20"):
        discriminate(a, b, length=5, amplitude=1.0, rng=np.random.default_rng(0))


def test_the_next_experiment_is_designed_for_the_confusable_pair():
    channel, (a, b) = models(PAIRS[0])
    claims = [SimpleNamespace(cause="input_saturation", fit=a), SimpleNamespace(cause="hammerstein", fit=b)]
    out = SimpleNamespace(attribution=SimpleNamespace(claims=claims), thin=1)
    train = Record(channel.u, channel.y)
    result = SimpleNamespace(
        effect="input_saturation", confusable=("hammerstein",), extra={"train": train, "outputs": [out]}
    )
    pair, design = deciding_experiment(result, length=60, rng=np.random.default_rng(7))
    assert pair == ("input_saturation", "hammerstein")
    assert len(design.u) == 60
    assert np.max(np.abs(design.u)) <= np.max(np.abs(channel.u)) + 1e-12
    sure = SimpleNamespace(effect="input_saturation", confusable=(), extra=result.extra)
    assert deciding_experiment(sure, length=60, rng=np.random.default_rng(7)) is None
