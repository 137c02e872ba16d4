"""Fractional delays."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.pem.search.fractional_delay import estimate_fractional_delay, shifted
from oed.data import Record
from oed.errors import InputError


def multisine(rng, length=600):
    """A periodic signal up to 0.6 pi, as a function of time that can be shifted exactly."""
    lines = 2 * np.pi * np.arange(1, 180) / length
    phases = rng.uniform(0, 2 * np.pi, len(lines))
    return lambda t: np.cos(np.outer(t, lines) + phases).sum(axis=1) / np.sqrt(len(lines) / 2)


@pytest.mark.parametrize("fraction", [0.37, -0.8, 2.5])
def test_shift_of_a_band_limited_signal(rng, fraction) -> None:
    signal, t = multisine(rng), np.arange(600.0)
    moved = shifted(signal(t)[:, None], fraction)[:, 0]
    assert np.abs(moved - signal(t - fraction))[40:-40].max() < 1e-3
    assert shifted(signal(t)[:, None], 0.0)[:, 0].tolist() == signal(t).tolist()
    with pytest.raises(InputError, match="between -4 and 4"):
        shifted(signal(t)[:, None], 9.0)


@pytest.mark.slow
def test_delay_is_found_with_its_error() -> None:
    """20 runs: the errors in units of the claimed one have a mean square between 0.29 and 2.3 (false alarm 1e-3)."""
    away = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        signal, t = multisine(rng), np.arange(600.0)
        y = lfilter([0, 0, 0.5], [1, -0.8], signal(t - 0.4)) + 0.2 * rng.normal(size=600)
        found = estimate_fractional_delay(
            Record(signal(t), y), "oe", (1, 1), 2, initial="estimate", search="quick", offset=False
        )
        away.append((found.delay - 2.4) / found.standard_error)
    assert 0.29 < np.mean(np.square(away)) < 2.3
    assert "delay 2." in repr(found)
