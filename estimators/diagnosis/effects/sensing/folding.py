"""Sensors that fold their signal: magnitudes, squares, rectifiers, angles of one turn.

A linear model has no gain through an even curve, and its residual shows nothing of what is behind it: the signal is
unfolded (signs of segments, turns counted), or dynamics are drawn at random and the signs follow from them in turn.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.output import KEPT
from estimators.residual.algebra import delayed

Array = NDArray[Any]
DRAWS = 24  # random sets of poles
ROUNDS = 12  # of signs from the model, and the model from the signs
SEED = 1987  # of the poles: the same record has the same answer
NEAR_ZERO = 0.35  # of the mean magnitude: below it a minimum may be a change of sign
# poles of a filter behind the fold: a jump is one of the angle only where it is undone
LAGS = np.arange(0.0, 0.96, 0.05)
FOLLOWED, BY, FORMS = (3, 2, 2)  # of them, whose angle so many poles follow best; models fitted
# of the least error of the whole reading, up to which a lag may be the right one: what is clear of all jumps tells of no turn
ALIKE = 1.3
LEAST_TURNS = 2  # jumps of a record that make it one of an angle
COUNTS = 3  # rounds of turns from the model, and the model from the turns
CLEAR, TAIL = 3, 10  # samples before and after a jump that say little: a filter keeps them
ORDERS_TURNED = (1, 2, 3, 4)  # of the angle
ORDERS_FOLDED = (2, 3)
"""Of what is behind a fold, beside the linear model's: two drives on a belt swing and lag."""
MOVED = 0.2  # of a turn, from sample to sample, beyond which an angle is in the middle of a jump


def _wrapped(x: Array, p: Array, clock: Clock) -> Array:
    """The angle on straight lines between samples, its turns taken off where it passes their end, through the filter.

    A jump takes part of a sample, and the errors are smooth in the parameters.
    """
    from scipy.signal import lfilter

    modulus, offset, centre, pole = p
    if abs(modulus) < 1e-12 * (np.ptp(x) + 1e-300) or not 0.0 <= pole < 1.0:
        return np.full(len(x), np.inf)
    t = x + (offset - centre)
    turns = np.floor(t / modulus + 0.5)
    before, count = np.concatenate((t[:1], t[:-1])), np.concatenate((turns[:1], turns[:-1]))
    moved = np.where(turns != count, t - before, 1.0)
    when = np.clip((0.5 * modulus * (turns + count) - before) / moved, 0.0, 1.0)
    late = (1.0 - pole ** (1.0 - when)) / (1.0 - pole)  # the filter's weight of what comes after the jump
    # where in the sample its weight lies
    mean = 1.0 / (1.0 - pole) + 1.0 / np.log(pole) if pole > 0.0 else 1.0
    y = centre + before + mean * (t - before) - modulus * (count + (turns - count) * late)
    return y[0] + np.asarray(lfilter([1.0 - pole], [1.0, -pole], y - y[0]))


def _random_poles(rng: np.random.Generator, order: int) -> Array:
    """A stable denominator of rates between a hundredth and one per sample, some of its poles in pairs."""
    poles: list[complex] = []
    while len(poles) < order:
        size = float(np.exp(rng.uniform(np.log(0.01), 0.0)))
        if order - len(poles) > 1 and rng.random() < 0.5:
            damping = rng.uniform(0.05, 0.9)
            z = np.exp(size * (-damping + 1j * np.sqrt(1.0 - damping**2)))
            poles += [z, np.conj(z)]
        else:
            poles.append(np.exp(-size))
    return np.real(np.poly(poles))[1:]


def _unfolded(t: Array) -> Array:
    """Signs that change at every minimum near zero."""
    smooth = np.convolve(t, np.ones(3) / 3.0, mode="same")
    inner = (
        (smooth[1:-1] <= smooth[:-2]) & (smooth[1:-1] < smooth[2:]) & (smooth[1:-1] < NEAR_ZERO * t.mean())
    )
    flips = np.concatenate(([0], inner, [0]))
    return np.where(np.cumsum(flips) % 2 == 0, 1.0, -1.0)


@dataclass(frozen=True, eq=False)
class _Fold:
    """How a sensor folds: what is seen without its curve, and the target of the linear part given its own output."""

    seen: Callable[[Array], Array]
    # (magnitude seen, linear part) -> what the linear part should have been
    target: Callable[[Array, Array], Array]


