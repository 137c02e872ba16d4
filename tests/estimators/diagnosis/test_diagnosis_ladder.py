"""The ladder chooses by unused blocks only: the simplest within a standard error, never worse than the linear model."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from estimators.diagnosis.baseline.blocks import Block, Blocks
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.ladder import Kind, Step, climb, paired_gain
from estimators.diagnosis.ladder.asked import begun, outside
from estimators.diagnosis.ladder.figures import difference_figure, together
from estimators.diagnosis.ladder.held_out import _borne_after_all, _by_chance, continues, onward
from estimators.diagnosis.ladder.outcome import Outcome
from estimators.diagnosis.ladder.steps import Ladder, beyond_chance, common_samples, over_linear, refused
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.result.answers import LinearAnswer
from oed.data import Record

N = 2000
SILENT = LinearAnswer(0, (0,), LinearModel(np.ones(1), np.zeros((1, 1))), Prior(0.0, np.ones(1), 1.0))
POLICY = Policy()
COUNTED = (np.ones(N, dtype=bool),)


def _step(kind: Kind, unused: np.ndarray, **more) -> Step:
    return Step(kind, (), (unused,), SILENT, **more)


def _case(seed: int, *sizes: float) -> tuple[list[np.ndarray], list[Step]]:
    """Measured noise, and one step per kind whose prediction is off by a signal of the given size."""
    rng = np.random.default_rng(seed)
    y = rng.standard_normal(N)
    steps = [
        _step(kind, size * rng.standard_normal(N)) for kind, size in zip(list(Kind), sizes, strict=False)
    ]
    return [y], steps


def test_a_better_step_is_climbed_and_a_worse_one_is_not() -> None:
    y, steps = _case(1, 1.0, 0.3)
    assert climb(y, steps, COUNTED, POLICY).chosen.kind is Kind.NAMED
    y, steps = _case(1, 0.3, 1.0)
    ladder = climb(y, steps, COUNTED, POLICY)
    assert ladder.chosen is ladder.linear


def test_within_its_error_the_simpler_step_is_the_answer() -> None:
    y, steps = _case(2, 1.0, 0.3, 0.3)
    assert climb(y, steps, COUNTED, POLICY).chosen.kind is Kind.NAMED


def test_a_pole_slower_than_a_block_must_gain_what_no_drift_gives() -> None:
    """Errors of 1.17 and 1 beside the linear model's 1.56: charged 1.4 times, the first is more and the second is not."""
    for size, slow, kind in ((0.6, False, Kind.NAMED), (0.6, True, Kind.LINEAR), (0.0, True, Kind.NAMED)):
        y, steps = _case(1, 1.2, size)
        steps[1] = replace(steps[1], slow=slow)
        assert climb(y, steps, COUNTED, POLICY).chosen.kind is kind


def test_what_was_searched_for_on_the_same_blocks_must_gain_more() -> None:
    """A perfect discovered step gains 4 % on a named one that is off by .3 of the noise, and 11 % on one off by .5."""
    for size, kind in ((0.3, Kind.NAMED), (0.5, Kind.DISCOVERED)):
        y, steps = _case(2, 1.0, size)
        better = _step(Kind.DISCOVERED, 0.0 * y[0])
        assert climb(y, [*steps, better], COUNTED, POLICY).chosen.kind is kind
        assert climb(y, [*steps, better], COUNTED, replace(POLICY, searched=POLICY.claimed)).chosen is better


def test_a_regression_of_all_that_is_missing_need_not_stand_on_one_piece_of_it() -> None:
    """A river under snow: 1.93 mm/d for a named piece, where a regression of the linear model's residual had 1.18."""
    y, steps = _case(4, 1.6, 1.4)
    ladder = climb(y, steps, COUNTED, POLICY)
    assert ladder.chosen.kind is Kind.NAMED
    assert 0.0 < ladder.explained < 0.5
    rng, asked = np.random.default_rng(5), []

    def found(most: float, size: float) -> Ladder:
        def make(bare):
            asked.append(bare.chosen)
            return _step(Kind.REMAINDER, size * rng.standard_normal(N)) if size < 9.0 else None

        return over_linear(ladder, most, make, y, POLICY)

    assert found(ladder.explained, 0.0) is ladder
    assert not asked  # nothing more to explain: none is fitted
    assert found(0.9, 9.0) is ladder
    standing_by = found(0.9, 0.9)  # not a third less than the answer
    assert standing_by.chosen is ladder.chosen
    assert [r.step.kind for r in standing_by.rungs[len(ladder.rungs) :]] == [Kind.REMAINDER]
    better = found(0.9, 0.1)
    assert better.chosen.kind is Kind.REMAINDER
    again = climb(y, [*steps, better.chosen], COUNTED, POLICY)
    assert again.chosen is better.chosen
    assert [r.figure for r in again.rungs] == [r.figure for r in better.rungs]
    assert all(step is ladder.linear for step in asked)


