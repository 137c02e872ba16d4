"""Sensors that show the largest or the smallest of what they read over a window, which goes along with the time or begins anew."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot
from estimators.diagnosis.effects.output import KEPT
from estimators.diagnosis.effects.profiled import firm
from estimators.diagnosis.effects.sensing.reports import BEATS, CLEAR_OF, SHORTEST, densest
from estimators.diagnosis.effects.sensing.sensors import settled

Array = NDArray[Any]
WINDOWS, LONGEST = 24, 8
"""Lengths of a window that are tried, each a fifth longer than the one before, and the share of a record, one in so many, that the longest takes."""
SPREADS, TOLD = (1, 5, 25), 0.15
"""Samples over which what the linear model foretells has moved, and the share of what it leaves that their sizes must explain: behind a
window that is late one way."""
FEW = (1, 2)
"""Poles that are tried beside the linear model's, which had some for the window."""
ENDED, AGAIN, NEAR = 3, 6, np.array([-2.0, -1.0, 1.0, 2.0])
"""Models that are fitted to the end, how often anew, and by how many samples longer windows are tried then."""
MOSTLY = 0.9  # share of all falls that must come at the same place of a period


def _sliding(x: Array, p: Array, clock: Clock) -> Array:
    """p: the window in samples, and 1 for its largest, -1 for its smallest value."""
    width = max(round(abs(float(p[0]))), 1)
    return p[1] * maximum_filter1d(p[1] * settled(x, clock), width, mode="nearest", origin=(width - 1) // 2)


def _begun_anew(x: Array, p: Array, clock: Clock) -> Array:
    """p: samples from one beginning to the next, an instant at which one is, and which extreme it is."""
    begins = (clock.k - p[1]) % max(abs(float(p[0])), 1.0) < 1.0
    x = p[2] * settled(x, clock)
    return p[2] * np.concatenate(
        [np.maximum.accumulate(one) for one in np.split(x, np.flatnonzero(begins)) if len(one)]
    )


def _told(channel: Any, base: Any) -> float:
    """1 or -1 where what the linear model leaves goes up or down with how far its output has moved, 0 where with neither."""
    y, keep = channel.y - base.residual, channel.keep
    moves = [np.abs(y - np.concatenate((np.repeat(y[:1], k), y[:-k]))) for k in SPREADS]
    X, r = np.column_stack([*moves, np.ones(len(y))])[keep], base.residual[keep]
    by = X @ np.linalg.lstsq(X, r, rcond=1e-9)[0] - np.mean(r)
    return float(np.sign(by @ X[:, 1])) if by @ by > TOLD * float(r @ r) else 0.0


def _undone(y: Array, width: int, side: float) -> tuple[Array, NDArray[np.bool_]]:
    """(N,) the signal whose extremes over a window these are, and where it is known: not in what is shorter than the window."""
    x = side * y
    low = -maximum_filter1d(-x, width, mode="nearest", origin=-(width // 2))
    return side * low, maximum_filter1d(low, width, mode="nearest", origin=(width - 1) // 2) <= x


def _left(channel: Any, f: Any, effect: Effect, shape: list[float]) -> float:
    """Sum of squares that a linear model leaves behind a window."""
    from estimators.diagnosis.model.simulation import simulate

    x = simulate(f.structure, f.p, channel.u, channel.clock)
    shown = effect.apply(x, np.array(shape), channel.clock)  # pyright: ignore[reportOptionalCall]
    return float(np.sum((channel.y - shown)[channel.keep] ** 2))


def _ended(
    channel: Any, base: Any, effect: Effect, found: list[tuple[float, list[float], Any]]
) -> Iterator[Any]:
    """The best of linear models behind a window, fitted to the end with it, and with longer and shorter ones for as long as they leave less:
    a linear model that is late takes up the rest of a window, so that each is fitted with its own."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.structure import Part

    for _, shape, f in sorted(found, key=lambda entry: entry[0])[:ENDED]:
        s = f.structure.adding(Part(effect, base.structure.inputs[0]))
        scales, own = np.append(f.scales, np.zeros(len(shape))), len(f.p)

        def ended(p: Array, s: Any = s, scales: Array = scales) -> Any:
            return fit(channel, s, p, scales, noise=base.noise, iterations=20)

        g = ended(np.append(f.p, shape))
        for _ in range(AGAIN if effect is SLIDING else 0):
            near = [ended(np.append(g.p[:own], [w, *shape[1:]])) for w in g.p[own] + NEAR if w >= 2.0]
            closer = min(near, key=_squares)
            if not _squares(closer) < _squares(g):
                break
            g = closer
        if firm(base, _squares(g)):
            yield g


def _squares(f: Any) -> float:
    return float(np.sum(f.residual**2))


def _windows(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A linear model of the signal of which these may be the extremes, for windows of every length."""
    from estimators.diagnosis.model.linear import fit_linear

    s = base.structure
    if s.layout != "tf" or s.effects or np.mean(channel.keep) < KEPT or not (side := _told(channel, base)):
        return
    forms = [replace(s, order=n, taps=min(n, s.taps), delay=d) for n in {*FEW, s.order} for d in {0, s.delay}]
    found = []
    for width in np.unique(np.round(np.geomspace(2, len(channel) // LONGEST, WINDOWS))).astype(int):
        y, known = _undone(channel.y, width, side)
        for form in forms:
            f = fit_linear(replace(channel, y=y).without(~known), form, rough=True)
            found.append((_left(channel, f, SLIDING, [float(width), side]), [float(width), side], f))
    yield from _ended(channel, base, SLIDING, found)


def _resets(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A linear model of the samples that are new extremes, or the first of a window: where readings fall, they all begin one."""
    from estimators.diagnosis.model.shown import LATER, as_shown

    s, keep = base.structure, channel.keep
    if s.layout != "tf" or s.effects or np.mean(keep) < KEPT:
        return
    steps = np.diff(channel.y)
    clear = CLEAR_OF * 1.4826 * float(np.median(np.abs(steps)))
    for side in (1.0, -1.0):
        falls, rises = side * steps < -clear, side * steps > clear
        every, place = densest(falls) if BEATS <= falls.sum() < len(steps) // SHORTEST else (0, 0)
        if not every or np.sum(falls[place::every]) < MOSTLY * falls.sum():
            continue
        begins = (np.arange(len(steps)) - place) % every == 0
        shape = [float(every), float((channel.clock.k[0] + place + 1) % every), side]
        models = as_shown(channel, base, channel.y, np.concatenate(([True], rises | begins)), LATER)
        found = [(_left(channel, f, ANEW, shape), shape, f) for f in models]
        yield from _ended(channel, base, ANEW, found)


SLIDING = Effect(
    key="window_extreme", cause="peak_hold", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, trials=60,
    sentence="the sensor shows the largest, or the smallest, of what it has read over a window of time", apply=_sliding,
    parameters={"window": "sample", "side": "1"}, search=_windows,
)  # fmt: skip
ANEW = Effect(
    key="window_begun_anew", cause="peak_hold", nature=Nature.SAMPLING, slot=Slot.OUTPUT, memory=True, trials=600,
    sentence="the sensor shows the largest, or the smallest, of what it has read since a fixed time that comes again and again", apply=_begun_anew,
    parameters={"every": "sample", "place": "sample", "side": "1"}, search=_resets,
)  # fmt: skip
EXTREMES = (SLIDING, ANEW)
