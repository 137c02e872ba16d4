"""Where to start the fit of each effect: shapes scanned by their score against the fitted model."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Effect, Nature, Sizes, Slot
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.layouts import RATES, layout_matrices, states
from estimators.diagnosis.model.linear import fresh_poles, numerators, prefiltered_error, relinearised
from estimators.diagnosis.model.simulation import acted, joined, simulate
from estimators.diagnosis.model.structure import Part, Structure, stable_polynomial

Array = NDArray[Any]
SHARES = (1.0, 0.4)
"""Of the amplitude that the score promises: the model bends more than the score, which is linear."""

RENEWED = 4
"""Shapes of an effect whose linear part is made anew before they are compared: those whose score is best."""

SPARE, STEPS, ANEW = 2, 14, 3
"""Poles that a linear model may have to follow what drifts; Gauss-Newton steps from poles without them, and how often they are begun anew."""
DRIFTS = "drifts"  # the family of what changes with time and comes back, or does not
SLOW, MOST_RENEWED, DRIFTING = 20.0, 12, (DRIFTS, "heat")
"""A pole that remembers a twentieth of a record, or more, may have followed a drift in it: what a quicker one shows would be a fast change.
Shapes that are made anew then, of the families of what changes a gain slowly."""

QUICKLY = 8
"""Gauss-Newton steps by which a curve at the output finds its level, at most."""

LAGS = tuple(float(np.exp(-1.0 / tau)) for tau in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0))
"""Poles of an actuator's lag that are asked of a bend behind it, by octaves: a fit goes on from the nearest."""

LAGGING = (Nature.DYNAMIC, Nature.INPUT_STATIC)
AHEAD, CLOSE, AHEAD_STEPS = 4, 0.5, 30
"""Effects with a search of their own that are tried behind a lag, the best of those that gain such a share of the best gain; steps of their fits."""

TIMES, AGAIN = 100, 3
"""Times over a record at which a change of known size is put once more, as the best of 20 of unknown size may lie elsewhere; rounds of it."""

PACES = (0.3, 0.6)
"""Quick poles that may follow a process: a sensor's or an actuator's lag, from one sample on."""


@dataclass(frozen=True, eq=False)
class Start:
    """Parameters to start a fit from, their typical sizes, and the likelihood ratio that the score promises against the model without the effect."""

    structure: Structure
    p: Array
    scales: Array
    promise: float


@dataclass(frozen=True, eq=False)
class Scored:
    """The best shapes of an effect: what they promise, and the starts that `made` makes of them, once one of them is fitted."""

    promise: float = -np.inf
    made: Callable[[], list[Start]] = list

    @cached_property
    def starts(self) -> list[Start]:
        """The starts, most promising first."""
        return sorted(self.made(), key=lambda start: -start.promise)


def sizes_of(channel: Channel, base: Fit, part: Part) -> Sizes:
    """The signals of a fitted model that the starts of an effect take their sizes from."""
    u, y = channel.u[:, part.channel], channel.y - base.residual
    layout, order = base.structure.layout, base.structure.order
    if part.effect.slot is Slot.OUTPUT:  # what it reads has no level and nothing else added to it yet
        y = _before_added(channel, base.structure, base.p)[0]
    if part.effect.slot is not Slot.PLANT:
        poles = np.roots(np.concatenate(([1.0], base.p[:order]))) if layout == "tf" else np.zeros(0)
        return Sizes(u, y, channel.clock, poles=poles)
    s = base.structure
    rates, U = s.rates(base.p), channel.u[:, list(s.inputs)]
    u = u if part.effect.each else joined(s, rates, U)
    X = states(layout, rates, U)
    position, velocity = layout_matrices(layout, rates)[3:]
    damping = float(np.exp(np.subtract(*np.clip(rates[[1, 0]], *RATES)))) if len(rates) > 1 else 1.0
    return Sizes(u, y, channel.clock, X @ position, X @ velocity, damping=damping)