@pytest.mark.parametrize(("rest", "exact"), [(0.0, True), (1e-150, False)])
def test_of_an_error_of_rounding_alone_every_share_is_a_number(rest: float, exact: bool) -> None:
    """A static gain fitted without noise: its error is nothing at all on one processor and 1e-16 on another, and the square of
    a ratio to it left the range of doubles."""
    _, steps = _case(1, 1.0, 1.0)
    y = [np.full(N, rest)]
    steps = [replace(steps[0], unused=(0.0 * y[0],)), replace(steps[1], unused=(y[0] + 1e10,))]
    ladder = climb(y, steps, COUNTED, POLICY)
    assert ladder.chosen is ladder.linear
    assert ladder.explained == 0.0
    assert ladder.exact is exact  # an error as large as the record is no rounding, however small both are
    assert ladder.left(1e10) >= 1.0
    assert exact == (over_linear(ladder, 0.9, lambda bare: steps[1], y, POLICY) is ladder)
    other = replace(ladder, answer=1)
    assert over_linear(other, 0.9, lambda bare: None, y, POLICY) is other


def test_the_gain_of_nothing_passes_one_standard_error_in_about_a_sixth() -> None:
    """Two equally wrong models: one-sided normal rate .16; 400 pairs, 3.5 standard deviations of the count."""
    passed = 0
    for seed in range(400):
        y, steps = _case(seed, 0.5, 0.5)
        passed += paired_gain(y, steps[0].unused, steps[1].unused, COUNTED, POLICY).beyond(1.0)
    assert abs(passed / 400 - 0.159) < 3.5 * np.sqrt(0.159 * 0.841 / 400)


def test_what_is_refused_or_not_finite_is_never_the_answer() -> None:
    y, steps = _case(3, 1.0)
    best = y[0].copy()
    refused = _step(Kind.REMAINDER, best, admitted=False)
    broken = _step(Kind.NAMED, np.where(np.arange(N) == 7, np.inf, best))
    ladder = climb(y, [*steps, refused, broken], COUNTED, POLICY)
    assert ladder.chosen is ladder.linear
    assert not np.isfinite(ladder.rungs[1].value)


def test_a_finite_prediction_gains_all_over_one_that_is_not() -> None:
    y, steps = _case(4, 1.0)
    broken = [np.full(N, np.inf)]
    assert paired_gain(y, broken, steps[0].unused, COUNTED, POLICY).beyond(1.0)
    assert not paired_gain(y, steps[0].unused, broken, COUNTED, POLICY).beyond(0.0)


def test_named_effects_lend_their_names_only_to_an_answer_that_they_nearly_are() -> None:
    """Nine tenths of a large error go with a curve that is nearly right: what it leaves must be near the answer's too."""
    same, other = (
        SimpleNamespace(
            nature=x,
            weight=1.0,
            output=0,
            same_as="",
            part=SimpleNamespace(effect=SimpleNamespace(nature=x, cause=x)),
        )
        for x in "ab"
    )
    for named, claim, lent in (
        (0.34, other, True),
        (0.5, other, False),
        (0.5, same, True),
        (1.2, same, False),
    ):
        y, steps = _case(3, 3.0, 1.0, 1.0)
        y, noise = [0.0 * y[0]], y[0]
        steps[1:] = [replace(steps[1], unused=(named * noise,)), replace(steps[2], unused=(0.3 * noise,))]
        ladder = climb(y, steps, COUNTED, POLICY)
        assert ladder.chosen.kind is Kind.DISCOVERED or named == 0.34
        ladder = replace(ladder, answer=2)
        found, terms = SimpleNamespace(claims=[claim]), SimpleNamespace(terms=[same])
        o = Outcome(0, None, found, ladder, None, None, terms)  # pyright: ignore[reportArgumentType]
        assert o.named_carries(POLICY) is lent
        assert o.agrees("a", "anything") is (terms.terms[0].nature == "a")
        # two effects are no simpler a cause than one term: a loss was heat and a gain that swings
        found.claims.append(other)
        assert not o.named_carries(POLICY)
    drag = SimpleNamespace(nature="dynamic nonlinearity", weight=1.0, output=0, same_as="nonlinear_drag")
    o = Outcome(0, None, None, None, None, None, SimpleNamespace(terms=[drag]))  # pyright: ignore[reportArgumentType]
    assert o.agrees("dynamic nonlinearity", "nonlinear_drag")
    assert not o.agrees(
        "dynamic nonlinearity", "slow_hidden_state"
    )  # most causes are dynamic: that says little
    drag.same_as = "pendulum"  # a cosine over a part of a turn
    assert o.agrees("dynamic nonlinearity", "duffing")


