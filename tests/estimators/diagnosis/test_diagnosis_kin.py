"""Effects that a linear model's scores pass over: the kin of what did best, a curve that falls again, a change that begins anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.ladder.anew import begun_anew
from estimators.diagnosis.ladder.held_out import HeldOut
from estimators.diagnosis.ladder.steps import Kind, Ladder, Rung, Step
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.result.report import ErrorFigure
from estimators.diagnosis.search.candidates import Menu, augmented
from estimators.diagnosis.search.starts import quick_pole
from oed.data import Record
from tests.estimators.diagnosis.case_parts import linear
from tests.estimators.diagnosis.test_diagnosis_classes import error, record

Array = np.ndarray


@pytest.mark.parametrize("stand_in", ["timescale_change", "loss_change"])
def test_the_kin_of_what_did_best_is_fitted_whatever_its_score_promised(stand_in):
    """An inertia that grows: a score from the linear model prefers a sudden change, and one effect is fitted."""
    channel, base, noise = record("inertia_drift", 1.0)
    menu = Menu((named(stand_in), named("inertia_drift")))
    found = list(augmented(channel, base, menu, top=1))
    assert {f.structure.parts[-1].key for f in found} == {e.key for e in menu.effects}
    assert min(map(error, found)) < 1.35 * noise


def _through(
    curve: Callable[[Array], Array], order: int, level: float, rng: np.random.Generator
) -> tuple[Channel, Fit, float]:
    """A record of a curve before a plant, its linear fit and the noise."""
    u = np.repeat(rng.uniform(-1.5, 1.5, 60), 15)
    y = linear(curve(u))
    noise = 0.01 * float(np.std(y))
    y = y + noise * rng.standard_normal(len(u))
    channel = Channel((level + 12.0 * u)[:, None], y, Clock(np.arange(900.0), 900), np.ones(900, dtype=bool))
    f = fit_linear(channel, replace(Structure(order).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    white = float(np.mean(f.residual**2))
    return channel, replace(f, noise=np.zeros(0), variance=white, deviance=f.n * np.log(white)), noise


@pytest.mark.parametrize("order", [3, 4])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_curve_behind_a_lag_that_no_pole_of_the_linear_model_shows(order, seed):
    """A valve's stem before its curve, two levels of input: with an order too many the linear model's poles have not the stem's."""
    rng, tau = np.random.default_rng(seed), 2.3
    u = np.repeat(np.sign(rng.standard_normal(90)), 15)
    u[:15] = 0.0
    stem = lfilter([1.0 - np.exp(-1.0 / tau)], [1.0, -np.exp(-1.0 / tau)], u)
    y = lfilter([0.0, 0.014], np.poly(np.exp([-1.0 / 15.0, -1.0 / 4.0])), np.exp(0.73 * stem))
    noise = 0.01 * float(np.std(y))
    y = y + noise * rng.standard_normal(len(u))
    channel = Channel(u[:, None], y, Clock(np.arange(1350.0), 1350), np.ones(1350, dtype=bool))
    base = fit_linear(channel, replace(Structure(order).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2))
    curve = named("input_exponential")
    assert 0.5 < -tau * np.log(quick_pole(channel, base, 0)) < 2.0
    found = augmented(channel, base, Menu((curve, named("output_quadratic"))), top=1)
    assert min(error(f) for f in found if f.structure.parts[-1].effect is curve) < 1.05 * noise


def test_no_kin_is_asked_of_what_explains_the_record_nor_of_what_keeps_still(rng):
    channel, base, noise = _through(lambda u: u * np.linspace(1.0, 1.6, len(u)), 2, 0.0, rng)
    found = list(augmented(channel, base, Menu((named("gain_drift"), named("inertia_drift"))), top=1))
    assert error(min(found, key=error)) < 1.1 * noise
    assert {f.structure.parts[-1].key for f in found} == {"gain_drift"}
    channel, base, noise = _through(lambda u: np.exp(-2.0 * u), 2, 0.0, rng)
    found = list(augmented(channel, base, Menu((named("saturation_upper"), named("input_sine"))), top=1))
    assert error(min(found, key=error)) > 2.0 * noise
    assert len({f.structure.parts[-1].key for f in found}) == 1


@pytest.mark.parametrize("level", [0.0, 40.0])
@pytest.mark.parametrize("order", [2, 4])
def test_a_curve_that_falls_again_is_found_where_the_linear_model_says_nothing_of_it(order, level, rng):
    """Light on algae passed through its optimum: to the linear model the input hardly acts."""
    channel, base, noise = _through(lambda u: 1.2 - u**2 + 0.1 * u, order, level, rng)
    effect = named("input_polynomial")
    start = effect.more(channel, base, 0)  # pyright: ignore[reportOptionalCall]
    begun = fit(channel, start.structure, start.p, start.scales, iterations=8)
    assert error(base) > 20.0 * noise
    assert error(begun) < 2.0 * noise


def test_a_curve_of_two_levels_has_no_such_start(rng):
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 10)
    channel = Channel(u[:, None], linear(u), Clock(np.arange(400.0), 400), np.ones(400, dtype=bool))
    assert named("input_polynomial").more(channel, fit_linear(channel, Structure(2)), 0) is None  # pyright: ignore[reportOptionalCall]


def _held(after: float, bears: bool) -> HeldOut:
    figure = lambda x: ErrorFigure(x, 0.9 * x, 1.1 * x)
    told: dict[str, Any] = {
        "rmse_after": figure(after), "borne": figure(1.0 if bears else -1.0), "difference": figure(1.0 - after), "warnings": (),
    }  # fmt: skip
    return HeldOut(**{f.name: told.get(f.name) for f in fields(HeldOut)})


@pytest.mark.parametrize(
    ("by_clock", "anew", "taken"),
    [((1.5, False), (0.1, True), 0.1), ((1.5, False), (1.4, True), 1.5), ((1.5, False), (0.1, False), 1.5), ((0.2, True), (0.1, True), 0.2)],
)  # fmt: skip
def test_a_change_begins_anew_only_where_the_clock_is_refused_and_that_is_surely_borne(by_clock, anew, taken):
    train, test = Record(np.ones(50), np.ones(50)), Record(np.ones(50), np.ones(50), t0=200.0)
    step = Step(Kind.NAMED, ("gain_drift",), (), None)  # type: ignore[arg-type]
    ladder = Ladder((Rung(step, np.zeros(50), ErrorFigure(1.0, 1.0, 1.0)),) * 2, 1, ())
    asked: list[float] = []

    def assessed(record: Record | None) -> HeldOut:
        assert record is not None
        asked.append(record.t0)
        return _held(*(by_clock if record.t0 == 200.0 else anew))

    held = begun_anew(assessed, train, test, [ladder])
    assert held.rmse_after.value == taken
    assert bool(held.warnings) == (taken == anew[0])
    assert asked == ([200.0] if by_clock[1] else [200.0, 0.0])
    assert begun_anew(assessed, train, test.replace(t0=0.0), [ladder]).warnings == ()