def _before_added(channel: Channel, s: Structure, p: Array) -> tuple[Array, NDArray[np.int_]]:
    """(N,) simulated output before anything is added to it, and which parameters make it."""
    bare, at = s.keeping([q.effect.slot is not Slot.ADDED for q in s.parts])
    return simulate(bare, p[at], channel.u, channel.clock), at


@dataclass(frozen=True, eq=False)
class _Score:
    """What a linear step of an effect's amplitude, `alpha` of the shape's in `p`, promises; `d` (N,) how the shape moves the innovations."""

    promise: float
    alpha: float
    p: Array
    d: Array


def _white(channel: Channel, base: Fit, x: Array) -> Array:
    """A signal as the noise model of a fit sees it, 0 where a sample does not count."""
    x = np.where(channel.keep, x, 0.0)
    return np.asarray(lfilter(np.concatenate(([1.0], base.noise)), [1.0], x)) if len(base.noise) else x


def _scores(
    channel: Channel, base: Fit, s: Structure, shapes: list[list[float]], Q: Array, signed: bool
) -> Iterator[_Score]:
    """The score of each shape, with the model's own parameters, whose derivatives Q spans, projected out."""
    reference = simulate(base.structure, base.p, channel.u, channel.clock)
    r = _white(channel, base, base.residual)
    r0 = r - Q @ (Q.T @ r)
    rss = float(r0 @ r0) + 1e-300
    for shape in shapes:
        p = np.concatenate((base.p, shape))
        y = simulate(s, p, channel.u, channel.clock)
        if not np.all(np.isfinite(y)):
            continue
        d = _white(channel, base, y - reference)
        d0 = d - Q @ (Q.T @ d)
        power = float(d0 @ d0)
        if power <= 1e-16 * float(d @ d) or power == 0:
            continue
        alpha = float(d0 @ r0) / power
        promise = base.n * -np.log(max(1.0 - alpha**2 * power / rss, 1e-12))
        yield _Score(promise if signed or alpha >= 0 else promise * 1e-3, alpha, p, d)


def scored(channel: Channel, base: Fit, part: Part, best: int) -> Scored:
    """The best shapes of an effect's grid by their score, the model's own parameters projected out."""
    if part.effect.starts is None:
        return Scored()
    grid, sizes = part.effect.starts(sizes_of(channel, base, part))
    s, amplitude, own = base.structure.adding(part), part.effect.amplitude, len(base.p)
    scales = np.concatenate((base.scales, sizes))
    r = _white(channel, base, base.residual)
    Q, R = np.linalg.qr(base.jacobian) if base.jacobian.size else (np.zeros((len(r), 0)), np.zeros((0, 0)))
    found = sorted(_scores(channel, base, s, grid, Q, amplitude is not None), key=lambda x: -x.promise)
    fresh: dict[int, list[Array]] = {}  # by shape
    if part.effect.slot in (Slot.INPUT, Slot.PLANT, Slot.OUTPUT) and not base.structure.effects:
        slow = part.effect.family in DRIFTING and followed(channel, base)
        for k, score in enumerate(found[: MOST_RENEWED if slow else RENEWED]):
            fresh[id(score.p)] = renewed(channel, s, score.p)
            fresh[id(score.p)] += _of_any_size(channel, s, score.p, scales) if slow else []
            promises = [score.promise]
            for q in fresh[id(score.p)]:
                rest = _white(channel, base, channel.y - simulate(s, q, channel.u, channel.clock))
                left = float(rest @ rest) / (float(r @ r) + 1e-300)
                promises.append(base.n * -np.log(max(left, 1e-12)))
            found[k] = replace(score, promise=max(promises))
        found.sort(key=lambda x: -x.promise)

    def start(score: _Score) -> Start:
        p, alpha = score.p, score.alpha
        step = alpha if amplitude is not None else min(max(alpha, 0.0), 1.0)
        move = np.zeros(own)
        if R.size:
            try:
                move = np.linalg.solve(R, Q.T @ (r - step * score.d))
            except np.linalg.LinAlgError:
                move = np.zeros(own)
        options = fresh[id(p)] if id(p) in fresh else renewed(channel, s, p)
        for share in SHARES if amplitude is not None else (1.0,):
            trial = p.copy()
            if amplitude is not None:
                trial[own + amplitude] *= alpha * share
            options.append(trial.copy())
            trial[:own] -= move
            options.append(trial)
        return Start(s, min(options, key=lambda q: _squares(channel, s, q)), scales, score.promise)

    quick: list[Start] = []
    if part.effect.alone and s.layout == "tf" and not base.structure.effects:
        quick = _quick(channel, s, [np.concatenate((base.p, shape)) for shape in grid], scales, base)
    promise = max((x.promise for x in (*found[:best], *quick)), default=-np.inf)
    return Scored(promise, lambda: [*map(start, found[:best]), *quick])


