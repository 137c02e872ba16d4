"""The recursions of hidden loops against the differential equations that they stand for."""

import numpy as np
import pytest

from estimators.diagnosis.baseline.linear_model import Prior
from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.kernels.event_kernels import scanned_events, triggered
from estimators.diagnosis.effects.kernels.loop_kernels import (
    COURSE,
    carried,
    flowing,
    geared,
    steered_loop,
    stored,
)
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.search.free_runs import Start, _Moved, free_run


@pytest.mark.parametrize("which", [0, 1, COURSE])
def test_a_steered_loop_is_its_differential_equation(which):
    """Against Euler's steps, two hundred to a sample, which are off by a two hundredth of what moves in one."""
    pace, proportional, integral, up, down, lag, behind = p = np.array([0.1, 3.0, 0.3, 0.04, 0.06, 0.7, 1.2])
    u, course, h = np.repeat([0.5, 2.0, -1.0, 0.5], 40), which == COURSE, 1.0 / 200
    s = z = x = i = 0.0 if course else u[0]
    at, plain = u[0], []
    for value in u:
        for _ in range(200):
            command = integral * (value - at) - proportional * x if course else proportional * (value - x) + i
            s, z, x, i, at = (
                s + h * np.clip((command - s) / lag, -down, up), z + h * (s - z) / behind, x + h * pace * (z - x),
                i + h * integral * (value - x), at + h * x,
            )  # fmt: skip
        plain.append((x, s, at)[which])
    assert np.max(np.abs(steered_loop(u, p, u[0], which) - plain)) < 0.01 * np.ptp(plain)


@pytest.mark.parametrize(("torque", "seen"), [(False, 2), (True, 3), (True, 1)])
def test_a_geared_drive_is_its_differential_equation(torque, seen):
    """Against two thousand Euler's steps to a sample; and what it says changes with half its play as smoothly as a fit takes for granted."""
    own, damping, ratio, gear, contact, friction, half = p = np.array([0.3, 0.2, 0.4, 0.6, 0.2, 0.05, 0.35])
    u, h, x, plain = np.repeat([0.0, 2.0, -1.0, 0.5], 25), 1.0 / 2000, np.zeros(4), []
    for value in u:
        for _ in range(2000):
            a, v, b, w = x
            past = a - b - min(max(a - b, -half), half)
            twisted = gear**2 * past + contact * (v - w) if past else 0.0
            pull = damping * (value - v) if torque else own**2 * (value - a) - damping * v
            x = x + h * np.array([v, pull - ratio * twisted, w, twisted - friction * w])
        plain.append(x[seen])
    run = geared(u, p, 0.0, torque, seen)
    assert np.max(np.abs(run - plain)) < 0.005 * np.ptp(plain)
    slope = lambda d: (geared(u, p + d * np.eye(7)[6], 0.0, torque, seen) - run) / d
    assert np.max(np.abs(slope(1e-6) - slope(1e-3))) < 0.1 * np.max(np.abs(slope(1e-3)))


@pytest.mark.parametrize("leak", [0.0, 0.05])
def test_a_store_is_its_differential_equation(leak):
    """Against two thousand Euler's steps to a sample; before the record it waits where it stands."""
    u, h, x, plain = np.repeat([1.0, 2.0, -1.5, 0.5, -3.0], 12), 1.0 / 2000, 1.5, []
    for value in u:
        for _ in range(2000):
            x = min(max(x + h * (value - 0.3 - leak * x), 0.0), 9.0)
        plain.append(x)
    run = stored(u, leak, 0.3, np.array([0.0, 9.0, 1.5]), 0)
    assert min(plain) == 0.0
    assert max(plain) == 9.0
    assert np.max(np.abs(run - plain)) < 2e-3
    late = stored(np.concatenate((np.full(7, 5.0), u)), leak, 0.3, np.array([0.0, 9.0, 1.5]), 7)
    assert np.array_equal(late[:7], np.full(7, 1.5))
    assert np.array_equal(late[7:], run)


@pytest.mark.parametrize(
    ("key", "ends", "levels"),
    [("store", [9.0], [0.0, 4.0, 9.0]), ("store_empty", [], [0.0, 30.0]), ("store_full", [], [-30.0, 0.0])],
)
def test_a_record_says_how_full_its_store_is_at_its_start(key, ends, levels):
    """Whatever it held when the training record began: from between its ends, and at them."""
    rng = np.random.default_rng(5)
    u, clock = np.repeat(rng.uniform(-1.0, 1.6, 20), 10)[:, None], Clock(np.arange(200.0), 200)
    s = Structure(1).adding(Part(named(key)))
    p = np.array([-0.3, 0.7, 0.02, 0.3, *ends, 3.0 if key != "store_full" else -3.0])
    start = Start(Prior(0.0, 0.9 ** np.arange(64.0), 1e-4), rest=False, error=1e-4)
    for level in levels:
        y = simulate(s, np.append(p[:-1], level), u, clock) + 0.01 * rng.standard_normal(200)
        run = free_run(_Moved(s, p), u, clock, y, 20, start)
        assert np.max(np.abs(run - y)) < 0.05
        untold = free_run(_Moved(s, p), u, clock, np.full(200, np.nan), 20, start)
        assert np.max(np.abs(untold - y)) > 1.0


