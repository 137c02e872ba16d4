"""Figures in which optimality can be seen: the sensitivity function touches 1 at the support and nowhere exceeds it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from oed.design.problem.design import Design


def plot_sensitivity(design: Design, axes: Axes | None = None, *, points: int = 4000) -> Any:
    """Sensitivity over frequency with the support marked on it."""
    axes = axes_or_new(axes)
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
    """Lines of the spectrum, one-sided power summed over channels, over the plant's largest gain."""
    axes = axes_or_new(axes)
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


def axes_or_new(axes: Axes | None) -> Axes:
    """The axes given, or those of a new figure."""
    if axes is not None:
        return axes
    from matplotlib.figure import Figure

    return Figure(figsize=(6.4, 3.4), layout="constrained").subplots()
