"""What was stated of a record, its order or a start at rest, and does not hold, is said; what holds is left alone."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline import Options, best_linear
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.baseline.search import Search
from estimators.diagnosis.effects import named
from estimators.diagnosis.ladder.stated import lacking, settling, starts_moving, unheard
from estimators.diagnosis.ladder.steps import climb
from estimators.diagnosis.loop import diagnose
from estimators.diagnosis.policy import Policy, Setting
from estimators.diagnosis.search import examination
from estimators.diagnosis.search.named import linear_step
from estimators.diagnosis.search.selection import attribute
from oed import Record
from tests.estimators.diagnosis.case_small import looking_for

POLES = np.poly([0.8, 0.6])
LEVELS = "offset", "drift", "step_input", "step_output", "initial"
LIGHT = np.poly([0.99 * np.exp(0.5j), 0.99 * np.exp(-0.5j)]).real


def record(den=POLES, num=(0.0, 0.1, 0.05), *, n=600, delay=0, colour=(1.0,), start=None, seed=0) -> Record:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 5), 5)
    y = lfilter(num, den, np.concatenate((np.zeros(delay), u))[:n])
    noise = lfilter([1.0], colour, rng.standard_normal(n))
    y += 0.03 * y.std() * noise / noise.std()
    if start is not None:
        y += start * lfilter([1.0, 0.0], den, np.eye(1, n)[0]) * y.std()
    return Record(u, y, 0.1)


def lacks(r: Record, order: int, **shares) -> str | None:
    options, policy = Options(deviations=True), Policy()
    base = best_linear([r], options)
    y, counted = [r.y[:, 0]], [base.blocks.counting([r])[0][:, 0]]
    ladder = climb(y, [linear_step(base, 0, True)], counted, policy)
    o = SimpleNamespace(index=0, ladder=ladder, bent=False, share=SimpleNamespace(feedback=False), **shares)
    found = lacking([r], o, base, order, options, policy)  # type: ignore[arg-type]
    return found and found.key


@pytest.mark.parametrize(
    "made, order, key",
    [
        (record(delay=3), 2, "delay"),
        (record(), 1, "order_one"),
        (record(np.convolve(POLES, LIGHT), (0.0, 0.02, 0.0, -0.01)), 2, "order"),
        (record(), 2, None),
        (record(colour=(1.0, -0.95)), 2, None),
        (record(LIGHT), 2, None),
    ],
    ids=["delay", "one order more", "a mode", "as stated", "as stated, slow noise", "as stated, light"],
)
def test_what_a_stated_order_lacks(made, order, key):
    assert lacks(made, order) == key


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("den, colour", [(POLES, (1.0, -0.98)), (LIGHT, (1.0,)), (LIGHT, LIGHT)])
def test_records_at_rest_are_believed(den, colour, seed):
    r = record(den, colour=colour, seed=seed)
    options = Options(deviations=True)
    assert starts_moving([r], 0, best_linear([r], options), 2, options) is None


def test_a_better_minimum_is_no_start(monkeypatch):
    """Beside a heat pump's defrosts the model at rest had ended in a poor minimum, and a state at the start had taken "14 % of the error"."""
    of_form, r, options = Search.of_form, record(), Options(deviations=True)

    def poor(self: Search, form, *near):
        found = of_form(self, form, *near)
        return found if near or found is None else replace(found, noise=1.4 * found.noise)

    base = best_linear([r], options)
    monkeypatch.setattr(Search, "of_form", poor)
    assert starts_moving([r], 0, base, 2, options) is None


def test_a_record_that_starts_in_a_state_is_fitted_and_told():
    train, test = record(LIGHT, start=1.0), record(LIGHT, seed=1)
    found = diagnose(train, test, looking_for(*LEVELS, orders=(2,), deviations=True, separate=True))
    assert found.effect == "initial_condition"
    assert "does not start at rest" in found.system
    # the test record does start at rest, and the model is as good as without the state
    assert found.rmse_after.value < 0.05 * test.y.std()