@pytest.mark.parametrize("leak", [0.0, 0.05])
def test_a_flow_that_cannot_turn_back_is_its_differential_equation(leak):
    """Against two thousand Euler's steps to a sample, from off its rest; before the record it waits there; nothing jumps with the end."""
    rng = np.random.default_rng(8)
    u, h, plain = np.repeat(rng.uniform(0.0, 3.0, 12), 15), 1.0 / 2000, []
    w, r, least = 0.3, 0.1, 0.05 if leak else -0.5
    v = 1.0 * w**2 / (w**2 + r * leak) - 0.2
    i, ends = leak * (v + 0.2) / w + 0.1, 0
    for value in u:
        for _ in range(2000):
            i, v = max(i + h * (w * (value - v) - r * i), least), v + h * (w * i - leak * v)
            ends += i == least
        plain.append(v)
    run = lambda end, lead=0: flowing(
        np.concatenate((np.full(lead, 5.0), u)), np.array([w, r, leak]), 1.0, end, np.array([0.1, -0.2]), lead
    )
    assert 0.1 < ends / (2000 * len(u)) < 0.9
    assert np.max(np.abs(run(least) - plain)) < 0.005 * np.ptp(plain)
    assert np.array_equal(run(least, 7)[7:], run(least))
    slope = lambda d: (run(least + d) - run(least)) / d
    assert np.max(np.abs(slope(1e-6) - slope(1e-3))) < 0.1 * np.max(np.abs(slope(1e-3)))


@pytest.mark.parametrize(("key", "way"), [("flow_up", 1.0), ("flow_down", -1.0)])
def test_a_record_says_how_its_flow_begins(key, way):
    """Whatever the training record began with, in the window; without one, from rest, and few samples leave it there."""
    rng = np.random.default_rng(5)
    u, clock = way * np.repeat(rng.uniform(0.0, 3.0, 20), 10)[:, None], Clock(np.arange(200.0), 200)
    s = Structure(1).adding(Part(named(key)))
    p = np.array([-0.3, 0.7, 0.25, 0.1, 0.02, 0.0, 1.0, -1.0])
    start = Start(Prior(0.0, 0.9 ** np.arange(64.0), 1e-4), rest=False, error=1e-4)
    for begun in ([0.0, 0.0], [0.6, 0.4]):
        at = lambda begun=begun: np.append(p[:-2], way * np.array(begun))
        y = simulate(s, at(), u, clock) + 0.01 * rng.standard_normal(200)
        run = free_run(_Moved(s, p), u, clock, y, 20, start)
        assert np.max(np.abs(run - y)) < 0.05
    at_rest, since = (
        simulate(s, np.append(p[:-2], [0.0, 0.0]), u, clock),
        slice(30, None),
    )  # its filter has settled
    untold = free_run(_Moved(s, p), u, clock, np.full(200, np.nan), 20, start)
    assert np.allclose(untold[since], at_rest[since])
    one = np.where(np.arange(200) < 1, untold + 0.01, np.nan)
    assert np.max(np.abs(free_run(_Moved(s, p), u, clock, one, 1, start) - untold)) < 0.05


def test_what_rides_on_a_moved_base_is_its_differential_equation():
    """Against two thousand Euler's steps to a sample."""
    u, h, plain = np.repeat([0.0, 1.0, -2.0, 0.5, 3.0], 25), 1.0 / 2000, []
    r, x, v = 0.0, 0.0, 0.0
    for value in u:
        for _ in range(2000):
            gain = (value - r) / 1.5 - v
            r += h * (value - r) / 1.5
            v, x = v + h * (0.09 * (r - x) + (0.05 if gain > 0.0 else 0.25) * gain), x + h * v
        plain.append(x)
    run = carried(u, np.array([0.3, 0.05, 0.25, 1.5]), 0.0)
    assert np.max(np.abs(run - plain)) < 2e-3 * np.ptp(plain)


@pytest.mark.parametrize("adds", [False, True])
@pytest.mark.parametrize("lag", [0.0, 1.7])
def test_an_event_runs_for_its_time_once_its_level_has_risen_by_its_dose(adds, lag):
    """Against steps a two-hundredth of a sample long, from the record on: a constant input before it fills no level."""
    fine, lead = 200, 5
    u = np.repeat(np.random.default_rng(4).uniform(0.0, 3.0, 30), 8)
    u[:lead] = u[lead]
    threshold, dose, time, value = 0.8, 14.3, 5.4, -1.1
    out, x, level, left = np.zeros(len(u)), u[0], 0.0, 0.0
    for k, v in enumerate(u):
        for _ in range(fine):
            x = x + (v - x) / (lag * fine) if lag else v
            out[k] += ((x + value if adds else value) if left > 0.0 else x) / fine
            if left > 0.0:
                left -= 1.0 / fine
                level = max(-left, 0.0) * max(x - threshold, 0.0)  # of what is left of the step
            elif k >= lead:
                rise = max(x - threshold, 0.0)
                level += rise / fine
                if level >= dose:
                    level, left = 0.0, time - (level - dose) / rise
    found = triggered(u, np.array([threshold, dose, time, value, lag]), adds, u[0], lead)
    assert np.sum(np.abs(found - u) > 0.5) > 20
    np.testing.assert_allclose(found, out, atol=0.1)  # of an event that is a few steps late
    assert np.mean(np.abs(found - out)) < 0.01


def test_a_scan_of_doses_sums_what_is_told_of_each_event():
    """A level that rises by one a sample: events of two samples at a dose of four begin at 4, 10, 16, and so on."""
    n = 40
    rng = np.random.default_rng(6)
    told = np.concatenate((np.zeros((2, 1)), np.cumsum(rng.standard_normal((2, n)), axis=1)), axis=1)
    filled = np.arange(n + 1.0)
    begins = np.arange(4, n, 6)
    sums = (told[:, np.minimum(begins + 2, n)] - told[:, begins]).sum(axis=1)
    scores = scanned_events(filled, told, np.array([4.0, 30.0]), 2.0, 3)
    np.testing.assert_allclose(scores, [sums @ sums / len(begins), 0.0])
