"""Effects at the input that are profiled: a staircase, a periodic gain, a machine that runs up.

Their likelihood has many minima over the shape, and poles that bent to imitate them hide which is the right one: every shape
of a grid has the linear part made anew before the shapes are compared.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks, lfilter

from estimators.diagnosis.effects.disturbances.added import harmonics, in_series, run_up, swept_line, turning
from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot

Array = NDArray[Any]
FIRM = 60.0
"""Likelihood ratio of the best shape of a grid, against the linear model, below which nothing is fitted: chance over some
hundred shapes of three parameters reaches 25 in white noise, twice that in a coloured one."""
BEGUN, ENDED = 6, 2
"""Shapes that a few steps are made from, and those of them that are fitted to the end."""
FINEST = 30.0
"""Steps across the input's range: finer ones leave a hundredth of it as an error."""
CROSSED = 0.02
"""Of a step, by which it and its level are moved for a derivative: as many samples cross an edge that their number says something."""
NEAREST = 0.02  # of its first step, the smallest by which an edge is moved
AROUND = np.array([(a, b) for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0) if a or b])
"""Ways in which two parameters are moved."""
COARSE = 0.1
"""Power of its step by which a staircase is preferred: on an input of few levels, finer ones are the same."""
HARMONIC = (0.5, 1.6)
"""Size of a sawtooth's first harmonic, over what its step says, from which on it may be one: whatever else a residual has in
common with a wave over the input's levels has any size."""
WHOLE = (0.85, 1.15, 61)
"""Steps that are tried with a level at zero, over the one found: from, to, how many."""
LEAST_TURNS = 1.2  # of a gain in a record: fewer are a drift
WAVES, WAVED, REPEATS = 12, 20.0, 3.0
"""Harmonics of a periodic gain, what each must gain of Schwarz's criterion, and its turns in a record: less would be any function of time."""
MOST_FLOWS = 3  # inputs of a record that are tried with one another
QUICK = 0.2  # pole of the filter behind a process or a loop that its shapes are tried with


def _stairs(x: Any, p: Array, clock: Clock) -> Any:
    step = abs(p[0]) + 1e-300
    return p[1] + step * np.floor((x - p[1]) / step + 0.5)


def _bit_stuck(x: Any, p: Array, clock: Clock) -> Any:
    """A signal without a bit of its code: of the weight p[0], and zero at the level p[1]."""
    weight = abs(p[0]) + 1e-300
    return x - weight * (np.floor((x - p[1]) / weight) % 2.0)


def swaying(x: Any, p: Array, clock: Clock) -> Any:
    """A signal times a gain that changes periodically: its frequency, then the cosine's and sine's size of each harmonic."""
    if not LEAST_TURNS <= abs(p[0]) * clock.length / (2.0 * np.pi) <= 0.5 * clock.length:
        return 0.0 * x + np.inf
    return x * (1.0 + in_series(p, clock))


def profile(
    channel: Any, base: Any, part: Any, shapes: Iterable[Any], start: Array | None = None
) -> list[tuple[float, Array]]:
    """(sum of squares, parameters) of each shape with the numerators made for it, the best first."""
    from estimators.diagnosis.model.linear import relinearised
    from estimators.diagnosis.model.simulation import simulate

    s, found = base.structure.adding(part), []
    for shape in shapes:
        p = np.concatenate((base.p if start is None else start[: len(base.p)], shape))
        p = p if (again := relinearised(channel, s, p)) is None else again
        y = simulate(s, p, channel.u, channel.clock)
        if np.all(np.isfinite(y)):
            found.append((float(np.sum((channel.y - y)[channel.keep] ** 2)), p))
    return sorted(found, key=lambda entry: entry[0])


def descended(
    around: Callable[[Array, float], Iterable[tuple[float, Array]]], best: tuple[float, Array]
) -> tuple[float, Array]:
    """(sum of squares, parameters), moved to the best of those around it at a distance for as long as the error falls, by ever smaller
    ones: what the samples that cross an edge, or the commands that pass, tell of it has no derivative."""
    size = 1.0
    while size > NEAREST:
        near = min(around(best[1], size), key=lambda entry: entry[0], default=best)
        best, size = (near, size) if near[0] < best[0] else (best, 0.5 * size)
    return best


