"""The loop that runs a rule, what it keeps, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.rules.inputs import fixed, multisine, prbs, sweep, white
from estimators.rules.limits import Limits, scaled
from estimators.rules.power import power_iterations
from estimators.rules.trace import Step, run
from oed.errors import ExperimentError, InputError, Status
from oed.experiments import Experiment, replayed, simulated
from oed.plants.named import named_plant


def apply_reference(u):
    return named_plant("reference").simulate(u)


@pytest.mark.parametrize("rule", [white, multisine, prbs, sweep], ids=lambda rule: rule.__name__)
@pytest.mark.parametrize("channels", [1, 2])
def test_inputs_have_exact_power(rule, channels, rng):
    experiment = Experiment(lambda u: u[:, :1] + 0.1, channels, 1)
    trace = run(rule, experiment, samples=101, experiments=3, rng=rng)
    power = [np.mean(np.sum(r.u**2, axis=1)) for r in trace.records]
    np.testing.assert_allclose(power, 1.0, rtol=0.02 if rule is sweep else 1e-12)
    assert trace.kinds == (rule.__name__,) * 3
    assert trace.usage.energy == pytest.approx(101 * sum(power))
    if rule is not sweep:  # every experiment is a new draw
        assert not np.allclose(trace.records[0].u, trace.records[1].u)
    if channels == 2:
        assert not np.allclose(trace.records[0].u[:, 0], trace.records[0].u[:, 1])


def test_multisine_is_flat(rng):
    u = next(multisine(100, 1, 1, rng)).u[:, 0]
    lines = np.abs(np.fft.rfft(u))
    np.testing.assert_allclose(lines[1:50], lines[1], rtol=1e-9)
    assert lines[0] < 1e-9
    assert lines[50] < 1e-9


def test_fixed_input_is_applied_as_it_is(rng):
    u = rng.standard_normal((20, 1))
    trace = run(fixed(u), simulated(named_plant("reference")), samples=20, experiments=2, rng=rng)
    assert all(np.array_equal(r.u, u) for r in trace.records)
    with pytest.raises(InputError, match=r"shape \(20, 1\)"):
        run(fixed(u), simulated(named_plant("reference")), samples=21, experiments=2, rng=rng)


def test_budget_and_replay(rng):
    start = rng.standard_normal((50, 1))

    def rule(*a):
        return power_iterations(*a, start=start)

    trace = run(rule, simulated(named_plant("reference")), samples=50, experiments=4, rng=rng)
    assert trace.status is Status.BUDGET
    assert len(trace) == 4
    again = run(rule, replayed(trace.records), samples=50, experiments=4, rng=rng)
    assert all(np.array_equal(a.y, b.y) for a, b in zip(trace.records, again.records, strict=True))
    assert trace.first(2).usage.samples == 100
    beyond = run(rule, replayed(trace.records), samples=50, experiments=9, rng=rng)
    assert beyond.status is Status.FAILED
    assert len(beyond) == 4
    assert "replayed" in beyond.message


def test_stopping_rule_is_asked_after_every_experiment(rng):
    lengths = []

    def stop(trace):
        lengths.append(len(trace))
        return len(trace) == 3

    trace = run(white, simulated(named_plant("reference")), samples=10, experiments=9, rng=rng, stop=stop)
    assert lengths == [1, 2, 3]
    assert trace.status is Status.CONVERGED


def test_rule_may_end_by_itself(rng):
    def twice(samples, n_inputs, n_outputs, rng):
        for _ in range(2):
            yield rng.standard_normal((samples, n_inputs))

    trace = run(twice, simulated(named_plant("reference")), samples=10, experiments=9, rng=rng)
    assert (len(trace), trace.status, trace.kinds) == (2, Status.OK, ("", ""))


@pytest.mark.parametrize(
    "answer, message",
    [
        (lambda u: u * np.nan, "not finite"),
        (lambda u: u[:-1], "shape"),
        (lambda u: u * 0 + 3.0, "constant output"),
        (lambda u: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_a_rig_that_breaks_midway_leaves_what_was_measured(answer, message, rng):
    count = 0

    def apply(u):
        nonlocal count
        count += 1
        return answer(u) if count == 3 else apply_reference(u)

    trace = run(power_iterations, Experiment(apply), samples=30, experiments=5, rng=rng)
    assert trace.status is Status.FAILED
    assert len(trace) == 2
    assert message in trace.message
    assert "2 experiments before are kept" in trace.message
    count = 2  # and at once, nothing is there to keep
    with pytest.raises(ExperimentError, match="experiment 1"):
        run(power_iterations, Experiment(apply), samples=30, experiments=5, rng=rng)


def test_amplitude_limit_of_the_rig_is_met_or_named(rng):
    rig = lambda: Experiment(apply_reference, amplitude=1.5)
    with pytest.raises(InputError, match="limit is 1.5"):
        run(power_iterations, rig(), samples=100, experiments=5, rng=rng)

    def limited(*a):
        return power_iterations(*a, limits=Limits(amplitude=1.5))

    trace = run(limited, rig(), samples=100, experiments=5, rng=rng)
    assert trace.status is Status.BUDGET
    assert trace.usage.peak <= 1.5 * (1 + 1e-9)


@pytest.mark.parametrize(
    "limits, check",
    [
        (Limits(power=2.0), lambda u: np.mean(np.sum(u**2, 1)) == pytest.approx(2.0)),
        (Limits(power=None, energy=3.0), lambda u: np.sum(u**2) == pytest.approx(3.0)),
        (Limits(power=None, amplitude=[0.5, 2.0]), lambda u: (np.abs(u).max(0) <= [0.5001, 2.001]).all()),
        (
            Limits(power=None, channel_power=[0.1, 0.2]),
            lambda u: (np.mean(u**2, 0) <= [0.1001, 0.2001]).all(),
        ),
        (Limits(power=1.0, amplitude=0.1), lambda u: np.abs(u).max() == pytest.approx(0.1)),
    ],
)
def test_scaling_meets_every_limit_and_touches_one(limits, check, rng):
    x = rng.standard_normal((40, 2))
    u = scaled(x, limits)
    assert check(u)
    assert np.linalg.matrix_rank(np.column_stack([u.ravel(), x.ravel()])) == 1
    assert not check(1.01 * u) or limits.power == 1.0


@pytest.mark.parametrize("bad", [{"power": 0.0}, {"amplitude": -1.0}, {"power": None}, {"energy": np.nan}])
def test_limits_that_no_signal_meets(bad):
    with pytest.raises(InputError, match="limit"):
        Limits(**bad)


def test_arguments_are_checked(rng):
    with pytest.raises(InputError, match="samples is 1"):
        run(white, simulated(named_plant("reference")), samples=1, experiments=5, rng=rng)
    with pytest.raises(InputError, match="experiments is 0"):
        run(white, simulated(named_plant("reference")), samples=10, experiments=0, rng=rng)
    with pytest.raises(InputError, match=r"oed.Experiment\(apply"):
        run(white, apply_reference, samples=10, experiments=1, rng=rng)
    with pytest.raises(InputError, match="one input and one output"):
        run(power_iterations, simulated(named_plant("three-by-two")), samples=10, experiments=1, rng=rng)
    assert Step(np.ones((2, 1))).kind == ""


def test_an_interrupt_of_compiled_code_is_no_failed_experiment():
    """It comes out as a SystemError, and a run that took it for a fault of the plant would not end."""

    def interrupted(u):
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    with pytest.raises(KeyboardInterrupt):
        run(white, Experiment(interrupted, 1, 1), samples=20, experiments=3, rng=np.random.default_rng(0))