EVEN = _Fold(np.abs, lambda t, x: np.where(x < 0, -t, t))
SQUARE = _Fold(lambda y: np.sqrt(np.maximum(y, 0.0)), lambda t, x: np.where(x < 0, -t, t))
HALF = _Fold(lambda y: np.maximum(y, 0.0), lambda t, x: np.where(t > 0.15 * t.mean(), t, np.minimum(x, t)))


def _behind(effect: Callable[[], Effect], fold: _Fold) -> Callable[..., Iterator[Any]]:
    """Fits of a linear part behind a fold, from unfolded signs and from random poles.

    The model before it was fitted to what the fold left: its order need not hold for what is behind.
    """

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.effects.profiled import of_order

        s = base.structure
        if s.layout != "tf" or s.effects:
            return
        for n in sorted({s.order, *ORDERS_FOLDED}):
            new, _, sizes = of_order(base, n, s.taps if n == s.order else n)
            yield from _of_order(effect(), fold, channel, base, new, sizes)

    return search


def _of_order(effect: Effect, fold: _Fold, channel: Any, base: Any, s: Any, sizes: Array) -> Iterator[Any]:
    """Fits of a linear part of one structure behind a fold."""
    from scipy.signal import lfilter

    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fresh_poles
    from estimators.diagnosis.model.structure import Part, stable_polynomial

    y, keep = channel.y, channel.keep
    floor = float(np.quantile(y[keep], 0.002)) if any(q.effect is OFFSET for q in s.parts) else 0.0
    t = np.where(keep, fold.seen(y - floor), 0.0)
    U = channel.u[:, list(s.inputs)]

    def regressors(f: Array) -> Array:
        v = np.asarray(lfilter([1.0], np.concatenate(([1.0], f)), U, axis=0))
        late = [delayed(x[:, None], range(1 + s.delay, 1 + s.delay + s.taps)) for x in v.T]
        return np.column_stack([*late, np.ones(len(y))])

    def settled(f: Array, target: Array) -> tuple[float, Array, Array, Array]:
        """(error, numerators and level, what the linear part should be, its denominator) after rounds of signs."""
        X = regressors(f)
        Q, R = np.linalg.qr(X[keep])
        theta = np.zeros(X.shape[1])
        for _ in range(ROUNDS):
            theta = np.linalg.lstsq(R, Q.T @ target[keep], rcond=1e-10)[0]
            again = fold.target(t, X @ theta)
            if np.array_equal(again, target):
                break
            target = again
        return float(np.sum((target - X @ theta)[keep] ** 2)), theta, target, f

    rng = np.random.default_rng(SEED)
    found = []
    for draw in range(DRAWS):
        known = draw == 0 and s.order == base.structure.order
        f = base.p[: s.order] if known else _random_poles(rng, s.order)
        X = regressors(f)
        guess = X @ (
            rng.standard_normal(X.shape[1]) / (np.std(X, axis=0) + np.abs(np.mean(X, axis=0)) + 1e-300)
        )
        found += [settled(f, fold.target(t, guess)), settled(f, _unfolded(t) * t)]
    found.sort(key=lambda entry: entry[0])
    better = []
    for entry in found[:4]:
        for _ in range(4):  # the poles from the signs, and the signs from the poles
            f = fresh_poles(entry[2], U, s, keep)
            if not stable_polynomial(f):
                break
            again = settled(f, entry[2])
            if again[0] > 0.999 * entry[0]:
                break
            entry = again
        better.append(entry)
    new = s.adding(Part(effect, s.inputs[0]))
    scales = np.concatenate((sizes, [float(np.std(t)) + 1e-300]))
    scales[: s.order] = 1.0
    for _, theta, _, f in sorted(better, key=lambda entry: entry[0])[:2]:
        p = np.zeros(new.size)
        p[: s.order], p[s.order : s.plant_size], p[-1] = f, theta[:-1], theta[-1]
        for q, sl in zip(new.parts, new.slices(), strict=True):
            if q.effect is OFFSET:
                p[sl] = floor
        scales[s.order : s.plant_size] = np.abs(theta[:-1]) + 0.1 * np.abs(theta[:-1]).max() + 1e-300
        yield fit(channel, new, p, scales.copy(), noise=base.noise, iterations=30)


