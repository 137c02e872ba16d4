"""The sequential methods that a session can run, each as a rule for `estimators.rules.trace`."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from estimators.rules.limits import Limits
from estimators.rules.trace import Rule
from estimators.sessions.settings import Settings
from oed.errors import InputError

FROM_REST = ("two-stage", "sequential", "diagnose-next")


def rule_of(settings: Settings, known: Sequence[NDArray[np.float64]] = ()) -> Rule:
    """The rule of a session's method."""
    if settings.method in FROM_REST and settings.periodic:
        raise InputError(
            f"the method {settings.method} fits models to experiments from rest; use one period and no warm-up."
        )
    if settings.method == "power":
        from estimators.rules.power import power_iterations

        return partial(power_iterations, limits=_limits(settings))
    if settings.method == "procedure-2":
        from estimators.rules.procedure2 import procedure_2

        return partial(procedure_2, limits=_limits(settings), scaling=settings.scaling)
    power = nominal_power(settings)
    if settings.method == "bandit":
        from estimators.rules.bandit import thompson_sampling

        return partial(thompson_sampling, power=power)
    if settings.method == "diagnose-next":
        from estimators.sessions.proposals import diagnose_next

        amplitude = settings.amplitude[0] if settings.amplitude else 3 * float(np.sqrt(power))
        return partial(diagnose_next, power=power, amplitude=amplitude, seed=settings.seed, known=known)
    from estimators.rules import adaptive

    make = adaptive.two_stage if settings.method == "two-stage" else adaptive.sequential
    return make(
        settings.entry_orders, settings.delay, criterion=settings.criterion, experiments=settings.experiments, power=power
    )  # fmt: skip


def _limits(settings: Settings) -> Limits:
    """What the iterations scale their inputs to; what they do not know of, the session scales down to."""
    energy = None
    if settings.energy is not None:
        energy = sum(settings.energy) / (settings.periods + settings.warm_up)
    return Limits(power=settings.power, amplitude=settings.amplitude, energy=energy)


def nominal_power(settings: Settings) -> float:
    """Power of the inputs of methods that know of no other limit."""
    if settings.power is not None:
        return settings.power
    if settings.amplitude is not None:
        return float(np.sum(np.square(settings.amplitude)))
    total = settings.samples * (settings.periods + settings.warm_up)
    return float(np.sum(settings.energy or (1.0,))) / total
