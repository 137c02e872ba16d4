"""What is missing from a model: each planted defect is named, nothing is named where nothing is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnosis import loop
from estimators.sessions import Session, Settings, what_is_missing
from estimators.sessions.diagnosis import diagnosis_of
from estimators.sessions.proposals import joined, propose
from oed.data import Record
from oed.errors import InputError
from oed.experiments import simulated
from oed.plants.json import plant_to_json
from oed.plants.plant import Plant
from tests.estimators.diagnosis.case_small import looking_for

NUM, DEN = np.array([0.0, 0.5, 0.2]), np.array([1.0, -1.2, 0.72])


def added(num, den):
    """The model plus one more path, over a common denominator."""
    parts = np.convolve(NUM, den), np.convolve(num, DEN)
    length = max(map(len, parts))
    return sum(np.pad(p, (0, length - len(p))) for p in parts), np.convolve(DEN, den)


DEFECTS = {
    "gain": (1.2 * NUM, DEN),
    "delay": (np.append(0.0, NUM), DEN),
    "feedthrough": added([0.15], [1.0]),
    "lag": added([0.0, 0.1], [1.0, -0.95]),
    "mode": added([0.0, 0.1, 0.05], [1.0, -2 * 0.95 * np.cos(2.0), 0.9025]),
}


def session_on(rig: Plant, **options) -> Session:
    model = Plant(NUM, DEN, noise_covariance=0.0, name="model")
    session = Session(Settings("power", samples=300, experiments=8, model=plant_to_json(model), **options))
    session.run(simulated(rig, seed=1))
    return session


@pytest.mark.parametrize("defect", DEFECTS)
@pytest.mark.parametrize("options", [{}, {"periods": 2, "warm_up": 1}])
def test_a_planted_defect_is_named(defect, options):
    num, den = DEFECTS[defect]
    session = session_on(Plant(num, den, noise_covariance=1e-4, name="rig"), **options)
    found = diagnosis_of(session).of_model
    assert found.cause.name == defect
    assert found.cause.after < 0.3 * found.cause.before
    if defect != "delay":  # which is corrected to first order only; otherwise the noise is left
        assert found.cause.after == pytest.approx(0.01 / np.sqrt(session.settings.periods), rel=0.15)
    match defect:
        case "gain":
            assert found.cause.parameters["gain_11"] == pytest.approx(0.2, abs=0.005)
        case "feedthrough":
            assert found.cause.parameters["feedthrough_11"] == pytest.approx(0.15, abs=0.005)
        case "lag":
            assert found.cause.parameters["pole"] == pytest.approx(0.95, abs=0.01)
        case "mode":
            assert found.cause.parameters["frequency"] == pytest.approx(2.0, abs=0.01)
            assert found.cause.parameters["radius"] == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_named_where_nothing_is_missing(seed):
    """The negative control: the criterion must not pay for corrections of noise."""
    model = Plant(NUM, DEN, noise_covariance=0.0, name="model")
    session = Session(Settings("power", samples=300, experiments=8, model=plant_to_json(model), seed=seed))
    session.run(simulated(Plant(NUM, DEN, noise_covariance=1e-2, name="rig"), seed=seed))
    assert what_is_missing(session.trace, model, 1.0).cause.name == "none"


def test_the_entry_of_the_error_is_found():
    model = [[NUM, 0 * NUM], [0 * NUM, NUM]]
    rig = [[NUM, 0 * NUM], [0.3 * NUM, NUM]]
    den = [[DEN, DEN], [DEN, DEN]]
    settings = Settings(
        "procedure-2", samples=200, experiments=10, inputs=("a", "b"), outputs=("p", "q"),
        model=plant_to_json(Plant(model, den, name="model")),
    )  # fmt: skip
    session = Session(settings)
    found = session.run(simulated(Plant(rig, den, noise_covariance=1e-4, name="rig"), seed=2))
    share = diagnosis_of(session).of_model.share
    assert share[1, 0] > 0.99
    assert abs(abs(found.direction[0]) - 1) < 1e-2  # the worst input is the one that has the wrong path


def test_what_cannot_be_diagnosed_is_said():
    session = Session(Settings("power", samples=100, experiments=3))
    with pytest.raises(InputError, match="needs two"):
        diagnosis_of(session)
    session.run(simulated(Plant(NUM, DEN, name="rig"), seed=1))
    with pytest.raises(InputError, match="no model"):
        diagnosis_of(session)


def saturating(u):
    e = np.random.default_rng([7, int(1e6 * abs(u).sum())]).standard_normal(u.shape)
    return Plant(NUM, DEN, name="x").simulate(np.clip(u, -1.0, 1.0)) + 0.02 * e


@pytest.mark.slow
def test_diagnose_next_finds_the_cause_and_proposes_the_experiment_that_decides(tmp_path, monkeypatch):
    from estimators.sessions import open_session, start_session

    few = looking_for("saturation", "dead_zone", "input_cubic", "output_cubic", "gain_drift")
    known, own = lambda given: replace(given, effects=few.effects, effort=few.effort), loop.diagnose
    monkeypatch.setattr(loop, "diagnose", lambda train, test, given: own(train, test, known(given)))
    settings = Settings("diagnose-next", samples=240, amplitude=2.5, power=2.0, experiments=2)
    session = start_session(tmp_path / "rig", settings)
    session.tell(saturating(session.ask()))
    session.tell(saturating(session.ask()))
    assert session.trace.kinds == ("levels", "decide")
    again = open_session(tmp_path / "rig")  # plays the recorded inputs back instead of designing them again
    for mine, theirs in zip(again.trace.records, session.trace.records, strict=True):
        np.testing.assert_array_equal(mine.u, theirs.u)
        assert np.abs(mine.u).max() <= 2.5 * (1 + 1e-9)
        assert not mine.u[-30:].any()
    found = diagnosis_of(again)
    assert found.of_rig.effect == "input_saturation"
    assert found.of_rig.rmse_after.value < 0.3 * found.of_rig.rmse_before.value
    assert found.proposal is not None
    assert "input_saturation" in found.proposal.candidates


def test_the_first_proposal_is_general_and_later_ones_keep_the_limits():
    rng = np.random.default_rng(0)
    first = propose([], 160, 1.0, 2.0, rng)
    assert first.causes == ()
    assert np.mean(first.u[:140] ** 2) <= 1.0 + 1e-12
    assert np.abs(first.u).max() <= 2.0
    assert not first.u[140:].any()
    records = [Record(first.u[:, None], 0 * first.u[:, None]), Record(first.u[:, None], first.u[:, None])]
    assert len(joined(records)) == 320
