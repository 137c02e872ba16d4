"""Two models compared sample by sample, and what a report says of the removable error."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from estimators.diagnosis import loop
from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.ladder.claims import Claim, Named
from estimators.diagnosis.ladder.figures import difference_figure, root_figure
from estimators.diagnosis.ladder.held_out import _borne, removed
from estimators.diagnosis.ladder.steps import Gain, Kind, Step, paired_gain
from estimators.diagnosis.ladder.verdicts import _assumed
from estimators.diagnosis.loop import diagnose
from estimators.diagnosis.model.fitting import Channel
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.policy import Policy, Setting
from estimators.diagnosis.record.paired import as_good, paired_difference
from estimators.diagnosis.result.report import ErrorFigure
from estimators.diagnosis.search.candidates import Menu, augmented
from estimators.residual.algebra import mean_error
from oed.data import Record
from tests.estimators.diagnosis.case_small import looking_for


def fits(seed: int, size: float):
    """A cubic at the input: the linear model, the cubic and an arctangent-like rival at the output."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(600)
    y = lfilter([0.0, 0.4], [1.0, -0.6], u + size * u**3) + 0.05 * rng.standard_normal(600)
    channel = Channel(u[:, None], y, Clock(np.arange(600.0), 600), np.ones(600, dtype=bool))
    linear = fit_linear(channel, Structure(1))
    right, wrong = (
        next(iter(augmented(channel, linear, Menu((named(k),))))) for k in ("input_cubic", "output_cubic")
    )
    return linear, right, wrong


def test_a_strong_effect_is_told_from_its_rival_and_a_weak_one_is_not():
    _, right, wrong = fits(41, 0.1)
    difference, error = paired_difference(right, wrong)
    assert difference > 5 * error > 0
    assert not as_good(right, wrong)
    assert not as_good(right, wrong, adequate=False)
    linear, right, wrong = fits(42, 0.002)
    assert abs(paired_difference(right, wrong)[0]) < 10
    assert as_good(right, wrong)
    assert as_good(right, linear)
    assert as_good(right, right)


def test_the_standard_error_is_that_of_repeated_differences():
    draws = [paired_difference(*fits(seed, 0.01)[1:]) for seed in range(43, 55)]
    spread = np.std([d for d, _ in draws], ddof=1)
    # the spread of 12 draws is good to a fifth, and an error to as much: a factor of two is three of these
    assert spread / 2 < np.mean([e for _, e in draws]) < 2 * spread


def test_a_transient_at_the_start_counts_in_the_interval():
    e = np.sqrt(np.concatenate(([600.0], np.ones(299))))[:, None]
    figure = root_figure(e, e)
    assert figure.value == pytest.approx(np.sqrt(899 / 300))
    assert figure.low < 1.0 < figure.value < figure.high


@pytest.mark.parametrize(
    "colour, samples", [(0.0, 100), (0.0, 400), (0.5, 400), (0.8, 200), (0.8, 400), (0.95, 1000)]
)
def test_intervals_of_errors_on_data_not_used_hold(colour, samples, record_figure):
    """500 times the same record, measured again: its noise has a memory, what a linear model lacks is slow. Blocks of 2 n^(1/3) drawn
    anew held the error after in .89 (white, 100), .85 (n = 200, colour .8) and .82 (1000, .95) of them."""

    def drawn(seed, pole):
        noise = np.random.default_rng(seed).standard_normal(samples + 300)
        return np.asarray(lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], noise))[300:, None]

    told = {"before": [], "after": [], "difference": [], "removed": []}
    lacks = drawn([samples], 0.9)
    most = float(np.sqrt(1 + np.mean(lacks**2)))
    for seed in range(500):
        after = drawn([seed, samples], colour)
        before = after + lacks
        floor = 1 + np.random.default_rng([seed, 1]).standard_normal() / np.sqrt(2 * samples), samples
        for name, figure, truth in (
            ("before", root_figure(before, after), most),
            ("after", root_figure(after, after), 1.0),
            ("difference", difference_figure(before, after), most - 1),
            ("removed", removed(before, after, floor, Policy()), 1.0),
        ):
            told[name].append(figure.low <= truth <= figure.high)
    shares = {name: float(np.mean(held)) for name, held in told.items()}
    record_figure("coverage of errors on data not used", shares, colour=colour, samples=samples, runs=500)
    low, high = binom.ppf(1e-3, 500, 0.93) / 500, binom.isf(1e-3, 500, 0.97) / 500
    assert low <= shares["after"] <= high, shares
    assert low <= min(shares.values()), shares


def test_an_error_of_equal_or_no_values_is_nothing():
    assert mean_error(np.ones(50)) == 0.0
    nothing, same = np.zeros((9, 2)), np.arange(18.0).reshape(9, 2)
    assert root_figure(nothing, nothing) == ErrorFigure(0.0, 0.0, 0.0)
    assert difference_figure(same, same) == ErrorFigure(0.0, 0.0, 0.0)


