"""What swings far comes out of phase with the record from nearly every start, and is fitted to growing shares of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnosis.effects import Clock, named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.path import INITIAL
from estimators.diagnosis.model import fitting
from estimators.diagnosis.model.fitting import Channel, Fit, grown
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Part, Structure
from tests.estimators.diagnosis.case_parts import lag, swing

NOISE = 0.02
PIVOT = named("pendulum_pivot")


def crane(seed: int, size: float) -> tuple[Channel, Fit]:
    """The angle below a trolley that is told one speed after the other, some forty swings, and its linear model."""
    rng = np.random.default_rng(seed)
    u = size * np.repeat(rng.uniform(-1.0, 1.0, 100), rng.integers(3, 20, 100))[:1000]
    push = np.concatenate(([0.0], np.diff(lag(u, 0.6))))
    y = swing(lambda x, v, f, t: -0.08 * np.sin(x) - 0.03 * v - 0.08 * f * np.cos(x), push)
    n = len(u)
    y = y + NOISE * rng.standard_normal(n)
    channel = Channel(u[:, None], y, Clock(np.arange(n, dtype=float), n), np.ones(n, dtype=bool))
    s = replace(Structure(3, (0,)).adding(Part(OFFSET)).adding(Part(INITIAL)), base=2)
    base = fit_linear(channel, s)
    return channel, replace(base, noise=np.zeros(0))


def least(channel: Channel, base: Fit) -> float:
    assert PIVOT.search is not None
    return min(float(np.std(f.residual)) for f in PIVOT.search(channel, base, ()))


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_a_pendulum_that_swings_far_is_found_by_its_first_swings(seed) -> None:
    channel, base = crane(seed, 3.0)
    assert np.max(np.abs(channel.y)) > 2.0
    assert least(channel, base) < 1.2 * NOISE


@pytest.mark.parametrize("shares", [(), (0.04, 0.06, *fitting.SHARES)])
def test_by_the_whole_record_or_by_too_little_of_it_it_is_not(shares, monkeypatch) -> None:
    """From every start a fit to all of it ends at twelve times the noise; two swings say too little of eight parameters."""
    monkeypatch.setattr(fitting, "SHARES", shares)
    assert least(*crane(2, 3.0)) > 6.0 * NOISE


def test_half_of_the_starts_are_given_up_with_each_share() -> None:
    channel, base = crane(1, 0.2)
    s, p = base.structure, base.p
    starts = [(p * (1.0 + 0.01 * k), base.scales) for k in range(5)]
    found = grown(channel, s, starts)
    assert len(found) == 1
    assert found[0][0] == pytest.approx(base.n * np.log(base.residual @ base.residual / base.n), abs=1.0)
    assert grown(channel, s, []) == []
