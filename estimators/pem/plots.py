"""Figures of an identified model: measured against modelled, residuals, Bode, poles and zeros, step, order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estimators.pem.uncertainty import bode_band, pole_covariances, step_band
from estimators.residual.measures import fit_percent, p_stated, window_of
from estimators.residual.tests import ResidualTest, residual_tests
from oed.data import Record
from oed.errors import InputError
from oed.files.objects import as_record
from oed.models.model import Polynomial

if TYPE_CHECKING:
    from estimators.pem.fit import Fit


@dataclass(frozen=True)
class FitPlots:
    """The figures of one fit, as `fit.plot.bode()`; several fits in one figure by the functions of this module."""

    fit: Fit

    def bode(self, **how: Any) -> Figure:
        """Gain and phase with their bands, see `plot_bode`."""
        return plot_bode(self.fit, **how)

    def compare(self, record: Record, **how: Any) -> Figure:
        """Measured against simulated, see `plot_compare`."""
        return plot_compare(self.fit, record, **how)

    def residuals(self, record: Record, **how: Any) -> Figure:
        """Correlations of the residual on a record, fitted or fresh, see `plot_residual_tests`."""
        given = as_record(record)
        fresh = not any(
            np.array_equal(r.y, given.y) and np.array_equal(r.u, given.u) for r in self.fit.records
        )
        return plot_residual_tests(residual_tests(self.fit, given, fresh=fresh), **how)

    def poles(self, **how: Any) -> Figure:
        """Poles with their ellipses, see `plot_poles`."""
        return plot_poles(self.fit, **how)

    def step(self, samples: int = 100, **how: Any) -> Figure:
        """Step response with its band, see `plot_step`."""
        return plot_step(self.fit, samples, **how)

    def order(self) -> Figure:
        """Singular values of a subspace method, see `plot_order`."""
        return plot_order(self.fit)


BLUE, ORANGE, GREY = "#1f77b4", "#d95f02", "#777777"


def plot_compare(fits: Fit | Mapping[str, Fit], record: Record, *, window: int = 0) -> Figure:
    """Measured output against that of models simulated from the state that the first `window` samples set, which are not judged."""
    named = dict(fits) if isinstance(fits, Mapping) else {"model": fits}
    record = as_record(record, missing=True)
    figure = Figure(figsize=(8, 2.6 * record.n_outputs), layout="constrained")
    axes = figure.subplots(record.n_outputs, 1, squeeze=False, sharex=True)[:, 0]
    simulated = {
        name: fit.simulate_record(record, window=window_of(fit.initial, window))
        for name, fit in named.items()
    }
    for i, ax in enumerate(axes):
        ax.plot(record.t, record.y[:, i], color="black", lw=1, alpha=0.6, label="measured")
        for name, y in simulated.items():
            fit = fit_percent(record.y[window:, [i]], y[window:, [i]])
            ax.plot(record.t, y[:, i], lw=1, label=f"{name}: {fit:.1f} %")
        unit = record.output_units[i]
        ax.set_ylabel(record.output_names[i] + (f" [{unit}]" if unit else ""))
        ax.legend(loc="upper right", fontsize="small")
    axes[-1].set_xlabel("time [s]" if record.dt != 1 else "sample")
    return figure


def plot_residual_tests(tests: Mapping[str, ResidualTest], *, level: float = 0.99) -> Figure:
    """Correlations over their lags, with the band that holds them where nothing is missing."""
    from scipy.special import ndtri

    half = float(ndtri((1 + level) / 2))
    figure = Figure(figsize=(4 * min(len(tests), 3), 2.6 * -(-len(tests) // 3)), layout="constrained")
    axes = figure.subplots(-(-len(tests) // 3), min(len(tests), 3), squeeze=False).ravel()
    for ax, (name, test) in zip(axes, tests.items(), strict=False):
        ax.fill_between(test.lags, -half * test.deviation, half * test.deviation, color=BLUE, alpha=0.2, lw=0)
        out = np.abs(test.correlation) > half * test.deviation
        ax.vlines(test.lags, 0, test.correlation, color=GREY, lw=1)
        ax.plot(test.lags[~out], test.correlation[~out], "o", ms=3, color=BLUE)
        ax.plot(test.lags[out], test.correlation[out], "o", ms=3, color=ORANGE)
        ax.axhline(0, color="black", lw=0.5)
        ax.set_title(f"{name}: {p_stated(test.p_value)}", fontsize="medium")
        ax.set_xlabel("lag [samples]")
    for ax in axes[len(tests) :]:
        ax.remove()
    return figure


def _band(ax: Axes, x: Any, value: Any, low: Any, high: Any, name: str) -> None:
    (line,) = ax.plot(x, value, lw=1.2, label=name)
    ax.fill_between(x, low, high, color=line.get_color(), alpha=0.25, lw=0)


def _entry(fit: Fit, i: int, j: int) -> str:
    """What an entry of G is called beside others: its input and its output by their names."""
    r = fit.records[0]
    return f"{r.input_names[j]} to {r.output_names[i]}" if r.n_outputs * r.n_inputs > 1 else ""


def plot_bode(fits: Fit | Mapping[str, Fit], *, level: float = 0.95, points: int = 400) -> Figure:
    """Gain and phase of every entry of G with pointwise confidence bands."""
    named = dict(fits) if isinstance(fits, Mapping) else {"model": fits}
    omega = np.geomspace(0.01, np.pi, points)
    first = next(iter(named.values())).model.structure
    dt = next(iter(named.values())).model.dt
    turn, unit = (1.0, "rad/sample") if dt == 1 else (2 * np.pi * dt, "Hz")
    entries = [(i, j) for i in range(first.n_outputs) for j in range(first.n_inputs)]
    figure = Figure(figsize=(max(5.0, 3.2 * len(entries)), 5), layout="constrained")
    axes = figure.subplots(2, len(entries), squeeze=False, sharex=True)
    for name, fit in named.items():
        gain, phase = bode_band(fit, omega)
        for column, (i, j) in enumerate(entries):
            for ax, band, factor in ((axes[0, column], gain, 1.0), (axes[1, column], phase, 180 / np.pi)):
                value, low, high = (factor * side[:, i, j] for side in (band.value, *band.interval(level)))
                floor = 1e-3 * value.max() if ax is axes[0, column] else -np.inf
                _band(ax, omega / turn, value, np.maximum(low, floor), high, name)
    for column, (i, j) in enumerate(entries):
        # an absent entry has no logarithm
        there = any(line.get_ydata().max() > 0 for line in axes[0, column].lines)
        axes[0, column].set(xscale="log", yscale="log" if there else "linear")
        axes[0, column].set_title(_entry(next(iter(named.values())), i, j))
        axes[1, column].set_xlabel(f"frequency [{unit}]")
    axes[0, 0].set_ylabel("gain")
    axes[1, 0].set_ylabel("phase [deg]")
    axes[0, 0].legend(fontsize="small")
    return figure


def plot_poles(fit: Fit, *, level: float = 0.95) -> Figure:
    """Poles with confidence ellipses, and zeros of the entries of a polynomial model."""
    radius = np.sqrt(-2 * np.log(1 - level))  # chi-squared with two degrees of freedom
    turn = np.linspace(0, 2 * np.pi, 100)
    figure = Figure(figsize=(5, 5), layout="constrained")
    ax = figure.subplots()
    ax.plot(np.cos(turn), np.sin(turn), color=GREY, lw=0.8)
    for pole, covariance in pole_covariances(fit):
        values, vectors = np.linalg.eigh(covariance)
        axes = vectors * (radius * np.sqrt(np.maximum(values, 0)))
        curve = axes @ np.stack([np.cos(turn), np.sin(turn)])
        ax.plot(pole.real, pole.imag, "x", color=BLUE)
        ax.plot(pole.real + curve[0], pole.imag + curve[1], color=BLUE, lw=0.8)
    structure = fit.model.structure
    if structure.kind != "ss":
        for row in structure.coefficients(fit.theta):  # type: ignore[union-attr]
            for b in row["b"]:
                zeros = np.roots(np.trim_zeros(b, "f"))
                ax.plot(zeros.real, zeros.imag, "o", color=ORANGE, fillstyle="none")
    ax.set(xlabel="real", ylabel="imaginary", xlim=(-1.5, 1.5), ylim=(-1.5, 1.5), aspect="equal")
    ax.set_title(f"poles x with {100 * level:g} % ellipses, zeros o", fontsize="medium")
    return figure


def plot_step(fit: Fit, samples: int = 100, *, level: float = 0.95) -> Figure:
    """Step response of every entry with pointwise confidence bands."""
    band = step_band(fit, samples)
    low, high = band.interval(level)
    ny, nu = band.value.shape[1:]
    figure = Figure(figsize=(max(5.0, 3.2 * nu), 2.8 * ny), layout="constrained")
    axes = figure.subplots(ny, nu, squeeze=False, sharex=True)
    for i in range(ny):
        for j in range(nu):
            _band(axes[i, j], band.x, band.value[:, i, j], low[:, i, j], high[:, i, j], "step response")
            axes[i, j].set_title(_entry(fit, i, j))
    axes[-1, 0].set_xlabel("sample")
    axes[0, 0].set_ylabel("step response")
    return figure


def plot_order(fit: Fit) -> Figure:
    """What a subspace method went by: the singular values that tell the order, and the simulation error by
    horizon."""
    form, how = fit.model.structure, fit.subspace
    if how is None or isinstance(form, Polynomial):
        raise InputError('this fit has no singular values; fits by "moesp", "n4sid" and "cva" have.')
    n, many = form.order, len(how.tried) > 1
    figure = Figure(figsize=(8 if many else 4.5, 3), layout="constrained")
    axes = figure.subplots(1, 2 if many else 1, squeeze=False)[0]
    size = how.singular_values[how.singular_values > 1e-16 * how.singular_values[0]]
    at = np.arange(1, len(size) + 1)
    axes[0].semilogy(at[:n], size[:n], "o", color=BLUE, label=f"taken: {n}")
    axes[0].semilogy(at[n:], size[n:], "o", color=GREY, mfc="none", label="left")
    axes[0].set(xlabel="number", ylabel=f"singular value ({how.method})")
    axes[0].legend(fontsize="small")
    if many:
        axes[1].plot(list(how.tried), list(how.tried.values()), ".-", color=BLUE, lw=1)
        axes[1].plot(how.horizon, how.tried[how.horizon], "o", color=ORANGE, label=f"taken: {how.horizon}")
        axes[1].set(xlabel="horizon [block rows]", ylabel="simulation error / output size")
        axes[1].legend(fontsize="small")
    return figure
