"""Names say no more than a fit shows: curves, losses, folds that a record hardly reaches."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline.choice import SLOW
from estimators.diagnosis.discovery.dictionary import Kind as Curve
from estimators.diagnosis.discovery.form import Factor, Term
from estimators.diagnosis.discovery.model import DiscoveredModel
from estimators.diagnosis.discovery.wording import lagged, named_by_shape
from estimators.diagnosis.effects import Nature, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.effects.plant import SWINGS
from estimators.diagnosis.ladder import Kind, Ladder
from estimators.diagnosis.ladder.claims import Named
from estimators.diagnosis.ladder.held_out import _order
from estimators.diagnosis.ladder.outcome import FAILED, SOME, UNSURE, Outcome
from estimators.diagnosis.ladder.verdicts import Finding, _supported
from estimators.diagnosis.model.fitting import Channel, fit
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.result.report import ErrorFigure
from estimators.diagnosis.search import naming
from estimators.diagnosis.search.examination import Known, _forgetting
from estimators.diagnosis.search.few import _loose
from estimators.diagnosis.search.naming import CONTENT, FOLDED, LATE, as_shown
from estimators.diagnosis.share import Evidence

CHANNEL: Any = None


def _shown(
    key: str,
    p: list[float],
    first: int = 0,
    plant: tuple = (Structure(1), [-0.5, 1.0]),
    channel: Channel = CHANNEL,
    left: float = 0.0,
):
    """The effect that is claimed where one was fitted, by default beside a pole at 0.5."""
    part = Part(named(key), 0, first=first)
    residual = left * np.ones(0 if channel is CHANNEL else len(channel.y))
    fit: Any = SimpleNamespace(
        structure=plant[0].adding(part), p=np.array([*plant[1], *p]), residual=residual
    )
    return as_shown(part, fit, channel).effect


def test_a_process_without_memory_and_a_curve_behind_the_plant_are_named_as_what_they_are(
    monkeypatch,
) -> None:
    monkeypatch.setattr(naming, "_bends", lambda part, f, channel: False)
    for error, key in ((0.05, "loss"), (0.06, "order")):  # of a loss that is told from none, or a lag
        rows = {"loss.rate": (0.5, 0.01, ""), "loss.k2": (0.1, error, ""), "loss.k3": (0.1, 0.2, "")}
        monkeypatch.setattr(naming, "parameters_of", lambda f, channel, rows=rows: rows)
        assert _shown("loss", [0.5, 0.1, 0.1]).key == key
    level: Any = SimpleNamespace(u=np.linspace(0.0, 1.0, 99)[:, None], y=(), clock=None)
    assert _shown("loss", [4.5, 0.1, 0.1], channel=level).key == "input_polynomial"
    assert _shown("input_power", [0.4]).key == "input_power"
    assert _shown("input_power", [-0.2, 0.4], first=1).key == "input_power"
    assert _shown("input_power", [-0.9, 0.4], first=1).key == "sandwich"


def test_a_spring_where_nothing_can_swing_is_a_loss() -> None:
    for damping, cause in ((0.3, "duffing"), (1.98 * SWINGS, "duffing"), (2.02 * SWINGS, "nonlinear_loss")):
        plant = Structure(2, layout="oscillator"), np.log([1.0, damping]).tolist()
        effect = _shown("stiffness_cubic", [0.1], plant=plant)
        assert (effect.key, effect.cause) == ("stiffness_cubic", cause)


def test_a_fold_that_is_hardly_reached_is_a_curve() -> None:
    n = 2000
    u = np.linspace(0.0, 1.0, n)
    channel = Channel(u[:, None], u, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    plant = Structure(1), [0.0, 1.0]
    for share, cause in ((0.8 * FOLDED, "output_nonlinearity"), (1.2 * FOLDED, "magnitude_sensor")):
        assert _shown("squared", [-share], plant=plant, channel=channel).cause == cause
        assert _shown("squared", [share - 1.0], plant=plant, channel=channel).cause == cause
    # a river's flow, low for a third of the time: what is folded there is less than the model's error
    for left, cause in ((0.07, "magnitude_sensor"), (0.09, "output_nonlinearity")):
        assert _shown("squared", [-0.3], plant=plant, channel=channel, left=left).cause == cause
        assert (
            _shown("rectified", [-0.3], plant=plant, channel=channel, left=left).cause == "magnitude_sensor"
        )


def test_a_flow_that_hardly_fills_or_passes_no_pipe_is_a_product() -> None:
    n = 1000
    u = np.full((n, 2), 2.0)
    channel = Channel(u, u[:, 0], Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    for share, cause in ((0.8, "bilinear"), (1.2, "other")):
        fill = share * CONTENT / (2.0 * n)
        found = (
            _shown("capacity_filled", [0.1, fill, 1.0, 1.0, 2.0], channel=channel),
            _shown("through_flow", [0.1, 2.0 * share * LATE], channel=channel),
        )
        assert [e.cause == "bilinear" for e in found] == [cause == "bilinear"] * 2


@pytest.mark.parametrize(("share", "key"), [(0.0, "order"), (0.5, "recycle")])
def test_what_comes_back_with_no_share_told_from_nothing_is_more_dynamics(share, key, rng) -> None:
    """The hair dryer had "delayed feedback" with a share of -1.0 +- 1.7."""
    n = 600
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 6), 6)
    s = Structure(1).adding(Part(named("recycle")))
    p, scales = np.array([-0.8, 0.2, share, 6.0, 2.0, 9.0]), np.array([1.0, 1.0, 1.0, 6.0, 2.0, 1.0])
    channel = Channel(u[:, None], u, Clock(np.arange(float(n)), n), np.ones(n, dtype=bool))
    y = simulate(s, p, channel.u, channel.clock) + 0.02 * rng.standard_normal(n)
    f = fit(replace(channel, y=y), s, p + [0.0, 0.0, 0.02, 0.0, 0.0, 0.0], scales)
    assert as_shown(f.structure.parts[-1], f, replace(channel, y=y)).effect.key == key


def test_the_gain_that_all_inputs_lose_is_found_though_a_slow_pole_had_taken_its_place(rng) -> None:
    """Two inputs about levels of their own: as the gain decays so does the level, which a pole that nothing drives follows too."""
    n, rate = 900, 0.5
    u = 45.0 + 10.0 * np.column_stack([np.repeat(rng.choice([-1.0, 1.0], n // 15), 15) for _ in range(2)])
    x = lfilter([0.0, 0.02], [1.0, -1.6, 0.63], 0.3 * u[:, 0] + 0.1 * u[:, 1])
    y = 3.0 + np.asarray(x) * np.exp(-rate * np.arange(n) / n) + 0.05 * rng.standard_normal(n)
    channel = Channel(u[60:], y[60:], Clock(np.arange(n - 60.0), n - 60), np.ones(n - 60, dtype=bool))
    s = replace(Structure(2, (0, 1)).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2)
    base = fit_linear(channel, s)
    search: Any = named("gain_decay").search
    found = min(search(channel, base, ()), key=lambda f: f.criterion)
    drift = fit(
        channel, s.adding(Part(named("gain_drift"))), np.append(base.p, 0.0), np.append(base.scales, 1.0)
    )
    rms = lambda f: float(np.sqrt(np.mean(f.residual**2)))
    assert rms(base) > 2.0 * 0.05
    assert rms(drift) > 1.3 * 0.05
    assert rms(found) < 1.15 * 0.05
    np.testing.assert_allclose(found.p[-1], rate * (n - 60) / n, rtol=0.03)


def test_a_delay_that_follows_a_logged_speed_is_found_where_the_linear_model_has_its_mean(rng) -> None:
    n, way = 800, 40.0
    u = np.column_stack(
        [np.repeat(rng.standard_normal(n // 8), 8), np.repeat(rng.uniform(3.0, 9.0, n // 40), 40)]
    )
    x = np.asarray(lfilter([0.0, 0.3], [1.0, -0.7], u[:, 0] + 0.05 * u[:, 1]))
    through = np.cumsum(u[:, 1])
    y = np.interp(
        np.interp(through - way, through, np.arange(n)), np.arange(n), x
    ) + 0.02 * rng.standard_normal(n)
    channel = Channel(u[40:], y[40:], Clock(np.arange(n - 40.0), n - 40), np.ones(n - 40, dtype=bool))
    s = replace(Structure(1, (0, 1), delay=6).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2)
    base = fit_linear(channel, s)
    search: Any = named("conveyed").search
    found = min(search(channel, base, ()), key=lambda f: f.criterion)
    assert float(np.std(base.residual)) > 5.0 * 0.02
    assert float(np.std(found.residual[20:])) < 1.2 * 0.02
    np.testing.assert_allclose(found.p[-2:], [way, 2.0], rtol=0.02)
    still = replace(channel, u=channel.u - [0.0, 4.0])  # what turns drives no belt
    assert not list(search(still, base, ()))


def test_terms_that_make_up_one_curve_of_the_rate_are_named_by_its_shape(rng) -> None:
    v = np.linspace(-5.0, 5.0, 41)
    bent = {
        "coulomb_friction": -2.0 * np.sign(v) * np.sqrt(np.abs(v))
        + 3.0 * np.tanh(v / 8.0),  # flat beyond a jump
        "nonlinear_drag": -1.5 * v * np.abs(v) + 0.03 * v**3,
        "asymmetric_rise_and_fall": -0.5 * np.abs(v) + 0.2 * np.maximum(v - 0.3, 0.0),
    }
    for name, force in bent.items():
        assert named_by_shape(v, force + 7.0 * v + 0.02 * rng.standard_normal(len(v))) == name


def test_a_state_that_inputs_alone_drive_is_a_curve_of_the_input() -> None:
    """A propeller that follows its voltage with a lag had been "a slow hidden state"."""
    state = Term((Factor(Curve.LINEAR, "s0", 1.0),), "force")
    drives = lambda *signals: [Term(tuple(Factor(Curve.SQUARE, s, 0.0) for s in signals), "slow", rate=0.1)]
    assert lagged(state, drives("u0")) is not None
    assert lagged(state, drives("u0", "u1")) is not None
    assert lagged(state, drives("y0")) is None
    assert lagged(Term((*state.factors, Factor(Curve.LINEAR, "u0", 0.0)), "force"), drives("u0")) is None
    assert lagged(Term((Factor(Curve.LINEAR, "y0", 0.0),), "force"), drives("u0")) is None


def test_a_curve_that_opens_as_the_input_grows_is_no_saturation() -> None:
    grid = np.linspace(-3.0, 3.0, 61)
    term: Any = SimpleNamespace(factors=[SimpleNamespace(signal="u0")])
    model: Any = SimpleNamespace(_drivers=(0,))
    term.chain = 0
    for sign, closes in ((1.0, True), (-0.9, False)):
        curve: Any = SimpleNamespace(grid=grid, value=sign * np.tanh(grid))
        assert DiscoveredModel._saturates(model, term, curve) is closes


def test_the_nature_that_the_residual_shows_leads_where_the_terms_have_it() -> None:
    terms = [
        SimpleNamespace(output=0, nature=n, weight=w)
        for n, w in (("a", 8.0), ("b", 2.0), ("c", 0.9 * SOME * 10.0))
    ]
    o: Any = SimpleNamespace(discovery=SimpleNamespace(terms=terms), index=0)
    assert [Outcome.weighs(o, n) for n in "abc"] == [True, True, False]


@pytest.mark.parametrize(
    ("own", "best", "left", "feedback", "more", "told"),
    [
        (0.33, 0.966, 0.02, False, False, True),  # a dead zone and a mode for a meter that rectifies
        (0.93, 0.966, 0.02, False, False, False),  # its own nature explains as much
        (0.33, 0.80, 0.02, False, False, False),  # the named model explains far more than any regression
        (0.33, 0.966, 0.02, True, False, False),  # in a loop the shares are those of one-step predictions
        (0.33, 0.993, 0.006, False, True, True),
        (
            0.33,
            0.993,
            0.006,
            False,
            False,
            False,
        ),  # a thermistor: a thirteenth of the error is left, and it is noise
        (
            0.33,
            0.92,
            0.041,
            False,
            False,
            False,
        ),  # a rotor on a balance: a fifth is left, less than others leave
        (0.33, 0.92, 0.041, False, True, True),
        (0.33, 0.92, 0.065, False, False, True),
    ],
)
def test_a_name_is_not_given_where_causes_of_another_place_explain_as_much(
    own, best, left, feedback, more, told
) -> None:
    natures = [
        Evidence("a", best, best - 0.02, best + 0.02, ""),
        Evidence("b", own, own - 0.1, own + 0.1, ""),
    ]
    share: Any = SimpleNamespace(feedback=feedback, natures=natures, nature="a", explainable=True)
    rungs = [
        SimpleNamespace(step=SimpleNamespace(kind=k), value=v)
        for k, v in ((Kind.LINEAR, 1.0), (Kind.NAMED, left**0.5))
    ]
    none: Any = None
    rest: Any = SimpleNamespace(explainable=more)
    o = Outcome(0, none, none, SimpleNamespace(rungs=rungs), share, rest, none)  # type: ignore[arg-type]
    assert o.gainsaid("b") is told
    assert o.behind("b") is (own < 0.9 and not feedback)  # whatever the named model explains
    assert not o.gainsaid("a")
    assert not o.gainsaid("c")  # of a nature that no regression looks for it says nothing
    nothing: Any = SimpleNamespace(feedback=feedback, natures=[], nature="", explainable=False)
    assert not replace(o, share=nothing).gainsaid("b")


def test_what_the_joint_fit_does_not_tell_from_nothing_is_not_claimed_beside_what_it_does():
    """An aerodynamic pendulum: "bilinear", beta = .035 +- .098, had stood before the propeller's curve."""

    def outcome(beta: float, sure: bool) -> Outcome:
        rows = {
            "bilinear.beta": (beta, 0.098, "1/u"),
            "input_quadratic.c2": (0.3, 0.02, "1/u"),
            "bilinear_2.x": (9.0, 1.0, ""),
        }
        steps = [SimpleNamespace(step=SimpleNamespace(kind=Kind.NAMED, parameters=rows))]
        claims = [SimpleNamespace(key="bilinear"), SimpleNamespace(key="input_quadratic")]
        terms = [SimpleNamespace(output=0, same_as="bilinear", sure=sure)]
        none: Any = None
        parts: list[Any] = [
            SimpleNamespace(claims=claims),
            SimpleNamespace(rungs=steps),
            SimpleNamespace(terms=terms),
        ]
        return Outcome(0, none, parts[0], parts[1], none, none, parts[2])

    assert [c.key for c in outcome(0.035, False).claims] == ["input_quadratic"]
    assert [c.key for c in outcome(0.35, False).claims] == ["bilinear", "input_quadratic"]
    assert outcome(0.035, False).unsure("bilinear", "bilinear")
    assert not outcome(0.035, True).unsure("bilinear", "bilinear")
    assert not outcome(0.35, False).unsure("bilinear", "bilinear")


