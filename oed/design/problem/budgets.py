"""Limits on powers that are linear in the spectrum: input, channels, output."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.design.problem.information_maps import InformationMap
from oed.design.problem.lines import Budget
from oed.errors import InputError

LARGEST = 1e30
"""Of a power, and one over it the smallest: the search squares what they tell, and fails from 1e60 on (see the fuzzing)."""


def power_budgets(
    information: InformationMap,
    input_power: float | None = None,
    output_power: float | None = None,
    channel_power: ArrayLike | None = None,
    rate_power: ArrayLike | None = None,
) -> tuple[Budget, ...]:
    """The budgets of a design: channel_power (nu,), rate_power (nu,)."""
    nu = information.n_inputs
    budgets = []
    if input_power is None and output_power is None and channel_power is None:
        if rate_power is not None:
            raise InputError(
                "a constant has no rate, so a limit on the rate alone leaves the power free; limit a power too."
            )
        input_power = 1.0
    if input_power is not None:
        budgets.append(
            Budget("input power", lambda w: _input_form(information, w), _limit(input_power, "input power"))
        )
    if output_power is not None:
        budgets.append(
            Budget(
                "output power", lambda w: _square(information.gain(w)), _limit(output_power, "output power")
            )
        )
    for values, what in ((channel_power, "power"), (rate_power, "rate")):
        if values is None:
            continue
        limits = np.atleast_1d(np.asarray(values, dtype=float))
        if limits.shape != (nu,):
            raise InputError(
                f"{limits.size} channel {what}s were given for {nu} input channels; give one for each."
            )
        for j, limit in enumerate(limits):
            name = f"{what} of input {j + 1}"
            form = lambda w, j=j: _input_form(information, w, j)
            if what == "rate":
                form = lambda w, j=j: (
                    _input_form(information, w, j) * (np.abs(1 - np.exp(-1j * w)) ** 2)[:, None, None]
                )
            budgets.append(Budget(name, form, _limit(limit, name)))
    return tuple(budgets)


def _limit(value: float, name: str) -> float:
    try:
        value = float(value)
    except (TypeError, ValueError):
        raise InputError(f"the {name} is {value!r}; it must be a positive number.") from None
    if not (np.isfinite(value) and value > 0):
        raise InputError(
            f"the {name} is {value}; it must be positive and finite: without power there is no design."
        )
    if not 1 / LARGEST <= value <= LARGEST:
        raise InputError(
            f"the {name} is {value:g}; it must lie between {1 / LARGEST:g} and {LARGEST:g}: choose other units."
        )
    return value


def _square(G: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return G.conj().swapaxes(1, 2) @ G


def _input_form(
    information: InformationMap, omega: NDArray, channel: int | None = None
) -> NDArray[np.complex128]:
    nu = information.n_inputs
    if information.input_gain is None:
        form = np.eye(nu) if channel is None else np.diag(np.eye(nu)[channel])
        return np.broadcast_to(form.astype(complex), (len(omega), nu, nu))
    T = information.input_gain(omega)
    return _square(T if channel is None else T[:, channel : channel + 1])
