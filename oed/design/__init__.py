"""Optimal inputs by convex optimisation, each with a certificate that is computed here.

The public verb:

    solve_design(model, criterion="D", *, input_power=None, output_power=None, channel_power=None,
                 band=None, points=400, prior=None, solver="newton", refine=True, tolerance=1e-7) -> Design

A `Design` holds the spectrum, its loss per sample at the stated power and the plant's own noise, and a `Certificate`, computed
here: no admissible spectrum has a smaller loss than `bound`.

Beside it: `robust_design` (several plants: average, minimax; D, A, E, c), `quantile_design` (most of them), `least_power_design` and `application_criterion`,
`closed_loop_map` (the reference of a loop with a known controller), `masked_design` (limits per frequency),
`amplitude_design` (finite signals within an amplitude and a rate), `moment_design` and `autocorrelation_design` (other
parametrisations, by CVXPY), `basis_design` and `autoregressive_design` (spectra of a given shape). Figures are in `oed.design.plots`.

`model` is a Plant, a Model, an InformationMap (what all designs reduce to), or anything with
`response(omega) -> (G (K, ny, nu), dG (K, n, ny, nu))` through `information_map(model, noise_covariance=..)`.
`criterion` is "D", "A", "E", "hinf", "static-gain", ... or a Criterion of `oed.criteria`.
Signals from spectra are in `oed.signals.synthesis`: multisine, realise, filtered_noise, binary.

CVXPY and Clarabel are imported only in this package, and only when a design needs them.
"""

from typing import TYPE_CHECKING

from oed.lazily import exporting

if TYPE_CHECKING:
    from oed.design.parametrisations.amplitude import amplitude_design
    from oed.design.parametrisations.autocorrelation import autocorrelation_design, moment_design
    from oed.design.parametrisations.masked import masked_design
    from oed.design.parametrisations.shaped import autoregressive_design, band_basis, basis_design
    from oed.design.problem.certificate import Certificate
    from oed.design.problem.design import Design
    from oed.design.problem.information_maps import InformationMap, information_map
    from oed.design.questions.closed_loop import closed_loop_map
    from oed.design.questions.least_power import application_criterion, least_power_design
    from oed.design.questions.quantile import QuantileDesign, quantile_design
    from oed.design.questions.robust import robust_design
    from oed.design.solve import solve_design

__all__ = [
    "Certificate", "Design", "InformationMap", "QuantileDesign", "amplitude_design",
    "application_criterion", "autocorrelation_design", "autoregressive_design", "band_basis",
    "basis_design", "closed_loop_map", "information_map", "least_power_design", "masked_design",
    "moment_design", "quantile_design", "robust_design", "solve_design",
]  # fmt: skip

__getattr__, __dir__ = exporting(__name__)
