"""Two inputs that meet behind lags of their own: the compiled loops against fine steps, what is found, and where nothing is looked for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.effects.input.meeting import MEETING, PROMISED, _promises, lost_by
from estimators.diagnosis.effects.kernels.meeting_kernels import at_rest, growth
from estimators.diagnosis.model.fitting import Channel
from estimators.diagnosis.model.linear import fit_linear
from estimators.diagnosis.model.structure import Structure
from tests.estimators.diagnosis.test_diagnosis_classes import fits

FINEST = 400


def _levels(seed: int) -> np.ndarray:
    """(60, 2) steps that both inputs make, about a level."""
    return np.repeat(np.random.default_rng(seed).uniform(2.0, 4.0, (5, 2)), 12, axis=0)


@pytest.mark.parametrize("power", [1.0, 2.0, 0.0, -1.0, 0.5])
def test_a_growth_has_its_slope_at_the_centre_by_any_law(power):
    assert growth(0.0, 0.7, power) == pytest.approx(1.0)
    assert (growth(1e-6, 0.7, power) - growth(-1e-6, 0.7, power)) / 2e-6 == pytest.approx(0.7, rel=1e-6)
    assert growth(0.3, 0.7, 1e7) == pytest.approx(growth(0.3, 0.7, 0.0), rel=1e-6)


@pytest.mark.parametrize("power", [1.0, 2.0, 0.0, -1.0])
def test_a_product_of_lags_is_the_mean_over_each_sample_of_fine_steps(power):
    u, level, lags, slope, centre = _levels(1), 0.4, (1.7, 5.0), 0.3, 2.9
    w, v, out = *u[0], []
    for one, two in u:
        total = 0.0
        for _ in range(FINEST):
            w, v = w + (one - w) / lags[0] / FINEST, v + (two - v) / lags[1] / FINEST
            total += (w - level) * float(growth(v - centre, slope, power)) / FINEST
        out.append(total)
    p = np.array([level, *lags, slope, 2.0, centre, power])
    found = named("product_of_lags").signal(u, 0, p, Clock(np.arange(60.0), 60))  # pyright: ignore[reportOptionalCall]
    np.testing.assert_allclose(found, out, atol=0.01)


@pytest.mark.parametrize(
    ("share", "rise", "power", "drive"), [(0.6, 0.5, 0.0, 0.0), (1.0, 0.0, 1.0, 2.0), (1.0, 0.0, 1.0, 1.0)]
)
def test_a_loss_by_a_lag_ends_each_sample_where_fine_steps_do(share, rise, power, drive):
    """Of a reaction that heats itself, the other input's lag is raised by what is lost."""
    u, rate, level, lags, slope, centre = _levels(2), 0.2, -0.3, (1.7, 5.0), 0.4, 2.9
    p = np.array([rate, level, *lags, slope, share, rise, 2.0, centre, power, drive])
    w, (x, v), out = u[0, 0], at_rest(u[0, 0] - level, u[0, 1], lost_by(p)), []
    for one, two in u:
        for _ in range(FINEST):
            s = max(float(growth(v - centre, slope, power)), 0.0)
            w += (one - w) / lags[0] / FINEST
            v += (two + rise * s * x - v) / lags[1] / FINEST
            x += rate * (s**drive * (w - level) - (1.0 - share + share * s) * x) / FINEST
        out.append(x)
    found = named("loss_by_lag").signal(u, 0, p, Clock(np.arange(60.0), 60))  # pyright: ignore[reportOptionalCall]
    np.testing.assert_allclose(found, out, atol=0.01)
    at_once = named("loss_by_lag").signal(u[:12], 0, p, Clock(np.arange(12.0), 12))  # pyright: ignore[reportOptionalCall]
    np.testing.assert_allclose(at_once, at_once[0], rtol=1e-9)  # it rests under the first inputs


def test_the_lags_and_the_slope_of_a_product_are_those_of_its_rig():
    """A rudder behind a servo of 2.5 samples, in a stream of 14: the square of 1 + .4 (v - 3)."""
    f = fits("product_of_lags", "product_of_lags")[0][0]
    _, lag, other, slope, which, centre, power = f.p[f.structure.slices()[-1]]
    assert (f.structure.parts[-1].channel, which, power) == (0, 2.0, 2.0)
    assert (abs(lag), abs(other)) == pytest.approx((1 / 0.4, 1 / 0.07), rel=0.05)
    assert slope == pytest.approx(2.0 * 0.4 / (1.0 + 0.4 * (centre - 3.0)), rel=0.03)


def test_the_slope_of_a_reaction_is_that_of_its_rig():
    f = fits("loss_by_lag", "loss_by_lag")[0][0]
    rate, _, _, other, slope, share = f.p[f.structure.slices()[-1]][:6]
    assert slope == pytest.approx(0.6, rel=0.05)
    assert abs(other) == pytest.approx(1 / 0.09, rel=0.05)
    assert rate * (1.0 - share) == pytest.approx(0.08, rel=0.05)


@pytest.mark.parametrize("inputs", [1, 2])
def test_nothing_is_looked_for_with_one_input_or_where_a_linear_model_leaves_no_product(inputs, rng):
    """Two lags of 2 and 20 samples that add up: chance over the lags that are tried stays below what is asked for."""
    u, x, y = rng.standard_normal((1200, inputs)), np.zeros(inputs), []
    for now in u:
        y.append(x.sum() + 0.02 * rng.standard_normal())
        x += (now - x) / np.array([2.0, 20.0])[:inputs]
    channel = Channel(u, np.array(y), Clock(np.arange(1200.0), 1200), np.ones(1200, dtype=bool))
    base = fit_linear(channel, Structure(2, tuple(range(inputs))))
    for effect in MEETING:
        search = effect.search or pytest.fail(f"{effect.key} has no search of its own")
        assert not list(search(channel, base, ()))


def test_two_inputs_that_meet_at_once_promise_nothing_of_lags(rng):
    """A thrust through an angle, before a plant that lags: a product with a bent input, which has names of its own."""
    u = np.repeat(rng.uniform(0.2, 1.4, (100, 2)), 12, axis=0)
    y = lfilter([0.0, 0.1], [1.0, -0.9], u[:, 0] * np.cos(u[:, 1])) + 0.005 * rng.standard_normal(1200)
    channel = Channel(u, np.asarray(y), Clock(np.arange(1200.0), 1200), np.ones(1200, dtype=bool))
    assert _promises(channel, fit_linear(channel, Structure(2, (0, 1))), 0, 1) < 0.25 * PROMISED
    late = np.column_stack((u[:, 0], lfilter([0.1], [1.0, -0.9], u[:, 1])))
    y = lfilter([0.0, 0.1], [1.0, -0.9], late[:, 0] * np.cos(late[:, 1])) + 0.005 * rng.standard_normal(1200)
    channel = replace(channel, y=np.asarray(y))
    assert _promises(channel, fit_linear(channel, Structure(2, (0, 1))), 0, 1) > 2.0 * PROMISED


@pytest.mark.parametrize(("key", "size"), [("product_of_lags", 7), ("loss_by_lag", 11)])
def test_a_fit_that_has_lost_its_numbers_is_not_admitted(key, size):
    """A room with a wall's mass: a fit ended without numbers, and no input has none for its own."""
    out = named(key).signal(_levels(3), 0, np.full(size, np.nan), Clock(np.arange(60.0), 60))  # pyright: ignore[reportOptionalCall]
    assert np.all(np.isinf(out))