def nearer(
    channel: Any, base: Any, part: Any, best: tuple[float, Array], steps: Array
) -> tuple[float, Array]:
    """(sum of squares, parameters) with the last two parameters moved by steps."""

    def around(p: Array, size: float) -> list[tuple[float, Array]]:
        shapes = (np.concatenate((p[len(base.p) : -2], p[-2:] + size * steps * d)) for d in AROUND)
        return profile(channel, base, part, shapes, p)

    return descended(around, best)


def firm(base: Any, left: float) -> bool:
    """Whether a sum of squares is that much below the base model's."""
    return gained(base.n, float(np.sum(base.residual**2)), left) > FIRM


def gained(n: int, before: float, left: float) -> float:
    """Twice the log-likelihood that a smaller sum of squares gains; none where nothing is left, as of a record without noise."""
    return n * float(np.log(max(max(before, 1e-300) / max(left, 1e-300), 1e-300)))


def ended(channel: Any, base: Any, part: Any, starts: Iterable[Array], sizes: list[float]) -> Iterator[Any]:
    """The best of the starts after a few steps, fitted to the end."""
    from estimators.diagnosis.model.fitting import fit

    s, scales = base.structure.adding(part), np.concatenate((base.scales, sizes))
    begun = [fit(channel, s, p, scales, noise=base.noise, iterations=10, colour=False) for p in starts]
    for f in sorted(begun, key=lambda f: f.deviance)[:ENDED]:
        yield fit(channel, s, f.p, scales, noise=base.noise, iterations=30)


def of_order(f: Any, order: int, taps: int) -> tuple[Any, Array, Array]:
    """A fit's structure with another number of poles and coefficients, and the parameters and scales that its parts keep. The linear part
    has no scales, and would be held, until `plant_scales` gives it some."""
    few = replace(f.structure, order=order, taps=taps)
    p, scales = np.zeros(few.size), np.zeros(few.size)
    for now, then in zip(few.slices(), f.structure.slices(), strict=True):
        known = min(now.stop - now.start, then.stop - then.start)
        p[now][:known], scales[now][:known] = f.p[then][:known], f.scales[then][:known]
        scales[now][known:] = f.scales[then][-1:]  # of starting states that the other order has not
    return few, p, scales


def quick_behind(channel: Any, base: Any) -> list[Any]:
    """The fit with a quick linear part of gains alone, for shapes that replace the dynamics, whose poles are not the linear model's; without
    a delay, as what a limit holds back looks late to a linear model, and with the linear model's."""
    s, p, scales = of_order(base, 1, 2)
    gains = [np.std(channel.y) / (np.std(channel.u[:, j]) + 1e-300) for j in s.inputs]
    p[0], p[1 : s.plant_size] = -QUICK, 0.0
    scales[0], scales[1 : s.plant_size] = 1.0, np.repeat(gains, 2)
    return [replace(base, structure=replace(s, delay=d), p=p, scales=scales) for d in sorted({0, s.delay})]


def profiled_behind(
    channel: Any, base: Any, part: Any, shapes: Iterable[Any]
) -> tuple[Any, list[tuple[float, Array]]]:
    """The quick linear part behind which a shape leaves least, and the profile with it."""
    found: list[tuple[Any, list[tuple[float, Array]]]] = [
        (quick, []) for quick in quick_behind(channel, base)
    ]
    for shape in shapes:  # one after the other behind each: what its recursion makes of the input is the same
        for quick, tried in found:
            tried += profile(channel, quick, part, [shape])
    for _, tried in found:
        tried.sort(key=lambda entry: entry[0])
    return min(found, key=lambda entry: entry[1][0][0] if entry[1] else np.inf)


