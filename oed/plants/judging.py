"""A model that somebody already has, beside the ones that a diagnosis fits: its orders, and its error on a record."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.data import Record
from oed.errors import InputError
from oed.plants.plant import Plant
from oed.plants.realisations import n_states, state_space

LEAST, PER_STATE = 20, 3
"""Samples at least, and for every state and the level, to which what a run begins with is fitted; they are not judged."""


def orders_of(plant: Plant) -> tuple[int, ...]:
    """The largest order of a transfer function to each output; poles at zero are delay."""
    return tuple(max(int(np.max(np.flatnonzero(den))) for den in row) for row in plant.den)


def errors_of(plant: Plant, record: Record) -> NDArray[np.float64]:
    """Root mean square of measured minus simulated, per output, without the samples at the start.

    Initial state and level of the output are fitted to those; the level of the input is then no matter, since the model
    answers a constant by a constant and by its own free motion.
    """
    if (plant.n_inputs, plant.n_outputs) != (record.n_inputs, record.n_outputs):
        raise InputError(
            f"the model has {plant.n_inputs} inputs and {plant.n_outputs} outputs, the record {record.n_inputs} and "
            f"{record.n_outputs}; give the model of this system."
        )
    n = n_states(plant)
    window = max(LEAST, PER_STATE * (n + 1))
    if len(record) <= 2 * window:
        raise InputError(f"{len(record)} samples are too few to judge a model of {n} states by; give more than {2 * window}.")  # fmt: skip
    A, _, C, _ = state_space(plant)
    free, state = np.empty((len(record), plant.n_outputs, n)), np.eye(n)
    for row in free:
        row[:], state = C @ state, A @ state
    left = record.y - plant.simulate(record.u)
    found: list[Any] = []
    for i in range(plant.n_outputs):
        basis = np.column_stack([free[:, i], np.ones(len(record))])
        there = np.isfinite(left[:window, i])
        start = np.linalg.lstsq(basis[:window][there], left[:window, i][there], rcond=None)[0]
        found.append(np.sqrt(np.nanmean((left[:, i] - basis @ start)[window:] ** 2)))
    return np.array(found)