@pytest.mark.parametrize("told", [True, False])
def test_a_weak_claim_stands_first_where_its_nature_gainsays_the_others(told) -> None:
    fit = lambda left: SimpleNamespace(residual=np.array([left]))
    o: Any = SimpleNamespace(
        examined=SimpleNamespace(attribution=SimpleNamespace(base=fit(1.0), alternatives=())),
        named=SimpleNamespace(fit=fit(0.25)), share=SimpleNamespace(explainable=True, nature="a"), kept=0.25,
        gainsaid=lambda nature: told and nature == "b",
    )  # fmt: skip
    claims = [
        Finding(key, key, nature, weight, 0.0, "")
        for key, nature, weight in (("strong", "b", 0.43), ("weak", "a", 0.003))
    ]
    found = _supported(o, claims, Policy())
    assert [f.key for f in found] == (["weak", "strong"] if told else ["strong", "weak"])
    assert found[0].weight == 0.43  # of what the model explains, whichever claim it is named by
    assert _supported(o, [], Policy()) == []


@pytest.mark.parametrize(
    ("high", "nature", "bent", "told"),
    [
        (0.5, "dynamic nonlinearity", False, True),
        (1.0, "dynamic nonlinearity", True, True),  # a regression is another witness
        (1.0, "dynamic nonlinearity", False, False),
        (0.5, "linear dynamics", True, False),
    ],
)
def test_what_surely_bends_is_told_though_no_model_of_it_lasts(high, nature, bent, told) -> None:
    rungs = [
        SimpleNamespace(value=1.0, figure=ErrorFigure(1.0, 0.9, 1.1)),
        SimpleNamespace(value=0.4, figure=ErrorFigure(0.4, 0.3, high), step=SimpleNamespace(nature=nature)),
    ]
    o: Any = SimpleNamespace(ladder=SimpleNamespace(rungs=rungs, answer=1), bent=bent)
    assert Outcome.surely(o, 0.5) is told
    assert not Outcome.surely(o, 0.7)


