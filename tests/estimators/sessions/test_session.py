"""A session asks and is told; what comes out is what the direct call gives, bit for bit."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from estimators.rules.adaptive import sequential, two_stage
from estimators.rules.bandit import thompson_sampling
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import run
from estimators.sessions import FlaggedMeasurement, Session, Settings
from estimators.sessions.layout import placed, rig_samples, taper
from oed.errors import InputError, Status
from oed.experiments import simulated
from oed.plants.named import named_plant
from oed.plants.norms import peak

REFERENCE = named_plant("reference", 0.01)

METHODS = {
    "power": power_iterations,
    "procedure-2": partial(procedure_2, scaling="each"),
    "bandit": thompson_sampling,
    "two-stage": two_stage((2, 2), 1, experiments=4),
    "sequential": sequential((2, 2), 1, experiments=4),
}


@pytest.mark.parametrize("method", METHODS)
def test_ask_and_tell_give_what_run_gives(method):
    direct = run(
        METHODS[method],
        simulated(REFERENCE, seed=5),
        samples=150,
        experiments=4,
        rng=np.random.default_rng(7),
    )
    rig = simulated(REFERENCE, seed=5)
    session = Session(Settings(method, samples=150, experiments=4, seed=7))
    while session.step:
        assert session.ask() is session.ask()
        session.tell(rig(session.ask()))
    for mine, theirs in zip(session.trace.records, direct.records, strict=True):
        np.testing.assert_array_equal(mine.u, theirs.u)
        np.testing.assert_array_equal(mine.y, theirs.y)
    assert session.trace.kinds == direct.kinds
    assert session.trace.usage == direct.usage
    assert session.finished is Status.BUDGET
    found = session.estimate()
    assert found.interval[0] < found.value < found.interval[1]
    assert found.value == pytest.approx(peak(REFERENCE).value, rel=0.03)
    with pytest.raises(InputError, match="finished"):
        session.ask()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "sizes", [(1e-12, 1e12, 1e-12), (1e12, 1e-12, 1e12), (1e-24, 1e24, 1e-49), (1e49, 1e49, 1e49)]
)
def test_units_change_no_conclusion(method, sizes):
    """Far from one a bandit went by single precision, which ends at 1e38, and a design was silently none: white noise."""
    found = {}
    for a, b, dt in ((1.0, 1.0, 1.0), sizes):
        rig = simulated(REFERENCE, seed=5)
        session = Session(Settings(method, samples=150, experiments=4, seed=7, power=a * a, dt=dt))
        estimate = session.run(lambda u, a=a, b=b, rig=rig: b * rig(u / a))
        found[b] = [x * a / b for x in (estimate.value, *estimate.interval)], estimate, session.trace.kinds
    (usual, one, kinds), (scaled, other, same) = found.values()
    assert np.allclose(scaled, usual, rtol=1e-4)
    assert (one.status, kinds) == (other.status, same)
    assert np.isclose(one.frequency, other.frequency, rtol=1e-4)


@pytest.mark.parametrize("size", [1e-75, 1e-140])
def test_a_size_without_sixth_powers_is_a_line(size):
    """The interval had been seven times too narrow at 1e-140, in silence."""
    with pytest.raises(
        InputError, match="root of the power is .*between 1e-50 and 1e.50.*choose other units"
    ):
        Settings("power", samples=150, power=size * size)
    with pytest.raises(InputError, match="sampling time is .*between 1e-50 and 1e.50.*choose other units"):
        Settings("diagnose-next", samples=240, dt=size)  # the diagnosis at its end refused it
    with pytest.raises(InputError, match="limit amplitude is .*choose other units"):
        Settings("power", samples=150, amplitude=size)
    rig = simulated(REFERENCE, seed=5)
    with pytest.raises(InputError, match="size of the outputs is .*choose other units"):
        Session(Settings("power", samples=150)).run(lambda u: size * rig(u))


def test_there_is_always_an_estimate_with_its_uncertainty():
    session = Session(Settings("power", samples=24, experiments=4))
    assert np.isnan(session.estimate().value)
    assert "nothing is recorded" in str(session.estimate())
    rig = simulated(REFERENCE, seed=2)
    while session.step:  # too short for a local model at first: a crude value, and an interval that says so
        session.tell(rig(session.ask()))
        found = session.estimate()
        assert found.interval[0] <= found.value <= found.interval[1]
        assert found.standard_error > 0


def test_run_takes_a_callable():
    session = Session(Settings("power", samples=100, experiments=3))
    assert session.run(simulated(REFERENCE, seed=1)).value == pytest.approx(2.41, rel=0.05)


def test_periods_are_averaged_and_their_scatter_is_the_noise_floor():
    """Circulant responses: after the warm-up the mean is that of the periodic steady state, noise over P."""
    settings = Settings("power", samples=64, periods=8, warm_up=2, ramp=6, rest=5, experiments=3, dt=0.5)
    rows = 64 * 10 + 2 * 6 + 5
    assert rig_samples(settings) == rows
    plant = named_plant("reference", 0.04)
    session = Session(settings)
    rig, quiet = simulated(plant, seed=4), plant.simulate
    while session.step:
        u = session.ask()
        assert u.shape == (rows, 1)
        assert not u[-5:].any()
        session.tell(rig(u))
    omega = 2 * np.pi * np.arange(33) / 64
    G = plant.response(omega)[0][:, 0, 0]
    for record in session.trace.records:
        steady = np.fft.irfft(G * np.fft.rfft(record.u[:, 0]), 64)
        error = record.y[:, 0] - steady  # 0.04/8 per sample; 0.9^128 of the transient is left
        assert np.std(error) == pytest.approx(np.sqrt(0.04 / 8), rel=0.35)
    assert quiet(np.zeros((3, 1))).shape == (3, 1)
    # sigma^2/P from 3 x 7 x 64 degrees of freedom: a relative error of 0.027 in the deviation at two standard errors
    assert session.estimate().noise_floor[0] == pytest.approx(np.sqrt(0.04 / 8), rel=0.06)


def test_a_ramp_from_rest_iterates_on_the_tapered_system():
    """With T the reversal and W the taper, T W G W is symmetric: its largest singular value by dense algebra."""
    plant = named_plant("reference", 0.0)
    settings = Settings("power", samples=80, ramp=10, experiments=60)
    session = Session(settings)
    session.run(plant.simulate)
    g = plant.impulse_response(80)[:, 0, 0]
    G = np.array([[g[i - j] if i >= j else 0.0 for j in range(80)] for i in range(80)])
    W = np.diag(taper(settings)[:, 0])
    np.testing.assert_allclose(W, W[::-1, ::-1], atol=1e-15)
    norm = np.linalg.norm(W @ G @ W, 2)
    assert norm < np.linalg.norm(G, 2)
    assert session.estimate().gains[-1] == pytest.approx(norm, rel=1e-3)
    first = session.rig_records[0]
    np.testing.assert_allclose(first.u, placed(session.own_trace.records[0].u, settings))
    assert abs(first.u[0, 0]) < 0.1 * np.abs(first.u).max()


def test_model_minus_rig():
    """[M] (1): the session's system is the model minus the rig, its norm that of the difference."""
    from oed.plants.json import plant_to_json
    from oed.plants.plant import Plant

    rig = Plant([0, 0.2155, 0.2012], [1, -0.9854, 0.8187], noise_covariance=1e-4, name="rig")
    model = Plant([0, 0.2155, 0.1012], [1, -0.9854, 0.8187], noise_covariance=0.0, name="model")
    difference = Plant([0, 0, -0.1], [1, -0.9854, 0.8187], noise_covariance=1e-4, name="difference")
    session = Session(Settings("procedure-2", samples=400, experiments=12, model=plant_to_json(model)))
    found = session.run(simulated(rig, seed=3))
    true = peak(difference)
    assert abs(found.value - true.value) < 4 * found.standard_error
    assert found.standard_error < 0.01 * true.value
    assert found.frequency == pytest.approx(true.frequency, abs=0.01)


