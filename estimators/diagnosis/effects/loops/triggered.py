"""Events that a hidden level triggers: a defrost, a backwash, a siphon, which come once the input has filled the level, and last their time."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, level_before
from estimators.diagnosis.effects.input import kept
from estimators.diagnosis.effects.loops.anew import remade
from estimators.diagnosis.effects.profiled import descended, ended, entering, firm, gained, lean, of_order

Array = NDArray[Any]
FEWEST, MOST = 3, 80
"""Events of a record, at least and about at most: two are pulses at any times, and of more in a short record each is no event."""
SHORTEST, LONGEST, LONGER = 1.0, 0.5, 1.4
"""Duration of an event in samples, at least; of the time between two, at most; and the ratio of one to the next that are tried."""
THRESHOLDS = (-1.0, -0.5, -0.35, -0.25, -0.15, -0.1, -0.05, *np.linspace(0.0, 0.85, 18))
"""Of the input's range above its least value, that are tried: far below it a level fills as a clock runs."""
CLOCK = -1e6  # such a threshold, at which nothing of the input is left
AROUND, NEARBY = (
    np.linspace(-0.04, 0.04, 9),
    0.03,
)  # and about those that promise most, which are so far apart
SHIFTED = 0.4
"""Of its duration, by which the last event is moved from one dose to the next that is tried."""
FINEST = 1e-4  # ratio of two doses less 1, at least: a long record has no more time
PROMISE = 60.0
"""Likelihood ratio of the best events, below which none are fitted: chance over some ten thousand of them reaches 25 in white noise."""
KEPT, FITTED, FURTHER = 4, 2, (-1, 0, 1)
"""Events that are tried with linear parts of their own, those of them that are moved and fitted, and poles that these may have more than
the linear model: it leaves out what the events hide, and has some that stand for them."""
LESS = 0.8  # of what a linear part of as many poles leaves by itself, what events leave at most before they are moved
LEAST_RECORD = 100  # samples, of which a few events leave some between them
LAGS = 4  # of the autoregression: a plant, a sensor and their delay
APART, OFTENER = 0.1, 2
"""Of the input's range and of their number, by which two of them differ at least; and the best, which may be every other or third of all."""
ROUNDS, FINER, MOVES = 2, 0.3, 25
"""Fits, steps after the first of them of those before, and moves from one to the next, at most: a valley of no ground has no end."""
STEPS = (0.03, 0.5, 0.3, 0.3, 0.5)
"""By which events are moved first: threshold in the input's range, the last event and the duration in durations, the value in standard
deviations of the input, the lag in samples."""


def _applied(adds: bool) -> Callable[..., Array]:
    def apply(x: Array, p: Array, clock: Clock) -> Array:
        from estimators.diagnosis.effects.kernels.event_kernels import triggered

        if not (p[1] > 0.0 and p[2] >= SHORTEST):
            return np.full(len(x), np.inf)
        run = lambda x, p: triggered(x, held_to(p), adds, level_before(x), clock.lead)
        return kept(run, x, p, ("triggered", adds, clock.lead))

    return apply


def held_to(p: Array) -> Array:
    """Threshold, dose, duration, value, and a lag that is none where it is less."""
    return np.array([*p[:4], max(float(p[4]), 0.0)])


@dataclass(frozen=True, eq=False)
class _Record:
    """An input `u` (N,) with what events at it would explain: `told` (2, N + 1) the integrals of a unit of it, and of the input itself about
    its mean, over what the residual has in common with them, and the likelihood ratio `promised` of what both explain."""

    u: Array
    told: Array
    passed: Callable[[Array], Array]
    power: float
    n: int

    def filled(self, threshold: float) -> Array:
        """(N + 1,) integral of what the input is above a threshold."""
        return np.concatenate(([0.0], np.cumsum(np.maximum(self.u - threshold, 0.0))))

    def promised(self, score: float, duration: float) -> float:
        """Likelihood ratio of a score."""
        each = float(
            np.sum(self.passed(np.minimum(np.maximum(duration - np.arange(len(self.u)), 0.0), 1.0)) ** 2)
        )
        return gained(self.n, self.power, self.power - score / max(each, 1e-300))


def _asked(channel: Any, inputs: tuple[int, ...], j: int, u: Array) -> _Record:
    """What the errors of an autoregression have in common with each sample of the input j, `u` (N,), among others: it takes no poles of a
    linear model, which bend to what events do."""
    from estimators.diagnosis.share.signals import late

    y, n = channel.y - np.mean(channel.y[channel.keep]), len(u)
    others = [x - np.mean(x) for x in channel.u[:, [i for i in inputs if i != j]].T]
    turned = (u - np.mean(u)) / (np.std(u) + 1e-300)
    X = np.column_stack(
        [late(x, k) for x in (y, turned, *others) for k in range(1, LAGS + 1)] + [turned, *others, np.ones(n)]
    )
    counts = channel.keep.copy()
    counts[:LAGS] = False
    X, y = X[counts], y[counts]
    Q = np.linalg.qr(X)[0]
    theta = np.linalg.lstsq(X, y, rcond=None)[0]
    r = np.zeros(n)
    r[counts] = y - Q @ (Q.T @ y)
    passes = np.concatenate(([theta[-2 - len(others)]], theta[LAGS : 2 * LAGS]))
    passed = lambda x: np.asarray(lfilter(passes, [1.0], x))
    back = passed(r[::-1])[::-1]
    told = np.cumsum(np.stack((back, back * turned)), axis=1)
    return _Record(
        u, np.concatenate((np.zeros((2, 1)), told), axis=1), passed, float(r @ r), int(np.sum(counts))
    )


