"""Where to start the fit of each effect: shapes scanned by their score against the fitted model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.model.fitting import Channel, Fit
from estimators.diagnosis.model.layouts import COEFFICIENTS, LAYOUTS, layout_matrices, states
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure

__all__ = ["Start", "gains_of_shapes", "shapes", "tone_starts"]

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Start:
    """Parameters to start a fit from, with the approximate likelihood ratio that they promise.

    Attributes
    ----------
    structure : Structure
        What is to be fitted.
    p : ndarray
        Parameters to start from.
    scales : ndarray
        Their typical sizes.
    promise : float
        Approximate likelihood ratio against the model without the effect.
    """

    structure: Structure
    p: Array
    scales: Array
    promise: float


def _quantiles(x: Array, levels: tuple[float, ...]) -> list[float]:
    return [float(v) for v in np.quantile(x, levels)]


def _times(channel: Channel, count: int = 40) -> Array:
    n = len(channel)
    return channel.clock.k[0] + np.linspace(0.03, 0.97, count) * n


def shapes(key: str, channel: Channel, base: Fit, j: int) -> tuple[list[list[float]], list[float], bool]:
    """Grid of shapes of one effect.

    Parameters
    ----------
    key : str
        The effect.
    channel : Channel
        Data.
    base : Fit
        The model it is added to.
    j : int
        The input that it concerns.

    Returns
    -------
    tuple
        Parameter vectors, typical sizes, and whether the first parameter is an amplitude in which the
        output is (nearly) linear.
    """
    u = channel.u[:, j]
    su = float(np.std(u)) + 1e-300
    y = channel.y - base.residual
    sy = float(np.std(y)) + 1e-300
    size = np.abs(u)
    if key == "saturation":
        return [[v] for v in _quantiles(size, (0.97, 0.9, 0.8, 0.65, 0.5))] + [[1.5 * su], [su]], [su], False
    if key == "saturation_asymmetric":
        high, low = _quantiles(u, (0.97, 0.88, 0.75)), _quantiles(u, (0.03, 0.12, 0.25))
        return [[a, b] for a in low for b in high], [su, su], False
    if key in ("saturation_upper", "saturation_lower"):
        levels = (0.98, 0.93, 0.85, 0.75, 0.6) if key.endswith("upper") else (0.02, 0.07, 0.15, 0.25, 0.4)
        return [[v] for v in _quantiles(u, levels)], [su], False
    if key == "dead_zone":
        return [[f * su] for f in (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)], [su], False
    if key == "dead_zone_asymmetric":
        return [[a * su, b * su] for a in (0.1, 0.3, 0.6) for b in (0.1, 0.3, 0.6)], [su, su], False
    if key == "input_quadratic":
        return [[0.03 / su]], [1 / su], True
    if key == "input_cubic":
        return [[0.02 / su**2]], [1 / su**2], True
    if key == "input_polynomial":
        return [[a / su, b / su**2] for a in (-0.1, 0.1) for b in (-0.03, 0.03)], [1 / su, 1 / su**2], False
    if key in ("rate_limit", "rate_limit_sampled"):
        jump = np.abs(np.diff(u))
        jump = jump[jump > 1e-9 * su]
        wide = float(np.ptp(u))
        grid = _quantiles(jump, (0.9, 0.7, 0.4)) if len(jump) else []
        return [[v] for v in grid + [wide / m for m in (1.3, 2, 3, 5, 8, 12, 20)]], [su], False
    if key == "backlash_input":
        return [[f * su] for f in (0.08, 0.16, 0.3, 0.5, 0.8)], [su], False
    if key == "hysteresis":
        return [[a, w * su] for a in (0.3, 0.7) for w in (0.15, 0.4, 1.0)], [1.0, su], False
    if key in ("backlash_output", "backlash_sampled"):
        return [[f * sy] for f in (0.08, 0.16, 0.3, 0.5, 0.8)], [sy], False
    if key == "gain_drift":
        return [[0.05]], [1.0], True
    if key == "gain_change":
        return [[0.05, t] for t in _times(channel)], [1.0, 1.0], True
    if key == "step_input":
        return [[0.05 * su, t] for t in _times(channel)], [su, 1.0], True
    if key == "step_output":
        return [[0.05 * sy, t] for t in _times(channel)], [sy, 1.0], True
    if key == "lag":
        return [[v] for v in (0.2, 0.4, 0.6, 0.75, 0.85, 0.92)], [1.0], False
    if key == "output_quadratic":
        return [[0.03 / sy]], [1 / sy], True
    if key == "output_cubic":
        return [[0.02 / sy**2]], [1 / sy**2], True
    if key == "output_polynomial":
        return [[a / sy, b / sy**2] for a in (-0.1, 0.1) for b in (-0.03, 0.03)], [1 / sy, 1 / sy**2], False
    if key in ("output_arctan", "output_tanh"):
        return [[f / sy] for f in (0.25, 0.5, 1.0, 1.8)], [1 / sy], False
    if key == "output_clip":
        return [[v] for v in _quantiles(np.abs(y), (0.97, 0.9, 0.8, 0.65))], [sy], False
    if key in ("output_clip_upper", "output_clip_lower"):
        levels = (0.98, 0.93, 0.85, 0.75, 0.6) if key.endswith("upper") else (0.02, 0.07, 0.15, 0.25, 0.4)
        return [[v] for v in _quantiles(y, levels)], [sy], False
    if key == "output_dead_zone":
        return [[f * sy] for f in (0.1, 0.25, 0.5, 0.8)], [sy], False
    if key == "output_absolute":
        return [[0.05]], [1.0], True
    if key == "offset":
        return [[0.05 * sy]], [sy], True
    if key == "drift":
        return [[a * sy, b * sy] for a in (-0.1, 0.1) for b in (-0.2, 0.2)], [sy, sy], False
    if key in ("timescale_change", "damping_change", "pole_change"):
        return [[0.1, t] for t in _times(channel, 20)], [1.0, 1.0], True
    if key == "delay":
        return [[v] for v in (0.3, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 8.0)], [1.0], False
    return _plant_shapes(key, channel, base, j)


def _plant_shapes(
    key: str, channel: Channel, base: Fit, j: int
) -> tuple[list[list[float]], list[float], bool]:
    """Shapes of the effects inside the plant, by the size of position and velocity there."""
    s = base.structure
    u = channel.u[:, j]
    su = float(np.std(u)) + 1e-300
    c = np.zeros(COEFFICIENTS)
    X = states(s.layout, base.p[: LAYOUTS[s.layout][1]], u, c)

    position, velocity = layout_matrices(s.layout, base.p[: LAYOUTS[s.layout][1]])[3:]
    sx = float(np.std(X @ position)) + 1e-12 * su
    sv = float(np.std(X @ velocity)) + 1e-12 * su
    if key == "stiffness_cubic":
        return [[f * su / sx**3] for f in (0.01, 0.05, -0.02)], [su / sx**3], False
    if key == "stiffness":
        return (
            [[a * su / sx**2, b * su / sx**3] for a in (-0.05, 0.05) for b in (-0.01, 0.03)],
            [su / sx**2, su / sx**3],
            False,
        )
    if key == "stiffness_square":
        return [[f * su / sx**2] for f in (0.05, 0.3, -0.1)], [su / sx**2], False
    if key == "stiffness_quintic":
        return (
            [[a * su / sx**3, b * su / sx**5] for a in (0.0, 0.03) for b in (-0.003, 0.01)],
            [su / sx**3, su / sx**5],
            False,
        )
    if key in ("stiffness_upper", "stiffness_lower", "stiffness_gap"):
        side = -1.0 if key == "stiffness_lower" else 1.0
        levels = (0.3, 0.8, 1.5) if key == "stiffness_gap" else (0.0, 0.7, 1.5)
        slopes = (0.3, 2.0, 10.0, -0.3) if key == "stiffness_gap" else (0.3, 2.0, -0.3)  # stops are stiff
        return (
            [[k * su / sx, side * g * sx] for k in slopes for g in levels],
            [su / sx, sx],
            False,
        )
    if key == "end_stop":
        top = float(np.max(np.abs(X @ position)))
        return [[f * top] for f in (0.9, 0.75, 0.6, 0.45)], [sx], False
    if key == "position_damping":
        return [[f * su / (sx**2 * sv)] for f in (0.05, 0.3, -0.05)], [su / (sx**2 * sv)], False
    if key == "hysteretic_spring":
        return [[f * su, w * sx] for f in (0.15, 0.5) for w in (0.2, 0.7, 2.0)], [su, sx], False
    if key == "coulomb":
        return [[f * su] for f in (0.03, 0.1, 0.2, 0.4)], [su], False
    if key == "coulomb_asymmetric":
        return [[f * su, g] for f in (0.1, 0.3) for g in (-0.3, 0.3)], [su, 1.0], False
    if key == "stribeck":
        return (
            [[f * su, g * f * su, h * sv] for f in (0.1, 0.25) for g in (0.6,) for h in (0.2, 0.6)],
            [su, su, sv],
            False,
        )
    if key == "drag":
        return [[f * su / sv**2] for f in (0.02, 0.1, 0.3)], [su / sv**2], False
    return [[f / sx] for f in (0.05, 0.2, -0.05, -0.2)], [1 / sx], False


def gains_of_shapes(
    channel: Channel,
    base: Fit,
    part: Part,
    grid: list[list[float]],
    sizes: list[float],
    amplitude: bool,
    best: int,
) -> list[Start]:
    """The best shapes of a grid by their score, the model's own parameters projected out.

    Parameters
    ----------
    channel : Channel
        Data.
    base : Fit
        Fitted model without the effect.
    part : Part
        The effect.
    grid : list of list of float
        Shapes.
    sizes : list of float
        Typical sizes of the effect's parameters.
    amplitude : bool
        Whether the first parameter is an amplitude.
    best : int
        How many starts to return.

    Returns
    -------
    list of Start
        Best first; `promise` is the likelihood ratio of the linearised problem.
    """
    s = base.structure.adding(part)
    scales = np.concatenate((base.scales, sizes))
    keep = channel.keep

    def white(x: Array) -> Array:
        x = np.where(keep, x, 0.0)
        return np.asarray(lfilter(np.concatenate(([1.0], base.noise)), [1.0], x)) if len(base.noise) else x

    r = white(base.residual)
    Q, R = np.linalg.qr(base.jacobian) if base.jacobian.size else (np.zeros((len(r), 0)), np.zeros((0, 0)))
    reference = simulate(base.structure, base.p, channel.u, channel.clock)
    r0 = r - Q @ (Q.T @ r)
    rss = float(r0 @ r0) + 1e-300
    found: list[tuple[float, float, Array, Array]] = []
    for shape in grid:
        p = np.concatenate((base.p, shape))
        y = simulate(s, p, channel.u, channel.clock)
        if not np.all(np.isfinite(y)):
            continue
        d = white(y - reference)
        d0 = d - Q @ (Q.T @ d)
        power = float(d0 @ d0)
        if power <= 1e-16 * float(d @ d) or power == 0:
            continue
        alpha = float(d0 @ r0) / power
        promise = base.n * -np.log(max(1.0 - alpha**2 * power / rss, 1e-12))
        if not amplitude and alpha < 0:
            promise *= 1e-3
        found.append((promise, alpha, p, d))
    found.sort(key=lambda x: -x[0])
    at = len(base.p)
    out = []
    for promise, alpha, p, d in found[:best]:
        step = alpha if amplitude else min(max(alpha, 0.0), 1.0)
        move = np.zeros(at)
        if R.size:
            try:
                move = np.linalg.solve(R, Q.T @ (r - step * d))
            except np.linalg.LinAlgError:
                move = np.zeros(at)
        options = []
        for share in (1.0, 0.4) if amplitude else (1.0,):
            trial = p.copy()
            if amplitude:
                trial[at] *= alpha * share
            options.append(trial.copy())
            trial[:at] -= move
            options.append(trial)
        out.append(Start(s, min(options, key=lambda q: _squares(channel, s, q)), scales, promise))
    return out


def _squares(channel: Channel, s: Structure, p: Array) -> float:
    y = simulate(s, p, channel.u, channel.clock)
    if not np.all(np.isfinite(y)):
        return np.inf
    return float(np.sum(np.where(channel.keep, channel.y - y, 0.0) ** 2))


def tone_starts(channel: Channel, base: Fit, count: int) -> Start | None:
    """Sinusoids at the highest peaks of the residual's periodogram, taken out one after another.

    Parameters
    ----------
    channel : Channel
        Data.
    base : Fit
        Fitted model without the sinusoids.
    count : int
        How many sinusoids.

    Returns
    -------
    Start or None
        None where the record is too short.
    """
    n = len(channel)
    if n < 20:
        return None
    k = channel.clock.k
    r = np.where(channel.keep, base.residual, 0.0)
    pad = 8 * n
    omega = 2 * np.pi * np.arange(pad // 2 + 1) / pad
    lines: list[float] = []
    columns: list[Array] = []
    rest = r - r.mean()
    white = np.concatenate(([1.0], base.noise))
    gain = np.abs(np.fft.rfft(white, pad)) ** 2
    for _ in range(count):
        power = np.abs(np.fft.rfft(rest * np.hanning(n) if lines else rest, pad)) ** 2 * gain
        power[omega < 2 * np.pi * 1.2 / n] = 0.0
        for w in lines:
            power[np.abs(omega - w) < 2 * np.pi * 1.0 / n] = 0.0
        w = float(omega[int(np.argmax(power))])
        lines.append(w)
        columns += [np.cos(w * k), np.sin(w * k)]
        X = np.stack(columns, axis=1)
        theta = np.linalg.lstsq(X, r, rcond=None)[0]
        rest = r - X @ theta
    p = np.concatenate([[w, theta[2 * i], theta[2 * i + 1]] for i, w in enumerate(lines)])
    s = base.structure.adding(Part("tones", 0, count))
    sy = float(np.std(r)) + 1e-300
    scales = np.concatenate((base.scales, np.tile([1.0 / n, sy, sy], count)))
    return Start(s, np.concatenate((base.p, p)), scales, 0.0)
