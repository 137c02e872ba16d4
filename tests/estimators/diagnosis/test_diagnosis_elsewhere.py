"""One cause seen at two outputs: the rate of a position whose spring is nonlinear is that position's model and a filter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators import diagnose
from estimators.diagnosis.result.answers import ThroughAnswer
from estimators.diagnosis.result.model import DiagnosedModel
from oed.data import Record
from tests.estimators.diagnosis.case_small import looking_for

pytestmark = pytest.mark.slow
SPRINGS = looking_for("stiffness_cubic", "stiffness_square", "output_cubic", "drag", "saturation")


def _record(seed: int, samples: int = 900, k3: float = 0.6) -> Record:
    """A mass on a hardening spring: its position, and what a coil about it induces behind a resonant filter, with noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.5, 1.5, samples // 6), 6)
    x, v, h, rows = 0.0, 0.0, 0.02, []
    for k in range(samples):
        rows.append((x, v))
        for _ in range(10):
            v += h * (u[k] - 0.5 * v - x - k3 * x**3)
            x += h * v
    x, v = np.array(rows).T
    y = np.column_stack((x, lfilter([0, 0, 0.1], [1, -1.6, 0.7], v))) + 0.01 * rng.standard_normal(
        (samples, 2)
    )
    return Record(u, y, dt=0.2)


@pytest.fixture(scope="module")
def found():
    return diagnose(_record(1), _record(2), SPRINGS)


def test_the_second_output_is_told_through_the_first(found) -> None:
    behind = found.model.answers[1]
    assert isinstance(behind, ThroughAnswer)
    assert behind.through is found.model.answers[0]
    assert found.effect == "duffing"
    assert found.rmse_after.value < 0.015 < 0.3 * found.rmse_before.value


def test_its_model_is_kept_and_exported(found) -> None:
    u = _record(5, 120).u
    run = found.model.simulate(u)
    assert DiagnosedModel.from_json(found.model.to_json()).simulate(u) == pytest.approx(run, abs=1e-9)
    step, x = found.model.to_casadi(settled=u[0])
    rows = []
    for k in range(len(u)):
        x, y = step(x, u[k], k)
        rows.append(np.asarray(y).ravel())
    assert np.array(rows) == pytest.approx(run, abs=1e-6)


def test_outputs_with_nothing_in_common_keep_their_own_models() -> None:
    """A control: the second output is a linear lag of the input, which the first one's spring says nothing of."""
    record = _record(1, 600)
    rng = np.random.default_rng(9)
    y2 = np.zeros(len(record))
    for k in range(1, len(record)):
        y2[k] = 0.8 * y2[k - 1] + 0.2 * record.u[k - 1, 0]
    alone = record.replace(y=np.column_stack((record.y[:, 0], y2 + 0.01 * rng.standard_normal(len(record)))))
    assert not any(isinstance(a, ThroughAnswer) for a in diagnose(alone, None, SPRINGS).model.answers)
