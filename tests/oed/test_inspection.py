"""What is said of records before a model is fitted: each planted defect is found, clean records are let be."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from oed.data import Record
from oed.errors import InputError
from oed.inspection import defects, excitation_order


def clean(seed, pole=0.0, samples=500):
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -pole], rng.normal(size=samples))
    y = lfilter([0, 0.2, 0.2], [1, -0.98, 0.82], u)
    return u, y + 0.3 * y.std() * rng.normal(size=samples)


def kinds(u, y, **options):
    return [(d.kind, d.channel) for d in defects(Record(u, y), **options)]


@pytest.mark.parametrize("pole, most", [(0.0, 2), (0.9, 6)])
def test_clean_records_are_let_be(pole, most) -> None:
    """100 records: white inputs, and coloured ones whose means wander; false alarms in all."""
    assert sum(len(kinds(*clean(seed, pole), order=4)) for seed in range(100)) <= most


def test_planted_defects_are_found() -> None:
    u, y = clean(1)
    assert ("offset", "u") in kinds(u + 2, y)
    assert ("trend", "y") in kinds(u, y + np.linspace(0, 3, 500))
    spiked = y.copy()
    spiked[[50, 200, 333]] += [30, -40, 25]
    (spikes,) = [d for d in defects(Record(u, spiked)) if d.kind == "outliers"]
    assert (spikes.size, spikes.channel) == (3, "y")
    assert "50, 200, 333" in spikes.sentence
    assert ("saturation", "y") in kinds(u, np.minimum(np.repeat(y, 5)[:500], 0.8 * y.max()))
    assert ("slow sampling", "y") in kinds(u, np.repeat(y[:125], 4))
    (slow,) = [d for d in defects(Record(u, np.repeat(y[:125], 4))) if d.kind == "slow sampling"]
    assert slow.size == 4
    assert kinds(np.ones(500), y) == [("constant", "u")]
    gappy = y.copy()
    gappy[10:13] = np.nan
    assert kinds(u, gappy) == [("missing", "y")]


def test_slow_smooth_signals_and_steps_have_no_outliers() -> None:
    t = np.arange(600)
    slow = np.sin(0.02 * t) + 1e-3 * np.random.default_rng(0).normal(size=600)
    steps = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 30), 20)
    assert "outliers" not in {kind for kind, _ in kinds(steps, slow)}


def test_records_of_different_sampling() -> None:
    u, y = clean(2)
    (found,) = defects([Record(u, y, dt=0.1), Record(u, y, dt=0.2)])
    assert (found.kind, found.size) == ("sampling", 2.0)


def test_nothing_is_changed() -> None:
    u, y = clean(3)
    record = Record(u + 5, y)
    before = record.u.tobytes(), record.y.tobytes()
    assert defects(record, order=4)
    assert (record.u.tobytes(), record.y.tobytes()) == before


@pytest.mark.parametrize("lines", [1, 2, 3])
def test_each_sinusoid_excites_two(lines) -> None:
    """A sum of k sinusoids inside (0, pi) is exciting of order 2 k (Ljung 1999, section 13.2), an offset aside."""
    t = np.arange(400.0)
    u = sum(np.sin(w * t + w) for w in (0.3, 1.1, 2.0)[:lines])
    assert excitation_order(u, 12) == 2 * lines
    assert excitation_order(u + 7, 12) == 2 * lines
    (found,) = [d for d in defects(Record(u, u), order=7) if d.kind == "excitation"]
    assert f"of order {2 * lines}" in found.sentence


def test_white_and_constant_inputs(rng) -> None:
    assert excitation_order(rng.normal(size=100), 20) == 20
    assert excitation_order(np.full(50, 3.0), 5) == 0
    with pytest.raises(InputError, match="the sequence of data is empty"):
        defects([])
