"""The remainder: kernels against plain twins, bounded, honest on unused blocks, harmless where there is nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators import diagnose
from estimators.diagnosis import loop
from estimators.diagnosis.baseline import best_linear
from estimators.diagnosis.effects import named
from estimators.diagnosis.policy import Effort, Setting
from estimators.diagnosis.remainder import (
    Limits,
    fit_remainder,
    from_json,
    linear_footing,
    spliced,
    stack,
    to_json,
)
from estimators.diagnosis.remainder.network import Sizes
from estimators.diagnosis.remainder.network_kernels import derivatives, free_run
from estimators.diagnosis.remainder.trees import Trees, grown
from estimators.diagnosis.search import selection
from estimators.diagnosis.share import Evidence, explainable_share
from estimators.diagnosis.share.signals import Bank
from oed.data import Record
from oed.errors import InputError
from tests.estimators.diagnosis.case_small import two_poles

QUICK = Limits(shapes=())
NETS = Limits(starts=4)


def _input(rng: np.random.Generator, n: int) -> np.ndarray:
    """Random levels held for 1 to 12 samples."""
    return np.repeat(rng.uniform(-1.0, 1.0, n), rng.integers(1, 13, n))[:n]


def _spring(u: np.ndarray) -> np.ndarray:
    """Hardening spring, five steps a sample."""
    y, x, v = np.zeros(len(u)), 0.0, 0.0
    for k, w in enumerate(u):
        y[k] = x
        for _ in range(5):
            v += 0.2 * (0.5 * w - 0.25 * x - 0.5 * x**3 - 0.25 * v)
            x += 0.2 * v
    return y


def _sensor(u: np.ndarray) -> np.ndarray:
    return np.tanh(1.5 * np.asarray(lfilter([0.0, 0.4], [1.0, -1.2, 0.45], u)))


def _pair(system, seed: int, noise: float, n: int = 900) -> tuple[Record, Record, np.ndarray]:
    """Training record, test record, and the test output without noise."""
    rng = np.random.default_rng(seed)
    u, u2 = _input(rng, n), _input(rng, n)
    y, y2 = system(u), system(u2)
    e = noise * rng.standard_normal(2 * n)
    return Record(u, y + e[:n]), Record(u2, y2 + e[n:]), y2


def _linear(u: np.ndarray) -> np.ndarray:
    return np.asarray(lfilter([0.0, 0.5, 0.3], [1.0, -1.5, 0.7], u))


def _twin(parts: dict[str, np.ndarray], w: np.ndarray) -> np.ndarray:
    x, out = np.zeros(len(parts["A"])), []
    for row in w:
        t = np.tanh(parts["F"] @ np.concatenate((x, row)) + parts["g"])
        out.append(parts["C"] @ x + parts["D"] @ row + parts["K"] @ t + parts["d"][0])
        x = parts["A"] @ x + parts["B"] @ row + parts["E"] @ t
    return np.array(out)


def test_network_kernels_agree_with_their_plain_twin_and_with_differences() -> None:
    """Twin to 1e-12; central differences of step 1e-6 lose half of 16 digits: 1e-7 of unit derivatives."""
    sizes, rng = Sizes(2, 3, 4), np.random.default_rng(0)
    count = sum(int(np.prod(s)) for s in sizes.shapes.values())
    theta, w = 0.3 * rng.standard_normal(count), rng.standard_normal((40, 3))
    parts = sizes.split(theta)
    y, J = derivatives(*parts.values(), w)
    np.testing.assert_allclose(y, _twin(parts, w), atol=1e-12)
    np.testing.assert_allclose(free_run(*parts.values(), w), y, atol=1e-14)
    steps = 1e-6 * np.eye(count)
    expected = np.stack(
        [(_twin(sizes.split(theta + s), w) - _twin(sizes.split(theta - s), w)) / 2e-6 for s in steps]
    )
    np.testing.assert_allclose(J, expected.T, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("system, left", [(_spring, 0.5), (_sensor, 0.5)])
def test_what_has_no_name_is_taken_up(system, left: float) -> None:
    """A hardening spring and a saturating sensor: at least half of the linear model's error goes, also on new data."""
    train, test, truth = _pair(system, 1, 0.005)
    base = best_linear([train])
    rest = fit_remainder(base, [train], linear_footing(base, [train]), limits=NETS)
    assert rest.admitted
    run = base.simulate(test)
    before = np.std((run[:, 0] - truth)[20:])
    assert np.std((rest.simulate(test, run) - truth)[20:]) < left * before
    assert rest.rmse_unused < 0.8 * base.rmse_unused[0]
    _, low, high = rest.predict(test, run)
    inside = np.mean((test.y[20:, 0] >= low[20:]) & (test.y[20:, 0] <= high[20:]))
    assert inside > 0.9  # 95 %, by 900 correlated samples


