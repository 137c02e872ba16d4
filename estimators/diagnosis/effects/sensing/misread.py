"""A sensor that reads otherwise between two times of the record, or from a time on: a span set wrongly, a connector that slips."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.input import banked
from estimators.diagnosis.effects.profiled import FIRM, firm, gained, of_order

Array = NDArray[Any]
EDGES, FEWEST, LEAST, LEFT = 40, 10, 0.02, 0.25
"""Times of a record at which a window may begin or end, samples and the share of all that it has at least, and the share of the others:
these tell the plant."""
RIDGE = 1e-8  # of the squares of each direction: what samples outside a window say nothing of is zero
ROUNDS, TRIED, APART = 8, 2, 0.05
"""Times that a window and the line in it are made anew, one for the other; windows that get a linear part of their own, and the share of
the record by which their ends are apart."""
ENDS = 0.05  # of a record, at either end of which nothing is taken to change for good
FARTHEST = 1e3
"""Standard deviations of the output, of a signal that a sensor may read: what explodes is beyond them."""
SAME, SOONER = (-1, 0), (0, 1, 2)
"""Poles more than the linear model has, some of which may imitate a window; and without its delay, which may stand for those that one hides."""
COUNTED = 0.6  # share of the samples, from which on the others may be those of a window that stand out of the linear model
EDGE = 1e6  # scale of a time, by which it is known for an edge that samples cross: it has no derivative
Window = tuple[int, int]


def _misread(x: Any, p: Array, clock: Clock) -> Any:
    """Each sample is read at once: a time between two of them is an edge."""
    over = 1.0 * (clock.k > p[3]) if len(p) > 3 else 0.0
    wrongly = 1.0 * (clock.k > p[2]) - over
    return x + wrongly * ((p[0] - 1.0) * x + p[1])


def _directions(channel: Any, base: Any) -> Array:
    """(N, r) what is linear in the inputs, by any mixture of lags and by the poles of the linear model, orthonormal on the samples that count."""
    s, n = base.structure, len(channel)
    u = channel.u[:, list(s.inputs)]
    den = np.concatenate(([1.0], base.p[: s.order]))
    taps = [np.eye(1, s.delay + 2 + i, s.delay + 1 + i)[0] for i in range(s.taps)]
    columns = [lfilter(b, den, x) for x in u.T for b in taps]
    columns += list(lfilter([1.0], den, np.eye(n, s.order), axis=0).T)
    columns += list(banked(np.column_stack((u, np.ones(n)))).reshape(n, -1).T)
    D = np.column_stack((*columns, np.ones(n)))
    D = np.where(channel.keep[:, None], np.nan_to_num(D), 0.0)
    return np.linalg.qr(D / (np.linalg.norm(D, axis=0) + 1e-300))[0]


def _line(n: Any, x: Any, y: Any, xx: Any, xy: Any, yy: Any) -> tuple[Any, Any, Any]:
    """Squares that a line leaves, its slope and constant, of the sums over some samples."""
    spread, n = xx - x * x / np.maximum(n, 1.0), np.maximum(n, 1.0)
    slope = (xy - x * y / n) / np.maximum(spread, 1e-12 * xx + 1e-300)
    return yy - y * y / n - slope * (xy - x * y / n), slope, (y - slope * x) / n


class _Windows:
    """What windows of a record leave in which its output is a line of what the samples outside them foretell of it; `plain` without one."""

    def __init__(self, channel: Any, base: Any) -> None:
        self.mean = float(np.mean(channel.y))
        self.y = np.where(channel.keep, channel.y - self.mean, 0.0)
        self.Z = np.column_stack((_directions(channel, base), channel.keep, self.y))
        self.power = self.Z.T @ self.Z
        free = float(self.y @ self.y - np.sum(self.power[:-2, -1] ** 2))
        self.plain = min(free, float(np.sum(base.residual[channel.keep] ** 2)))
        self.edges = np.unique(np.linspace(0, len(self.Z), EDGES + 1).astype(int))
        cells = [self.Z[a:b].T @ self.Z[a:b] for a, b in pairwise(self.edges)]
        self.sums = np.cumsum([np.zeros_like(self.power), *cells], axis=0)

    def told(self, inside: Array) -> tuple[Array, Array]:
        """(M,) squares that are left, and (M, r) coefficients of the directions, of the products (M, r + 2, r + 2) in windows."""
        r, out = inside.shape[-1] - 2, self.power - inside
        theta = np.linalg.solve(out[:, :r, :r] + RIDGE * np.eye(r), out[:, :r, -1:])[..., 0]
        along = lambda of: np.einsum("mr,mr->m", theta, of)
        xx = np.einsum("mr,mrs,ms->m", theta, inside[:, :r, :r], theta)
        sums = inside[:, r, r], along(inside[:, :r, r]), inside[:, r, -1], xx, along(inside[:, :r, -1])
        left, *_ = _line(*sums, inside[:, -1, -1])
        return left + out[:, -1, -1] - along(out[:, :r, -1]), theta

    def best(self, lasting: bool) -> Iterator[Window]:
        """The best windows of a grid that promise something, no two of them next to each other."""
        n, edges, sums = len(self.Z), self.edges, self.sums
        first, last = np.triu_indices(len(edges), 1)
        windows = np.stack((edges[first], edges[last]), axis=1)
        fit = _able(windows[:, 0], windows[:, 1], n, lasting)
        windows = windows[fit]
        if not len(windows):
            return
        left, _ = self.told(sums[last[fit]] - sums[first[fit]])
        known: list[Array] = []
        for i in np.argsort(left):
            if len(known) == TRIED or not gained(n, self.plain, float(left[i])) > FIRM:
                return
            if all(np.max(np.abs(windows[i] - other)) > APART * n for other in known):
                known.append(windows[i])
                yield int(windows[i, 0]), int(windows[i, 1])

    def foretold(self, window: Window) -> Array:
        """(N,) the output that the samples outside a window foretell."""
        inside = self.Z[slice(*window)]
        return np.asarray(self.mean + self.Z[:, :-2] @ self.told((inside.T @ inside)[None])[1][0])


@lru_cache(maxsize=1)  # for what lasts and for what does not
def _windows(channel: Any, base: Any) -> _Windows:
    return _Windows(channel, base)


def _able(first: Any, last: Any, n: int, lasting: bool) -> Any:
    """Whether windows have enough samples and leave enough, and end well before the record, or with it where what begins is lasting."""
    size = last - first
    ends = last == n if lasting else last < (1.0 - ENDS) * n
    return (first > ENDS * n) & ends & (size >= max(FEWEST, LEAST * n)) & (n - size >= LEFT * n)


def _nearest(x: Array, channel: Any, window: Window, lasting: bool) -> tuple[float, float, float, Window]:
    """Squares that are left, gain and zero of what is read of a signal (N,), and the window, each made anew for the other."""
    y, keep, n = channel.y, channel.keep, len(x)
    best = (np.inf, 1.0, 0.0, window)
    for _ in range(ROUNDS):
        on = _inside(window, n)
        a, b = x[on & keep], y[on & keep]
        left, gain, zero = map(float, _line(float(len(a)), a.sum(), b.sum(), a @ a, a @ b, b @ b))
        left += float(np.sum((y - x)[~on & keep] ** 2))
        if not left < best[0]:
            break
        best = (left, gain, zero, window)
        better = np.where(keep, (y - x) ** 2 - (y - gain * x - zero) ** 2, 0.0)
        before = np.concatenate(([0.0], np.cumsum(better)))
        rise = before - np.minimum.accumulate(before)
        # samples at an edge that do not count stood out as it does
        end = n if lasting else n - int(np.argmax(rise[::-1]))
        window = int(np.argmin(before[: end + 1])), end
        if not _able(*window, n, lasting):
            break
    return best


def _inside(window: Window, n: int) -> Array:
    """(N,) whether a sample is in a window."""
    at = np.arange(n)
    return np.asarray((at >= window[0]) & (at < window[1]))


def _made_for(channel: Any, base: Any, windows: _Windows, window: Window, lasting: bool) -> Iterator[Any]:
    """(criterion, structure, parameters, scales) with a linear part made for the samples outside a window, of each order that may do."""
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.simulation import simulate

    s, n, k, size = base.structure, len(channel), channel.clock.k, float(np.std(channel.y))
    *_, window = _nearest(windows.foretold(window), channel, window, lasting)
    out = _inside(window, n)
    clear = replace(channel, keep=channel.keep & ~out)
    forms = {(max(s.order + more, 1), s.delay) for more in SAME}
    forms |= {(s.order + more, 0) for more in SOONER if s.delay > 0}
    # what stands in for the samples that are out makes poles begin otherwise
    between = channel.y, np.where(out, windows.foretold(window), channel.y)
    for (order, delay), y in product(sorted(forms), between):
        few = replace(of_order(base, order, order)[0], delay=delay)
        f = fit_linear(replace(clear, y=y), few, rough=True)
        x = simulate(few, f.p, channel.u, channel.clock)
        if not np.all(np.abs(x - windows.mean) < FARTHEST * size):
            continue
        left, gain, zero, (first, last) = _nearest(x, channel, window, lasting)
        # what is added is so behind the sensor
        placed = zip(few.parts, few.slices(), strict=True)
        added = sum(f.p[sl].sum() for part, sl in placed if part.effect is OFFSET)
        shape = [gain, zero + (gain - 1.0) * added, k[first] - 0.5, *([] if lasting else [k[last] - 0.5])]
        scales = np.concatenate((f.scales, [1.0, size, EDGE, EDGE][: len(shape)]))
        if firm(base, left):
            yield (
                base.n * np.log(max(left, 1e-300)) + len(f.p) * np.log(base.n),
                few,
                np.append(f.p, shape),
                scales,
            )


def _searched(effect: Callable[[], Effect], lasting: bool) -> Callable[..., Iterator[Any]]:
    """The windows in which a line of what the others foretell leaves least, with a linear part made for these."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.fitting import fit
        from estimators.diagnosis.model.structure import Part

        s = base.structure
        if s.layout != "tf" or s.effects or np.mean(channel.keep) < COUNTED or not np.ptp(channel.y) > 0.0:
            return
        tried, made = _windows(channel, base), []
        for window in tried.best(lasting):
            made += list(_made_for(channel, base, tried, window, lasting))
        if made:
            _, few, p, scales = min(made, key=lambda entry: entry[0])
            # the linear model's noise is mostly the window, and would draw the fit from it
            yield fit(channel, few.adding(Part(effect(), s.inputs[0])), p, scales, iterations=30)

    return search


def _read(key: str, sentence: str, trials: float, *times: str) -> Effect:
    return Effect(
        key=key, cause="parameter_change", nature=Nature.TIME, slot=Slot.OUTPUT, trials=trials, per_sample=True, family="changes",
        sentence=sentence, apply=_misread, parameters={"gain": "1", "zero": "y"} | dict.fromkeys(times, "sample"),
        search=_searched(lambda: MISREAD[key], len(times) == 1),
    )  # fmt: skip


MISREAD = {
    "misread": _read(
        "misread", "between two times the sensor reads otherwise, by a gain and a zero: a span set wrongly, a connector that slips",
        1.0, "start", "end",
    ),
    "misread_since": _read(
        "misread_since", "from a time on the sensor reads otherwise, by a gain and a zero: a span set anew, another range", 0.3, "time",
    ),
}  # fmt: skip
