"""Prediction-error identification: every parameter with its standard error.

    from estimators.pem import identify
    fit = identify(record, "oe", (2, 2), delay=3)
    fit                                    # prints the parameters with their standard errors
    fit.hinf_norm                          # (value, standard error, frequency)

`identify(records, structure="oe", orders=(2, 2), delay=1, *, diagonal=False, offset=True,
initial=None, start=None, ...) -> Fit`

A `Fit` holds the model (`oed.models.model.Model`) with its uncertainty and answers `simulate`, `predict`, `simulate_record`,
`residuals_of`, `linearised`, `to_plant`. `identify_response` does the same of a measured frequency response, its lines
weighted by their variance. Beside them: `pem.uncertainty` (sandwich, profile_interval, bode_band, step_band,
pole_covariances), `pem.greybox` (physically parametrised models), `pem.plots`, `pem.choice`, `estimators.residual.tests`.
"""

from typing import TYPE_CHECKING

from oed.lazily import exporting

if TYPE_CHECKING:
    from estimators.pem.estimation import identify
    from estimators.pem.fit import Fit
    from estimators.pem.frequency_response import ResponseFit, identify_response

__all__ = ["Fit", "ResponseFit", "identify", "identify_response"]

__getattr__, __dir__ = exporting(__name__)