@pytest.mark.slow
@pytest.mark.parametrize(
    "noise, whole",
    [
        (0.9, False),
        pytest.param(0.9, True, marks=pytest.mark.validate),
        pytest.param(0.0, True, marks=pytest.mark.validate),
    ],
)
def test_nothing_is_taken_up_from_a_linear_system(monkeypatch, noise: float, whole: bool) -> None:
    """12 linear records a noise: two standard errors are passed in 2.3 %, by correlated pieces somewhat more; 2 of 12 at a
    twentieth have p < .12, 3 have p < .02. None that is admitted is made worse by 3 %."""
    if not whole:
        two_poles(monkeypatch)
    admitted = 0
    for seed in range(12):
        train, test, truth = _pair(_linear, seed, 0.0, 600)
        e = np.asarray(lfilter([1.0], [1.0, -noise], np.random.default_rng(seed).standard_normal(600)))
        train = train.replace(y=train.y[:, 0] + 0.3 * e / np.std(e))
        base = best_linear([train])
        rest = fit_remainder(base, [train], linear_footing(base, [train]), limits=NETS)
        admitted += rest.admitted
        if rest.admitted:
            run = base.simulate(test)
            before, after = (
                np.sqrt(0.09 + np.mean((r - truth)[20:] ** 2)) for r in (run[:, 0], rest.simulate(test, run))
            )
            assert after < 1.03 * before
    assert admitted <= 2


def test_it_is_bounded_for_any_input_and_gone_far_outside() -> None:
    train, _, _ = _pair(_sensor, 2, 0.01)
    base = best_linear([train])
    rest = fit_remainder(base, [train], linear_footing(base, [train]), limits=NETS)
    u = 1e6 * np.sign(np.sin((np.arange(300) + 0.5) / 7.0))
    run = base.simulate(Record(u, np.zeros(300)), 0)
    np.testing.assert_array_equal(rest.simulate(Record(u, np.zeros(300)), run), run[:, 0])
    near = Record(1.2 * u / 1e6, np.zeros(300))
    run = base.simulate(near, 0)
    reach = 2.0 * np.ptp(train.y)
    assert np.abs(rest.simulate(near, run) - run[:, 0]).max() < reach


@pytest.mark.slow
def test_it_is_the_same_twice_and_from_json_bit_for_bit() -> None:
    train, test, _ = _pair(_sensor, 3, 0.01, 500)
    base = best_linear([train])
    rests = [fit_remainder(base, [train], linear_footing(base, [train]), limits=NETS) for _ in range(2)]
    run = base.simulate(test)
    first = rests[0].simulate(test, run)
    np.testing.assert_array_equal(first, rests[1].simulate(test, run))
    np.testing.assert_array_equal(first, from_json(to_json(rests[0])).simulate(test, run))
    with pytest.raises(InputError, match="no 'remainder 1'"):
        from_json("{}")


def test_it_stands_on_any_step_and_on_several_records() -> None:
    train, test, truth = _pair(_sensor, 4, 0.01)
    y = train.y[:, 0].copy()
    y[100:110] = np.nan
    records = [train.replace(y=y)[:500], train.replace(y=y)[500:]]
    base = best_linear(records)
    rest = fit_remainder(base, records, spliced(base.y_model, base.unused, base.blocks), limits=QUICK)
    assert [len(u) for u in rest.unused] == [500, 400]
    run = base.simulate(test)
    assert np.std((rest.simulate(test, run) - truth)[20:]) < 0.8 * np.std((run[:, 0] - truth)[20:])


def _loop(seed: int, n: int = 600) -> Record:
    """A linear plant under feedback through one sample of delay, with coloured noise in the loop."""
    rng = np.random.default_rng(seed)
    e = np.asarray(lfilter([1.0], [1.0, -0.9], rng.standard_normal(n)))
    u, y, state = np.zeros(n), np.zeros(n), np.zeros(2)
    r = _input(rng, n)
    for k in range(n):
        y[k] = state[0] + 0.3 * e[k]
        u[k] = r[k] - (0.5 * y[k - 1] if k else 0.0)
        state = np.array([1.2 * state[0] + state[1] + 0.3 * u[k], -0.5 * state[0] + 0.2 * u[k]])
    return Record(u, y)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 7, pytest.param(10, marks=pytest.mark.validate)])
def test_a_controllers_echo_of_the_noise_is_not_taken_up(seed: int) -> None:
    """Past inputs tell the noise; at two of these seeds unused blocks alone admitted what would fail in open loop."""
    train = _loop(seed)
    base = best_linear([train])
    share = explainable_share(base, [train])
    assert share.feedback
    assert share.nature in ("noise", "linear dynamics")
    rest = fit_remainder(base, [train], linear_footing(base, [train]), limits=QUICK, share=share)
    assert not rest.admitted


