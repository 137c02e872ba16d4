"""Single effects that the search by one-step errors passes over are put before unused blocks; what swings is a pendulum."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.discovery.dictionary import Kind
from estimators.diagnosis.discovery.form import Factor, Term
from estimators.diagnosis.discovery.wording import NARROW, same_as
from estimators.diagnosis.effects import CATALOGUE, Clock, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.ladder import Gain, Step
from estimators.diagnosis.ladder import Kind as Stage
from estimators.diagnosis.loop import Setting, diagnose
from estimators.diagnosis.model.fitting import Channel, fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.policy import Effort, Policy
from estimators.diagnosis.record.leftover import leftovers
from estimators.diagnosis.search import few as stage
from estimators.diagnosis.search import named as searched
from estimators.diagnosis.search.candidates import Menu, augmented
from estimators.diagnosis.search.named import Bench, _as_linear
from estimators.diagnosis.search.selection import Attribution
from oed.data import Record
from oed.errors import InputError
from tests.estimators.diagnosis.case_parts import swing
from tests.estimators.diagnosis.case_small import looking_for

CAUSES = {e.cause for e in CATALOGUE}


def logged(rng: np.random.Generator, n: int, bent: bool) -> Record:
    """A second-order lag about an operating level behind a compressive sensor, in noise of a time constant of its own."""
    u = 3.0 + np.repeat(rng.choice([-2.0, -0.5, 1.0, 2.0], n // 25 + 1), 25)[:n]
    x = lfilter([0.03, 0.03], [1.0, -1.5, 0.56], u - u[0]) + u[0]
    e = lfilter([1.0], [1.0, -0.9], 0.01 * rng.standard_normal(n))
    return Record(u, (4.0 * np.arctan(0.6 * (x - 1.0)) if bent else x) + e)


@pytest.mark.validate
def test_a_compressive_sensor_is_named_beside_coloured_noise(rng) -> None:
    train, test = logged(rng, 900, True), logged(rng, 500, True)
    result = diagnose(train, test, Setting(deviations=False, skip=20))
    assert result.effect == "output_nonlinearity"
    assert result.rmse_after.value < 0.5 * result.rmse_before.value


@pytest.mark.slow
def test_nothing_is_claimed_of_a_linear_plant_in_the_same_noise(rng) -> None:
    setting = Setting(deviations=False, skip=20, effort=Effort.QUICK)
    result = diagnose(logged(rng, 500, False), logged(rng, 400, False), setting)
    assert result.effect in ("none", "coloured_noise")


@pytest.mark.slow
def test_several_training_records_are_one_diagnosis(rng) -> None:
    records = [logged(rng, n, True) for n in (300, 400)]
    test = logged(rng, 300, True)
    setting = looking_for(
        "output_arctan", "output_tanh", "output_clip", "saturation", deviations=False, skip=20
    )
    result = diagnose(records, test, setting)
    assert result.effect == "output_nonlinearity"
    assert result.rmse_after.value < 0.5 * result.rmse_before.value
    assert len(result.ladder) > 1


def test_training_records_of_different_systems_are_refused(rng) -> None:
    first = logged(rng, 200, False)
    with pytest.raises(InputError, match="other training record has 1 inputs and 2 outputs"):
        diagnose([first, Record(first.u, np.repeat(first.y, 2, axis=1))[:150]])
    with pytest.raises(InputError, match="sequence of data is empty"):
        diagnose([])


def test_residual_tests_skip_parameters_that_are_held(rng) -> None:
    u = rng.standard_normal(400)
    y = lfilter([0.0, 0.5], [1.0, -0.7], u) + 0.1 * rng.standard_normal(400)
    channel = Channel(u[:, None], y, Clock(np.arange(400.0), 400), np.ones(400, dtype=bool))
    free = fit_linear(channel, Structure(1, (0,)))
    scales = free.scales.copy()
    scales[0] = 0.0
    held = fit(channel, free.structure, free.p, scales)
    assert held.p[0] == free.p[0]
    assert leftovers(channel, replace(held, scales=scales), alpha=1e-4) == []


def test_terms_get_names_of_the_catalogue_where_they_say_the_same() -> None:
    def said(kind: int, signal: str, slot: str, swings: bool = True, width: float = 1.0) -> str:
        return same_as(Term((Factor(kind, signal, 0.0, width),), slot), swings)

    assert said(Kind.SIN, "y0", "force") == "pendulum"
    assert said(Kind.SIN, "y0", "force", swings=False) == "nonlinear_loss"  # nothing swings without a mass
    assert said(Kind.BELL, "v0", "force") == "stribeck_friction"
    assert said(Kind.LOG, "u0", "force") == "hammerstein"
    assert said(Kind.ABS, "du0", "force") == ""
    assert said(Kind.CUBE, "y0", "force") == "duffing"
    assert (said(Kind.CUBE, "y0", "output"), said(Kind.CUBE, "y1", "output")) == ("output_nonlinearity", "")
    assert said(Kind.INVERSE, "y0", "force") == ""  # no spring: its equation says more
    for width, cause in ((0.9, "coulomb_friction"), (1.1, "nonlinear_loss")):  # y0 may be a speed
        assert said(Kind.TANH, "y0", "force", False, width * NARROW) == cause
    pairs = {("u0", "u1"): "product_of_inputs", ("u0", "y0"): "bilinear", ("u0", "u0"): "", ("u0", "v0"): ""}
    for (a, b), name in pairs.items():
        assert same_as(Term((Factor(Kind.LINEAR, a, 0.0), Factor(Kind.LINEAR, b, 0.0)), "force")) == name
    moved = Factor(Kind.LINEAR, "u0", 0.0), Factor(Kind.LINEAR, "v0", 0.0)
    assert (
        same_as(Term(moved, "output")) == "flow_dependent_delay"
    )  # y(t - d(u)) = y - d(u) y' to first order
    assert same_as(Term((moved[0], Factor(Kind.LINEAR, "v1", 0.0)), "output")) == ""
    found = {
        said(k, s, slot) for k in range(16) for s in ("y0", "v0", "u0", "du0") for slot in ("force", "output")
    }
    assert found - {""} <= CAUSES


def test_what_a_pole_explains_as_well_is_linear_dynamics(rng) -> None:
    u = rng.standard_normal(500)
    y = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], u) + 0.02 * rng.standard_normal(500)
    channel = Channel(u[:, None], y, Clock(np.arange(500.0), 500), np.ones(500, dtype=bool))
    good, poor = (fit_linear(channel, Structure(order)) for order in (2, 1))
    for rival, gain, news, cause, told in (
        (good, 0.0, False, "sensor_lag", False),
        (good, 0.3, False, "sensor_lag", True),
        (good, 0.0, True, "sensor_lag", True),
        (poor, 0.0, False, None, True),
    ):
        a = SimpleNamespace(claims=[SimpleNamespace(effect=named("lag"), cause="sensor_lag", fit=rival)])
        bench = SimpleNamespace(
            unused=lambda f: f, over=lambda *a, gain=gain: Gain(gain, 0.01, gain), policy=Policy(),
            tells=lambda f, news=news: news,
        )  # fmt: skip
        found = _as_linear(bench, a, good)  # pyright: ignore[reportArgumentType]
        assert (found[0] and found[0].cause, found[1]) == (cause, told)


def test_an_effect_is_worth_what_the_best_of_the_models_without_it_lacks(monkeypatch) -> None:
    """On unused blocks: one fit without it is closer on the record itself and far off there, the linear model is farther still."""
    fits = [
        SimpleNamespace(residual=np.full(4, own), unused=unused, structure=SimpleNamespace(effects=effects))
        for own, unused, effects in ((0.9, 5.0, [Part(OFFSET)]), (1.0, 2.0, [Part(OFFSET)]), (3.0, 1.0, []))
    ]
    bench: Any = SimpleNamespace(channel=None, unused=lambda f: f.unused, error=lambda run: run)
    found = lambda: searched._best_without(bench, Attribution(*fits[::-1], [], [], 1.0), fits[0], 0)  # type: ignore[arg-type]
    monkeypatch.setattr(searched, "without", lambda *about: fits[:2])
    assert found() is fits[1]
    bare = SimpleNamespace(residual=np.full(4, 0.9), unused=4.0, structure=SimpleNamespace(effects=[]))
    monkeypatch.setattr(searched, "without", lambda *about: [bare])
    assert found() is fits[2]


def test_what_is_far_off_on_the_record_itself_is_not_put_before_unused_blocks(monkeypatch) -> None:
    effects = [SimpleNamespace(effect=named("input_cubic"))]
    fits = [
        SimpleNamespace(structure=SimpleNamespace(effects=effects), p=error, scales=None, n=4, deviance=0.0, noise=np.ones(1),
                        residual=np.full(4, error))
        for error in (0.5, 0.9, 1.0, 0.99 * stage.HALF, 1.01 * stage.HALF)
    ]  # fmt: skip
    asked, paired = [], []

    def steps(bench, a):
        asked.append(a.final)
        error = max(a.final.p, 1.0)
        return SimpleNamespace(
            step=None, fit=a.final, unused=np.ones(1), whole=True, step_error=lambda b: error, dropped=()
        )

    def second(channel, f, menu, coloured, needed):
        paired.append(f)
        return []

    monkeypatch.setattr(
        stage, "fit", lambda channel, structure, p, *a, **k: next(f for f in fits if f.p == p)
    )
    monkeypatch.setattr(stage, "named_steps", steps)
    monkeypatch.setattr(stage, "second", second)
    monkeypatch.setattr(stage, "trending", lambda channel, f: None)
    gain = SimpleNamespace(meets=lambda limits: True)
    bench = SimpleNamespace(linear=np.zeros(1), channel=range(100), over=lambda *a: gain, policy=Policy(),
                            stands=lambda n: True)  # fmt: skip
    a = Attribution(None, None, fits[0], [], [], 1.0, alternatives=tuple(fits[1:]))  # type: ignore[arg-type]
    stage.best_named(bench, a, Menu())  # type: ignore[arg-type]
    assert asked == fits[:4]  # the search's own, and all but the last
    assert paired == fits[1:4]


@pytest.mark.parametrize("passing", [False, True])
@pytest.mark.parametrize(
    ("able", "better", "chosen"),
    [(True, False, "pole"), (True, True, "trend"), (False, False, "trend"), (False, True, "trend")],
)
def test_a_trend_stands_for_a_pole_that_forgets_nothing_only_where_it_must(
    able, better, chosen, passing, monkeypatch
) -> None:
    """Where unused blocks are surely better with it, or the ladder would refuse how the model with the pole starts; and for a step
    that unused blocks did not bear: a thermometer that crept had a step of no time that could be told."""
    effects = [SimpleNamespace(key="step_input", effect=named("step_input"))]
    structure = SimpleNamespace(effects=effects if passing else [], parts=(), slices=lambda: (), order=1)
    fits = {
        name: SimpleNamespace(name=name, noise=(), structure=structure, scales=np.ones(1))
        for name in ("pole", "trend")
    }
    named_as = lambda bench, a: SimpleNamespace(
        step=SimpleNamespace(parameters={}, unused=(a.final.name,)), claims=(), fit=a.final, unused="", dropped=[("step_input", "")]
    )  # fmt: skip
    # the linear model as a coarse sensor reads it has a step, and no effects whose runs stand beside it
    monkeypatch.setattr(stage, "named_steps", named_as)
    monkeypatch.setattr(stage, "trending", lambda channel, f: None if passing else fits["trend"])
    monkeypatch.setattr(stage, "drifting", lambda channel, f: fits["trend"])
    gain = SimpleNamespace(meets=lambda limits: better)

    def over(second, first):
        assert (second, first) == ("trend", "pole")
        return gain

    bench = SimpleNamespace(channel=None, policy=Policy(), over=over,
                            stands=lambda n: able or n.fit.name == "trend")  # fmt: skip
    a = Attribution(None, None, fits["pole"], [], [], 1.0)  # type: ignore[arg-type]
    assert stage.best_named(bench, a, Menu()).fit.name == chosen  # type: ignore[arg-type]
    without = Menu(tuple(e for e in Menu().effects if e.key != "drift"))  # the clock tells nothing there
    if able:
        assert stage.best_named(bench, a, without).fit.name == "pole"  # type: ignore[arg-type]


def test_what_does_not_start_as_a_test_record_will_is_no_answer(monkeypatch) -> None:
    """Blocks have a window that sets their state; a run from the record's own start shows what integrates what was fitted to it."""
    y, rise = np.sin(np.arange(50.0)), np.linspace(0.0, 9.0, 50)
    step = lambda run: Step(Stage.NAMED, (), (y,), SimpleNamespace(simulate=lambda record, window: run), 1)  # type: ignore[arg-type]
    monkeypatch.setattr(searched, "linear_step", lambda *about: step(0.0 * y))
    bench: Any = SimpleNamespace(train=Record(y, y), output=0, base=None, rest=False, skip=0, wanted=None)
    runs = (y, y + rise, np.full(50, np.nan))
    assert [Bench.stands(bench, SimpleNamespace(step=step(run))) for run in runs] == [True, False, False]  # type: ignore[arg-type]
    assert Bench.stands(bench, SimpleNamespace(step=None))  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_start_is_judged_on_the_record_as_it_is_where_the_input_acts_at_once(rng, monkeypatch) -> None:
    """The model takes the input a sample earlier itself: on a record moved already it would be two samples early."""
    u = rng.standard_normal(400)
    e = lfilter([1.0], [1.0, -0.8], 0.02 * rng.standard_normal(400))
    asked, stands = [], Bench.stands

    def kept(bench, n):
        asked.append((bench.ahead, n.step is not None, stands(bench, n)))
        return asked[-1][-1]

    monkeypatch.setattr(Bench, "stands", kept)
    y = lfilter([0.3], [1.0, -0.7], np.clip(u, -0.7, 0.7)) + e
    found = diagnose(Record(u, y), None, looking_for("saturation", "input_tanh", "delay"))
    assert found.effect == "input_saturation"
    assert next(told for told in asked if told[1]) == (True, True, True)


