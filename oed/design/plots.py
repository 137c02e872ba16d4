"""Figures in which optimality can be seen: the sensitivity function touches 1 at the support and nowhere exceeds it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from oed.design.problem.design import Design

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_autocorrelation", "plot_design", "plot_sensitivity", "plot_with_certificate"]


def plot_sensitivity(design: Design, axes: Axes | None = None, *, points: int = 4000) -> Any:
    """Sensitivity over frequency with the support marked on it.

    Parameters
    ----------
    design : Design
        The design.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.
    points : int
        Frequencies of the curve, besides those of the support.

    Returns
    -------
    matplotlib.axes.Axes
        With the drawing.
    """
    axes = _axes(axes)
    support = design.spectrum.omega
    omega = np.unique(np.concatenate([np.linspace(0, np.pi, points), support]))
    axes.axhline(1.0, color="0.6", linewidth=1)
    axes.plot(omega, design.certificate.sensitivity(omega), color="C0", linewidth=1.5)
    axes.plot(support, design.certificate.sensitivity(support), "o", color="C3", markersize=5, clip_on=False)
    axes.set(
        xlim=(0, np.pi),
        ylim=(0, 1.08),
        xlabel="frequency (rad/sample)",
        ylabel="sensitivity",
        title=f"{design.criterion.name}: gap {design.gap:.1e}",
    )
    return axes


def plot_design(design: Design, axes: Axes | None = None) -> Any:
    """Lines of the spectrum, one-sided power summed over channels, over the plant's largest gain.

    Parameters
    ----------
    design : Design
        The design.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    matplotlib.axes.Axes
        With the drawing.
    """
    axes = _axes(axes)
    power = np.einsum("kii->k", design.spectrum.power).real
    omega = np.linspace(0, np.pi, 2000)
    gain = np.linalg.svd(design.map.gain(omega), compute_uv=False)[:, 0]
    axes.fill_between(omega, power.max() * gain / gain.max(), color="0.9", label="gain of the plant, scaled")
    axes.vlines(design.spectrum.omega, 0, power, color="C3", linewidth=2, label="power of the lines")
    axes.set(
        xlim=(0, np.pi),
        ylim=(0, 1.08 * power.max()),
        xlabel="frequency (rad/sample)",
        ylabel="power",
        title=f"{design.criterion.name}-optimal input, white noise reaches {100 * design.efficiency_white:.3g} %",
    )
    axes.legend(frameon=False, loc="upper right")
    return axes


def plot_with_certificate(design: Design) -> Any:
    """The spectrum's lines above the sensitivity that certifies them, as a Figure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 6.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    plot_design(design, above)
    plot_sensitivity(design, below)
    return figure


def plot_autocorrelation(
    model: Any, criterion: str = "D", lags: Sequence[int] = (4, 8, 16, 24, 32, 48), axes: Axes | None = None
) -> Any:
    """How fast the best finite moving average nears the optimum over all spectra.

    Parameters
    ----------
    model : Plant, Model or InformationMap
        One input.
    criterion : str
        As for `autocorrelation_design`.
    lags : sequence of int
        Numbers of lags; 64 take several seconds.
    axes : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    matplotlib.axes.Axes
        With the relative excess of the loss over the certified bound, against the lags; both logarithmic.
    """
    from oed.design.parametrisations.autocorrelation import autocorrelation_design
    from oed.design.solve import solve_design

    axes = _axes(axes)
    bound = solve_design(model, criterion).bound
    excess = [autocorrelation_design(model, criterion, lags=int(L)).loss / bound - 1 for L in lags]
    axes.loglog(list(lags), excess, "o-", label="best moving average")
    axes.loglog(list(lags), excess[0] * lags[0] / np.asarray(lags, dtype=float), ":", label="1 / lags")
    axes.set_xlabel("lags")
    axes.set_ylabel(f"loss ({criterion}) above the certified optimum, relative")
    axes.legend()
    return axes


def _axes(axes: Axes | None) -> Axes:
    if axes is not None:
        return axes
    from matplotlib.figure import Figure

    return Figure(figsize=(6.4, 3.4), layout="constrained").subplots()
