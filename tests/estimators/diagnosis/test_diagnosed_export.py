"""The answer of a diagnosis as a step in CasADi and as a linear system: the same numbers as its simulation, or a refusal."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline.linear_model import LinearModel
from estimators.diagnosis.discovery.dictionary import Kind
from estimators.diagnosis.discovery.form import Factor, Form, Term, flow_of
from estimators.diagnosis.discovery.model import DiscoveredModel
from estimators.diagnosis.discovery.starts import Scales
from estimators.diagnosis.discovery.validation import StartPrior
from estimators.diagnosis.effects import Effect, Nature, Slot, named
from estimators.diagnosis.ladder.steps import Gain
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.remainder.mixture import Remainder
from estimators.diagnosis.result.answers import DiscoveredAnswer, LinearAnswer, NamedAnswer, RemainderAnswer
from estimators.diagnosis.result.model import DiagnosedModel
from estimators.diagnosis.search.free_runs import Start
from oed.data import Record
from oed.errors import InputError
from tests.estimators.diagnosis.case_answers import NAMED, POLES, PRIOR, named_answer

DEN, NUM = np.array([1.0, -1.5, 0.7]), np.array([[0.0, 0.1, 0.1]])


def _model(*answers) -> DiagnosedModel:
    names = tuple(f"y{i + 1}" for i in range(len(answers)))
    return DiagnosedModel(answers, np.full(len(answers), 0.1), 0.5, ("u1",), names)


def _twin(model: DiagnosedModel, u, settled=None) -> np.ndarray:
    step, x = model.to_casadi(settled)
    out = []
    for k, inputs in enumerate(u):
        x, y = step(x, inputs, k)
        out.append(np.array(y).ravel())
    return np.array(out)


def _input(n: int = 120, level: float = 0.0) -> np.ndarray:
    u = np.repeat(np.random.default_rng(4).standard_normal((n // 3, 1)), 3, axis=0) + level
    u[:6] = level
    return u


def _held(model: DiagnosedModel, level: float = 0.0) -> np.ndarray:
    """The twin's run, held to the simulation, of the model as it is and as it is read back from its text."""
    u = _input(level=level)
    expected = model.simulate(u)
    assert np.all(np.isfinite(expected))
    for one in (model, DiagnosedModel.from_json(model.to_json())):
        np.testing.assert_allclose(_twin(one, u, [level]), expected, rtol=1e-9, atol=1e-9)
    return expected


def test_a_gate_that_is_never_shut_has_a_twin():
    _held(_model(named_answer("tf", [("water_column", [0.4, 0.01, 0.3, 1.2])], {"rest": False})), level=6.0)


@pytest.mark.slow  # the recursions are compiled at their first use
@pytest.mark.parametrize("name", NAMED)
def test_a_named_answer_is_its_twin(name):
    layout, effects, options = NAMED[name]
    run = _held(_model(named_answer(layout, effects, options)))
    assert np.std(run) > 1e-3
    if effects:  # the control: without its effects it is another model
        plain = _model(named_answer(layout, [], options)).simulate(_input())
        assert np.abs(run - plain).max() > 1e-3


@pytest.mark.parametrize(
    "name",
    [
        "maps",
        "rate",
        "two rates",
        "heat",
        "vessel",
        "springs",
        "loop of limited speed",
        "angle",
        "fatigue",
        "warm",
        "store",
        "on change",
        "plays",
    ],
)
def test_a_named_answer_settles_under_an_operating_level_as_the_simulation_does(name):
    layout, effects, options = NAMED[name]
    _held(_model(named_answer(layout, effects, options | {"rest": False})), level=1.5)


