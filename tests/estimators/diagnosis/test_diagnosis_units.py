"""No effect of the catalogue and no regression knows a unit: what it makes of a signal in another is the same signal in that one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.baseline.disturbances import foretold
from estimators.diagnosis.effects import CATALOGUE, Clock
from estimators.diagnosis.effects.effect import Sizes, Slot
from estimators.residual.algebra import decomposed, powers_of_two

FAR = (2.0**-150, 2.0**150)
N = 300
CURVES = [e for e in CATALOGUE if e.apply and e.starts and e.slot in (Slot.INPUT, Slot.OUTPUT)]


def sizes(unit: float) -> Sizes:
    u = 2.5 + np.repeat(np.random.default_rng(3).uniform(-1.5, 2.0, N // 4), 4)
    y = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], u)
    clock, poles = Clock(np.arange(float(N)), N), np.array([0.75 + 0.37j, 0.75 - 0.37j])
    return Sizes(unit * u, unit * y, clock, unit * y, unit * np.gradient(y), poles)


def shown(effect, unit: float) -> np.ndarray:
    """What it makes of its signal at every start of its grid, over its largest value: a root has its own unit, which is the gain's."""
    s = sizes(unit)
    x = s.u if effect.slot is Slot.INPUT else s.y
    found = np.array([effect.apply(x, np.array(p), s.clock) for p in effect.starts(s)[0]])
    return found / np.max(np.abs(found), axis=1, keepdims=True)


@pytest.mark.parametrize("effect", CURVES, ids=lambda e: e.key)
@pytest.mark.parametrize("unit", FAR)
def test_curves_are_the_same_in_any_unit(effect, unit):
    """Widths and sharpnesses below 1e-12 had been none, and signals beyond 1e60 an explosion."""
    usual = shown(effect, 1.0)
    assert np.all(np.isfinite(usual))
    np.testing.assert_allclose(shown(effect, unit), usual, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("unit", FAR)
def test_a_constant_beside_a_signal_in_any_unit(unit):
    """A decomposition that counts directions by the largest column left out all others: a trend was all that an input had moved."""
    rng = np.random.default_rng(4)
    t, u = np.linspace(-1.0, 1.0, N), rng.standard_normal(N)
    y = 0.5 * t + 2.0 + 3.0 * u
    W = lambda a: np.column_stack((t, np.ones(N), a * u))
    np.testing.assert_allclose(decomposed(W(unit), y), [0.5, 2.0, 3.0 / unit], rtol=1e-9)
    part = foretold(y, W(unit), slice(0, 1), slice(0, 50))
    np.testing.assert_allclose(part, 0.5 * t[:50], rtol=1e-9)


def test_powers_of_two_reach_to_the_ends_of_the_doubles():
    x = np.array([[1.0, 3.0, 1.7976931348623157e308, 5e-324, 0.0]])
    assert powers_of_two(x, (0,)).tolist() == [1.0, 2.0, 2.0**1023, 5e-324, 1.0]