def followed(channel: Channel, base: Fit) -> bool:
    """Whether a slow pole of a linear model may have followed what drifts, so that its residual says little of that."""
    return base.structure.layout == "tf" and _slow(base.p[: base.structure.order], len(channel))


def steady_of(channel: Channel, base: Fit) -> Fit | None:
    """The linear model with the poles that changes from sample to sample show, where a slow one may have followed what drifts; of
    which the residual then says nothing."""
    s, y = base.structure, channel.y
    if s.effects or not followed(channel, base):
        return None
    U = channel.u[:, list(s.inputs)]
    keep = channel.keep & np.concatenate(([False], channel.keep[:-1]))
    f = fresh_poles(np.diff(y, prepend=y[0]), np.diff(U, axis=0, prepend=U[:1]), s, keep)
    if not stable_polynomial(f):
        return None
    q = relinearised(channel, s, np.concatenate((f, base.p[s.order :])))
    if q is None:
        return None
    held = np.where(np.arange(len(q)) < s.order, 0.0, base.scales)
    return replace(fit(channel, s, q, held, iterations=2, colour=False), scales=base.scales)


def _slow(f: Array, n: int) -> bool:
    """Whether the slowest pole of a denominator, without its 1, remembers a share of n samples."""
    return bool(np.abs(np.roots(np.concatenate(([1.0], f)))).max(initial=0.0) > 1.0 - SLOW / n)


def _quick(channel: Channel, s: Structure, shapes: list[Array], scales: Array, base: Fit) -> list[Start]:
    """The best of all shapes before a linear part of one quick pole: an effect that is a process has the slow one itself.

    Behind a process the linear model's slow pole must be cancelled by a zero, from which no fit finds the way back.
    """
    trials = []
    for p in shapes:
        for pole in PACES:
            q = p.copy()
            q[: s.order] = 0.0
            q[0] = -pole
            trials += [] if (again := relinearised(channel, s, q)) is None else [again]
    if not trials:
        return []
    best = min(trials, key=lambda q: _squares(channel, s, q))
    left = _squares(channel, s, best) / (float(np.sum(base.residual[channel.keep] ** 2)) + 1e-300)
    return [Start(s, best, scales, base.n * -np.log(max(left, 1e-12)))] if np.isfinite(left) else []


def renewed(channel: Channel, s: Structure, p: Array) -> list[Array]:
    """The parameters with a linear part that is made for the effects: with the poles as they are, and with fresh ones.

    A linear model bends its poles towards what it lacks; behind the right effect they are worth little.
    """
    if s.parts and s.parts[-1].effect.slot is Slot.OUTPUT:
        return _behind(channel, s, p)
    found = [] if (q := relinearised(channel, s, p)) is None else [q]
    entering = acted(s, p, channel.u, channel.clock) if found and s.layout == "tf" else None
    if entering is not None:
        # a pole too many settles where noise or a trend wants it
        spare = SPARE if _slow(p[: s.order], len(channel)) else 1
        for _, f in _of_fewer_poles(channel, s, entering, spare):
            q = np.concatenate((f, p[s.order :]))
            found += [] if (again := relinearised(channel, s, q)) is None else [again]
    return found