def test_what_only_the_test_record_bears_must_be_told_and_no_better_start(rng) -> None:
    """Linear records: a better start was a drag of three terms, and a gas furnace a store of -.06 +- .83."""
    y, steps = _case(3, 1.0, 0.5)
    ladder = replace(climb(y, steps, COUNTED, POLICY), answer=0)
    off, better = 2.0 * rng.standard_normal((N, 1)), rng.standard_normal((N, 1))
    begun = np.concatenate((better[: N // 4], off[N // 4 :]))
    for kind, value, run, borne in (
        (Kind.NAMED, 1.0, better, 1),
        (Kind.NAMED, 1.0, begun, 0),
        (Kind.DISCOVERED, 1.0, better, 0),
        (Kind.DISCOVERED, 3.0, better, 1),
    ):
        step = replace(
            ladder.rungs[1].step, kind=kind, parameters={"coefficient of term 1": (value, 1.0, "")}
        )
        rungs = (ladder.rungs[0], replace(ladder.rungs[1], step=step))
        ladder = replace(ladder, rungs=rungs)
        assert _borne_after_all(ladder, 0, [off, run], [True, True], False, POLICY) == borne
        echo = replace(ladder, rungs=(rungs[0], replace(rungs[1], step=replace(step, echo=True))))
        for loop in (False, True):  # the noise of a test record from the loop is heard there too
            found = _borne_after_all(echo, 0, [off, run], [True, True], loop, POLICY)
            assert found == borne * (not loop)


def test_a_test_record_bears_no_claim_by_errors_that_all_last_as_long(rng) -> None:
    """Of a linear plant whose level there is another, a term was borne out by 600 samples of one slow error: .64 fell to .17."""
    settling, white = 3.0 * np.exp(-2.0 * np.arange(N) / N), rng.standard_normal((2, N))
    assert difference_figure(settling[:, None], 0.3 * settling[:, None]).low > 0.0
    assert _by_chance(settling + 0.05 * white[0], 0.3 * settling + 0.05 * white[1])
    assert not _by_chance(2.0 * white[0], white[1])


def test_what_runs_by_the_clock_gives_way_to_terms_that_do_as_well_without_it() -> None:
    y, steps = _case(3, 1.0, 0.5, 0.49)
    for nature, kind in (("time variation", Kind.DISCOVERED), ("dynamic nonlinearity", Kind.NAMED)):
        chosen = climb(y, [steps[0], replace(steps[1], nature=nature), steps[2]], COUNTED, POLICY).chosen
        assert chosen.kind is kind


def test_scattered_folds_are_all_samples_once_and_leave_their_neighbourhood_out() -> None:
    blocks = Blocks((500,), 20, 40, tuple(Block(0, a, a + 100) for a in range(0, 500, 100)))
    folds = blocks.scattered(5)
    rows = np.concatenate([np.arange(b.start, b.stop) for fold, _ in folds for b in fold])
    assert len(folds) == 5
    assert sorted(rows) == list(range(500))
    for fold, (use,) in folds:
        assert use.sum() > 200  # every stretch of 100 has samples of every fold
        assert not any(use[max(0, b.start - 5) : b.stop + 5].any() for b in fold)


def test_the_best_of_hundreds_gains_less_by_luck_than_what_needs_no_second_search() -> None:
    """Four of 300 tones, each the best for what the others leave and fitted to the same noise, twenty records."""
    errors, most = POLICY.unchecked
    for seed in range(20):
        rest = np.random.default_rng(seed).standard_normal(400)
        noise, waves = rest, np.cos(np.outer(np.arange(400), np.linspace(0.01, 3.0, 300)))
        for _ in range(4):
            scores = (waves.T @ rest) ** 2 / np.sum(waves**2, axis=0)
            x = waves[:, int(np.argmax(scores))]
            rest = rest - x * (x @ rest) / (x @ x)
        use = [np.ones(400, dtype=bool)]
        gain = paired_gain([noise], [0.0 * noise], [noise - rest], use, POLICY)
        assert 0.0 < gain.share < 0.5 * most
        half = paired_gain([noise], [0.0 * noise], [0.6 * noise], use, POLICY)
        assert half.share > most
        assert half.beyond(errors)


def test_without_one_kind_of_step_what_was_refused_stays_refused() -> None:
    y, steps = _case(5, 1.0, 0.3, 0.3)
    steps[1] = replace(steps[1], admitted=False)
    rest = refused(steps, Kind.DISCOVERED)
    assert [s.admitted for s in rest] == [True, False, False]
    assert climb(y, rest, COUNTED, POLICY).answer == 0


def test_an_input_between_the_levels_of_the_training_record_is_said() -> None:
    """Nine levels were trained on; of the second input all values."""
    rng = np.random.default_rng(3)
    u = rng.uniform(-1.0, 1.0, (N, 2))
    few = np.stack((np.round(4.0 * u[:, 0]) / 4.0, u[:, 1]), axis=1)
    said = [" ".join(outside([Record(few, u, 1.0)], Record(v, u, 1.0), POLICY)) for v in (u, few)]
    assert "19.9 % of the test record's samples lie between levels of the input 1 " in said[0]
    assert "more than 0.1 from the nearest" in said[0]
    assert "input 2" not in said[0]
    assert "between levels" not in said[1]


def test_a_test_record_that_does_not_begin_at_rest_is_said() -> None:
    """A run from rest misses its opening, and the error of a good model was that of a dozen samples."""
    rng = np.random.default_rng(3)
    y = 0.1 * rng.standard_normal(500)
    swing = y + 3.0 * 0.8 ** np.arange(500)
    said, quiet = (begun(Record(y, v, 1.0), np.zeros((500, 1)), 0) for v in (swing, y))
    assert "first 50 samples" in said[0]
    assert "skip=50" in said[0]
    assert quiet == []
    assert begun(Record(y, swing, 1.0), np.zeros((500, 1)), 20) == []


def test_a_record_that_goes_on_starts_from_where_the_other_ended():
    """A room that keeps its heat for 300 samples: by its inputs alone the second part begins as far off as they have moved it."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(0.0, 1.0, 20), 60)
    e = lfilter([1.0], [1.0, -0.5], 0.05 * rng.standard_normal(1200))
    whole = Record(u, lfilter([0.0, 1.0], [1.0, -np.exp(-1.0 / 300)], u) + e, dt=10.0, t0=70.0)
    train, test = whole[:800], whole[800:]
    den, num = np.array([1.0, -np.exp(-1.0 / 300)]), np.array([[0.0, 1.0]])
    power = 50.0**2 * np.exp(-np.arange(64) / 300)
    answer = LinearAnswer(0, (0,), LinearModel(den, num), Prior(float(np.mean(train.y)), power, 0.05**2))
    off = lambda r, skip: np.abs(r.y[:, 0] - onward(train, r, skip)(answer))
    assert continues(train, test)
    for skip in (0, 20):
        assert np.max(off(test, skip)) < 1.0
    later = test.replace(t0=test.t0 + 10 * test.dt)  # another day
    assert not continues(train, later)
    assert np.max(off(later, 0)) > 10.0
    assert not continues(train, test.replace(t0=0.0))


def test_only_what_answers_an_input_at_once_can_be_a_controllers_inverse() -> None:
    """A dead zone about most of a record hides it at some samples, and not at all."""
    u = np.random.default_rng(4).normal(size=(300, 2))
    inside = lambda v: np.sign(v) * np.maximum(np.abs(v) - 1.5, 0.0)
    late = lambda x: np.concatenate(([0.0], x[:-1]))
    runs = {
        True: (lambda r: r.u[:, 0], lambda r: late(r.u[:, 0]) + inside(r.u[:, 1])),
        False: (lambda r: late(r.u[:, 0]), lambda r: np.full(len(r), 2.0)),
    }
    for at_once, models in runs.items():
        for run in models:
            step = replace(
                _step(Kind.NAMED, np.zeros(300)),
                answer=SimpleNamespace(simulate=lambda r, _, run=run: run(r)),
            )
            assert step.at_once(Record(u, np.zeros(300)), 20) is at_once


@pytest.mark.parametrize(
    "colour, samples", [(0.0, 100), (0.0, 400), (0.5, 400), (0.8, 200), (0.8, 400), (0.95, 1000)]
)
def test_intervals_on_unused_blocks_hold(colour: float, samples: int, record_figure) -> None:
    """500 times the same record, measured again. The spread of twenty stretches held the answer's error in .87 (200 samples, colour .8)
    and .89 (1000, .95), the linear model's in .99 (400, white)."""

    def drawn(seed: list[int], pole: float) -> np.ndarray:
        noise = np.random.default_rng(seed).standard_normal(samples + 300)
        return np.asarray(lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], noise))[300:]

    lacks, nothing, held = drawn([samples], 0.9), np.zeros(samples), np.zeros(2)
    truths = np.sqrt(1 + np.mean(lacks**2)), 1.0
    for seed in range(500):
        noise = drawn([seed, samples], colour)
        steps = [_step(Kind.LINEAR, -noise - lacks), _step(Kind.NAMED, -noise)]
        ladder = climb([nothing], steps, [np.ones(samples, dtype=bool)], POLICY)
        held += [
            r.figure.low <= truth <= r.figure.high for r, truth in zip(ladder.rungs, truths, strict=True)
        ]
    record_figure(
        "coverage of errors on unused blocks", list(held / 500), colour=colour, samples=samples, runs=500
    )
    assert binom.ppf(1e-3, 500, 0.93) <= held.min(), held
    assert held.max() <= binom.isf(1e-3, 500, 0.97), held


def test_errors_of_several_outputs_come_together_where_each_counts() -> None:
    rng = np.random.default_rng(5)
    e = rng.standard_normal((2, 3000)) * [[1.0], [2.0]]
    both, alone = together(list(e), list(e)), together([e[0]], [e[0]])
    assert both.value == pytest.approx(np.sqrt(np.mean(e**2)))
    e[1] = np.nan
    assert together(list(e), list(e)) == alone
    # of two equal outputs nothing more is known than of one; of two that know nothing of one another more is
    assert together([e[0]] * 2, [e[0]] * 2).high == pytest.approx(alone.high)
    two = [e[0], rng.standard_normal(3000)]
    other = together(two, two)
    assert np.log(other.high / other.value) < 0.8 * np.log(alone.high / alone.value)
    endless = np.where(np.arange(3000) == 7, np.inf, e[0])
    assert together([endless], [e[0]]).low == np.inf
    assert together([e[0]], [endless]) == alone


def test_slow_signals_go_together_by_chance_and_quick_ones_do_not() -> None:
    """The best of a hundred random walks takes half of another one's power and more; true changes of that share are told apart."""
    rng, n = np.random.default_rng(12), 700
    counted, nothing, taken = (np.ones(n, dtype=bool),), [np.zeros(n)], []
    for _ in range(40):
        noise, *others = np.cumsum(rng.standard_normal((101, n)), axis=1)
        noise, others = noise - noise.mean(), np.array(others) - np.mean(others, axis=1, keepdims=True)
        runs = others * (others @ noise / np.sum(others**2, axis=1))[:, None]
        best = min(runs, key=lambda run: float(np.sum((noise - run) ** 2)))
        taken.append(1.0 - np.sum((noise - best) ** 2) / np.sum(noise**2))
        assert not beyond_chance([noise], nothing, [best], counted)
    assert np.median(taken) > 0.5
    true = lfilter([1.0], [1.0, -0.8], rng.standard_normal(n))
    seen = true + np.std(true) * rng.standard_normal(n)
    assert beyond_chance([seen], nothing, [true], counted)
    assert not beyond_chance([seen], nothing, [true * np.inf], counted)


def test_independent_samples_are_bartletts() -> None:
    """The spread of the correlation of two autoregressions that know nothing of one another, pole .9: 1000 samples are 105."""
    rng, n = np.random.default_rng(13), 1000
    pairs = lfilter([1.0], [1.0, -0.9], rng.standard_normal((400, 2, n + 200)), axis=2)[:, :, 200:]
    r = [float(a @ b / np.sqrt(a @ a * (b @ b))) for a, b in pairs]
    told = float(np.median([common_samples(a, b) for a, b in pairs]))
    assert told == pytest.approx(1.0 / np.var(r), rel=0.2)
    assert told == pytest.approx(n * (1 - 0.81) / (1 + 0.81), rel=0.15)
