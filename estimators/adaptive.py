"""Sequential optimal design: experiment, fit, redesign. Rules that know a model structure but not its values.

The optimal input depends on the plant that it is to find. `two_stage` spends a share of the experiments on white
noise, fits once and then applies the optimum for the fitted model; `sequential` redesigns again and again. What
earlier experiments have told enters every design as prior information, so that the designs need not determine again
what is known. For the peak gain `sequential` hedges: the optimum for a known plant is one sinusoid at the peak, which
tells nothing about whether the peak is elsewhere; it applies the mean of the optima of plants drawn from what is known
so far, a multisine as wide as the peak is uncertain.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.trace import Rule, Step
from oed.data import Record, Spectrum
from oed.errors import InputError, OedError
from oed.plants import Plant

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
    draws: int = 32,
    inflation: float = 3.0,
) -> Rule:
    """White noise once, then redesign after 1, 2, 3, 4, 6, 8, 12, 16, 24, ... experiments.

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
    draws : int
        Plants drawn for the mean of their optima, for the criterion "hinf"; 0 designs for the fitted plant alone.
    inflation : float
        How many times the standard errors of the fit the draws are spread: the asymptotic covariance of a fit to few data
        is too small, and a design that is too narrow cannot correct itself.

    Returns
    -------
    callable
        A rule for `run`.

    Notes
    -----
    Optimal for the peak gain is the sinusoid at the peak in the direction of the largest singular value (gain-scaling
    theorem, `oed.theory.claim`); the mean of these sinusoids over the posterior is the design that is best on average to
    first order where the posterior is wide.
    """
    if draws < 0 or not inflation > 0:
        raise InputError(f"draws is {draws} and inflation {inflation:g}; give draws >= 0 and inflation > 0.")
    hedge = (draws, inflation) if draws and criterion == "hinf" else None
    return _redesigning(orders, delay, criterion, power, _twos_and_threes, 1, experiments, hedge)


def _twos_and_threes(done: int) -> bool:
    """Whether a number is a power of two, or three times one."""
    return any(done == factor * 2**k for factor in (1, 3) for k in range(done.bit_length()))


def _hedged(
    records: list[Record],
    orders: Any,
    delay: Any,
    power: float,
    hedge: tuple[int, float],
    rng: np.random.Generator,
) -> Spectrum | None:
    """Mean of the optimal sinusoids of plants drawn from the fit, on the lines of an experiment."""
    from estimators.pem import identify
    from oed.information import information_of_records

    draws, inflation = hedge
    try:
        plant = identify(records, "oe", orders, delay=delay).to_plant()
        information = information_of_records(plant, [r.u for r in records])
        root = inflation * np.linalg.cholesky(np.linalg.inv(information))
    except (OedError, np.linalg.LinAlgError):
        return None  # as in _designed
    lines = 2 * np.pi * np.arange(1, (len(records[0]) - 1) // 2 + 1) / len(records[0])
    found: dict[int, NDArray[np.complex128]] = {}
    kept = 0
    for _ in range(8 * draws):
        try:
            drawn = plant.with_theta(plant.theta + root @ rng.standard_normal(len(root)))
        except InputError:
            continue  # an unstable plant is none that could be measured: drawn again
        k, direction = _peak_line(drawn, lines)
        found[k] = found.get(k, 0) + power * np.outer(direction, direction.conj())
        kept += 1
        if kept == draws:
            break
    if not kept:
        return None
    chosen = sorted(found)
    return Spectrum(lines[chosen], np.array([found[k] / kept for k in chosen]))


def _peak_line(plant: Plant, lines: NDArray[np.float64]) -> tuple[int, NDArray[np.complex128]]:
    """Line with the largest gain, and the input direction there."""
    G = plant.response(lines)[0]
    if G.shape[1:] == (1, 1):
        return int(np.argmax(np.abs(G[:, 0, 0]))), np.ones(1, dtype=complex)
    _, s, vh = np.linalg.svd(G)
    k = int(np.argmax(s[:, 0]))
    return k, vh[k, 0].conj()


def _redesigning(
    orders: Any,
    delay: Any,
    criterion: str,
    power: float,
    due: Any,
    first: int,
    budget: int,
    hedge: tuple[int, float] | None = None,
) -> Rule:
    def rule(samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator) -> Steps:
        from oed.signals import realise

        records: list[Record] = []
        spectrum: Spectrum | None = None
        while True:
            done = len(records)
            if done >= first and (due(done) or spectrum is None):
                ahead = samples * max(budget - done, 1)
                if hedge:
                    spectrum = _hedged(records, orders, delay, power, hedge, rng)
                else:
                    spectrum = _designed(records, orders, delay, criterion, ahead, power)
            if spectrum is None:
                step = _white(samples, n_inputs, rng, power)
            else:
                step = Step(realise(spectrum, samples, rng=rng), "designed")
            y = yield step
            records.append(Record(step.u, y))

    return rule
