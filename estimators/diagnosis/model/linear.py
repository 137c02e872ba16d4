"""The linear model: output-error fits from several starts, and its translation into physical layouts."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.effect import Slot
from estimators.diagnosis.model.derivatives import exact_columns
from estimators.diagnosis.model.fitting import Channel, Fit, finite, fit
from estimators.diagnosis.model.layouts import LAYOUTS, states
from estimators.diagnosis.model.simulation import free_responses, simulate
from estimators.diagnosis.model.structure import Structure, stable_polynomial
from estimators.residual.algebra import least_squares

Array = NDArray[Any]


def plant_scales(s: Structure, p: Array) -> Array:
    """Typical sizes of the linear part's parameters, for finite differences."""
    scale = np.ones(s.plant_size)
    head = s.order if s.layout == "tf" else LAYOUTS[s.layout][1]
    b = np.abs(p[head : s.plant_size])
    scale[head:] = np.maximum(b, 0.1 * (b.max(initial=0.0) or 1.0))
    return scale


def _late(x: Array, lags: range) -> list[Array]:
    """A signal that is zero before it starts, at each of the lags."""
    return [np.concatenate((np.zeros(i), x[: len(x) - i])) for i in lags]


def _lagged(y: Array, U: Array, n: int, taps: int, delay: int) -> Array:
    """Regressors of an equation error: -y at lags 1 to n, then each input at its lags."""
    columns = _late(-y, range(1, n + 1))
    for x in U.T:
        columns += _late(x, range(1 + delay, taps + delay + 1))
    return np.array(columns).T


def _regression(
    y: Array, U: Array, n: int, taps: int, delay: int, keep: Array, beside: Array | None = None
) -> Array:
    X = _lagged(y, U, n, taps, delay)
    X = X if beside is None else np.hstack((X, beside))
    rows = keep.copy()
    rows[:n] = False
    return least_squares(X[rows], y[rows])


def _prefiltered(y: Array, U: Array, f: Array, taps: int, delay: int, keep: Array, begun: bool) -> Array:
    """Denominator (n,) of a Steiglitz-McBride pass from another one.

    The filters begin at rest. What a record that has `begun` off its mean leaves in its first samples would be dynamics: its start and
    level are then free; but slow poles that are free to begin anywhere follow what drifts.
    """
    n, den = len(f), np.concatenate(([1.0], f))
    v, W, *B = (np.asarray(lfilter([1.0], den, x, axis=0)) for x in (y, U, *_free(y, n, begun)))
    return _reflected(_regression(v, W, n, taps, delay, keep, *B)[:n])


def _free(y: Array, n: int, begun: bool) -> list[Array]:
    """What tells the level and the first samples of a record that has `begun` before."""
    return [np.column_stack((np.ones(len(y)), np.eye(len(y), n)))] if begun else []


def prefiltered_error(
    y: Array, U: Array, den: Array, s: Structure, rows: NDArray[np.bool_], begun: bool = False
) -> float:
    """Sum of squares of one Steiglitz-McBride step: equation error, prefiltered by a given denominator, as `_prefiltered` has it.

    Shapes: y (N,), U (N, nu), rows (N,).
    """
    v, W, *B = (np.asarray(lfilter([1.0], den, x, axis=0)) for x in (y, U, *_free(y, s.order, begun)))
    X = np.hstack((_lagged(v, W, s.order, s.taps, s.delay), *B))[rows]
    rest = v[rows] - X @ least_squares(X, v[rows])
    return float(rest @ rest)


NEAREST = 0.998
"""Radius from which on a pole counts as unstable: it rings through a record."""


def _reflected(f: Array) -> Array:
    """The polynomial with its unstable roots moved inside the circle."""
    if stable_polynomial(f / NEAREST ** np.arange(1, len(f) + 1), 1.0):
        return f
    roots = np.roots(np.concatenate(([1.0], f)))
    size = np.abs(roots)
    roots = np.where(
        size >= NEAREST, roots / np.maximum(size, 1e-9) * np.minimum(0.995, 1 / np.maximum(size, 1e-9)), roots
    )
    return np.real(np.poly(roots))[1:]


