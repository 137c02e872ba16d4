"""Limits on the input, and the largest multiple of a signal that meets them ([M] Sec. III-C)."""

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.errors import ExperimentError, InputError


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits on the input; those that are None do not bind. `power` sum over channels of the mean square, in
    squared input units (default 1); `energy` sum over channels and samples of the squares; `amplitude`
    largest absolute value, common or per channel; `channel_power` mean square of each channel, (nu,)."""

    power: float | None = 1.0
    energy: float | None = None
    amplitude: Any = None
    channel_power: Any = None

    def __post_init__(self) -> None:
        given = {name: getattr(self, name) for name in self.__dataclass_fields__}
        for name, value in given.items():
            if value is None:
                continue
            array = np.asarray(value, dtype=float)
            if not np.isfinite(array).all() or not (array > 0).all():
                raise InputError(
                    f"the limit on the input's {name} is {value}; it must be positive and finite: "
                    "no signal but zero meets it."
                )
        if all(value is None for value in given.values()):
            raise InputError(
                "no limit on the input is given; give a power, an energy or an amplitude, "
                "or the iterations grow without bound."
            )


def scaled(x: ArrayLike, limits: Limits) -> NDArray[np.float64]:
    """The largest positive multiple of a signal that meets the limits: x (N, nu) -> (N, nu)."""
    x = np.asarray(x, dtype=float)
    N = len(x)
    total = float(np.vdot(x, x)) / N
    if total == 0:
        raise ExperimentError(
            "the next input would be zero, because the measured output was; "
            "check the actuator, or start from another input."
        )
    factors = []
    if limits.power is not None:
        factors.append(sqrt(limits.power / total))
    if limits.energy is not None:
        factors.append(sqrt(limits.energy / (N * total)))
    if limits.amplitude is not None or limits.channel_power is not None:
        with np.errstate(divide="ignore"):
            factors += _channel_factors(x, limits)
    return x * min(factors)


def _channel_factors(x: NDArray[np.float64], limits: Limits) -> list[float]:
    """What the channels' own limits allow; infinite for a channel that is zero."""
    factors, nu = [], x.shape[1]
    if limits.amplitude is not None:
        peak = np.abs(x).max(axis=0)
        factors.append(float(np.min(_per_channel(limits.amplitude, nu, "amplitude") / peak)))
    if limits.channel_power is not None:
        power = np.mean(np.square(x), axis=0)
        allowed = _per_channel(limits.channel_power, nu, "channel_power")
        factors.append(float(np.min(np.sqrt(allowed / power))))
    return factors


def white_start(
    samples: int, n_inputs: int, rng: np.random.Generator, limits: Limits | None = None
) -> NDArray[np.float64]:
    """White Gaussian noise scaled to the limits (exactly unit power by default)."""
    return scaled(rng.standard_normal((samples, n_inputs)), limits or Limits())


def _per_channel(value: Any, nu: int, name: str) -> NDArray[np.float64]:
    array = np.asarray(value, dtype=float)
    if array.ndim and array.shape != (nu,):
        raise InputError(
            f"the limit {name} has shape {array.shape} for {nu} inputs; give one number or one per input."
        )
    return np.broadcast_to(array, (nu,))
