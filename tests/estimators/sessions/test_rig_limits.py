"""Limits that protect a rig: met by scaling, named where violated; an abort halves what follows."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.sessions import FlaggedMeasurement, Session, Settings
from estimators.sessions.checking import check_input, fitting_factor
from oed.errors import InputError
from oed.experiments import simulated
from oed.plants.named import named_plant

TWO = {
    "method": "procedure-2",
    "samples": 50,
    "dt": 0.1,
    "inputs": ("a", "b"),
    "outputs": ("p", "q"),
    "power": 9.0,
}
LIMITS = {"amplitude": (1.5, 0.5), "rate": (4.0, 30.0), "energy": (5.0, 2.0)}


def used(name: str, u: np.ndarray, dt: float) -> np.ndarray:
    """Each limit's quantity by its definition, the rig at rest before and after."""
    around = np.vstack([0 * u[:1], u, 0 * u[:1]])
    return {
        "amplitude": np.abs(u).max(axis=0),
        "rate": np.abs(around[1:] - around[:-1]).max(axis=0) / dt,
        "energy": (u**2).sum(axis=0),
    }[name]


@pytest.mark.parametrize("names", [("amplitude",), ("rate",), ("energy",), ("amplitude", "rate", "energy")])
@pytest.mark.parametrize("ramp", [0, 8])
def test_every_input_meets_every_limit_and_the_largest_possible(names, ramp):
    settings = Settings(**TWO, **{name: LIMITS[name] for name in names}, ramp=ramp, experiments=12, rest=4)
    session = Session(settings)
    rig = simulated(named_plant("avis", 0.01), seed=2)
    tight = 0
    while session.step:
        u = session.ask()
        shares = [used(name, u, 0.1) / LIMITS[name] for name in names]
        assert max(map(np.max, shares)) <= 1 + 1e-8
        tight += max(map(np.max, shares)) > 0.95
        session.tell(rig(u))
    assert tight >= 3 if ramp == 0 else tight >= 0
    assert np.isfinite(session.estimate().value)


@pytest.mark.parametrize("name", LIMITS)
def test_the_violated_limit_is_named(name):
    settings = Settings(**TWO, **{name: LIMITS[name]})
    u = np.random.default_rng(0).standard_normal((50, 2)) * 5
    with pytest.raises(InputError, match=f"violates the limit {name} of a"):
        check_input(u, settings)
    factor, limit = fitting_factor(u, settings)
    assert limit.startswith(name)
    check_input(factor * u, settings)
    with pytest.raises(InputError, match=name):
        check_input(1.001 * factor * u, settings)


def test_limits_are_about_the_level():
    settings = Settings(
        "power", samples=100, amplitude=20.0, level=(50.0,), centre=True, experiments=3, rest=3
    )
    session = Session(settings)
    plant = named_plant("reference", 0.01)
    while session.step:
        u = session.ask()
        assert 30 - 1e-9 <= u.min() < u.max() <= 70 + 1e-9
        assert (u[-3:] == 50).all()
        session.tell(7 + plant.simulate(u - 50) + 0.01 * np.sin(np.arange(103.0))[:, None])
    assert session.estimate().value == pytest.approx(2.41, rel=0.05)


def test_an_abort_halves_this_input_and_those_that_follow():
    plant = named_plant("reference", 0.0)
    quiet, loud = (Session(Settings("power", samples=120, abort=a, experiments=4)) for a in (100.0, 2.0))
    quiet.run(plant.simulate)
    reductions, said = 0, []
    while loud.step:
        try:
            loud.tell(plant.simulate(loud.ask()))
        except FlaggedMeasurement as flagged:
            said.append(str(flagged))
            before = loud.ask()
            loud.reduce()
            np.testing.assert_allclose(loud.ask(), before / 2)
            reductions += 1
    assert reductions >= 1
    assert all("abort level 2" in sentence for sentence in said)
    for record in loud.rig_records:
        assert np.abs(record.y).max() <= 2
    # the system is linear and there is no noise: the estimate does not know that inputs were halved
    assert loud.estimate().gains[1:] == pytest.approx(quiet.estimate().gains[1:], rel=1e-9)
    # (the local model is an approximation, and weighs the halved records less: that moves it by some 1e-5)
    assert loud.estimate().value == pytest.approx(quiet.estimate().value, rel=1e-4)
