"""Figure of the autocorrelation parametrisation: how fast a finite moving average nears the optimum."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from oed.design.plots import axes_or_new


def plot_autocorrelation(
    model: Any, criterion: str = "D", lags: Sequence[int] = (4, 8, 16, 24, 32, 48), axes: Axes | None = None
) -> Any:
    """How fast the best finite moving average nears the optimum over all spectra."""
    from oed.design.parametrisations.autocorrelation import autocorrelation_design
    from oed.design.solve import solve_design

    axes = axes_or_new(axes)
    bound = solve_design(model, criterion).bound
    excess = [autocorrelation_design(model, criterion, lags=int(L)).loss / bound - 1 for L in lags]
    axes.loglog(list(lags), excess, "o-", label="best moving average")
    axes.loglog(list(lags), excess[0] * lags[0] / np.asarray(lags, dtype=float), ":", label="1 / lags")
    axes.set_xlabel("lags")
    axes.set_ylabel(f"loss ({criterion}) above the certified optimum, relative")
    axes.legend()
    return axes