def _durations(n: int) -> Array:
    """Durations that are tried, up to what leaves time between the fewest events."""
    return np.geomspace(
        2.0 * SHORTEST,
        (top := max(LONGEST * n / (FEWEST + 1), 4.0)),
        int(np.log(top / 2.0) / np.log(LONGER)) + 1,
    )


def _scan(record: _Record, thresholds: Array) -> list[tuple[float, Array]]:
    """(likelihood ratio, threshold, dose and duration) of the best events at each threshold and duration, the best first."""
    from estimators.diagnosis.effects.kernels.event_kernels import scanned_events

    n, found = len(record.u), []
    for threshold in thresholds:
        filled = record.filled(threshold)
        if not filled[-1] > 0.0:
            continue
        for duration in _durations(n):
            finest = np.log1p(max(SHIFTED * duration / n, FINEST))
            most = min(MOST, LONGEST * n / duration)
            doses = filled[-1] / np.exp(np.arange(np.log(FEWEST), np.log(most), finest))
            if not len(doses):
                continue
            scores = scanned_events(filled, record.told, doses, duration, FEWEST)
            at = int(np.argmax(scores))
            found.append(
                (record.promised(float(scores[at]), duration), np.array([threshold, doses[at], duration]))
            )
    return sorted(found, key=lambda entry: -entry[0])


def _promising(record: _Record) -> list[Array]:
    """Thresholds, doses and durations of the events that explain most, closer to the best; none where they promise too little."""
    low, wide = float(np.min(record.u)), float(np.ptp(record.u))
    found = _scan(record, low + wide * np.array(THRESHOLDS))
    if not found or found[0][0] < PROMISE:
        return []
    near: list[float] = []
    for _, (threshold, *_) in found[: 2 * KEPT]:
        if all(abs(threshold - other) > NEARBY * wide for other in near):
            near.append(float(threshold))
    close = np.unique(np.round([at + wide * AROUND for at in near[:KEPT]], 12))
    distinct: list[tuple[float, float, Array]] = []
    for _, shape in sorted((*found, *_scan(record, close)), key=lambda entry: -entry[0]):
        place, often = shape[0] / wide, np.log(record.filled(shape[0])[-1] / shape[1])
        if all(abs(place - other) > APART or abs(often - times) > APART for other, times, _ in distinct):
            distinct.append((place, often, shape))
        if len(distinct) == KEPT:
            break
    shapes = [shape for *_, shape in distinct]
    return shapes + [_oftener(record, shape, m) for shape in shapes[:OFTENER] for m in (2, 3)]


def _oftener(record: _Record, shape: Array, m: int) -> Array:
    """Events that come so many times as often, among which are those of a shape: the input fills no level while one runs."""
    threshold, dose, duration = shape
    meanwhile = float(np.mean(np.maximum(record.u - threshold, 0.0))) * duration
    return np.array([threshold, max(dose - (m - 1) * meanwhile, 0.1 * dose) / m, duration])


def _valued(
    channel: Any, bare: Any, part: Any, u: Array, shape: Array, lag: float = 0.0
) -> tuple[float, Array]:
    """(sum of squares, parameters) of events of a threshold, dose and duration behind a lag: their value is what they explain as an input of
    their own over what the input does."""
    from estimators.diagnosis.model.linear import fresh_poles, numerators

    s, apply = bare.structure, part.effect.apply
    without, by_one = (apply(u, np.array([*shape, value, lag]), channel.clock) for value in (0.0, 1.0))
    V, y = np.stack((without, by_one - without), axis=1), channel.y - np.mean(channel.y[channel.keep])
    V = V - np.mean(V[channel.keep], axis=0)
    two = replace(s, inputs=(0, 1), parts=())
    f = fresh_poles(y, V, two, channel.keep, begun=True)
    own, events = numerators(y, V, f, s.taps, s.delay, channel.keep).reshape(2, -1).sum(axis=1)
    return remade(channel, s.adding(part), np.concatenate((bare.p, shape, [events / (own or 1e-300), lag])))