def _of_fewer_poles(
    channel: Channel, s: Structure, U: Array, spare: int
) -> Iterator[tuple[Structure, Array]]:
    """Structures of up to so many poles less, and the fresh poles of each for what enters (N, inputs), with zeros for those it has not."""
    for order in range(max(s.order - spare, 1), s.order + 1):
        few = replace(s, order=order, taps=min(s.taps, order), parts=())
        f = np.pad(fresh_poles(channel.y, U, few, channel.keep), (0, s.order - order))
        if stable_polynomial(f):
            yield few, f


def _of_any_size(channel: Channel, s: Structure, p: Array, scales: Array) -> list[Array]:
    """The parameters with an effect at an input, and the poles, made for what it adds there as for an input of its own.

    Its size need not be known then: the linear model's slow pole, which followed the level of a gain that drifts, says it has none.
    """
    part, at = s.parts[-1], s.slices()[-1].start
    if part.effect.amplitude is None or part.effect.slot is not Slot.INPUT:
        return []
    at, none = at + part.effect.amplitude, p.copy()
    none[at] = 0.0
    before, entering = (acted(s, q, channel.u, channel.clock) for q in (none, p))
    if before is None or entering is None:
        return []
    j = s.inputs.index(part.channel)
    U = np.column_stack((before, entering[:, j] - before[:, j]))
    y, centred = channel.y - channel.y[channel.keep].mean(), U - U[channel.keep].mean(axis=0)
    found = []
    for few, f in _of_fewer_poles(channel, s, U, SPARE):
        b = numerators(y, centred, f[: few.order], few.taps, s.delay, channel.keep)
        b, q, sized = b.reshape(U.shape[1], few.taps), np.concatenate((f, p[s.order :])), []
        # of the taps, and of what they add up to
        for of, to in ((b[j] @ b[-1], b[j] @ b[j]), (b[-1].sum(), b[j].sum())):
            q[at] = p[at] * (of / (to or 1.0))
            sized += [] if (again := relinearised(channel, s, q)) is None else [again]
        if sized:
            best = min(sized, key=lambda q: _squares(channel, s, q))
            for _ in range(ANEW):  # damped anew, a fit leaves a valley in which it crept
                best = fit(channel, s, best, scales, iterations=STEPS, colour=False).p
            found.append(best)
    return found


STEEP, FINE = 0.02, 400
"""Slope of a sensor's curve, of its median over what was seen, from which on a reading says what it is of; points of the curve."""


def quick_pole(channel: Channel, base: Fit, j: int) -> float:
    """The pole of a lag before input j's curve: that behind which a square and a cube of the input, as inputs of their own before the
    linear model's poles, explain most of what it leaves. A linear model's own poles need not have that lag among them."""
    s, x = base.structure, channel.u[:, j]
    x = (x - x[channel.keep].mean()) / (x[channel.keep].std() + 1e-300)
    y, left = channel.y - channel.y[channel.keep].mean(), []
    for pole in LAGS:
        z = np.asarray(lfilter([1.0 - pole], [1.0, -pole], x))
        U = np.column_stack((channel.u[:, list(s.inputs)], z, z**2, z**3))
        U -= U[channel.keep].mean(axis=0)
        f = np.concatenate(([1.0], fresh_poles(y, U, s, channel.keep, begun=True)))
        left.append(prefiltered_error(y, U, f, s, channel.keep, begun=True))
    return LAGS[int(np.argmin(left))]