def cell(start: float, seed: int, n: int = 1200) -> Record:
    """A battery: three lags side by side, the slowest relaxing when the record starts; levels of the first samples are subtracted."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-4, 4, n // 15), 15)
    u[:15] = 0.0
    y = start * 0.9956 ** np.arange(n) + 0.6 * lfilter([1.0], [1.0, -0.8], rng.standard_normal(n))
    for pole, gain in ((0.9956, 30.0), (0.96, 10.0), (0.5, 4.0)):
        y += lfilter([0.0, gain * (1 - pole)], [1.0, -pole], u)
    return Record(u, y - y[:15].mean(), 2.0)


def test_a_start_that_ends_at_another_level_is_denied():
    """What was subtracted is where the record starts, not where it rests: a state alone, settling to 0, would not fit it."""
    train, test = cell(100.0, 0), cell(100.0, 5)
    options = Options(deviations=True)
    assert starts_moving([train], 0, best_linear([train], options), 2, options)
    found = diagnose(train, test, looking_for(*LEVELS, orders=(2,), deviations=True, separate=True))
    assert found.effect == "initial_condition"
    assert found.rmse_after.value < 0.2 * test.y.std()


def test_a_start_that_is_known_to_be_no_rest_is_kept_though_a_step_from_rest_is_near_it():
    """A relaxing cell starts at 0, as deviations do, and settles elsewhere: a load that comes with the record would do nearly that."""
    rng = np.random.default_rng(0)
    u = np.concatenate((np.zeros(15), np.repeat(rng.uniform(-300, 300, 60), 10)))[:, None]
    model = LinearModel(np.array([1.0, -0.98]), np.array([[0.0, 0.02]]), -1.0)
    prior = Prior(0.0, np.full(20, 900.0), 1.0, held=np.zeros(1))
    y = model.free_run(replace(prior, rest=True), u, np.empty(0), 0) + rng.standard_normal(len(u))
    assert not len(prior.of(model, u, y).opening)
    assert len(prior.of(model, u, y, known=True).opening) == 15


@pytest.mark.parametrize("own", [False, True], ids=["an added level", "the plant's own slow pole"])
def test_a_slow_pole_that_no_input_drives_is_a_level_that_settles(own):
    """The same decay, of a sensor that warms up or of the plant's state at the start: only the first is a disturbance."""
    slow = (1.0, -np.exp(-1.0 / 150))
    r = record(np.convolve(POLES, slow) if own else POLES, n=1200)
    decay = np.exp(-np.arange(1200) / 150)
    r = r.replace(y=r.y + 2.0 * r.y.std() * decay[:, None])
    base, told = best_linear([r], Options()), SimpleNamespace(index=0, share=SimpleNamespace(feedback=False))
    found = settling(r, told, base, Policy())  # type: ignore[arg-type]
    assert (found and found.key) == (None if own else "drift")