@pytest.mark.parametrize(
    ("nature", "memory", "passing"),
    [(Nature.ADDED, 0.98, True), (Nature.ADDED, 0.5, False), (Nature.DYNAMIC, 0.98, False)],
)
def test_what_runs_by_the_clock_beside_slow_noise_is_told_by_no_training_record_alone(
    nature, memory, passing
) -> None:
    """A step in a linear plant's slow noise, half of the error of 464 samples, refused by the test record: "an effect without a name"."""
    e = lfilter([1.0], [1.0, -memory], np.random.default_rng(4).standard_normal(464))
    rungs = [SimpleNamespace(errors=np.zeros(0)), SimpleNamespace(errors=np.r_[np.nan, e])]
    ladder = SimpleNamespace(rungs=rungs, answer=1, chosen=SimpleNamespace(nature=nature))
    assert Outcome.passing.fget(SimpleNamespace(ladder=ladder)) is passing  # type: ignore[attr-defined]


def test_the_names_of_a_model_go_where_another_stands_in_its_place() -> None:
    def rung(kind: Kind, value: float, high: float, admitted: bool = True) -> Any:
        step: Any = SimpleNamespace(kind=kind, admitted=admitted, echo=False)
        step.chain = (step,)
        return SimpleNamespace(step=step, value=value, figure=ErrorFigure(value, value, high))

    rungs = (rung(Kind.LINEAR, 1.0, 1.1), rung(Kind.NAMED, 0.2, 0.3), rung(Kind.DISCOVERED, 0.25, 0.3))
    none: Any = None
    claims = (SimpleNamespace(key="a"),)
    for third, order in (
        (rungs[2], [1, 2, 0]),  # what does as well stands in before the linear model
        (rung(Kind.DISCOVERED, 0.25, 0.3, admitted=False), [1, 0]),  # what was refused never does
        (rung(Kind.DISCOVERED, 0.9, 1.05), [1, 0]),  # nor what may be no better than it
    ):
        ladder = Ladder((*rungs[:2], third), 1, ())
        assert _order(ladder) == order
    found = Named(none, claims, (), none)  # type: ignore[arg-type]
    o = Outcome(0, none, found, Ladder(rungs, 1, ()), none, none, none)
    other = o.standing(rungs[2].step)
    assert (other.ladder.chosen, other.named.claims) == (rungs[2].step, ())
    assert other.named.dropped == (("a", FAILED),)
    for same in (rungs[1], rungs[0]):  # the linear model leaves open what is missing
        assert o.standing(same.step) is o
    # what the ladder refused and a test record bears out gets its names back, but not where it may hear the input's answer to the noise
    for echo in (False, True):
        rungs[1].step.admitted, rungs[1].step.echo = False, echo
        bare = replace(o, ladder=replace(o.ladder, answer=0), named=found.without_claims("no news"))
        assert bare.named.dropped == (("a", "no news"),)
        back = bare.standing(rungs[1].step)
        assert (back.named.claims, back.named.dropped, back.inverse) == (claims, (), echo)
    # a battery cell was a loop that winds up: one block of five had all of the gain
    unsure = (rungs[0], rung(Kind.NAMED, 0.2, 1.3, admitted=False), rungs[2])
    o = Outcome(0, none, found, Ladder(unsure, 0, ()), none, none, none)
    assert o.standing(unsure[1].step).named.dropped == (("a", UNSURE),)


