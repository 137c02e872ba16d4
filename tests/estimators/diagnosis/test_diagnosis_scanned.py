"""A drive that takes its command over by a clock of its own, whose period is no whole number of samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from estimators.diagnosis.baseline import best_linear
from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.loops.scanned import SCANS, _lines, _scans
from estimators.diagnosis.model.fitting import Channel
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Structure
from oed.data import Record

RATE = np.array([[0.0, 1.0, 0.0], [-0.12, -0.385, 0.12], [0.0, 0.0, 0.0]])


def command(rng: np.random.Generator, n: int) -> np.ndarray:
    """Steps of seven samples each, of two signs and any size."""
    steps = rng.choice([-1.0, 1.0], n // 7 + 1) * rng.uniform(0.5, 1.0, n // 7 + 1)
    return np.repeat(steps, 7)[:n]


def polled(u: np.ndarray, every: float, at: float) -> np.ndarray:
    """Output of a second-order plant whose drive reads its command at times of its own, from instant to instant."""
    state, scan, out = np.array([u[0], 0.0, u[0]]), at, []
    for k, wanted in enumerate(u):
        out.append(state[0])
        now = float(k)
        while scan < k + 1.0:
            state = expm(RATE * (scan - now)) @ state
            state[2], now, scan = wanted, scan, scan + every
        state = expm(RATE * (k + 1.0 - now)) @ state
    return np.array(out)


@pytest.mark.parametrize(("every", "at"), [(4.895, 0.967), (5.0, 2.0), (2.6, 0.4), (13.77, 1.1)])
def test_a_drives_own_scans_are_found_to_a_fraction_of_a_sample(every: float, at: float, rng) -> None:
    n = 1000
    u = command(rng, n)
    y = polled(u, every, at) + 0.01 * rng.standard_normal(n)
    # a record cut out of a longer one: its clock began before it
    channel = Channel(u[:, None], y, Clock(5000.0 + np.arange(n), n), np.ones(n, dtype=bool))
    base = fit_linear(channel, Structure(2, delay=2))
    found = min(_scans(channel, base, ()), key=lambda f: float(np.sum(f.residual**2)))
    period, phase = found.p[-2:]
    turns = (
        5000.0 + at + every * np.floor((n - at) / every) - phase
    ) / period  # to the last scan of the record
    assert abs(turns - np.rint(turns)) * period < 0.3
    assert np.std(found.residual) < 0.5 * np.std(base.residual)


def test_what_a_scan_takes_over_acts_from_where_it_falls_in_a_sample(rng) -> None:
    """Against the plant run from instant to instant, a linear model of the scanned command leaves next to nothing."""
    u = command(rng, 800)
    y = polled(u, 4.6, 0.25) + 1e-4 * rng.standard_normal(800)
    effect, clock = named("input_scanned"), Clock(np.arange(800.0), 800)
    left = [
        best_linear([Record(x, y)]).rmse_unused[0]
        for x in (u, *(effect.apply(u, np.array([4.6, at]), clock) for at in (0.25, 0.75)))
    ]
    assert left[1] < 0.15 * min(left[0], left[2])


def test_whole_periods_take_single_samples_and_others_two_in_part() -> None:
    effect, k = named("input_scanned"), np.arange(40.0)
    whole = effect.apply(k, np.array([5.0, 2.0]), Clock(k, 40))
    np.testing.assert_array_equal(whole, np.maximum(k - (k - 2) % 5, 0))
    # scans at 0.25, 2.75, 5.25, ..: half the time into sample 2 and so on
    part = effect.apply(k[:6], np.array([2.5, 0.25]), Clock(k[:6], 6))
    np.testing.assert_allclose(part, [0.0, 0.0, 0.75 * 0.0 + 0.25 * 2.0, 2.0, 2.0, 0.25 * 2.0 + 0.75 * 5.0])
    later = effect.apply(k[7:], np.array([2.5, 0.25]), Clock(k[7:], 33))
    np.testing.assert_allclose(later[3:], effect.apply(k, np.array([2.5, 0.25]), Clock(k, 40))[10:])
    assert not np.isfinite(effect.apply(k, np.array([SCANS + 0.5, 0.0]), Clock(k, 40))).any()


def test_periods_are_read_off_one_spectrum(rng) -> None:
    """White input, its age taken away: the strongest line is the scans' own, between two of the grid's."""
    n, every = 2000, 6.37
    u = rng.standard_normal(n)
    held = named("input_scanned").apply(u, np.array([every, 3.2]), Clock(np.arange(float(n)), n))
    (period, phase), *_ = _lines(u, held - u)
    assert period == pytest.approx(every, abs=every**2 / (10.0 * n))
    assert phase == pytest.approx(3.2, abs=0.6)


def test_an_input_that_never_moves_has_no_scans() -> None:
    n = 400
    channel = Channel(
        np.ones((n, 1)), np.sin(np.arange(n)), Clock(np.arange(float(n)), n), np.ones(n, dtype=bool)
    )
    moving = Channel(np.sin(0.3 * np.arange(n))[:, None], channel.y, channel.clock, channel.keep)
    base = fit_linear(moving, Structure(2))
    assert list(_scans(channel, base, ())) == []
