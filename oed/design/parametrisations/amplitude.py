"""Finite signals under limits on amplitude and rate: a relaxation with its bound, then the best of several realised signals.

|u_j(t)| <= a implies a power of at most a^2 in every channel; the spectrum that is optimal under these powers bounds
what any admissible signal can do (asymptotically: edge effects are not in the bound). A sinusoid reaches half of that
power, a square wave all of it, 8 / pi^2 of it in its fundamental: 1.62 times the sinusoid's. In the same way
|u_j(t) - u_j(t-1)| <= r implies a mean square of the changes of at most r^2, which is linear in the spectrum too.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.design.problem.budgets import LARGEST
from oed.design.problem.design import Design
from oed.design.solve import solve_design
from oed.errors import InputError
from oed.plants.systems import as_plant
from oed.signals.synthesis import Realised, binary, crest_factor, multisine


def amplitude_design(
    plant: Any,
    criterion: str | Criterion,
    amplitude: float,
    N: int,
    rng: np.random.Generator,
    *,
    rate: float | None = None,
    input_power: float | None = None,
    tries: int = 4,
    **options: Any,
) -> tuple[Design, Realised]:
    """A signal of N samples within an amplitude limit, and the bound that no such signal can pass.

    Parameters
    ----------
    plant : Plant
        The plant.
    criterion : str or Criterion
        As for `solve_design`.
    amplitude : float
        Largest absolute input of every channel.
    N : int
        Number of samples.
    rng : numpy.random.Generator
        For phases.
    rate : float, optional
        Largest absolute change of every channel from one sample to the next; the signal starts from rest, so its
        first sample is a change too.
    input_power : float, optional
        Limit on the power too.
    tries : int
        Multisines and binary signals that are tried; the one of least loss is returned.
    **options : object
        As for `solve_design`.

    Returns
    -------
    design : Design
        The relaxation.
    realised : Realised
        The signal, its loss with edge effects, and the relaxation's bound.
    """
    from oed.information import information_of_signal

    plant = as_plant(plant)
    channels = np.full(plant.n_inputs, _power("amplitude", amplitude))
    if rate is not None and not rate >= 2 * amplitude:  # a larger one limits nothing
        options["rate_power"] = np.full(plant.n_inputs, _power("rate", rate))
    design = solve_design(plant, criterion, input_power=input_power, channel_power=channels, **options)
    best: Realised | None = None
    for _ in range(max(1, tries)):
        smooth = multisine(design.spectrum, N, rng)
        # Between multisine and square wave: a multisine clipped hard keeps more power than one scaled down.
        hard = [binary(design.spectrum, N, rng, amplitude=amplitude)]
        hard += [np.clip(gain * smooth, -amplitude, amplitude) for gain in (1.0, 2.0)]
        if rate is not None:
            hard = [slew_limited(u, rate) for u in hard]
        signals = [within(smooth, amplitude, rate)]
        for u in hard:
            power = float(np.sum(u**2)) / N
            signals.append(u if input_power is None else u * min(1.0, np.sqrt(input_power / power)))
        for u in signals:
            loss = design.criterion.loss(information_of_signal(plant, u) / N + design.map.constant)
            if best is None or loss < best.loss:
                best = Realised(u, loss, design.loss, design.bound, float(np.sum(u**2)) / N, crest_factor(u))
    if best is None:
        raise InputError("no signal was tried; ask for at least one try.")
    return design, best


def within(u: NDArray[np.float64], amplitude: float, rate: float | None = None) -> NDArray[np.float64]:
    """A signal as it is, or as small as its limits ask for: u (N, nu) -> (N, nu)."""
    factor = amplitude / np.abs(u).max()
    if rate is not None:
        factor = min(factor, rate / np.abs(np.diff(u, axis=0, prepend=0.0)).max())
    return u * min(1.0, factor)


def slew_limited(u: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Follow a signal as fast as a rate limit allows, from rest: u (N, nu) -> (N, nu)."""
    out, last = np.empty_like(u), np.zeros(u.shape[1])
    for t, wanted in enumerate(u):
        last = last + np.clip(wanted - last, -rate, rate)
        out[t] = last
    return out


def _power(name: str, limit: float) -> float:
    """The most power that a limit on every sample leaves."""
    if not (np.isfinite(limit) and limit > 0):
        raise InputError(f"the {name} is {limit}; it must be positive and finite.")
    power = float(limit) * float(limit)  # a product overflows to infinity where a power of Python's raises
    if not 1 / LARGEST <= power <= LARGEST:
        most = LARGEST**0.5
        raise InputError(
            f"the {name} is {limit:g}; it must lie between {1 / most:g} and {most:g}: choose other units."
        )
    return power
