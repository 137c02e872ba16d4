"""Models side by side on a record that none of them was fitted to: a table, which can be drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.residual.measures import fit_percent, window_of
from oed.data import Record, check_sizes
from oed.errors import InputError
from oed.files.objects import as_record

if TYPE_CHECKING:
    from estimators.pem.fit import Fit

COLUMNS = ("model", "parameters", "simulation rmse", "simulation fit %", "one-step rmse", "one-step fit %")


def errors_on(fit: Fit, record: Record, *, skip: int = 0) -> dict[str, float]:
    """Errors of a fit on a record without its first `skip` samples: simulated, which they start, and one step ahead."""
    if not 0 <= skip < len(record):
        raise InputError(f"--skip {skip} of {len(record)} test samples; leave some to judge by.")
    check_sizes(record, "the record")
    y, simulated = record.y[skip:], fit.simulate_record(record, window=window_of(fit.initial, skip))[skip:]
    e = fit.residuals_of(record, initial="estimate")[skip:]
    return {
        "simulation_rmse": float(np.sqrt(np.nanmean((y - simulated) ** 2))),
        "simulation_fit_percent": fit_percent(y, simulated),
        "prediction_rmse": float(np.sqrt(np.nanmean(e**2))),
        "prediction_fit_percent": fit_percent(y, y - e),
    }


@dataclass(frozen=True, eq=False)
class Comparison:
    """Models on one record, the least simulation error first; prints itself as a table.

    Attributes
    ----------
    fits : mapping of str to Fit
        The models by name, in the rows' order.
    record : Record
        What they were compared on.
    skip : int
        Samples at its start that were not judged.
    rows : tuple of dict
        One a model: `model`, `parameters`, and its errors in the output's unit and in percent.

    Examples
    --------
    >>> Comparison({}, Record([[0.0]], [[0.0]]), 0, ())
    model  parameters  simulation rmse  simulation fit %  one-step rmse  one-step fit %
    """

    fits: Mapping[str, Fit]
    record: Record
    skip: int
    rows: tuple[dict[str, Any], ...]

    def __repr__(self) -> str:
        cells = [COLUMNS, *(tuple(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()) for row in self.rows)]  # fmt: skip
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = ["  ".join(c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths))) for row in cells]  # fmt: skip
        return "\n".join(lines)

    def plot(self) -> Any:
        """Draw measured against simulated outputs.

        Returns
        -------
        matplotlib.figure.Figure
            One panel an output.
        """
        from estimators.pem.plots import plot_compare

        return plot_compare(self.fits, self.record, window=self.skip)


def compare_models(fits: Mapping[str, Fit], record: Any, *, skip: int = 0) -> Comparison:
    """Compare identified models on a record, which none of them should have been fitted to.

    Parameters
    ----------
    fits : mapping of str to Fit
        The models by name.
    record : Record
        Or what can be read as one, in the units of the fitted records.
    skip : int, default 0
        Samples at the start that set the state of a simulation and are not judged.

    Returns
    -------
    Comparison
        `rows`, one a model with its parameters, root mean square errors in the output's unit and fit in percent, simulated and one
        step ahead, the least simulation error first; printed it is a table, `plot()` draws it.

    Raises
    ------
    InputError
        No model, another number of channels, or nothing left to judge by.

    Examples
    --------
    >>> from benchmarks.campaign.plants import hair_dryer_record
    >>> from estimators.pem import identify
    >>> first, second = hair_dryer_record()[:500], hair_dryer_record()[500:]
    >>> models = {"ARX": identify(first, "arx", (2, 2), 3), "OE": identify(first, "oe", (2, 2), 3)}
    >>> compare_models(models, second, skip=20).rows[0]["model"]
    'OE'
    """
    if not fits:
        raise InputError("there is no model to compare; give at least one, by name.")
    record = as_record(record, missing=True)
    errors = {name: errors_on(fit, record, skip=skip) for name, fit in fits.items()}
    ordered = {name: fits[name] for name in sorted(fits, key=lambda name: errors[name]["simulation_rmse"])}
    rows = ({"model": name, "parameters": len(fit.theta)} | errors[name] for name, fit in ordered.items())
    return Comparison(ordered, record, skip, tuple(rows))
