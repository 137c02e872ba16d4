"""Limits that protect a rig: what an input is checked against before anybody sees it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from estimators.sessions.settings import Settings
from oed.errors import InputError

__all__ = ["check_input", "fitting_factor"]

ROUNDING = 1e-9


def check_input(u: NDArray[np.float64], settings: Settings) -> None:
    """Raise if a rig's input violates a limit, naming the limit, the channel and the sample.

    Shapes: u (samples, nu).
    """
    if not np.isfinite(u).all():
        raise InputError("the input has samples that are not finite; nothing was written.")
    for name, unit, values, limits in _demands(u, settings):
        over = values.max(axis=0) > np.asarray(limits) * (1 + ROUNDING)
        if over.any():
            j = int(np.argmax(over))
            t = int(np.argmax(values[:, j]))
            where = "" if name == "energy" else f" at sample {t}"
            raise InputError(
                f"the input violates the limit {name} of {settings.inputs[j]}: {values[t, j]:.6g}{where}, allowed are "
                f"{limits[j]:.6g} {unit}; lower the power or widen the limit. Nothing was written."
            )


def fitting_factor(u: NDArray[np.float64], settings: Settings) -> tuple[float, str]:
    """By what the deviation from the levels must be multiplied so that every limit is met.

    Shapes: u (samples, nu).
    """
    factor, binding = 1.0, ""
    for name, _, values, limits in _demands(u, settings):
        largest = values.max(axis=0)
        for j, limit in enumerate(limits):
            if largest[j] > limit * (1 + ROUNDING):
                share = limit / largest[j]
                share = float(np.sqrt(share)) if name == "energy" else float(share)
                if share < factor:
                    factor, binding = share, f"{name} of {settings.inputs[j]}"
    return factor, binding


def _demands(
    u: NDArray[np.float64], settings: Settings
) -> Iterator[tuple[str, str, NDArray[np.float64], tuple[float, ...]]]:
    """Name, unit, values (rows, nu) and limit per channel of every limit that is set."""
    level = np.asarray(settings.level)
    deviation = u - level
    if settings.amplitude is not None:
        yield "amplitude", "about the level", np.abs(deviation), settings.amplitude
    if settings.rate is not None:  # the rig is at its level before and after
        around = np.vstack([level, u, level])
        yield "rate", "per second", np.abs(np.diff(around, axis=0)) / settings.dt, settings.rate
    if settings.energy is not None:
        yield "energy", "in all", np.sum(np.square(deviation), axis=0)[None, :], settings.energy
