"""Sequential optimal design: experiment, fit, redesign. Rules that know a model structure but not its values.

The optimal input depends on the plant that it is to find. `two_stage` spends a share of the experiments on white
noise, fits once and then applies the optimum for the fitted model; `sequential` redesigns after every doubling of the
data. What earlier experiments have told enters every design as prior information, so that the designs need not
determine again what is known.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.trace import Rule, Step
from oed.data import Record, Spectrum
from oed.errors import InputError, OedError

__all__ = ["sequential", "two_stage"]

Steps = Generator[Step, NDArray[np.float64], None]


def _white(samples: int, n_inputs: int, rng: np.random.Generator, power: float) -> Step:
    u = rng.standard_normal((samples, n_inputs))
    return Step(u * np.sqrt(power * samples / np.sum(u**2)), "white")


def _designed(
    records: list[Record], orders: Any, delay: Any, criterion: str, ahead: int, power: float
) -> Spectrum | None:
    """Optimal spectrum for the model fitted to the records; None where no model can be fitted or designed for."""
    from estimators.pem import identify
    from oed.design import solve_design
    from oed.information import information_of_records

    try:
        fit = identify(records, "oe", orders, delay=delay)
        plant = fit.to_plant()
        prior = information_of_records(plant, [r.u for r in records]) / ahead
        return solve_design(plant, criterion, input_power=power, prior=prior).spectrum
    except OedError:
        return None  # an unstable or unidentifiable fit: more white noise is the honest next input


def two_stage(
    orders: Any = (2, 2),
    delay: Any = 1,
    *,
    criterion: str = "hinf",
    experiments: int = 20,
    share: float = 0.2,
    power: float = 1.0,
) -> Rule:
    """White noise first, then the optimal input for the model fitted to it.

    Parameters
    ----------
    orders, delay : object
        Output-error orders (nb, nf) and delay, as for `identify`.
    criterion : str
        As for `solve_design`.
    experiments : int
        Budget, of which the first stage takes a share.
    share : float
        Share of the budget for the first stage; at least one experiment.
    power : float
        Input power of every experiment.

    Returns
    -------
    callable
        A rule for `run`.
    """
    if not 0 < share < 1:
        raise InputError(f"share is {share:g}; the first stage takes a share strictly between 0 and 1.")
    first = max(1, round(share * experiments))
    return _redesigning(orders, delay, criterion, power, lambda done: done == first, first, experiments)


def sequential(
    orders: Any = (2, 2),
    delay: Any = 1,
    *,
    criterion: str = "hinf",
    experiments: int = 20,
    power: float = 1.0,
) -> Rule:
    """White noise once, then redesign whenever the data have doubled.

    Parameters
    ----------
    orders, delay : object
        Output-error orders (nb, nf) and delay, as for `identify`.
    criterion : str
        As for `solve_design`.
    experiments : int
        Budget, which sets how far ahead each design plans.
    power : float
        Input power of every experiment.

    Returns
    -------
    callable
        A rule for `run`.
    """
    return _redesigning(orders, delay, criterion, power, lambda done: done & (done - 1) == 0, 1, experiments)


def _redesigning(
    orders: Any, delay: Any, criterion: str, power: float, due: Any, first: int, budget: int
) -> Rule:
    def rule(samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator) -> Steps:
        from oed.signals import realise

        records: list[Record] = []
        spectrum: Spectrum | None = None
        while True:
            done = len(records)
            if done >= first and (due(done) or spectrum is None):
                ahead = samples * max(budget - done, 1)
                spectrum = _designed(records, orders, delay, criterion, ahead, power)
            if spectrum is None:
                step = _white(samples, n_inputs, rng, power)
            else:
                step = Step(realise(spectrum, samples, rng=rng), "designed")
            y = yield step
            records.append(Record(step.u, y))

    return rule