@pytest.mark.parametrize(
    "change, sentence",
    [
        (lambda y: y[:-1], "too few samples: 99 where the input has 100"),
        (lambda y: np.vstack([y, y]), "too many samples: 200"),
        (lambda y: np.hstack([y, y]), "shape"),
        (lambda y: "nonsense", "not an array of numbers"),
    ],
)
def test_an_output_of_the_wrong_shape_changes_nothing(change, sentence):
    session = Session(Settings("power", samples=100, experiments=3))
    u = session.ask()
    y = REFERENCE.simulate(u)
    with pytest.raises(InputError, match=sentence):
        session.tell(change(y))
    assert session.step == 1
    assert session.ask() is u
    session.tell(y)
    assert session.step == 2


def held(y):
    y = y.copy()
    y[40:48] = y[40]
    return y


def missing(y, value=np.nan):
    y = y.copy()
    y[17] = value
    return y


@pytest.mark.parametrize(
    "change, options, sentence, acceptable",
    [
        (missing, {}, "1 samples of y are missing, not finite or beyond 1e.50, the first at 17", False),
        (
            lambda y: missing(y, 1e200),
            {},
            "1 samples of y are missing, not finite or beyond 1e.50, the first at 17",
            False,
        ),
        (held, {}, "repeats the value .* for 8 samples from sample 40", True),
        (lambda y: np.clip(y, -9, 0.3 * y.max()), {}, "looks saturated", True),
        (lambda y: y, {"sensor_range": ((-0.2, 0.2),)}, "y is saturated in", True),
        (lambda y: y, {"abort": 0.2}, "beyond its abort level 0.2", True),
        (lambda y: 0 * y, {}, "constant", True),
    ],
)
def test_a_spoilt_measurement_is_flagged_and_can_be_repeated(change, options, sentence, acceptable):
    session = Session(Settings("bandit", samples=101, experiments=2, **options))
    y = simulated(REFERENCE, seed=1)(session.ask())
    with pytest.raises(FlaggedMeasurement, match=sentence):
        session.tell(change(y))
    assert session.step == 1
    if acceptable:
        session.tell(change(y), accept=True)
        assert session.step == 2
    else:
        with pytest.raises(FlaggedMeasurement):
            session.tell(change(y), accept=True)


