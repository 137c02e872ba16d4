"""The loop on a simulated rig: the model error's gain before and after the missing effect is added."""

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.loop import Setting, diagnose
from estimators.diagnosis.next_experiment.model_error import linear_models, model_error_gain, models_of
from oed.data import Record
from oed.errors import InputError
from oed.experiments import Experiment

B, A = [0.0, 0.1, 0.1], [1.0, -1.5, 0.7]


def rig(limit, sigma=0.02, seed=5):
    rng = np.random.default_rng(seed)

    def apply(u):
        return lfilter(B, A, np.clip(u, -limit, limit), axis=0) + sigma * rng.standard_normal(u.shape)

    return Experiment(apply)


def found(limit):
    system, rng = rig(limit), np.random.default_rng(2)
    records = []
    for start, n in ((0.0, 500), (600.0, 300)):
        u = np.repeat(rng.uniform(-2, 2, n // 4), 4)[:, None]
        records.append(Record(u, system(u), t0=start))
    return system, diagnose(*records, Setting(orders=(2,), structure="SISO"))


@pytest.mark.slow
def test_adding_the_effect_lowers_the_gain_of_the_model_error():
    system, result = found(1.2)
    assert result.effect == "input_saturation"
    gains = [
        model_error_gain(system, model, samples=300, iterations=12, rng=np.random.default_rng(3), power=2.0)
        for model in (linear_models(result), models_of(result))
    ]
    before, after = gains
    assert before.gamma > 0.1
    assert after.gamma + 3 * after.standard_error < 0.2 * before.gamma
    # the worst case lies at the plant's resonance, where the saturation costs most
    w = np.linspace(0.01, np.pi, 400)
    peak = w[np.argmax(np.abs(np.polyval(B[::-1], np.exp(-1j * w)) / np.polyval(A[::-1], np.exp(-1j * w))))]
    assert abs(before.frequency - peak) < 0.15
    assert "rad/sample" in str(before)


@pytest.mark.slow
def test_without_an_effect_the_gain_stays_what_it_was():  # negative control: nothing is added, nothing changes
    system, result = found(50.0)
    assert not result.detected
    gain = model_error_gain(
        system, models_of(result), samples=300, iterations=8, rng=np.random.default_rng(3), power=2.0
    )
    assert gain.gamma < 0.05


def test_a_known_model_error_is_measured():
    # oracle: the rig is linear and twice the model, so that gamma is the norm of the model, by its frequency response
    system = Experiment(lambda u: 2 * lfilter(B, A, u, axis=0))
    gain = model_error_gain(
        system, lambda u: lfilter(B, A, u, axis=0), samples=400, iterations=25, rng=np.random.default_rng(1)
    )
    w = np.linspace(0, np.pi, 4000)
    norm = np.max(np.abs(np.polyval(B[::-1], np.exp(-1j * w)) / np.polyval(A[::-1], np.exp(-1j * w))))
    assert gain.gamma == pytest.approx(norm, rel=0.03)  # 400 samples: the finite norm is a little lower
    with pytest.raises(InputError, match="at least 4"):
        model_error_gain(system, lambda u: u, samples=50, iterations=2, rng=np.random.default_rng(0))