def test_a_growing_curve_is_tried_behind_a_lag_however_little_its_score_promises() -> None:
    """An equal-percentage valve whose stem lags: with four effects fitted, its curve is there, behind a lag, and the best."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(45, 79, 60), rng.integers(5, 20, 60))
    stem = 60.0 + np.asarray(lfilter([0.0, 0.1], [1.0, -0.9], u - 60.0))
    flow = 80.0 * 44.0 ** (stem / 100.0 - 1.0)
    y = np.asarray(lfilter([0.05], [1.0, -0.95], lfilter([0.25], [1.0, -0.75], flow - flow[0])))
    y, n = y + 0.05 * rng.standard_normal(len(u)), len(u)
    channel = Channel(u[:, None], y, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    base = fit_linear(channel, replace(Structure(3, (0,)).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    fits = list(augmented(channel, base, Menu(CATALOGUE, (), 4), iterations=15, top=4))
    best = min(fits, key=lambda f: float(np.sum(f.residual**2)))
    assert (best.structure.parts[-1].key, best.structure.parts[-1].first) == ("input_exponential", 1)


def test_play_is_tried_behind_the_lag_of_its_actuator() -> None:
    """A control cable: the servo lags, then the cable has play, then the surface swings; coloured noise."""
    rng, n = np.random.default_rng(3), 800
    u = 6.0 * lfilter([0.05], [1.0, -0.95], 6.0 * rng.standard_normal(n))
    servo = np.asarray(lfilter([0.0, 0.35], [1.0, -0.65], u))
    effect, clock = named("backlash_input"), Clock(np.arange(float(n)), n)
    assert effect.apply is not None
    moved = effect.apply(servo, np.array([2.0, 0.0]), clock)
    y = lfilter([0.0, 0.1], [1.0, -1.7, 0.8], moved) + 0.05 * lfilter(
        [1.0], [1.0, -0.7], rng.standard_normal(n)
    )
    channel = Channel(u[:, None], y, clock, np.ones(n, dtype=bool))
    base = fit_linear(channel, replace(Structure(3, (0,)).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    fits = list(augmented(channel, base, Menu((effect, named("dead_zone")), (), 2), iterations=15, top=2))
    best = min(fits, key=lambda f: float(np.sum(f.residual**2)))
    assert (best.structure.parts[-1].key, best.structure.parts[-1].first) == ("backlash_input", 1)
    assert float(np.sqrt(np.mean(best.residual**2))) < 0.1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_strong_eccentric_is_found_from_the_balance_of_forces(seed: int) -> None:
    """A motor that nearly stalls on every turn: its linear model is bent so far that its error has no angle in it."""
    rng, n, speed, angle = np.random.default_rng(seed), 1000, 0.0, 0.0
    u = np.repeat(rng.uniform(3.0, 9.0, n // 20), 20)
    y = np.zeros(n)
    for k in range(n):
        y[k] = speed
        for _ in range(40):
            speed += 5e-4 * (4.0 * u[k] - 1.6 * speed - 20.0 * np.sin(angle))
            angle += 5e-4 * speed
    y += 0.05 * rng.standard_normal(n)
    channel = Channel(u[:, None], y, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    base = fit_linear(channel, replace(Structure(2, (0,)).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    effect = named("position_periodic")
    assert effect.search is not None
    errors = [float(np.sqrt(np.mean(f.residual**2))) for f in effect.search(channel, base, ())]
    assert min(errors) < 1.5 * 0.05 < 0.3 * float(np.sqrt(np.mean(base.residual**2)))


@pytest.mark.slow
def test_a_sensor_of_two_decades_is_a_logarithm_found_by_undoing_the_curve() -> None:
    """The linear model of such a record is far from every plant: no step from it leads to the curve."""
    rng = np.random.default_rng(7)

    def gauge(n: int) -> Record:
        u = np.repeat(np.exp(rng.uniform(0.0, 4.4, n // 40 + 1)), 40)[:n]
        x = lfilter([0.05], [1.0, -0.95], u - u[0]) + u[0]
        return Record(u, 5.0 + 0.41 * np.log(0.02 * x + 0.02) + 0.01 * rng.standard_normal(n))

    curves = "output_logarithm", "output_exponential", "output_quadratic", "output_arctan", "input_quadratic"
    result = diagnose(gauge(1000), gauge(500), looking_for(*curves, deviations=False, separate=True))
    assert (result.effect, result.variant) == ("output_nonlinearity", "output_logarithm")
    assert result.rmse_after.value < 1.2 * 0.01
    value, error, _ = result.parameters["output_logarithm.c"]
    assert value == pytest.approx(1.0 / 0.41, abs=4.0 * error)


@pytest.mark.slow
@pytest.mark.parametrize(
    "level, memory, noise", [(0.0, 0.0, 0.04), pytest.param(12.0, 0.7, 0.3, marks=pytest.mark.validate)]
)
def test_a_zero_that_creeps_is_a_drift_though_a_predictor_follows_it(level, memory, noise) -> None:
    """In slower noise and at a level a gain that decays does nearly as well, and so does much else in one-step errors."""
    rng = np.random.default_rng(8)

    def cell(n: int, first: int) -> Record:
        u = np.repeat(rng.uniform(-1.0, 1.0, n // 30 + 1), 30)[:n]
        t = first + np.arange(n)
        e = noise * lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], rng.standard_normal(n))
        return Record(u, level + lfilter([0.1], [1.0, -0.9], u) + 1e-3 * t + e, t0=float(first))

    result = diagnose(cell(900, 0), cell(500, 900), Setting(deviations=False))
    assert result.effect == "output_drift"
    assert result.rmse_after.value < 1.3 * noise


@pytest.mark.validate
@pytest.mark.slow
def test_the_linear_model_of_a_coarse_encoder_is_read_as_the_encoder_reads(rng) -> None:
    def shaft(n: int) -> Record:
        u = np.repeat(rng.uniform(0.0, 50.0, n // 25 + 1), 25)[:n]
        y = lfilter([0.05, 0.05], [1.0, -1.5, 0.6], u) + 0.2 * rng.standard_normal(n)
        return Record(u, 9.0 * np.round(y / 9.0))

    result = diagnose(shaft(900), shaft(500), Setting(deviations=False, separate=True))
    assert result.effect == "quantisation"
    assert result.rmse_after.value < 0.6 * result.rmse_before.value


@pytest.mark.slow
def test_a_saturated_input_is_no_actuator_slower_than_its_record() -> None:
    """Where its lag was longer than the record, a limited rate was a saturation before an integrator, of which the plant's poles made none."""
    u, e = np.random.default_rng(1000).normal(size=(2, 1000))
    y = lfilter([0.0, 0.2155, 0.2012], [1.0, -0.9854, 0.8187], np.clip(u, -0.8, 0.8))
    rivals = looking_for("saturation", "input_tanh", "rate_limit", "rate_limit_sampled", "rate_in_loop")
    result = diagnose(Record(u, y + 0.05 * e), None, rivals)
    assert (result.effect, result.variant) == ("input_saturation", "saturation")
    value, error, _ = result.parameters["saturation.limit"]
    assert value == pytest.approx(0.8, abs=4.0 * error)


@pytest.mark.slow
def test_what_explodes_where_its_run_is_wanted_is_not_chosen():
    """A damping that falls ever more slowly: in this noise a straight line fits the record as well, and ends below zero in the next one."""
    rng, n = np.random.default_rng(2), 900
    u = np.repeat(rng.standard_normal(2 * n // 5), 5)
    y = swing(lambda x, v, f, t: 0.06 * (f - x) - 0.3 * np.exp(-t / 800.0) * v, u)
    y = y + 0.25 * np.std(y) * rng.standard_normal(2 * n)
    train, test = Record(u[:n], y[:n]), Record(u[n:], y[n:], t0=float(n))
    either = looking_for("damping_drift", "damping_settles")
    found = diagnose(train, test, either)
    assert found.effect == "parameter_drift"
    assert "damping_settles" in found.variant
    assert found.rmse_after.value < 0.4 * found.rmse_before.value
    alone = diagnose(train, None, either)
    assert "damping_drift" in alone.variant