@pytest.mark.parametrize("key, q", [("select_low", [2.0, 0.8, 0.3]), ("select_high", [2.0, -0.5, 0.1])])
@pytest.mark.parametrize("heard", [(0,), (0, 1)])
def test_of_two_inputs_the_twin_selects_the_same(key, q, heard):
    """Also of one that the output does not hear otherwise."""
    p = [*POLES["tf"], 0.05, 0.2][: 2 + 2 * len(heard)]
    s = Structure(2, heard).adding(Part(named(key), 0))
    answer = replace(named_answer("tf", [], {}), structure=s, p=np.array([*p, *q]))
    model = DiagnosedModel((answer,), np.full(1, 0.1), 0.5, ("u1", "u2"), ("y1",))
    u = np.hstack((_input(), np.roll(_input(), 40)))
    np.testing.assert_allclose(_twin(model, u, [0.0, 0.0]), model.simulate(u), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("heard", [(0,), (0, 1)])
def test_of_two_streams_the_twin_has_the_same_share(heard):
    p = [*POLES["tf"], 0.05, 0.2][: 2 + 2 * len(heard)]
    s = Structure(2, heard).adding(Part(named("share"), 0))
    answer = replace(named_answer("tf", [], {}), structure=s, p=np.array([*p, 2.0, 0.7]))
    model = DiagnosedModel((answer,), np.full(1, 0.1), 0.5, ("u1", "u2"), ("y1",))
    u = np.exp(0.5 * np.hstack((_input(), np.roll(_input(), 40))))
    run = model.simulate(u)
    assert np.ptp(run) > 0.05
    np.testing.assert_allclose(_twin(model, u, [0.0, 0.0]), run, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "key, q",
    [("product_of_lags", [0.2, 1.5, 6.0, 0.4, 2.0, 0.9, power]) for power in (1.0, 2.0, 0.0, -1.0)]
    + [("loss_by_lag", [0.3, -0.2, 1.5, 6.0, 0.4, 0.6, rise, 2.0, 0.9, power, drive])
       for rise, power, drive in ((0.1, 0.0, 0.0), (0.0, 1.0, 2.0), (0.0, 2.0, 1.0))],
)  # fmt: skip
def test_two_lags_meet_in_the_twin_as_in_the_simulation(key, q):
    s = Structure(2, (0, 1)).adding(Part(named(key), 0))
    answer = replace(named_answer("tf", [], {}), structure=s, p=np.array([*POLES["tf"], 0.05, 0.2, *q]))
    model = DiagnosedModel((answer,), np.full(1, 0.1), 0.5, ("u1", "u2"), ("y1",))
    u = np.hstack((_input(), np.roll(_input(), 40)))
    run = model.simulate(u)
    assert np.ptp(run) > 0.05
    np.testing.assert_allclose(_twin(model, u, [0.0, 0.0]), run, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("heard", [(0,), (1,), (0, 1)])
def test_inputs_that_share_a_supply_are_cut_back_in_the_twin_too(heard):
    """Also by an input that the output does not hear."""
    effect, p = named("shared_limit"), [*POLES["tf"], 0.05, 0.2][: 2 + 2 * len(heard)]
    s = Structure(2, heard).adding(Part(effect, heard[-1]))
    answer = replace(named_answer("tf", [], {}), structure=s, p=np.array([*p, 1.1, 0.7]))
    model = DiagnosedModel((answer,), np.full(1, 0.1), 0.5, ("u1", "u2"), ("y1",))
    u = np.hstack((_input(), np.roll(_input(), 40)))
    run = model.simulate(u)
    assert (
        np.abs(run - replace(model, answers=(replace(answer, p=np.array([*p, 1e9, 0.7])),)).simulate(u)).max()
        > 0.05
    )
    for one in (model, DiagnosedModel.from_json(model.to_json())):
        np.testing.assert_allclose(_twin(one, u, [0.0, 0.0]), run, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("level, off", [(31.0, 31.0), (0.5, 0.0)])
def test_a_store_is_as_full_as_the_window_of_a_record_says(level, off):
    """From a level that the training record did not start from; by less than three errors off it is as there."""
    answer = replace(named_answer(*NAMED["store"]), start=Start(PRIOR, False, 1e-4))
    moved = replace(answer, p=answer.p + level * (np.arange(len(answer.p)) == len(answer.p) - 1))
    wanted = replace(answer, p=answer.p + off * (np.arange(len(answer.p)) == len(answer.p) - 1))
    record = lambda y: Record(_input(), y, dt=0.5)
    y = moved.simulate(record(np.zeros(120)), 0)
    assert np.ptp(y - answer.simulate(record(y), 0)) > 0.01 * level / 31.0
    noise = 0.01 * np.random.default_rng(5).standard_normal(120) * (off > 0.0)
    run = answer.simulate(record(y + noise), 20)
    np.testing.assert_allclose(run, wanted.simulate(record(y), 0), atol=0.03)


@pytest.mark.parametrize("rest", [True, False])
def test_a_linear_answer_is_its_twin(rest):
    prior = replace(PRIOR, rest=rest)
    direct = LinearModel(DEN, np.array([[0.2, 0.1, 0.0, 0.1]]), 0.2)
    gain = LinearModel(np.ones(1), np.array([[2.0]]))
    _held(
        _model(LinearAnswer(0, (0,), direct, prior), LinearAnswer(1, (0,), gain, prior)), 0.0 if rest else 1.5
    )


def _discovered(*factors: Factor, **term) -> DiscoveredModel:
    """A second-order chain with one term, and a slow state that it may read."""
    slow = Term((Factor(Kind.SQUARE, "u0"),), "slow", rate=0.05)
    acts = Term(factors, **term)
    bounds = ((-3.0, 3.0), (-3.0, 3.0), (-2.0, 2.0), (-4.0, 4.0))
    form = Form((2,), 1, (0.4,), (0.3,), (slow, acts), feedthrough=True, bounds=bounds)
    theta = np.zeros(form.parameters)
    theta[:7] = 0.9, 1.0, 0.2, 0.6, 0.05, 0.1, 0.0
    theta[6] = 0.02
    theta[form.linear_size] = 1.0
    at = form.blocks[1].start
    theta[at : at + form.taps(acts)] = 0.2
    u, su, y, sy = (np.array([v]) for v in (0.3, 1.2, 0.5, 2.0))
    scales = Scales(u, su, y, sy, (0.4,), (0.3,), np.array([1]), 0.5, bounds)
    prior = StartPrior(np.zeros(2), np.eye(2), 0.01, np.zeros(1))
    names = {k: (k, "") for k in ("y0", "u0")}
    return DiscoveredModel(form, theta, scales, np.eye(len(theta)), prior, names, {"y0": (-1.0, 1.0)})


@pytest.mark.parametrize("kind", range(16))
def test_a_discovered_answer_is_its_twin_with_every_factor(kind):
    model = _discovered(Factor(kind, "y0", 0.1, 0.8), Factor(Kind.TANH, "s0", 0.0, 0.5))
    _held(_model(DiscoveredAnswer(0, model)))
    _held(_model(DiscoveredAnswer(0, model)), level=0.9)


@pytest.mark.parametrize(
    "term", [{"slot": "output"}, {"along": 0}, {"along": -2}], ids=["output", "along", "last"]
)
def test_a_discovered_answer_is_its_twin_in_every_slot(term):
    _held(
        _model(
            DiscoveredAnswer(
                0, _discovered(Factor(Kind.SIGNED_SQUARE, "v0"), Factor(Kind.ABS, "du0"), **term)
            )
        )
    )


def test_a_discovered_mobility_is_its_twin():
    _held(
        _model(
            DiscoveredAnswer(
                0,
                _discovered(
                    Factor(Kind.COS, "u0", 0.2, 0.7), Factor(Kind.LINEAR, flow_of(0)), slot="mobility"
                ),
            )
        )
    )


def test_a_discovered_model_with_a_steep_output_map_starts_where_its_record_rests(rng):
    """A thermistor's curve, of the size of what it bends: its runs had begun a third of a volt off, and took a tenth of the record back."""
    model = _discovered(Factor(Kind.TANH, "y0", 0.1, 0.5), slot="output")
    theta = model.theta.copy()
    theta[model.form.blocks[1].start] = 2.0
    model = replace(model, theta=theta, prior=replace(model.prior, mse=1e-4))
    u = np.concatenate((np.full(400, 0.8), np.repeat([1.5, -0.4, 0.9], 60)))[:, None]
    rested = model.simulate(Record(u, np.full((580, 1), np.nan), 0.5), 0)[
        385:
    ]  # fifteen samples of rest, then what moves
    y = rested + 0.01 * model.scales.sy * rng.standard_normal(rested.shape)
    run = model.simulate(Record(u[385:], y, 0.5), 0)
    assert np.max(np.abs(run - rested)) < 0.002 * np.ptp(
        rested
    )  # nor is the noise of its first sample its state


def test_several_outputs_share_one_step_and_one_discovered_model():
    found = DiscoveredAnswer(0, _discovered(Factor(Kind.CUBE, "y0")))
    linear = LinearAnswer(1, (0,), LinearModel(DEN, NUM), PRIOR)
    step, x = _model(found, linear, found).to_casadi()
    assert step.name_in() == ["x", "u", "k"]
    assert step.name_out() == ["x_next", "y"]
    assert (len(x), step.size1_out("y")) == (
        2 + 1 + 1 + 2 + 2,
        3,
    )  # chain, output before, slow, past inputs; filter
    together = _twin(_model(found, linear, found), _input())
    alone = [_model(found).simulate(_input()), _model(replace(linear, output=0)).simulate(_input())]
    np.testing.assert_allclose(together, np.hstack([*alone, alone[0]]), rtol=1e-9, atol=1e-9)


def test_what_has_no_twin_is_refused_by_name_with_what_to_do():
    refused = {
        "clock_drift": ("tf", [0.01]), "relay": ("tf", [0.2, 0.1]), "wrapped": ("tf", [1.0, 0.0, 0.0, 0.2]),
        "backlash_output": ("tf", [0.2]), "stiffness_drift": ("oscillator", [0.2]), "damping_change": ("oscillator", [0.2, 50.0]),
        "through_flow": ("tf", [0.1, 3.0]), "exposure": ("tf", [3.0, 1.0, 0.5]), "exposure_walled": ("tf", [3.0, 1.0, 0.5, 0.2, 1.0]), "capacity_filled": ("tf", [0.1, 0.02, 0.5, 1.0, 1.0]), "exchange_fouled": ("tf", [0.1, 0.6, 1.0, 0.5, 0.4]),
        "conveyed": ("tf", [3.0, 1.0]), "delay_periodic": ("tf", [0.1, 1.0, 0.5]),
        "clock_slips": ("tf", [30.0, 0.2, 1.5]), "resonance_drift": ("oscillator", [0.2]), "damping_settles": ("oscillator", [0.2, 2.5]),
        "stiffness_settles": ("oscillator", [0.2, 2.5]), "inertia_settles": ("oscillator", [0.2, 0.1, 2.5]), "resonance_settles": ("oscillator", [0.2, 2.5]),
        "input_staged": ("tf", [0.5, 0.3, 0.1]), "output_dead_band": ("tf", [0.4, 0.1, 0.1]),
        "stiffness_worked": ("oscillator", [0.2, 1.0, 40.0]), "acts_since": ("tf", [0.1, -0.5, 0.3, 1.0, 0.2, 50.3]), "output_autorange": ("tf", [0.3, 0.5, -0.2, 0.4]), "multiplexed": ("tf", [2.0, 1.0, 1.1, 0.1, 0.0, 0.3]),
    }  # fmt: skip
    for key, (layout, q) in refused.items():
        with pytest.raises(
            InputError, match=rf"y1 cannot be exported: the effect '{key}'.*diagnose without this effect"
        ):
            _model(named_answer(layout, [(key, q)], {})).to_casadi()
    thin = replace(named_answer("tf", [], {}), thin=2)
    with pytest.raises(InputError, match="every 2th sample.*diagnose the record sampled as slowly"):
        _model(thin).to_casadi()
    with pytest.raises(InputError, match="give 1 finite numbers: u1"):
        _model(named_answer("tf", [], {})).to_casadi([1.0, 2.0])


def _own(apply, key="mine") -> NamedAnswer:
    effect = Effect(key=key, cause="mine", nature=Nature.INPUT_STATIC, slot=Slot.INPUT, sentence="mine", parameters={"a": "1"},
                    apply=apply, starts=lambda s: ([[1.0]], [1.0]))  # fmt: skip
    return replace(
        named_answer("tf", [], {}),
        structure=Structure(2).adding(Part(effect)),
        p=np.array([*POLES["tf"], 0.5]),
    )


def test_an_effect_of_ones_own_is_exported_where_it_is_a_map_and_refused_where_it_remembers():
    model = _model(_own(lambda x, p, c: x - p[0] * np.tanh(x) * np.exp(-c.turn)))
    np.testing.assert_allclose(_twin(model, _input()), model.simulate(_input()), rtol=1e-9, atol=1e-9)
    for hidden in (lambda x, p, c: x - p[0] * np.cumsum(x), lambda x, p, c: lfilter([p[0]], [1.0, -p[0]], x),
                   lambda x, p, c: x * (x.shape[0] > 1)):  # fmt: skip
        with pytest.raises(InputError, match="'mine'"):
            _model(_own(hidden)).to_casadi()
    with pytest.raises(InputError, match="'delay'"):  # the catalogue's key on what remembers otherwise
        _model(_own(lambda x, p, c: np.cumsum(x), key="delay")).to_casadi()


def test_a_remainder_is_refused_and_the_model_without_it_is_exported():
    below = named_answer("tf", [("dead_zone", [0.4])], {})
    rest = Remainder(
        0,
        (),
        np.zeros(0),
        np.zeros(1),
        np.ones(1),
        (0.1, 0.5),
        (),
        0.1,
        Gain(0.03, 0.01, 0.5),
        True,
        "",
        (-0.2, 0.2),
    )
    model = _model(RemainderAnswer(0, below, (LinearAnswer(0, (0,), LinearModel(DEN, NUM), PRIOR),), rest))
    with pytest.raises(InputError, match="without_remainder"):
        model.to_casadi()
    lesser = model.without_remainder()
    assert lesser.errors == pytest.approx([0.2])  # .1 squared and the gain of .03
    _held(lesser)


def test_a_rounding_sensor_is_exported_to_half_a_step():
    answer = named_answer("tf", [], {})
    rounded = _model(replace(answer, step=0.05))
    off = np.abs(_twin(rounded, _input()) - rounded.simulate(_input()))
    assert 0.02 < off.max() <= 0.025 + 1e-12


LINEAR = {
    "arx": lambda: LinearAnswer(0, (0,), LinearModel(DEN, np.array([[0.2, 0.1, 0.0, 0.1]])), PRIOR),
    "lag, delay and path": lambda: named_answer(
        "tf", [("delay", [2.4]), ("lag", [0.6]), ("mode", [0.2, 0.1, -1.2, 0.8], {"size": 2})], {}
    ),
    "physical": lambda: named_answer("driven", [], {"delay": 2}),
}


@pytest.mark.parametrize("name", LINEAR)
def test_what_is_linear_goes_out_to_python_control(name):
    import control

    model = _model(LINEAR[name]())
    plant = model.to_control()
    assert (plant.dt, plant.input_labels, plant.output_labels) == (0.5, ["u1"], ["y1"])
    u = _input()
    np.testing.assert_allclose(
        control.forced_response(plant, U=u[:, 0]).outputs, model.simulate(u)[:, 0], atol=1e-9
    )


def test_an_offset_is_no_part_of_the_linear_system_and_a_spring_has_none():
    with_offset = _model(named_answer("tf", [("offset", [0.4])], {})).to_control()
    assert float(with_offset.dcgain()) == pytest.approx(1.0)
    for key, q in (("stiffness_cubic", [0.1]), ("coulomb", [0.2])):
        with pytest.raises(InputError, match="no linear system"):
            _model(named_answer("oscillator", [(key, q)], {})).to_control()


def test_the_interval_says_how_often_it_held():
    """Coverage is part of the file, and NaN where it was not measured."""
    model = _model(LINEAR["arx"]())
    assert np.isnan(model.coverage).all()
    measured = replace(model, coverage=np.array([0.93]))
    for one in (model, measured):
        again = DiagnosedModel.from_json(one.to_json())
        np.testing.assert_array_equal(again.coverage, one.coverage)
    record = Record(_input(), _input(), dt=0.5)
    y, low, high = measured.predict(record)
    np.testing.assert_allclose(high - y, y - low)


def test_the_page_on_control_does_what_it_says():
    """Its code runs as it stands: the level is reached through the curves that the plant was given, within the limits."""
    page = Path(__file__).resolve().parents[3] / "docs" / "howto" / "control.md"
    code = re.search(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S).group(1)
    found = {"model": _model(named_answer(*NAMED["maps"]))}
    exec(compile(code, str(page), "exec"), found)
    y = found["model"].simulate(np.concatenate((found["inputs"], found["inputs"][-1:])))
    assert abs(y[-1, 0] - 1.0) < 0.02
    assert np.abs(found["inputs"]).max() <= 2.0 + 1e-6
