"""Figures of the comparison, as matplotlib figures without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from oed.data import Spectrum
from oed.plants.plant import Plant
from oed.theory.limit import LimitSpectrum, limit_spectrum

__all__ = [
    "efficiency_figure",
    "estimated_gain_figure",
    "hair_dryer_figure",
    "limit_spectrum_figure",
    "panels",
    "rho_figure",
    "spectra_against_optima_figure",
]

COLOURS = ("#0b5fa5", "#c8442a", "#2e8b57", "#8a5aa8", "#b8860b", "#5b6770")
DASHES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v", "x")
GREY = "#5b6770"


def panels(
    count: int = 1, *, width: float = 9.0, height: float = 3.6, columns: int | None = None
) -> tuple[Figure, list[Any]]:
    """A figure with panels side by side, in the style of all figures here."""
    figure = Figure(figsize=(width, height), layout="constrained")
    columns = min(columns or count, count)
    axes = [figure.add_subplot(-(-count // columns), columns, k + 1) for k in range(count)]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(True, color="#e3e6e8", linewidth=0.7)
        ax.set_axisbelow(True)
    return figure, axes


def _frequency_axis(ax: Any) -> None:
    ax.set_xlim(0, np.pi)
    ax.set_xticks([0, np.pi / 4, np.pi / 2, 3 * np.pi / 4, np.pi], ["0", "π/4", "π/2", "3π/4", "π"])
    ax.set_xlabel("frequency ω (rad/sample)")


def _fine_frequencies(limit: LimitSpectrum) -> NDArray[np.float64]:
    """A grid on which every peak is drawn with its true height."""
    width = np.geomspace(1e-6, 1, 300)
    parts = [w + s * width for w in limit.peak.frequencies for s in (-1, 1)]
    omega = np.unique(np.concatenate([np.linspace(0, np.pi, 1500), limit.peak.frequencies, *parts]))
    return omega[(omega >= 0) & (omega <= np.pi)]


def limit_spectrum_figure(plant: Plant, noise_variances: Sequence[float]) -> Figure:
    """[S] Fig. 2: magnitude of G, and the limit spectra at several noise levels."""
    figure, (left, right) = panels(2)
    limits = [limit_spectrum(plant.replace(noise_variance=v)) for v in noise_variances]
    omega = _fine_frequencies(limits[0])
    left.plot(omega, np.abs(plant.response(omega)[0][:, 0, 0]), color=COLOURS[0])
    top = limits[0].peak
    left.plot(top.frequencies, [top.value] * len(top.frequencies), "o", color=COLOURS[1], markersize=4)
    left.annotate(
        f"γ = {top.value:.4f} at {top.frequency:.4f}",
        (top.frequency, top.value),
        textcoords="offset points",
        xytext=(10, -3),
        fontsize=9,
    )
    left.set_ylabel("|G|")
    for k, (variance, limit) in enumerate(zip(noise_variances, limits, strict=True)):
        right.semilogy(
            omega,
            limit.density(omega),
            DASHES[k % 4],
            color=COLOURS[k % 6],
            label=f"noise variance {variance:.3g}",
        )
    right.axhline(1, color=GREY, linewidth=0.8)
    right.text(np.pi, 1, "white", ha="right", va="bottom", fontsize=8, color=GREY)
    right.set_ylabel("limit spectrum Φ")
    right.legend(frameon=False, fontsize=9)
    for ax in (left, right):
        _frequency_axis(ax)
    left.set_title("Magnitude of the plant", fontsize=10, loc="left")
    right.set_title("Where the iterations put the power", fontsize=10, loc="left")
    return figure


def estimated_gain_figure(
    averages: Mapping[float, NDArray[np.float64]],
    single: NDArray[np.float64],
    single_variance: float,
    finite_norm: float,
    replicates: int,
) -> Figure:
    """[S] Fig. 3: estimated gain over the iterations, one run and averages.

    Shapes: single (M,).
    """
    figure, (left, right) = panels(2)
    n = np.arange(1, len(single) + 1)
    left.plot(n, single, "-.", color=COLOURS[2], linewidth=1, label="one run")
    left.plot(n, averages[single_variance], "--", color="black", label=f"mean of {replicates} runs")
    for k, (variance, average) in enumerate(averages.items()):
        right.plot(n, average, DASHES[k % 4], color=COLOURS[k % 6], label=f"noise variance {variance:.3g}")
    for ax in (left, right):
        ax.axhline(finite_norm, color="black", linewidth=1)
        ax.text(len(single), finite_norm, "finite-time norm", ha="right", va="bottom", fontsize=8)
        ax.set_xlabel("iteration n")
        ax.set_ylabel("estimated gain β₂")
        ax.set_ylim(0, None)
        ax.legend(frameon=False, fontsize=9, loc="lower right")
    left.set_title(f"Noise variance {single_variance:.3g}", fontsize=10, loc="left")
    right.set_title(f"Means over {replicates} runs", fontsize=10, loc="left")
    return figure


def spectra_against_optima_figure(
    plant: Plant, noise_variances: Sequence[float], optima: Mapping[str, Spectrum]
) -> Figure:
    """Cumulative power over frequency: limit spectra beside the optimal spectra.

    Lines have no density, so the comparison is made in the cumulative share of power, which both have.
    """
    figure, (ax,) = panels(1, width=7.0, height=3.8)
    for k, variance in enumerate(noise_variances):
        spectrum = limit_spectrum(plant.replace(noise_variance=variance)).spectrum
        share = np.cumsum(spectrum.power[:, 0, 0].real) / spectrum.total_power
        ax.plot(
            spectrum.omega,
            share,
            DASHES[k % 4],
            color=COLOURS[k % 6],
            label=f"iterations, noise variance {variance:.3g}",
        )
    ax.plot([0, np.pi], [0, 1], color=GREY, linewidth=0.8, label="white noise")
    for k, (name, spectrum) in enumerate(optima.items()):
        order = np.argsort(spectrum.omega)
        omega, power = spectrum.omega[order], spectrum.power[order, 0, 0].real
        steps = np.concatenate([[0.0], np.cumsum(power) / power.sum()])
        ax.stairs(
            steps,
            np.concatenate([[0.0], omega, [np.pi]]),
            baseline=None,
            color=COLOURS[3 + k],
            linewidth=1.4,
            label=f"optimal for {name}",
        )
    _frequency_axis(ax)
    ax.set_ylabel("share of input power below ω")
    ax.legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def efficiency_figure(
    rows: Sequence[Mapping[str, Any]], plant: str, theory: Mapping[float, NDArray[np.float64]]
) -> Figure:
    """Efficiency of the first n experiments together, measured and predicted, for the peak gain and for D."""
    variances = sorted({row["noise_variance"] for row in rows if row["plant"] == plant})
    figure = Figure(figsize=(9.5, 5.6), layout="constrained")
    methods = list(dict.fromkeys(row["method"] for row in rows if row["plant"] == plant))
    for r, (key, label) in enumerate((("c_efficiency", "peak gain"), ("d_efficiency", "parameters (D)"))):
        for k, variance in enumerate(variances):
            ax = figure.add_subplot(2, len(variances), r * len(variances) + k + 1)
            ax.spines[["top", "right"]].set_visible(False)
            ax.grid(True, color="#e3e6e8", linewidth=0.7)
            for m, method in enumerate(methods):
                mine = [
                    x
                    for x in rows
                    if (x["plant"], x["noise_variance"], x["method"]) == (plant, variance, method)
                ]
                mine = sorted((x for x in mine if x[key] > 0), key=lambda x: x["experiments"])
                ax.plot(
                    [x["experiments"] for x in mine],
                    [x[key] for x in mine],
                    marker=MARKERS[m % 6],
                    markersize=4,
                    linewidth=0 if method == "power" else 1,
                    color=COLOURS[m % 6],
                    label=method,
                )
            if key == "c_efficiency" and variance in theory and "power" in methods:
                line = theory[variance]
                ax.plot(
                    np.arange(1, len(line) + 1),
                    line,
                    color=COLOURS[methods.index("power") % 6],
                    linewidth=1,
                    label="power, theory",
                )
            ax.set_xscale("log")
            ax.set_ylim(0, 1.08)
            if k == 0:
                ax.set_ylabel(f"efficiency: {label}")
            if r == 0:
                ax.set_title(f"noise {variance:.3g}", fontsize=10, loc="left")
            else:
                ax.set_xlabel("experiments n")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=9)
    return figure


def rho_figure(rows: Sequence[Mapping[str, Any]], plants: Sequence[str]) -> Figure:
    """Rho of every method and estimator with its error bar, beside the prediction of the information."""
    pairs = list(dict.fromkeys((row["method"], row["estimator"]) for row in rows))
    variances = sorted({row["noise_variance"] for row in rows})
    figure, axes = panels(len(plants), width=9.5, height=1.6 + 0.34 * len(pairs))
    for ax, plant in zip(axes, plants, strict=True):
        mine = [row for row in rows if row["plant"] == plant]
        for k, variance in enumerate(variances):
            for row in (x for x in mine if x["noise_variance"] == variance):
                at = -pairs.index((row["method"], row["estimator"])) + 0.22 * (1 - k)
                if np.isfinite(row["rho"]):
                    ax.errorbar(
                        row["rho"],
                        at,
                        xerr=[[min(2 * row["rho_se"], 0.8 * row["rho"])], [2 * row["rho_se"]]],
                        fmt=MARKERS[k % 6],
                        color=COLOURS[k % 6],
                        markersize=4,
                        capsize=2,
                        linewidth=1,
                    )
                if np.isfinite(row["rho_predicted"]):
                    ax.plot([row["rho_predicted"]] * 2, [at - 0.1, at + 0.1], color="black", linewidth=1.4)
        ax.axvline(1, color=GREY, linewidth=1)
        ax.set_xscale("log")
        ax.set_ylim(-len(pairs) + 0.4, 0.6)  # the same rows in every panel, measured there or not
        ax.set_yticks(
            [-k for k in range(len(pairs))],
            [f"{m} / {e}" for m, e in pairs] if ax is axes[0] else [""] * len(pairs),
        )
        ax.set_title(plant, fontsize=10, loc="left")
    for k, variance in enumerate(variances):
        axes[0].plot([], [], MARKERS[k % 6], color=COLOURS[k % 6], label=f"noise {variance:.3g}")
    figure.supxlabel("ρ (1 is the bound; black: predicted by the information)", fontsize=10)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=9)
    return figure


def hair_dryer_figure(story: Any) -> Figure:
    """The hair dryer: input-residual correlation, and the simulation on the second half, before and after."""
    figure, (left, right) = panels(2)
    for k, (name, values) in enumerate(story.correlations.items()):
        left.plot(
            story.lags,
            values,
            f"{MARKERS[k]}-",
            color=COLOURS[1 - k],
            markersize=4,
            linewidth=1,
            label=f"{name} (nk = {(story.before_delay, story.delay)[k]})",
        )
    for sign in (-1, 1):
        left.axhline(sign * story.bound, color=GREY, linewidth=0.8, linestyle="--")
    left.set_xlabel("lag (samples)")
    left.set_ylabel("correlation of input and residual")
    left.set_title("What the residual says (dashed: 99 % bound)", fontsize=10, loc="left")
    left.legend(frameon=False, fontsize=9)
    part = slice(200, 320)
    t = story.test.t[part]
    right.plot(t, story.test.y[part, 0], color="black", linewidth=1, label="measured")
    for k, name in enumerate(("before", "after")):
        right.plot(
            t,
            story.simulated[name][part, 0],
            DASHES[1 - k],
            color=COLOURS[1 - k],
            linewidth=1.2,
            label=f"{name}: {story.rows[k]['simulation_rmse']:.3f} V rms",
        )
    right.set_xlabel("time (s)")
    right.set_ylabel("air temperature sensor (V)")
    right.set_title("Simulation on data not used for the fit", fontsize=10, loc="left")
    right.legend(frameon=False, fontsize=8)
    return figure