def test_the_removed_fraction_has_an_interval_and_never_rests_on_a_bound():
    rng = np.random.default_rng(61)
    records = []
    for n in (400, 300):
        u = rng.standard_normal((n, 1))
        y = lfilter([0.0, 0.4], [1.0, -0.6], np.clip(u[:, 0], -0.9, 0.9)) + 0.02 * rng.standard_normal(n)
        records.append(Record(u, y[:, None]))
    few = looking_for("saturation", "dead_zone", orders=(1,), structure="SISO", separate=True)
    found = diagnose(*records, few)
    low, high = found.removed_interval
    assert found.effect == "input_saturation"
    assert not found.floor_is_bound
    assert low <= found.removed <= high <= 1.0
    assert low > 0.9
    assert f"removed {100 * found.removed:.3g} % [" in str(found) == repr(found)
    bound = replace(found, floor_is_bound=True)
    assert bound.removed_interval[0] == pytest.approx(1 - found.rmse_after.value / found.rmse_before.value)
    assert "noise floor at most" in str(bound)
    assert "were there no noise" in str(bound)
    lucky = replace(found, room=ErrorFigure(1.3, 1.1, 1.5))
    assert lucky.removed == 1.0
    assert "below the estimated floor" in str(lucky)


@pytest.mark.parametrize(
    "shift, words", [(0.0, ""), (0.8, "; this record reaches one side of the limit only")]
)
def test_a_limit_that_is_reached_on_one_side_only_is_said_to_be_assumed_on_the_other(shift, words):
    rng = np.random.default_rng(71)
    u = (np.clip(rng.standard_normal(300), -1.6, 1.6) + shift)[:, None]
    channel = Channel(u, np.zeros(300), Clock(np.arange(300.0), 300), np.ones(300, dtype=bool))
    model = Structure(1).adding(Part(named("saturation")))
    f = SimpleNamespace(structure=model, p=np.array([-0.6, 0.4, 1.2]))
    out = SimpleNamespace(named=SimpleNamespace(fit=f), examined=SimpleNamespace(last=channel))
    assert _assumed(out, "saturation").startswith(words)
    assert bool(_assumed(out, "saturation")) == bool(words)
    assert _assumed(out, "input_cubic") == ""


def test_errors_that_surely_fall_bear_a_claim_beside_a_floor_too_near_to_tell_a_share(rng) -> None:
    """A diode behind a filter: .0649 -> .0523 beside a floor of at most .0636, and "no cause found that holds"."""
    noise = rng.standard_normal((4000, 1))
    before, after, floor = 0.066 * noise, 0.053 * noise, (0.0636, 100)
    assert removed(before, after, floor, Policy()).low < 0.0 < _borne(before, after, floor, Policy()).low
    assert _borne(before, before[::-1], floor, Policy()).low < 0.0
    far = removed(before, after, (0.01, 4000), Policy())
    assert _borne(before, after, (0.01, 4000), Policy()).value == far.value


@pytest.mark.parametrize(("better", "cause"), [(0.3, "output_nonlinearity"), (0.0, "sensor_lag")])
def test_a_test_record_tells_a_curve_from_the_dynamics_that_fit_as_well(better, cause, rng) -> None:
    """Both fit the training record; neither saw the test record."""
    y = rng.standard_normal((1000, 1))
    answer = lambda error: SimpleNamespace(simulate=lambda record, skip: y[:, 0] + error * noise)
    noise = rng.standard_normal(1000)
    step: Any = Step(Kind.NAMED, (), (), answer(1.0 - better), 1)  # type: ignore[arg-type]
    gain, part = Gain(0.1, 0.01, 0.1), Part(named("output_tanh"))
    linear = (named("order_one"), answer(1.0))
    n = Named(None, (Claim(part, gain, 0.0, ("sensor_lag", "pendulum")),), (), step, y, linear)  # type: ignore[arg-type]
    o: Any = Found(n.as_linear())
    assert o.named.claims[0].cause == "sensor_lag"
    held: Any = SimpleNamespace(answered=(step,))
    record = Record(y, y)
    found = loop._bent_after_all(o, record, record, held, Setting()).named.claims[0]
    assert found.cause == cause
    assert ("sensor_lag" in found.rivals) is False
    assert loop._bent_after_all(o, record, None, held, Setting()) is o


@dataclass(frozen=True)
class Found:
    """What the loop asks of an outcome here."""

    named: Named
    index: int = 0


def test_a_gain_of_one_stretch_or_of_small_ones_alone_is_not_sure(rng) -> None:
    """Half the error less everywhere is; a stretch with nearly all of the squares says nothing of the others, nor they of it."""
    policy, n = Policy(), 2000
    y, every = [np.zeros(n)], [np.ones(n, dtype=bool)]
    small = rng.standard_normal(n)
    large = np.where(np.arange(n) // 100 == 7, 30.0, 1.0) * small
    often = 0.5 * small
    once, elsewhere = (
        np.where(np.abs(large) > np.abs(small), 0.5, 1.1) * large,
        np.where(large == small, 0.5, 1.02) * large,
    )
    sure = lambda before, after: paired_gain(y, [before], [after], every, policy).surely((2.0, 0.05))
    assert sure(small, often)
    assert not sure(large, once)
    assert not sure(large, elsewhere)
    assert not sure(small, 0.97 * small)  # a share too small
