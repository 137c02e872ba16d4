"""The loop on a simulated rig: the model error's gain before and after the missing effect is added."""

from functools import partial

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.effects import Clock
from estimators.diagnosis.loop import diagnose
from estimators.diagnosis.model.simulation import simulate
from estimators.norm.peak_estimates import corrected
from estimators.norm.worst_inputs import worst_case
from estimators.rules.limits import Limits
from estimators.rules.power import power_iterations
from estimators.rules.trace import run
from oed.data import Record
from oed.experiments import Experiment
from tests.estimators.diagnosis.case_small import looking_for

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
    few = "saturation", "dead_zone", "input_cubic", "output_cubic"
    return system, diagnose(*records, looking_for(*few, orders=(2,), structure="SISO"))


def model_of(fit):
    """A fitted structure as a function u -> y, from rest and without noise."""
    clock = lambda u: Clock(np.arange(len(u), dtype=float), max(len(u), len(fit.residual)))
    return lambda u: simulate(fit.structure, fit.p, u, clock(u), rest=True)[:, None]


def error_gain(system, model, samples, iterations, seed, power=1.0):
    """Gain of model minus rig, by power iterations on the rig itself ([M] Section V): its estimate, and the strongest line."""
    trace = run(
        partial(power_iterations, limits=Limits(power=power)), Experiment(lambda u: model(u) - system(u)),
        samples=samples, experiments=iterations, rng=np.random.default_rng(seed),
    )  # fmt: skip
    return corrected(trace), worst_case(trace)


@pytest.mark.slow
def test_adding_the_effect_lowers_the_gain_of_the_model_error():
    system, result = found(1.2)
    assert result.effect == "input_saturation"
    fits = result.extra["outputs"][0].naive, result.extra["finals"][0]
    (before, worst), (after, _) = (error_gain(system, model_of(fit), 300, 12, 3, power=2.0) for fit in fits)
    assert before.value > 0.1
    assert after.value + 3 * after.standard_error < 0.2 * before.value
    # the worst case lies at the plant's resonance, where the saturation costs most
    w = np.linspace(0.01, np.pi, 400)
    peak = w[np.argmax(np.abs(np.polyval(B[::-1], np.exp(-1j * w)) / np.polyval(A[::-1], np.exp(-1j * w))))]
    assert abs(worst.frequency - peak) < 0.15


@pytest.mark.slow
def test_without_an_effect_the_gain_stays_what_it_was():  # negative control: nothing is added, nothing changes
    system, result = found(50.0)
    assert not result.detected
    assert error_gain(system, model_of(result.extra["finals"][0]), 300, 8, 3, power=2.0)[0].value < 0.05


def test_a_known_model_error_is_measured():
    # oracle: the rig is linear and twice the model, so that gamma is the norm of the model, by its frequency response
    system = Experiment(lambda u: 2 * lfilter(B, A, u, axis=0))
    gain, _ = error_gain(system, lambda u: lfilter(B, A, u, axis=0), 400, 25, 1)
    w = np.linspace(0, np.pi, 4000)
    norm = np.max(np.abs(np.polyval(B[::-1], np.exp(-1j * w)) / np.polyval(A[::-1], np.exp(-1j * w))))
    assert gain.value == pytest.approx(norm, rel=0.03)  # 400 samples: the finite norm is a little lower
