"""Finite signals under an amplitude limit: a relaxation with its bound, then the best of several realised signals.

|u_j(t)| <= a implies a power of at most a^2 in every channel; the spectrum that is optimal under these powers bounds
what any admissible signal can do (asymptotically: edge effects are not in the bound). A sinusoid reaches half of that
power, a square wave all of it, 8 / pi^2 of it in its fundamental: 1.62 times the sinusoid's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from oed.criteria import Criterion
from oed.design.result import Design
from oed.design.solve import solve_design
from oed.errors import InputError
from oed.signals import Realised, binary, crest_factor, multisine

__all__ = ["amplitude_design"]


def amplitude_design(
    plant: Any,
    criterion: str | Criterion,
    amplitude: float,
    N: int,
    rng: np.random.Generator,
    *,
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

    if not (np.isfinite(amplitude) and amplitude > 0):
        raise InputError(f"the amplitude is {amplitude}; it must be positive and finite.")
    channels = np.full(plant.n_inputs, float(amplitude) ** 2)
    design = solve_design(plant, criterion, input_power=input_power, channel_power=channels, **options)
    best: Realised | None = None
    for _ in range(max(1, tries)):
        smooth = multisine(design.spectrum, N, rng)
        signals = [smooth * min(1.0, amplitude / np.abs(smooth).max())]
        square = binary(design.spectrum, N, rng, amplitude=amplitude)
        power = float(np.sum(square**2)) / N
        signals.append(square if input_power is None else square * min(1.0, np.sqrt(input_power / power)))
        # Between the two: a multisine clipped hard keeps more power than one scaled down.
        clipped = np.clip(2 * smooth, -amplitude, amplitude)
        power = float(np.sum(clipped**2)) / N
        signals.append(clipped if input_power is None else clipped * min(1.0, np.sqrt(input_power / power)))
        for u in signals:
            loss = design.criterion.loss(information_of_signal(plant, u) / N + design.map.constant)
            if best is None or loss < best.loss:
                best = Realised(u, loss, design.loss, design.bound, float(np.sum(u**2)) / N, crest_factor(u))
    if best is None:
        raise InputError("no signal was tried; ask for at least one try.")
    return design, best
