"""Prediction-error identification: every parameter with its standard error.

    from estimators.pem import identify
    fit = identify(record, "oe", (2, 2), delay=3)
    fit                                    # prints the parameters with their standard errors
    fit.hinf_norm                          # (value, standard error, frequency)

`identify(records, structure="oe", orders=(2, 2), delay=1, *, diagonal=False, offset=True,
initial=None, start=None, ...) -> Fit`

- `records`: one `oed.data.Record` or a list of them (several experiments, one model); a pandas DataFrame, an
  xarray Dataset or a control TimeResponseData will do as well.
- `structure`, `orders`: fir nb; arx na nb; armax na nb nc; oe nb nf; bj nb nc nd nf; ss n. Each order is a
  number, or for MIMO one per entry (ny, nu); `diagonal=True` lets input i drive output i alone and takes
  one order per channel. `delay` is nk (number or (ny, nu)), 1 by default.
- `offset`: the model holds for deviations from levels: the input's is its mean, the output's is estimated. False for
  signals that are deviations already, such as simulated ones.
- `initial`: "zero" (at rest before the first sample), "estimate", "backcast"; per experiment. By default estimated,
  and zero with `offset=False`.
- `start`: parameters to start from; otherwise several starts are tried and the best optimum is kept
  (`search`: auto, quick, thorough).
- `fixed`, `bounds`, `prior`: by parameter name. `constraints`: CasADi expressions of the parameters. `robust`: "huber" or "student". `prefilter`: (num, den).
  `missing=True`: NaN in the outputs marks missing samples. `regularisation`: "tc", "dc" or "ss", a kernel for the taps of
  fir, with `disturbance` "ar1" or "walk". `method`, of ss: "moesp", "n4sid" or "cva", subspace methods, with `horizon`.

`Fit` (frozen): `model` (`oed.models.model.Model`), `theta`, `names`, `covariance`, `standard_errors`,
`noise_variance`, `noise_covariance`, `loss`, `fit_percent` (one step ahead), `simulation_fit_percent`, `aic`, `bic`, `status`, `residuals` (list of
(N, ny)), `iterations`, `hinf_norm`, `subspace`, `input_level`, `output_level`; verbs `simulate(u)`, `predict(record)`,
`simulate_record(record, window=n)`, `residuals_of(record)`, `linearised(record)`, `to_plant()`, `to_dict()`.

`identify_response`: the same of a measured frequency response, its lines weighted by their variance; a `ResponseFit`.

Beside it: `pem.uncertainty` (sandwich, profile_interval, bode_band, step_band, pole_covariances), `pem.greybox`
(physically parametrised models), `pem.plots`, `estimators.residual.tests`, `estimators.pem.choice`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from oed.lazily import exporting

if TYPE_CHECKING:
    from estimators.pem.estimation import identify
    from estimators.pem.fit import Fit
    from estimators.pem.frequency_response import ResponseFit, identify_response

__all__ = ["Fit", "ResponseFit", "identify", "identify_response"]

__getattr__, __dir__ = exporting(__name__, {
    "estimators.pem.fit": "Fit",
    "estimators.pem.frequency_response": "ResponseFit identify_response",
    "estimators.pem.estimation": "identify",
})  # fmt: skip