def lean(channel: Any, fits: Iterable[Any]) -> Iterator[Any]:
    """Each fit, with one pole of its linear part after the other left out for as long as Schwarz's criterion falls: the linear
    model had poles that imitate the effect, and one of them that stays at the circle stands for a constant of the record."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fresh_poles, plant_scales, relinearised
    from estimators.diagnosis.model.simulation import acted

    for f in fits:
        yield f
        while (order := f.structure.order - 1) > 0:
            few, p, scales = of_order(f, order, min(f.structure.taps, order))
            bare = replace(few, parts=())
            U = acted(f.structure, f.p, channel.u, channel.clock)
            if U is None:
                break
            p[:order] = fresh_poles(channel.y, U, bare, channel.keep)
            if (q := relinearised(channel, few, p)) is None:
                break
            scales[: few.plant_size] = plant_scales(few, q)
            less = fit(channel, few, q, scales, noise=f.noise, iterations=30)
            if not less.criterion < f.criterion:
                break
            f = less
            yield f


def through(base: Any, j: int, x: Array) -> Array:
    """Signals (N, ...) through the linear part of input j, and its noise model's inverse."""
    s = base.structure
    at = s.order + s.inputs.index(j) * s.taps
    num = np.concatenate((np.zeros(1 + s.delay), base.p[at : at + s.taps]))
    out = lfilter(num, np.concatenate(([1.0], base.p[: s.order])), x, axis=0)
    return np.asarray(
        lfilter(np.concatenate(([1.0], base.noise)), [1.0], out, axis=0) if len(base.noise) else out
    )


def left_over(channel: Any, base: Any) -> tuple[Array, Array]:
    """The residual, white and free of what the model's parameters can take up, and the orthonormal directions of these."""
    from estimators.diagnosis.model.fitting import innovations

    Q = np.linalg.qr(base.jacobian)[0] if base.jacobian.size else np.zeros((len(channel), 0))
    r = innovations(np.where(channel.keep, base.residual, 0.0), base.noise)
    return r - Q @ (Q.T @ r), Q


def in_common(D: Array, r: Array) -> tuple[Array, Array]:
    """(M,) what each pair of responses explains of the residual, and its two coefficients (2, M); D (N, 2 M), the first of all
    pairs first."""
    m = D.shape[1] // 2
    sin, cos = D[:, :m], D[:, m:]
    a, b, c = np.sum(sin**2, axis=0), np.sum(sin * cos, axis=0), np.sum(cos**2, axis=0)
    x, y, d = sin.T @ r, cos.T @ r, np.maximum(a * c - b**2, 1e-9 * a * c + 1e-300)
    first, second = (c * x - b * y) / d, (a * y - b * x) / d
    return first * x + second * y, np.stack((first, second))


def entering(channel: Any, base: Any) -> Iterator[tuple[int, Array]]:
    """What enters the linear part at each input; nothing where it is in a physical layout."""
    from estimators.diagnosis.model.simulation import acted

    s = base.structure
    U = acted(s, base.p, channel.u, channel.clock) if s.layout == "tf" else None
    yield from () if U is None else zip(s.inputs, U.T, strict=True)


def highest(gains: Array, count: int) -> Array:
    """Where a curve has its highest peaks."""
    at = find_peaks(np.concatenate(([-1.0], gains, [-1.0])))[0] - 1
    return at[np.argsort(-gains[at])[:count]]


def rotating(channel: Any, base: Any, x: Array, passed: Callable[[Array], Array]) -> list[Array]:
    """What the residual has in common with the linear response to a signal (N,) times a rotation, at all frequencies at once: a
    transform of the signal times the residual run backwards through the model as `passed` is. Of the best, frequency and coefficients."""
    n, k, (r, Q) = len(channel), channel.clock.k, left_over(channel, base)
    pad = 8 * n
    back = passed(r[::-1])[::-1]
    g = passed(np.eye(1, n)[0])
    auto = lambda x: np.fft.irfft(np.abs(np.fft.rfft(x, 2 * n)) ** 2)[:n]
    power = 2.0 * np.fft.rfft(auto(g) * auto(x), pad).real - auto(g)[0] * auto(x)[0]
    common = 2.0 * np.abs(np.fft.rfft(x * back, pad)) ** 2 / np.maximum(power, 1e-9 * power.max())
    common[: int(np.ceil(LEAST_TURNS * pad / n))] = 0.0
    found, least = [], FIRM
    for w in 2.0 * np.pi * highest(common, 3) / pad:
        D = passed(x[:, None] * np.stack((np.cos(w * k), np.sin(w * k)), axis=1))
        D -= Q @ (Q.T @ D)
        c = np.linalg.lstsq(D, r, rcond=None)[0]
        promise = gained(base.n, float(r @ r), float(np.sum((r - D @ c) ** 2)))
        if promise > least:
            least = max(least, 0.5 * promise)  # what promises less than half of the best is its echo
            found.append(np.array([w, *c]))
    return found