def _closer(
    channel: Any, bare: Any, part: Any, record: _Record, best: tuple[float, Array], part_of: float = 1.0
) -> tuple[float, Array]:
    """(sum of squares, parameters) with events moved to where no others near them leave less: each of their parameters, the threshold with
    a dose that leaves their number."""
    u, s = record.u, bare.structure.adding(part)
    n, wide, spread = len(u), float(np.ptp(u)), float(np.std(u))

    turns = iter(range(MOVES))

    def around(p: Array, size: float) -> Iterator[tuple[float, Array]]:
        if next(turns, None) is None:
            return
        threshold, dose, duration, value, lag = map(float, p[-5:])
        total = record.filled(threshold)[-1]
        steps = part_of * size * np.array(STEPS) * (wide, duration / n, duration, spread, 1.0)
        for i, way in product(range(5), (-1.0, 1.0)):
            moved = way * steps[i] * np.eye(5)[i]
            at = threshold + moved[0]
            shape = (
                at,
                dose * (1.0 + moved[1]) * record.filled(at)[-1] / total,
                duration + moved[2],
                value + moved[3],
                max(lag + moved[4], 0.0),
            )
            yield remade(channel, s, np.concatenate((p[:-5], shape)))

    return descended(around, best)


def _clocked(channel: Any, bare: Any, part: Any, record: _Record, enough: float) -> float:
    """Sum of squares of the best events that a clock triggers, where it may be near what is enough: those that the input hardly hastens are
    no dose's."""
    found = _scan(record, np.array([CLOCK * (float(np.ptp(record.u)) + abs(float(np.max(record.u))))]))
    tried = [_valued(channel, bare, part, record.u, shape) for _, shape in found[:KEPT]]
    best = min(tried, key=_left, default=(np.inf, bare.p))
    return _closer(channel, bare, part, record, best)[0] if best[0] < enough else best[0]


def _left(entry: tuple[float, Any]) -> float:
    return entry[0]


def _ended(channel: Any, bare: Any, part: Any, record: _Record, best: tuple[float, Array]) -> Iterator[Any]:
    """Events fitted to the end, and once more from where no others near them leave less than the fit: an event that is a sample late has no
    derivative that says so."""
    from estimators.diagnosis.model.linear import plant_scales
    from estimators.diagnosis.search.starts import renewed

    s, spread = bare.structure.adding(part), float(np.std(record.u))
    again = _valued(channel, bare, part, record.u, best[1][-5:-2], float(best[1][-1]))
    if again[0] < best[0]:  # they hid its poles from the input, and the value with them
        best = _closer(channel, bare, part, record, again)
    for i in range(ROUNDS):
        if i:
            best = _closer(channel, bare, part, record, remade(channel, s, best[1]), FINER)
        p = best[1]
        bare.scales[: bare.structure.plant_size] = plant_scales(bare.structure, p)
        sizes = [spread, abs(p[-4]), abs(p[-3]), spread, 1.0]
        fits = list(ended(channel, bare, part, [p, *renewed(channel, s, p)], sizes))
        yield from fits
        best = min(((float(np.sum(f.residual**2)), f.p) for f in fits), key=_left)


@lru_cache(maxsize=4)
def _sought(channel: Any, base: Any, j: int) -> tuple[_Record, list[Array]]:
    """The record of an input with the events that are promising at it, which both effects share."""
    u = next(u for i, u in entering(channel, base) if i == j)
    record = _asked(channel, base.structure.inputs, j, np.ascontiguousarray(u))
    return record, _promising(record)


def _searched(adds: bool) -> Callable[..., Iterator[Any]]:
    """Events at each input, with as many poles as the linear model and more, with its delay or none."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.structure import Part

        s = base.structure
        for j in s.inputs if s.layout == "tf" and not s.effects and len(channel) >= LEAST_RECORD else ():
            record, shapes = _sought(channel, base, j)
            part, tried = Part(TRIGGERED[adds], j), []
            for more, delay in product(FURTHER, sorted({0, s.delay})) if shapes else ():
                if s.order + more < 1:
                    continue
                few, p, scales = of_order(base, s.order + more, max(s.taps + more, 1))
                bare = replace(base, structure=replace(few, delay=delay), p=p, scales=scales)
                plain = min(float(np.sum(base.residual**2)), remade(channel, bare.structure, p)[0])
                with_events = (_valued(channel, bare, part, record.u, shape) for shape in shapes)
                tried += [(e, (plain, bare, p)) for e, p in with_events if e < LESS * plain and firm(base, e)]
            for error, (plain, bare, p) in sorted(tried, key=_left)[:FITTED]:
                left, p = _closer(channel, bare, part, record, (error, p))
                if gained(base.n, _clocked(channel, bare, part, record, LESS * plain), left) < PROMISE:
                    continue
                yield from lean(channel, _ended(channel, bare, part, record, (left, p)))

    return search


def _event(key: str, what: str, value: str, adds: bool) -> Effect:
    return Effect(
        key=key, cause="triggered_event", nature=Nature.DYNAMIC, slot=Slot.INPUT, trials=1e4, alone=True, apply=_applied(adds), search=_searched(adds),
        sentence=f"a hidden level fills with what the input exceeds a threshold by, and once it is full an event of a fixed time {what}: a defrost, a backwash",
        parameters={"threshold": "u", "dose": "u sample", "duration": "sample", value: "u", "lag": "sample"},
    )  # fmt: skip


TRIGGERED = (
    _event("event_replaces", "puts another value in the input's place", "instead", False),
    _event("event_adds", "adds to the input", "beside", True),
)
"""Trials: of a thousand samples some ten thousand doses, thresholds and durations can be told apart."""