def _unrolled(y: Array, pole: float, keep: Array) -> tuple[Array, Array, tuple[float, float]] | None:
    """(angle, samples clear of jumps, (turn, middle)) of a reading without its filter and its turns."""
    seen = np.concatenate((y[:1], (y[1:] - pole * y[:-1]) / (1.0 - pole)))
    clear = keep & np.concatenate((keep[:1], keep[:-1]))  # the filter remembers what does not count
    low, high = (float(v) for v in np.quantile(seen[clear], (0.002, 0.998)))
    turn, step, sure = high - low, np.abs(np.diff(seen)), clear.copy()
    sure[1:] &= step < MOVED * turn
    sure[:-1] &= step < MOVED * turn
    if sure.sum() < len(y) // 2:
        return None
    at = np.flatnonzero(sure)
    jumps = at[1:][np.abs(np.diff(seen[sure])) > 0.5 * turn]
    if not LEAST_TURNS <= len(jumps) <= len(y) // 8:
        return None
    clear[np.clip(jumps[:, None] + np.arange(-CLEAR, TAIL + 1), 0, len(y) - 1)] = False
    angle = np.interp(np.arange(len(y)), at, np.unwrap(seen[sure], period=turn))
    return angle, clear, (turn, 0.5 * (low + high))


def _turns(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """An angle of one turn: its jumps counted, behind filters of several lags, and a linear model of the angle unrolled.

    The model before it was fitted to the jumps: neither its order nor its delay need hold for the angle.
    """
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Part

    s, y, keep = base.structure, channel.y, channel.keep
    if s.layout != "tf" or s.effects or np.mean(keep) < KEPT:
        return
    few, tried, far = replace(s, order=BY, taps=BY, delay=0), [], MOVED * float(np.ptp(y[keep]))
    for pole in map(float, LAGS):
        if (found := _unrolled(y, pole, keep)) is not None:
            angle, clear, (turn, centre) = found
            f = fit_linear(replace(channel, y=angle, keep=clear), few, rough=True)
            run = simulate(f.structure, f.p, channel.u, channel.clock)
            e = y - _wrapped(run, np.array([turn, 0.0, centre, pole]), channel.clock)
            whole = float(np.mean(np.minimum(np.abs(e), far)[keep] ** 2))
            tried.append((whole, float(np.mean(f.residual[clear] ** 2)) * (1.0 - pole) ** 2, pole, found))
    least = ALIKE * min((whole for whole, *_ in tried), default=0.0)
    for _, _, pole, found in sorted(tried, key=lambda t: (max(t[0], least), t[1]))[:FOLLOWED]:
        angle, clear, (turn, centre) = found
        seen = np.concatenate((y[:1], (y[1:] - pole * y[:-1]) / (1.0 - pole)))
        forms = [replace(s, order=n, taps=n, delay=d) for n in ORDERS_TURNED for d in {0, s.delay}]
        fits = [fit_linear(replace(channel, y=angle, keep=clear), form, rough=True) for form in forms]
        for f in sorted(fits, key=lambda f: f.criterion)[:FORMS]:
            size = turn
            for _ in range(COUNTS):  # the turn and their number from the model, and the model from them
                away = simulate(f.structure, f.p, channel.u, channel.clock) - seen
                count = np.round(away / size)
                if not np.any(count[clear]):
                    break
                size = float(away[clear] @ count[clear] / (count[clear] @ count[clear]))
                f = fit_linear(replace(channel, y=seen + size * count, keep=clear), f.structure, rough=True)
            new = f.structure.adding(Part(WRAPPED, s.inputs[0]))
            p = np.concatenate((f.p, [size, 0.0, centre, pole]))
            scales = np.concatenate((f.scales, [turn, turn, turn, 1.0]))
            for q, sl in zip(new.parts, new.slices(), strict=True):
                if q.effect is OFFSET:  # inside the fold
                    p[-3], p[sl], scales[sl] = p[sl.start], 0.0, 0.0
            # a jump that comes samples early or late says nothing of the parameters yet
            for _ in range(COUNTS):
                e = y - simulate(new, p, channel.u, channel.clock)
                near = replace(channel, keep=keep & (np.abs(e) < MOVED * size))
                p = fit(near, new, p, scales, iterations=10, colour=False).p
            yield fit(channel, new, p, scales, noise=base.noise, iterations=30)


def _folded(
    key: str, sentence: str, apply: Callable[..., Any], fold: _Fold, effect: Callable[[], Effect]
) -> Effect:
    return Effect(
        key=key, cause="magnitude_sensor", nature=Nature.OUTPUT_STATIC, slot=Slot.OUTPUT, sentence=sentence, apply=apply,
        parameters={"level": "y"}, trials=2.0 * DRAWS, search=_behind(effect, fold),
    )  # fmt: skip


MAGNITUDE = _folded("magnitude", "the sensor reads the magnitude |y + level|", lambda x, p, c: np.abs(x + p[0]), EVEN,
                    lambda: MAGNITUDE)  # fmt: skip


STRAIGHT = 3.0
"""Spans of the signal from the fold of a parabola, beyond which its slope changes by less than a third over all of the signal: a
curve of any other sensor, which has effects of its own, and a line that takes the place of the model's gain."""


def _square(x: Array, p: Array, clock: Clock) -> Array:
    near = np.min(np.abs(x + p[0])) < STRAIGHT * np.ptp(x)
    return (x + p[0]) ** 2 if near else np.full(len(x), np.inf)


SQUARED = _folded("squared", "the sensor reads the square (y + level)^2", _square, SQUARE, lambda: SQUARED)
RECTIFIED = _folded("rectified", "the sensor reads one side only: max(y + level, 0)",
                    lambda x, p, c: np.maximum(x + p[0], 0.0), HALF, lambda: RECTIFIED)  # fmt: skip
WRAPPED = Effect(
    key="wrapped", cause="wrapped_angle", nature=Nature.OUTPUT_STATIC, slot=Slot.OUTPUT, memory=True, trials=12,
    sentence="the sensor reads an angle of one turn, modulo the turn, through a filter", apply=_wrapped,
    parameters={"turn": "y", "offset": "y", "centre": "y", "pole": "1"}, search=_turns,
    curve=lambda x, p: p[2] + (x + p[1] - p[2]) - p[0] * np.floor((x + p[1] - p[2]) / p[0] + 0.5),
)  # fmt: skip

CUT, GAP = (0.02, 0.6), 2.0
"""Share of the samples that a sensor may have cut off; and how far the least that it shows lies above what it reads there, in standard
deviations of that."""
FINE = 200  # part of a record that may lie in the gap all the same, as noise


def _blank(y: Array) -> tuple[NDArray[np.bool_], float] | None:
    """The samples that a sensor reads below its least level, and what it reads there; None without a gap above them."""
    ordered, few = np.sort(y), max(1, len(y) // FINE)
    first, last = (int(f * len(y)) for f in CUT)
    wide = ordered[first + few : last + few] - ordered[first:last]
    at = first + int(np.argmax(wide)) if len(wide) else 0
    low = y <= ordered[at]
    clear = len(wide) and ordered[at + few] - ordered[at] > GAP * float(np.std(y[low]))
    return (low, float(y[low].mean())) if clear else None


def _level(x: Array, y: Array, reading: float) -> float:
    """The level of a signal below which a reading is nearer to what is read than the signal is, in all."""
    order = np.argsort(x)
    gained = np.cumsum(((y - x) ** 2 - (y - reading) ** 2)[order])
    at = int(np.argmax(gained[:-1]))
    return float(x[order[at : at + 2]].mean())


def _cutting(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A linear model of what is not cut off, then the level from which on it is, where the record is nearest to the two of them."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.simulation import simulate
    from estimators.diagnosis.model.structure import Part

    s, y = base.structure, channel.y
    if s.layout != "tf" or s.effects or np.mean(channel.keep) < KEPT or (found := _blank(y)) is None:
        return
    low, reading = found
    f = fit_linear(replace(channel, keep=channel.keep & ~low), s)
    new, p = s.adding(Part(CUTOFF, s.inputs[0])), np.append(f.p, [0.0, reading])
    scales = np.append(f.scales, [float(np.std(y))] * 2)
    for _ in range(COUNTS):  # the level has no derivative
        x = simulate(s, p[:-2], channel.u, channel.clock)
        p[-2] = _level(x, y, p[-1])
        p = fit(channel, new, p, scales, noise=base.noise, iterations=10, colour=False).p
    yield fit(channel, new, p, scales, noise=base.noise, iterations=30)


CUTOFF = Effect(
    key="output_cutoff", cause="output_nonlinearity", nature=Nature.OUTPUT_STATIC, slot=Slot.OUTPUT, trials=12,
    sentence="the sensor reads one value for all that is below a level: a cut-off of low flows, a speed too slow to be counted",
    apply=lambda x, p, c: p[1] + (x - p[1]) * (x > p[0]), parameters={"level": "y", "reading": "y"}, search=_cutting,
)  # fmt: skip

FOLDING = (MAGNITUDE, SQUARED, RECTIFIED, WRAPPED, CUTOFF)