def _beats(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The gain of each input, at the frequencies that the residual shows."""
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import renewed

    s, n = base.structure, len(channel)
    for j, u in entering(channel, base) if n >= 100 else ():
        part = Part(SWAY, j)
        begun = [
            np.concatenate((base.p, shape)) for shape in rotating(channel, base, u, partial(through, base, j))
        ]
        starts = [q for p in begun for q in (p, *renewed(channel, s.adding(part), p))]
        for f in lean(channel, ended(channel, base, part, starts, [1.0 / n, 1.0, 1.0])):
            yield from waved(channel, f)


def waved(channel: Any, f: Any) -> Iterator[Any]:
    """A periodic gain, and one harmonic after the other until two of them gain too little: what is filled and emptied is no sine, and
    what is switched has every other one only."""
    from estimators.diagnosis.model.fitting import fit

    yield f
    turns = abs(f.p[f.structure.slices()[-1].start]) * len(channel) / (2.0 * np.pi)
    best, missed = f, 0
    for size in range(2, WAVES + 1 if turns >= REPEATS else 2):
        s = replace(f.structure, parts=(*f.structure.parts[:-1], replace(f.structure.parts[-1], size=size)))
        f = fit(channel, s, np.append(f.p, [0, 0]), np.append(f.scales, [1, 1]), noise=f.noise, iterations=10)
        if f.criterion <= best.criterion - WAVED:
            best, missed = f, 0
            yield best
        elif missed:
            return
        else:
            missed = 1


def _running_up(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The same behind the plant, whose resonances it passes: of the linear model, and of poles made for it."""
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.search.starts import renewed

    s, n = base.structure, len(channel)
    if n < 100 or s.effects or s.layout != "tf":
        return
    line = swept_line(channel, base)
    turns, r = (
        turning(channel.clock.k, *line),
        np.convolve(base.residual, np.concatenate(([1.0], base.noise)))[:n],
    )
    for j in s.inputs:
        X, part, su = through(base, j, turns), Part(SWEEP_INPUT, j), float(np.std(channel.u[:, j]))
        first = np.concatenate((base.p, line, np.linalg.lstsq(X, r, rcond=None)[0], [0.0]))
        starts = [first, *renewed(channel, s.adding(part), first)]
        yield from ended(channel, base, part, starts, [1.0 / n, 1.0 / n**2, su, su, 1.0])


def _edged(effect: Callable[[], Effect], each: float, ahead: float) -> Callable[..., Iterator[Any]]:
    """What differs from its input by a wave over the input's levels, of which a step is `each` period, and which begins at a level so
    many periods `ahead` of where its first harmonic does: the period of most in common with the residual is taken, then step and
    level are moved as long as the error falls, as they have no derivative."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.structure import Part

        for j, u in entering(channel, base):
            part, (r, Q) = Part(effect(), j), left_over(channel, base)
            wide = float(np.ptp(u))
            if wide <= 0.0:
                continue
            waves = np.arange(1.0, FINEST, 0.25) / wide
            turn = 2.0 * np.pi * np.outer(u, waves)
            D = through(base, j, np.concatenate((np.sin(turn), np.cos(turn)), axis=1))
            gains, (first, second) = in_common(D - Q @ (Q.T @ D), r)
            found: list[tuple[float, Any]] = []
            for at in highest(gains / waves**COARSE, 3):
                period, size = 1.0 / float(waves[at]), float(np.hypot(first[at], second[at]))
                promise = -base.n * float(np.log(max(1.0 - gains[at] / max(float(r @ r), 1e-300), 1e-12)))
                if promise < FIRM or not HARMONIC[0] < size * np.pi / period < HARMONIC[1]:
                    continue
                phase = float(np.arctan2(second[at], first[at])) / (2.0 * np.pi)
                level = period * (ahead - phase)
                # near the mean, where it hangs on the step least
                level += period * round((float(np.mean(u)) - level) / period)
                found += _moved(channel, base, part, (each * period, level), each)
                if any(not len(f.noise) for _, f in found):
                    break  # nothing is left that another could explain
            yield from (f for _, f in sorted(found, key=lambda entry: entry[0])[:1])

    return search


def _moved(
    channel: Any, base: Any, part: Any, shape: tuple[float, float], each: float
) -> Iterator[tuple[float, Any]]:
    """The step and level of least error near a first guess, and the poles that they ask for, in turn; last with whole steps
    from zero. With each fit its deviance, less what whole steps are ahead by: they have no level of their own."""
    from estimators.diagnosis.search.starts import renewed

    s, f, sizes = base.structure.adding(part), base, [1e6 * CROSSED * shape[0]] * 2
    for whole in (False, False, True):
        best = profile(channel, base, part, [shape], f.p)[:1]
        if whole:
            steps = shape[0] * np.linspace(*WHOLE)
            tried = profile(
                channel, base, part, ([d, d / each * np.round(shape[1] * each / d)] for d in steps), f.p
            )
            equal = sorted((p[-2], p) for e, p in tried if e < (1.0 + 1e-9) * tried[0][0])
            best = [(tried[0][0], equal[len(equal) // 2][1])] if equal else []
        if best and not whole:
            best = [nearer(channel, base, part, best[0], np.full(2, 0.1 * shape[0]))]
        if not best or not firm(base, best[0][0]):
            return
        starts = [best[0][1], *renewed(channel, s, best[0][1])]
        f = min(ended(channel, base, part, starts, [0.0, 0.0] if whole else sizes), key=lambda f: f.deviance)
        f = replace(f, scales=np.concatenate((base.scales, sizes)))
        yield f.deviance - whole * float(np.log(f.n)), f
        shape = abs(float(f.p[-2])), float(f.p[-1])


STAIRS = Effect(
    key="input_staircase", cause="input_quantisation", nature=Nature.INPUT_STATIC, slot=Slot.INPUT, trials=300,
    sentence="the input acts in whole steps: a staircase", parameters={"step": "u", "level": "u"}, apply=_stairs,
    search=_edged(lambda: STAIRS, 1.0, 0.5),
)  # fmt: skip
STUCK = Effect(
    key="input_bit", cause="input_quantisation", nature=Nature.INPUT_STATIC, slot=Slot.INPUT, trials=300,
    sentence="a bit of the input's converter is stuck: every other step of its weight is missing, or twice as high", parameters={"weight_of_bit": "u", "level": "u"},
    apply=_bit_stuck, search=_edged(lambda: STUCK, 0.5, 0.0),
)  # fmt: skip

SWAY = Effect(
    key="gain_periodic", cause="periodic_gain", nature=Nature.TIME, slot=Slot.INPUT, per_sample=True, family="drifts",
    sentence="the gain changes periodically: (1 + a cos(w t) + b sin(w t)), with harmonics where there are some", apply=swaying, search=_beats,
    **harmonics("1"),
)  # fmt: skip

SWEEP_INPUT = Effect(
    key="sweep_input", cause="periodic_disturbance", nature=Nature.ADDED, slot=Slot.INPUT, per_sample=True, trials=40.0,
    sentence="a sinusoid of steadily changing frequency, a machine that runs up, acts beside the input", apply=run_up, search=_running_up,
    parameters={"frequency": "rad/sample", "rate": "rad/sample^2", "cosine": "u", "sine": "u", "growth": "1"},
)  # fmt: skip

PROFILED = (STAIRS, STUCK, SWAY, SWEEP_INPUT)