def _batches(seed: int, count: int) -> Record:
    """Heated batches: each begins with a cold charge that no input tells, whatever the heating is."""
    rng, inputs, charges = np.random.default_rng(seed), [], []
    for _ in range(count):
        k, top = np.arange(int(rng.integers(22, 44))), rng.uniform(0.3, 2.0)
        heat = top * np.where(k < 12, 1.0 + 0.02 * k, 1.3 * np.exp(-(k - 12) / 6.0))
        inputs.append(heat + 0.01 * rng.standard_normal(len(k)))
        charges.append(-4.0 * np.exp(-k / 2.5))
    u = np.concatenate(inputs)
    y = lfilter([0.0, 0.1], [1.0, -0.9], u) + np.concatenate(charges)
    return Record(u, y + 0.02 * rng.standard_normal(len(u)))


def test_an_input_that_tells_most_of_the_error_does_not_answer_the_noise(monkeypatch) -> None:
    """The linear model's error foretells the next batch: a record of it looked like a loop until bends of the input had told what they
    can; where they cannot, it is none once the error is explained."""
    train, test = _batches(0, 80), _batches(100, 40)
    base = best_linear([train])
    assert not explainable_share(base, [train]).feedback
    monkeypatch.setattr(stack, "has_feedback", lambda *rows: True)
    rest = fit_remainder(base, [train], linear_footing(base, [train]), limits=Limits(shapes=()))
    assert not rest.feedback
    assert any(isinstance(m, Trees) for m in rest.members)
    run = base.simulate(test)
    left = [np.std(test.y[20:, 0] - y[20:]) for y in (run[:, 0], rest.simulate(test, run))]
    assert left[1] < 0.5 * left[0]
    np.testing.assert_array_equal(rest.simulate(test, run), from_json(to_json(rest)).simulate(test, run))


def test_trees_are_the_sum_of_their_means() -> None:
    """A step at 0 of a signal: the mean on either side of it, and within the bounds; twice the same."""
    rng = np.random.default_rng(1)
    X = rng.standard_normal((400, 2))
    r = np.where(X[:, 0] > 0.0, 2.0, -1.0)
    trees, again = (grown(_BANK, X, r, (-0.5, 3.0)) for _ in range(2))
    far = np.array([[9.0, 0.0], [-9.0, 0.0]])
    np.testing.assert_allclose(trees.predicted(far), [2.0, -0.5], atol=0.05)
    np.testing.assert_array_equal(trees.predicted(X), again.predicted(X))


_BANK = Bank((1.0, 2.0, 4.0), (16.0,), ((0.0,), (0.0,), (0.0,)), (0.0,) * 3, (1.0,) * 3, 400)


def test_what_follows_the_clock_is_left_to_the_clock() -> None:
    train, _, _ = _pair(_sensor, 7, 0.01, 500)
    base = best_linear([train])
    footing = linear_footing(base, [train])
    rest = fit_remainder(base, [train], footing, limits=QUICK)
    share = explainable_share(base, [train])
    assert rest.admitted
    clock = replace(share, share=0.99, natures=(Evidence("disturbance", 0.99, 0.98, 1.0, ""),))
    told = fit_remainder(base, [train], footing, limits=QUICK, share=clock)
    assert not told.admitted
    assert "clock" in told.why


def _clipped(u: np.ndarray, more: float) -> np.ndarray:
    """A limited actuator, and a gain of the second of two lags that falls with the first."""
    x = np.asarray(lfilter([0.0, 0.2], [1.0, -0.8], np.clip(u, -0.6, 0.6)))
    return np.asarray(lfilter([0.0, 0.3], [1.0, -0.7], x - more * x**2))


@pytest.mark.parametrize(("more", "sought"), [(0.0, False), (0.5, True)])
def test_more_is_looked_for_where_more_than_noise_is_left(monkeypatch, more: float, sought: bool) -> None:
    """With all that is missing named, what is left is as white as the noise, and in unused blocks as large: neither a second effect nor a
    remainder could find more there."""
    asked, paired, second = [], [], selection._more_effects
    monkeypatch.setattr(selection, "_more_effects", lambda *rows: paired.append(1) or second(*rows))
    monkeypatch.setattr(
        loop, "fit_remainder", lambda *rows, **more: asked.append(1) or fit_remainder(*rows, **more)
    )
    train, test, _ = _pair(lambda u: _clipped(u, more), 3, 0.003)
    found = diagnose(train, test, Setting(effects=(named("saturation"),), effort=Effort.QUICK))
    assert found.effect == "input_saturation"
    assert (bool(asked), bool(paired)) == (sought, sought)
