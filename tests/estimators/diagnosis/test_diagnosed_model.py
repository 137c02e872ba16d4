"""The answer of a diagnosis as a model: written, read, simulated from its start, with intervals that cover."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline import best_linear
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.discovery import discover
from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.result.answers import Answer, DiscoveredAnswer, LinearAnswer, NamedAnswer
from estimators.diagnosis.result.model import DiagnosedModel
from estimators.diagnosis.search.free_runs import Start
from oed.data import Record
from oed.errors import InputError

PRIOR = Prior(0.0, 0.9 ** np.arange(64.0), 0.01)
B, A = np.array([[0.0, 0.1, 0.1]]), np.array([1.0, -1.5, 0.7])


def _record(n: int, level: float = 0.0) -> Record:
    rng = np.random.default_rng(3)
    u = level + rng.standard_normal(n)
    return Record(u, lfilter(B[0], A, u) + 0.1 * rng.standard_normal(n), dt=0.5)


def _named(**options) -> NamedAnswer:
    s = Structure(2).adding(Part(OFFSET)).adding(Part(INITIAL)).adding(Part(named("dead_zone")))
    p = np.array([-1.5, 0.7, 0.1, 0.1, 0.3, 0.0, 0.0, 0.4])
    return NamedAnswer(0, replace(s, base=2), p, Start(PRIOR, rest=False), (0.0, 0.5, 300), **options)


def _discovered() -> Answer:
    rng = np.random.default_rng(5)
    u = rng.uniform(-2, 2, 400)
    record = Record(u, lfilter(B[0], A, u - 0.15 * u**3) + 0.02 * rng.standard_normal(400), dt=0.5)
    model = discover([record], best_linear([record]), "quick").model
    assert model is not None
    return DiscoveredAnswer(0, model)


MAKERS = {
    "linear": lambda: LinearAnswer(0, (0,), LinearModel(A, B, 0.2), PRIOR),
    "named": _named,
    "thinned, rounded, without delay": lambda: _named(thin=2, step=0.05, ahead=True),
    "discovered": _discovered,
}


@pytest.mark.parametrize("kind", MAKERS)
def test_what_is_read_simulates_as_what_was_written(kind, tmp_path):
    model = DiagnosedModel((MAKERS[kind](),), np.array([0.1]), 0.5, ("u",), ("y",))
    record = _record(120, level=1.0)
    model.save(tmp_path / "model.json")
    again = DiagnosedModel.load(tmp_path / "model.json")
    for window in (0, 20):
        np.testing.assert_allclose(again.simulate(record, window), model.simulate(record, window), rtol=1e-12)
    assert np.all(np.isfinite(model.simulate(record, 20)))


def test_a_run_without_a_window_starts_settled_under_its_first_input():
    model = DiagnosedModel((_named(),), np.array([0.1]), 0.5, ("u",), ("y",))
    level = 0.3 + 1.0 * (2.0 - 0.4)  # offset, and the gain of 1 behind the dead zone
    np.testing.assert_allclose(model.simulate(np.full(30, 2.0))[:, 0], level, atol=1e-3)


def test_where_samples_tell_the_state_a_record_does_not_start_at_rest():
    """A record that begins in full swing, after a training record that began at rest."""
    swing = LinearModel(np.array([1.0, -1.8, 0.98]), np.array([[0.0, 0.1]]))
    resting = LinearAnswer(0, (0,), swing, PRIOR, rest=True)
    truth = resting.simulate(Record(np.ones(300), np.full(300, np.nan), dt=0.5), 0)
    late = Record(np.ones(200), truth[30:230], dt=0.5)
    assert truth[0] == 0.0
    assert np.abs(resting.simulate(late, 20) - truth[30:230])[20:].max() < 0.01 * np.ptp(truth)
    assert np.abs(resting.simulate(late, 0) - truth[30:230]).max() > 0.1 * np.ptp(truth)


def test_the_interval_covers_as_often_as_it_says():
    """95 % of 4000 measured samples with the noise that the model states: five standard deviations of the count."""
    model = DiagnosedModel(
        (LinearAnswer(0, (0,), LinearModel(A, B), PRIOR),), np.array([0.1]), 0.5, ("u",), ("y",)
    )
    record = _record(4000)
    _, low, high = model.predict(record)
    share = np.mean((low < record.y) & (record.y < high))
    assert abs(share - 0.95) < 5 * np.sqrt(0.95 * 0.05 / 4000)
    narrow = replace(model, errors=np.array([0.05]))  # negative control: an error stated too small
    _, low, high = narrow.predict(record)
    assert np.mean((low < record.y) & (record.y < high)) < 0.75


def test_a_linear_answer_is_a_linear_system_and_a_dead_zone_is_none():
    model = DiagnosedModel(
        (LinearAnswer(0, (0,), LinearModel(A, B), PRIOR),), np.array([0.1]), 0.5, ("u",), ("y",)
    )
    plant = model.to_control()
    z = np.exp(0.3j)
    expected = np.polyval(B[0], z) / np.polyval(A, z)
    assert complex(plant(z)) == pytest.approx(expected)
    with pytest.raises(InputError, match="no linear system"):
        replace(model, answers=(_named(),)).to_control()


def test_what_is_no_model_is_refused():
    model = DiagnosedModel((_named(),), np.array([0.1]), 0.5, ("u",), ("y",))
    with pytest.raises(InputError, match="takes"):
        model.simulate(np.zeros((5, 2)))
    with pytest.raises(InputError, match="no diagnosed model"):
        DiagnosedModel.from_json("[1]")
    other = json.loads(model.to_json()) | {"schema": 99}
    with pytest.raises(InputError, match="schema 99"):
        DiagnosedModel.from_json(json.dumps(other))