@pytest.mark.slow
@pytest.mark.parametrize(
    "again",
    [False, pytest.param(True, marks=pytest.mark.validate)],
    ids=["on one clock", "switched on again"],
)
def test_a_level_that_settles_has_settled_by_the_next_record_on_its_clock(again):
    """A sensor that warms up from the first sample of the training record on, which rests there; only another clock begins anew."""
    rng, records = np.random.default_rng(2), []
    for start, n in ((0, 1200), (1290, 600)):
        u = np.concatenate((np.zeros(25), np.repeat(rng.uniform(-1.0, 1.0, n // 20), 20)[: n - 25])) + 4.0
        x = 4.0 * 0.2 / np.sum(POLES) + lfilter([0.0, 0.2], POLES, u - 4.0)
        level = 2.0 * x.std() * np.exp(-(np.arange(n) + start * (not again)) / 370.0)
        records.append(Record(u, x - level + 0.03 * x.std() * rng.standard_normal(n), t0=float(start)))
    known = looking_for("drift", "offset", "step_output", "gain_drift", "lag_drift", separate=again)
    found = diagnose(*records, known)
    assert found.effect == "output_drift"
    assert found.rmse_after.value < 0.05 * records[1].y.std()


@pytest.mark.slow
def test_a_level_that_few_samples_at_rest_leave_is_part_of_the_linear_model():
    """Deviations from the mean of ten samples of slow noise, under an input of two levels: u + c u^2 is a level there, and no curve."""
    rng, records = np.random.default_rng(6), []
    for start in (0.0, 2000.0):
        u = np.concatenate((np.zeros(10), np.repeat(rng.choice([-1.0, 1.0], 120), 8)))
        noise = lfilter([1.0], [1.0, -0.7], rng.standard_normal(len(u))) * np.sqrt(1.0 - 0.7**2)
        y = lfilter([0.0, 0.1], [1.0, -0.9], u) + 0.05 * noise + 0.04
        records.append(Record(u, y, t0=start))
    curves = "input_quadratic", "input_polynomial", "input_exponential", "output_quadratic"
    found = diagnose(*records, looking_for(*curves, *LEVELS, deviations=True))
    assert found.effect in ("none", "coloured_noise")
    assert found.rmse_before.value < 1.1 * 0.05
    assert found.rmse_after == found.rmse_before


def test_a_level_is_no_start_though_a_slow_pole_would_hold_it():
    """Deviations from the mean of fifteen samples of slow noise, of two poles where three are stated: the third would hold the level."""
    rng = np.random.default_rng(3)
    u = np.concatenate((np.zeros(15), np.repeat(rng.choice([-1.0, 1.0], 110), 11)))
    noise = lfilter([1.0], [1.0, -0.8], rng.standard_normal(len(u))) * 0.6
    y = lfilter([0.0, 0.2, 0.1], LIGHT, u)
    r = Record(u, y + 0.05 * np.std(y) * noise - 0.1 * np.std(y))
    options = Options(deviations=True)
    assert starts_moving([r], 0, best_linear([r], options), 3, options) is None


def loaded(load, seed=5) -> list[Record]:
    """Two records of deviations, one after the other, beside a load of the clock that stands elsewhere while they rest."""
    rng, records = np.random.default_rng(seed), []
    for start, n in ((0, 900), (900, 500)):
        u = np.concatenate((np.zeros(15), np.repeat(rng.uniform(-1.0, 1.0, n // 25), 25)[: n - 15]))
        x = lfilter([0.0, 0.1], [1.0, -0.9], u + load(start + np.arange(len(u)), len(u)))
        records.append(Record(u, x + 0.03 * rng.standard_normal(len(u)), t0=float(start)))
    return records


def test_a_level_beside_a_periodic_load_is_told_by_the_data():
    """The rests lie where the load is not in its mean: without a level the linear model was worse than a constant, all else bent to that."""
    load = lambda k, n: 1.5 * (np.cos(2.0 * np.pi * k / 90.0) - 1.0)
    cycles = "tones", "waveform", "gain_periodic", "input_quadratic", "saturation"
    found = diagnose(*loaded(load), looking_for(*cycles, *LEVELS, deviations=True))
    assert found.effect == "periodic_disturbance"
    assert found.rmse_after.value < 0.2 * found.rmse_before.value


def test_a_level_that_comes_with_the_record_is_named_where_nothing_else_is():
    load = lambda k, n: np.where(np.arange(n) < 15, 0.0, -3.0)
    found = diagnose(*loaded(load), looking_for(*LEVELS, "input_quadratic", "gain_change", deviations=True))
    assert found.effect == named("offset").cause


def held(direct: float, seed: int = 0) -> tuple[Record, Record]:
    """A plant whose controller answers the noise in its own sample, and the same plant moved by hand; `direct` its own quick path."""
    rng, n = np.random.default_rng(seed), 1500
    target = np.repeat(rng.uniform(-1.0, 1.0, n // 30), 30)
    noise, u, y, x, total = 0.05 * rng.standard_normal(n), np.zeros(n), np.zeros(n), 0.0, 0.0
    for k in range(n):
        # the controller knows what a quick path adds before it acts
        y[k] = (x + noise[k] + direct * (2.0 * target[k] + total)) / (1.0 + 2.0 * direct)
        total += 0.1 * (target[k] - y[k])
        u[k] = 2.0 * (target[k] - y[k]) + total
        y[k] = x + noise[k] + direct * u[k]
        x = 0.9 * x + 0.1 * u[k]
    by_hand = np.repeat(rng.uniform(-1.0, 1.0, n // 15), 15)
    out = lfilter([direct, 0.1 - 0.9 * direct], [1.0, -0.9], by_hand) + 0.05 * rng.standard_normal(n)
    return Record(u, y), Record(by_hand, out)


def test_a_model_that_hears_the_controllers_answer_gives_way_to_one_that_does_not():
    """Its direct path had taken up the answer to the noise: errors of records in a loop were 4 to 17 % larger where no loop was."""
    train, test = held(0.0)
    options = Options(deviations=True)
    base = best_linear([train], options)
    other, told = unheard([train], base, options)
    assert base.outputs[0].delays == (0,)
    assert told.later == (0,)
    assert min(other.outputs[0].delays) > 0
    errors = [np.std(test.y - b.simulate(test, 0)) for b in (base, other)]
    assert errors[1] < min(errors[0], 1.03 * 0.05)


def test_a_plant_that_acts_at_once_keeps_its_direct_path_in_a_loop():
    train, _ = held(0.5)
    options = Options(deviations=True)
    base = best_linear([train], options)
    assert unheard([train], base, options)[0] is base
    assert base.outputs[0].delays == (0,)


@pytest.mark.parametrize(("orders", "delays"), [((2,), [0, 3]), ((), [3])])
def test_a_delay_beside_an_order_that_is_stated_is_tried_where_an_effect_may_need_it(
    orders, delays, monkeypatch
) -> None:
    """A crane's linear model tells no delay from none, and without its delay no pendulum was found: 2.69 deg by discovered terms, .856."""
    tried = []

    def counted(channel, s, *args, **kwargs):
        tried.append(s.delay)
        return attribute(channel, s, *args, **kwargs)

    monkeypatch.setattr(examination, "attribute", counted)
    setting = Setting(orders=orders, deviations=False, effects=())
    found = examination.examine(record(delay=3), 0, setting, examination.Known(2, 3))
    assert (tried, found.attribution.final.structure.delay) == (delays, 3)