def test_sound_measurements_are_not_flagged():
    """Quantised, settled and silent outputs are no faults: the negative control of the flags."""
    rig = named_plant("three-by-two", 0.0)
    session = Session(
        Settings(
            "procedure-2", samples=60, rest=200, experiments=14, inputs=("a", "b"), outputs=("p", "q", "r")
        )
    )
    session.run(lambda u: np.round(rig.simulate(u), 1))
    session = Session(Settings("power", samples=60, rest=300, level=(3.0,), centre=True, experiments=4))
    session.run(lambda u: 5 + REFERENCE.simulate(u))
    assert session.finished is Status.BUDGET


def test_reference_inputs_tell_what_is_wrong():
    plant = named_plant("avis", 0.01)
    settings = Settings("procedure-2", samples=100, experiments=9, inputs=("a", "b"), outputs=("p", "q"))
    session = Session(settings)
    rig = simulated(plant, seed=1)
    first = session.ask()
    y = rig(first)
    for recorded, sentence in (
        (first[:, ::-1], "channels are swapped: b got the signal of a, a got the signal of b"),
        (-first, "opposite sign"),
        (np.vstack([np.zeros((3, 2)), first[:-3]]), "lags the one asked for by 3 samples"),
        (1.2 * first, "deviates by 20 %"),
        (np.full_like(first, np.nan), "not finite"),
    ):
        with pytest.raises(InputError, match=sentence):
            session.tell(y, recorded)
    session.tell(y, first * 1.01 + 0.001)  # a real recording has its own gain and offset
    later = rig(session.ask())
    with pytest.raises(InputError, match="that of step 1, and step 2 is waited for"):
        session.tell(later, first)
    with pytest.raises(InputError, match="this is the output of step 1"):
        session.tell(y)
    assert session.step == 2


@pytest.mark.parametrize(
    "options, sentence",
    [
        ({"method": "powr"}, "did you mean power"),
        ({"samples": 3}, "from 4 to"),
        ({"dt": 0.0}, "sampling time"),
        ({"amplitude": -1.0}, "limit amplitude"),
        ({"inputs": ("u", "u")}, "given once"),
        ({"inputs": ("u", "v")}, "use procedure-2"),
        ({"ramp": 60}, "ramps"),
        ({"level": (1.0, 2.0)}, "one finite number per input"),
        ({"method": "two-stage", "periods": 2}, "experiments from rest"),
        ({"sensor_range": ((1.0, 0.0),)}, "sensor range"),
        ({"model": {"num": [1], "den": [1], "dt": 2.0}}, "sampling time of the model"),
        ({"method": "diagnose-next"}, "at least 120"),
    ],
)
def test_settings_that_break_a_rule(options, sentence):
    with pytest.raises(InputError, match=sentence):
        Session(Settings(**{"method": "power", "samples": 100} | options))
