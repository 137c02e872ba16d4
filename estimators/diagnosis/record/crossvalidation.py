"""Blocked cross-validation, where no test record is given: each block is simulated by a fit that did not see it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Slot
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.simulation import simulate

__all__ = ["BLOCKS", "blocked_simulation"]

Array = NDArray[Any]
BLOCKS = 4


def blocked_simulation(channel: Channel, f: Fit, *, blocks: int = BLOCKS) -> Array:
    """Simulated output in which every block comes from parameters fitted to the other blocks.

    Parameters
    ----------
    channel : Channel
        Data.
    f : Fit
        A model of it; its structure and noise model are kept, its parameters are fitted again for every block.
    blocks : int
        Number of blocks, consecutive and of equal length.

    Returns
    -------
    ndarray
        (N,) simulated output; infinite in a block whose fit failed.

    Notes
    -----
    The simulation runs through the whole record, so that no block needs an initial state of its own; the record's
    is that of the fit to all blocks, as no other block says anything of it. The
    structure was chosen on all of the record: the error says how well the parameters carry over, and is a
    little too good where many structures were tried.
    """
    n = len(channel)
    out = np.full(n, np.inf)
    scales = f.scales.copy()
    for part, sl in zip(f.structure.parts, f.structure.slices(), strict=True):
        if part.effect.slot is Slot.START:
            scales[sl] = 0.0
    for rows in np.array_split(np.arange(n), blocks):
        keep = channel.keep.copy()
        keep[rows] = False
        g = fit(
            replace(channel, keep=keep),
            f.structure,
            f.p,
            scales,
            noise=f.noise,
            iterations=15,
            colour=False,
        )
        if np.isfinite(g.deviance):
            out[rows] = simulate(g.structure, g.p, channel.u, channel.clock)[rows]
    return out