def numerators(y: Array, U: Array, f: Array, taps: int, delay: int, keep: Array) -> Array:
    """Numerators by least squares for a given denominator.

    Shapes: y (N,), U (N, nu), keep (N,), returns (nu * taps,).
    """
    X = _lagged(y, np.asarray(lfilter([1.0], np.concatenate(([1.0], f)), U, axis=0)), 0, taps, delay)
    return least_squares(X[keep], y[keep])


def _starts(y: Array, U: Array, n: int, taps: int, delay: int, keep: Array) -> list[Array]:
    """Denominators to start from: ARX, Steiglitz-McBride passes, and reduced high-order models."""
    theta = _regression(y, U, n, taps, delay, keep)
    out = [theta[:n]]
    f = _reflected(theta[:n])
    for _ in range(8):
        f = _prefiltered(y, U, f, taps, delay, keep, False)
        out.append(f)
    out = [out[0], out[2], out[-1]]
    high = min(max(3 * n, 12), len(y) // 20)
    theta = _regression(y, U, high, high, delay, keep)
    impulse = np.zeros(81)
    impulse[0] = 1.0
    f_high = _reflected(theta[:high])
    g = lfilter(np.concatenate(([0.0], theta[high : 2 * high])), np.concatenate(([1.0], f_high)), impulse)[1:]
    rows = len(g) // 2
    H = np.lib.stride_tricks.sliding_window_view(g, rows)[:rows].copy()
    try:
        left, sv, _ = np.linalg.svd(H[:, : rows - 1])
        O = left[:, :n] * np.sqrt(sv[:n])
        A = np.linalg.lstsq(O[:-1], O[1:], rcond=None)[0]
        out.append(np.real(np.poly(np.linalg.eigvals(A)))[1:])
    except np.linalg.LinAlgError:
        pass
    return out


def fresh_poles(
    y: Array, U: Array, s: Structure, keep: NDArray[np.bool_], passes: int = 3, begun: bool = False
) -> Array:
    """Denominator of a linear model from inputs U (N, inputs) to y (N,): ARX, then Steiglitz-McBride passes; of a record that has `begun`
    off its mean, or as one that stood on it."""
    y, U = y - np.mean(y[keep]), U - np.mean(U[keep], axis=0)
    f = _reflected(_regression(y, U, s.order, s.taps, s.delay, keep)[: s.order])
    for _ in range(passes):
        f = _prefiltered(y, U, f, s.taps, s.delay, keep, begun)
    return f


def relinearised(channel: Channel, s: Structure, p: Array) -> Array | None:
    """The parameters with those in which the output is linear at their least squares: an effect may change what they are worth.

    None where a curve at the output makes it linear in none.
    """
    if s.layout == "tanks" or any(q.effect.slot in (Slot.OUTPUT, Slot.PATH) for q in s.parts):
        return None
    head = s.order if s.layout == "tf" else LAYOUTS[s.layout][1]
    # signals that were found beside the linear part stay as they are
    added = [sl for part, sl in s.placed[2] if part.effect.per_sample]
    kept = {*range(head), *(i for sl in added for i in range(sl.start, sl.stop))}
    columns = {i: d for i, d in exact_columns(s, p, channel.u, channel.clock) if i not in kept}
    if not columns:
        return None
    at, X = list(columns), np.array(list(columns.values())).T
    rest = channel.y - simulate(s, p, channel.u, channel.clock)
    if not (finite(rest) and np.all(np.isfinite(X))):
        return None
    q = p.copy()
    q[at] += least_squares(X[channel.keep], rest[channel.keep], 1e-10)
    return q


TRANSIENT = 0.05
"""Of the deviance per sample, that starts with an initial state must win: a twentieth of the error's power."""


def begun_linear(
    channel: Channel, s: Structure, noise: Array | None = None, extra: list[Array] | None = None
) -> list[Fit]:
    """A few steps of the linear model's output-error fit from several starts, the best first."""
    y, U = channel.y, channel.u[:, list(s.inputs)]
    level, means = 0.0, np.zeros(U.shape[1])
    if any(p.effect is OFFSET for p in s.parts):  # both about their means: a start knows of no level
        level, means = float(np.mean(y[channel.keep])), np.mean(U[channel.keep], axis=0)
    centred, moved = y - level, U - means
    fits, off, starts = [], [], any(q.effect.slot is Slot.START for q in s.parts)
    for f in _starts(centred, moved, s.order, s.taps, s.delay, channel.keep) + list(extra or []):
        f = _reflected(f)
        if not stable_polynomial(f):
            continue
        b = numerators(centred, moved, f, s.taps, s.delay, channel.keep)
        p = np.concatenate((f, b, np.zeros(s.size - s.plant_size)))
        for part, sl in zip(s.parts, s.slices(), strict=True):
            if part.effect is OFFSET:
                gains = b.reshape(len(means), s.taps).sum(axis=1) / (1.0 + float(np.sum(f)))
                p[sl] = level - gains @ means
        scales = np.concatenate((plant_scales(s, p), np.full(s.size - s.plant_size, np.std(y) + 1e-300)))
        fits.append(fit(channel, s, p, scales, noise=noise, iterations=4, colour=False))
        if starts and (q := relinearised(channel, s, p)) is not None:
            off.append(fit(channel, s, q, scales, noise=noise, iterations=4, colour=False))
    # a start that knows of no transient bends the rest to it where the record begins in one
    least = [min((f.deviance for f in found), default=np.inf) for found in (fits, off)]
    fits = off if least[1] < least[0] - TRANSIENT * len(y) else fits
    return sorted(fits, key=lambda x: x.deviance)


def fit_linear(
    channel: Channel, s: Structure, *, noise: Array | None = None, extra: list[Array] | None = None, rough: bool = False,
    begun: list[Fit] | None = None,
) -> Fit:  # fmt: skip
    """Output-error fit of the linear model from several starts, or on from those that are `begun`."""
    fits = begun_linear(channel, s, noise, extra) if begun is None else begun
    if rough:
        return fit(channel, s, fits[0].p, fits[0].scales, noise=noise, iterations=10, colour=False)
    distinct = [fits[0]]
    for other in fits[1:]:
        if other.deviance > distinct[-1].deviance + 0.5 and len(distinct) < 2:
            distinct.append(other)
    final = [fit(channel, s, x.p, x.scales, noise=noise, iterations=40) for x in distinct]
    return min(final, key=lambda x: x.deviance)


def _rates(f: Array) -> tuple[list[float], list[tuple[float, float]]]:
    """Real rates and (a0, a1) of complex pairs, in continuous time per sample."""
    poles = np.roots(np.concatenate(([1.0], f))).astype(complex)
    real, pairs = [], []
    for z in poles:
        if abs(z.imag) < 1e-9:
            x = z.real if z.real > 0.02 else 0.05
            real.append(float(-np.log(min(x, 0.99999))))
        elif z.imag > 0:
            s = np.log(z)
            pairs.append((float(abs(s) ** 2), float(-2 * s.real)))
    return sorted(real), pairs


def _alone(channel: Channel, s: Structure, p: Array) -> list[Array]:
    """What each input of a transfer function does by itself."""
    one = [replace(s, inputs=(j,), parts=()) for j in s.inputs]
    b = p[s.order : s.plant_size].reshape(len(s.inputs), s.taps)
    return [
        simulate(q, np.concatenate((p[: s.order], row)), channel.u, channel.clock)
        for q, row in zip(one, b, strict=True)
    ]


def _column(layout: str, r: Array, C: Array, u: Array, wanted: Array) -> Array:
    """The (order,) column by which a further input u enters a layout, for its part of the output to be what is wanted."""
    pair = np.stack((np.zeros(len(u)), u), axis=1)
    X = np.stack([states(layout, np.concatenate((r, e)), pair) @ C for e in np.eye(len(C))], axis=1)
    return np.linalg.lstsq(X, wanted, rcond=1e-9)[0]


def _layouts_of(
    order: int, real: list[float], pairs: list[tuple[float, float]]
) -> list[tuple[str, list[float]]]:
    """The physical layouts of an order, each with the rates that put its poles where the model has them."""

    def pair_of(a: float, b: float) -> tuple[float, float]:
        return a * b, a + b

    if order == 1:
        return [("first", [real[0]])]
    if order == 2 and pairs:
        w = np.sqrt(pairs[0][0])
        slow = [("integrator", [pairs[0][1]])] if pairs[0][0] < 1e-3 else []
        return [*slow, ("oscillator", [*pairs[0]]), ("cascade", [w, 1.2 * w]), ("chain", [w, 1.2 * w])]
    if order == 2:
        a, b = real
        slow = [("integrator", [b])] if a < 0.03 else []
        both = [(layout, rates) for layout in ("cascade", "chain") for rates in ([a, b], [b, a])]
        return [*slow, ("oscillator", [*pair_of(a, b)]), *both]
    if order == 3:
        rates = [*pairs[0], real[0]] if pairs else [*pair_of(*real[:2]), real[2]]
        return [("driven", rates), ("sensed", rates)]
    if order == 4:
        first, second = [*pairs, *(pair_of(*real[i : i + 2]) for i in range(0, len(real), 2))][:2]
        return [("modes", [*first, *second]), ("modes", [*second, *first])]
    return []


def layout_starts(channel: Channel, base: Fit) -> list[tuple[Structure, Array, Array]]:
    """The linear fit in each physical layout of its order, output map by least squares."""
    s = base.structure
    alone = _alone(channel, s, base.p)
    main = int(np.argmax([np.std(y) for y in alone]))
    order = [main, *(j for j in range(len(s.inputs)) if j != main)]
    out = []
    target = channel.y - (simulate(s, base.p, channel.u, channel.clock) - alone[main])
    U = channel.u[:, [s.inputs[j] for j in order]]
    if s.delay:
        U = np.concatenate((np.zeros((s.delay, U.shape[1])), U[: -s.delay]))
    for layout, rates in _layouts_of(s.order, *_rates(base.p[: s.order])):
        r = np.log(np.maximum(rates, 1e-6))
        X = states(layout, r, U[:, 0])
        if not np.all(np.isfinite(X)):
            continue
        C = np.linalg.lstsq(X[channel.keep], target[channel.keep], rcond=None)[0]
        new = replace(s, layout=layout, inputs=tuple(s.inputs[j] for j in order))
        further = [_column(layout, r, C, u, alone[j]) for u, j in zip(U.T[1:], order[1:], strict=True)]
        p = np.concatenate((r, C, *further, base.p[s.plant_size :]))
        sizes = [np.full(len(b), np.abs(b).max() + 1e-300) for b in (C, *further)]
        scales = np.concatenate((np.ones(len(r)), *sizes, base.scales[s.plant_size :]))
        for part, sl in zip(new.parts, new.slices(), strict=True):
            if part.effect.slot is Slot.START:  # the same free response, as a state of the layout
                old = s.slices()[new.parts.index(part)]
                wanted = free_responses(s, base.p, len(channel)) @ base.p[old]
                p[sl] = np.linalg.lstsq(free_responses(new, p, len(channel)), wanted, rcond=None)[0]
                scales[sl] = np.abs(p[sl]) + 0.1 * np.abs(p[sl]).max() + 1e-300
        out.append((new, p, scales))
    return out