def test_the_search_starts_from_a_linear_part_without_a_pole_that_an_effect_has_slowed(rng) -> None:
    """Two inputs whose product heats: one order too many is spent on what the product does slowly, and runs away beside it."""
    u = np.repeat(rng.standard_normal((80, 2)), 15, axis=0)
    y = lfilter([0.0, 0.05], [1.0, -0.95], u[:, 0] + 0.5 * u[:, 1] + u[:, 0] * u[:, 1])
    channel = Channel(u, y, Clock(np.arange(1200.0), 1200), np.ones(1200, dtype=bool))
    s = Structure(2, (0, 1))
    first = fit_linear(channel, s)
    slow = replace(first, p=np.concatenate((np.poly([0.9995, 0.9])[1:], first.p[2:])))
    for memory, order in ((240.0, 1), (np.inf, 2)):
        assert _forgetting(channel, s, slow, Known(2, memory=memory))[0].order == order
    few = fit_linear(channel, Structure(1, (0, 1)))
    poor = replace(slow, residual=few.residual / (1.01 * SLOW))
    assert _forgetting(channel, s, poor, Known(2, memory=240.0))[0].order == 2  # it pays for itself


@pytest.mark.parametrize(("error", "loose"), [(3.9, False), (4.1, True), (np.inf, True)])
def test_an_effect_is_loose_whose_parameter_the_record_leaves_open(error, loose) -> None:
    """A lamp had been play with a gap of -1 +- 28 where its input goes from 4 to 9."""
    s = Structure(2, parts=(Part(OFFSET), Part(named("saturation_upper"))), base=1)
    rows = {"offset.offset": (0.0, np.inf, ""), "saturation_upper.level": (1.0, 2.5 * error, "u")}
    claim = SimpleNamespace(key="saturation_upper", part=s.parts[1])
    f = SimpleNamespace(structure=s, scales=np.array([1.0] * (s.size - 1) + [2.5]))
    n = SimpleNamespace(claims=(claim,), step=SimpleNamespace(parameters=rows), fit=f)
    assert _loose(n) is loose  # type: ignore[arg-type]
    # by another name too: a motor's rate limit of 1 +- 3781, shown as more dynamics, was 3.8 off where the linear model was .28
    shown = SimpleNamespace(key="order", part=Part(named("order")))
    n = SimpleNamespace(claims=(shown,), step=n.step, fit=f)
    assert _loose(n) is loose  # type: ignore[arg-type]
    assert _loose(n, n.claims[:1]) is loose  # type: ignore[arg-type]
