"""A linear part made anew for a shape of an effect: the linear model's poles stand for the effect too."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def remade(channel: Any, structure: Any, p: Array) -> tuple[float, Array]:
    """(sum of squares, parameters) with poles and numerators made for the shape that the parameters end with; infinite where no poles are
    stable."""
    from estimators.diagnosis.model.linear import fresh_poles, relinearised
    from estimators.diagnosis.model.simulation import acted, simulate
    from estimators.diagnosis.model.structure import stable_polynomial

    p, order = p.copy(), structure.order
    if (U := acted(structure, p, channel.u, channel.clock)) is not None and np.all(np.isfinite(U)):
        p[:order] = fresh_poles(channel.y, U, replace(structure, parts=()), channel.keep, begun=True)
        if stable_polynomial(p[:order]) and (q := relinearised(channel, structure, p)) is not None:
            error = channel.y - simulate(structure, q, channel.u, channel.clock)
            return float(np.sum(error[channel.keep] ** 2)), q
    return np.inf, p