def _behind(channel: Channel, s: Structure, p: Array) -> list[Array]:
    """The same for a curve at the output: the linear part is made for what the sensor saw, the curve undone where it can be.

    There it may stand at another level; the curve moves there with the poles as they are.
    """
    part, shape, others = s.parts[-1], p[s.slices()[-1]], [q.effect.slot for q in s.parts[:-1]]
    if not part.effect.static or s.layout != "tf" or Slot.OUTPUT in others:
        return []
    bare, known = s.keeping([True] * len(others) + [False])
    seen, seeing = _before_added(channel, bare, p[known])
    added = simulate(bare, p[known], channel.u, channel.clock) - seen
    grid = np.linspace(2.0 * seen.min() - seen.max(), 2.0 * seen.max() - seen.min(), FINE)
    curve = part.effect.drawn(grid, shape)
    if curve is None or not np.all(np.isfinite(curve)) or not np.ptp(grid) > 0.0:
        return []
    slope = np.gradient(curve)
    steep = np.flatnonzero(slope > STEEP * np.median(slope[FINE // 3 : 2 * FINE // 3]))
    if len(steep) < 2 or len(steep) != steep[-1] - steep[0] + 1:
        return []
    curve, grid, read = curve[steep], grid[steep], channel.y - added
    keep = channel.keep & (read > curve[0]) & (read < curve[-1])
    if keep.sum() < 0.5 * channel.keep.sum():
        return []
    undone = replace(channel, y=np.interp(read, curve, grid) + added, keep=keep)
    found = []
    for q in renewed(undone, bare, p[known]):
        start = p.copy()
        start[known[seeing]] = q[seeing]
        held = np.where(np.arange(len(p)) < s.order, 0.0, np.maximum(np.abs(start), STEEP))
        found.append(fit(channel, s, start, held, iterations=QUICKLY, colour=False).p)
    return found


def behind_a_lag(channel: Channel, base: Fit, fits: list[Fit]) -> Iterator[Fit]:
    """The best effects at an input that have a search of their own once more, behind a lag of the actuator, where that does better: it is
    no pole of the linear part after them."""

    def able(f: Fit) -> bool:
        part = f.structure.parts[-1]
        e, own = part.effect, {"lag", "behind"} & part.effect.parameters.keys()
        acts = e.slot is Slot.INPUT and e.nature in LAGGING and e.apply is not None and e.signal is None
        return acts and not part.first and not own and f.structure.layout == "tf" and len(f.noise) > 0

    best: dict[Effect, Fit] = {}
    for f in sorted((f for f in fits if able(f)), key=lambda f: f.deviance):
        best.setdefault(f.structure.parts[-1].effect, f)
    found = list(best.values())
    if not found or base.structure.effects:
        return
    least = base.deviance - CLOSE * (base.deviance - found[0].deviance)
    for f in found[:AHEAD]:
        if f.deviance <= least:
            *before, part = f.structure.parts
            new, at = (
                replace(f.structure, parts=(*before, replace(part, first=1))),
                f.structure.slices()[-1].start,
            )
            p, scales = np.insert(f.p, at, -LAGS[1]), np.insert(f.scales, at, 1.0)
            g = fit(channel, new, p, scales, noise=f.noise, iterations=AHEAD_STEPS)
            if g.criterion < f.criterion:
                yield g


def to_the_end(channel: Channel, f: Fit, iterations: int) -> Fit:
    """The fit continued; of a change at an instant also from wherever in the record a change of that size does best."""
    s, again = f.structure, fit(channel, f.structure, f.p, f.scales, noise=f.noise, iterations=iterations)
    at = s.slices()[-1].stop - 1
    for _ in range(AGAIN if s.parts[-1].effect.timed else 0):
        f, times = again, channel.clock.k[0] + np.linspace(0.01, 0.99, TIMES) * len(channel)
        trials = (np.concatenate((f.p[:at], [t], f.p[at + 1 :])) for t in times)
        best = min(trials, key=lambda q: _squares(channel, s, q))
        again = fit(channel, s, best, f.scales, noise=f.noise, iterations=iterations)
        if not again.criterion < f.criterion:
            return f
    return again


def fitted(channel: Channel, base: Fit, starts: Iterable[Start], iterations: int) -> list[Fit]:
    """Fits from several starts under the noise model of the fit that they add to, those that have a finite error."""
    fits = [fit(channel, s.structure, s.p, s.scales, noise=base.noise, iterations=iterations) for s in starts]
    return [f for f in fits if np.isfinite(f.deviance)]


def _squares(channel: Channel, s: Structure, p: Array) -> float:
    y = simulate(s, p, channel.u, channel.clock)
    if not np.all(np.isfinite(y)):
        return np.inf
    return float(np.sum(np.where(channel.keep, channel.y - y, 0.0) ** 2))
