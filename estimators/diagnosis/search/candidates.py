"""Every effect of a catalogue fitted on top of a model: the candidates of one round of attribution."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects import CATALOGUE, Effect, Nature, Slot
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.linear import fit_linear, layout_starts
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.record.measurement import switched
from estimators.diagnosis.search.ratios import explained
from estimators.diagnosis.search.starts import (
    DRIFTING,
    DRIFTS,
    Start,
    behind_a_lag,
    fitted,
    quick_pole,
    renewed,
    scored,
    steady_of,
    to_the_end,
)

Array = NDArray[Any]

SHARE = 0.25  # of the best gain so far, that the simpler effect must have reached for one that refines it
LEAST_PROMISE = 6.0  # of the score, for an effect to be fitted where only the most promising are
BLIND = ("output_sigmoid", "output_arctan", "output_exponential", "output_polynomial", "input_exponential")
# curves that are fitted wherever any effect promises something: a score from a linear model that the curve of a sensor has
# spoilt says little of it, nor one of a curve that a lag of the actuator stands before; one saturates, two grow, one is general
UNDERSTATED = 3.0  # times what its score promises, that an effect may gain: scores are linear
NEAR = 0.5  # of the best gain at the input, for an effect to be tried with other poles
LAGGED = 4  # effects at the input that are tried behind a lag
RENEWALS = 3  # rounds of fresh poles for the best effect at the input
ON = 25  # further steps of what changes with time
QUICK = 5  # Gauss-Newton steps by which starts inside a plant are told apart
FORMS = 2  # layouts that are tried with several inputs, which cost a column of parameters each; the inside is looked at first
WHOLE = 60  # steps by which the best that a score leads to is fitted on, before it is asked whether anything is left
HOPELESS = (
    -30.0
)  # gain after those steps below which a start is given up: a layout may fit worse than the linear model


@dataclass(frozen=True, eq=False)
class Menu:
    """What is tried: effects, the inputs that do not act on this output in the model, how many are fitted (0: all)."""

    effects: tuple[Effect, ...] = CATALOGUE
    others: tuple[int, ...] = ()
    top: int = 0

    @property
    def family(self) -> int:
        """Effects that one record is tested for."""
        return sum(e.simulated for e in self.effects)


@dataclass(frozen=True, eq=False)
class _Task:
    """One effect at one input, in one layout: what its scores promise over the base model, and its starts, made once it is fitted."""

    effect: Effect
    promise: float
    starts: Callable[[], list[Start]]


def _least(fits: Iterable[Fit]) -> list[Fit]:
    """The fit of least deviance, or none."""
    fits = [f for f in fits if np.isfinite(f.deviance)]
    return [min(fits, key=lambda f: f.deviance)] if fits else []


def refit(channel: Channel, f: Fit, *, iterations: int = 15) -> Fit:
    """Fit again under the noise model that the last fit chose, until the two agree: the better pass by Schwarz's criterion."""
    if not len(f.noise):
        return f
    best = f
    for _ in range(3):
        again = fit(channel, f.structure, best.p, f.scales, noise=best.noise, iterations=iterations)
        if not np.isfinite(again.deviance) or again.criterion > best.criterion - 0.05:
            break
        best = again
    return best


def augmented(
    channel: Channel, base: Fit, menu: Menu, *, best: int = 2, iterations: int = 25, top: int = 0, needed: float = 0.0
) -> Iterator[Fit]:  # fmt: skip
    """Fits of a model with each further effect of a menu, per effect and input the best of its starts and that of one no score leads to.

    `best` starts per effect and `iterations` Gauss-Newton steps per start; only the `top` effects whose scores promise
    most, 0 for all. Where a gain is `needed`, only effects whose scores promise a part of it, and none without a score. What no score
    leads to is tried where nothing that has one explains the record.
    """
    wanted = _wanted(menu, base.structure)
    fits = list(
        _scanned(channel, base, [e for e in wanted if e.search is None], best, iterations, top, needed)
    )
    first = bool(fits) and not base.structure.effects
    if first and needed <= 0.0:
        f = min(fits, key=lambda f: f.criterion)
        fits.append(fit(channel, f.structure, f.p, f.scales, iterations=WHOLE))
    yield from fits
    if needed > 0.0 or (first and explained(channel, base, fits)):
        return
    further: list[Fit] = []
    steady = steady_of(channel, base) if any(e.family == DRIFTS for e in wanted) else None
    for e in wanted:
        if first:
            further += _led(channel, base, e, iterations)
        further += _own(channel, base, e, menu)
        if steady is not None and e.family == DRIFTS:
            further += _own(channel, steady, e, menu)
    further += behind_a_lag(channel, base, further)
    yield from further
    if top and first:
        yield from _kin(channel, base, wanted, [*fits, *further], iterations)


def _kin(
    channel: Channel, base: Fit, wanted: list[Effect], fits: list[Fit], iterations: int
) -> Iterator[Fit]:
    """Where what did best changes with time and does not explain the record, all that does: a linear model whose slow pole has followed
    a drift says little of it by its scores, but what stands in for a cause is of its kind."""
    near, of = min(fits, key=lambda f: f.criterion), lambda f: f.structure.parts[-1].effect
    timed = lambda e: e.nature is Nature.TIME or e.family in DRIFTING
    if not timed(of(near)) or explained(channel, base, [near]):
        return
    for f in fits:
        if f is not near and f.structure.layout == "tf" and of(f).search is None and timed(of(f)):
            yield fit(channel, f.structure, f.p, f.scales, noise=f.noise, iterations=ON)
    known = {of(f) for f in fits}
    rest = [e for e in wanted if e.search is None and e not in known and timed(e)]
    yield from _scanned(channel, base, rest, 2, iterations, 0, 0.0)


def _scanned(
    channel: Channel, base: Fit, wanted: list[Effect], best: int, iterations: int, top: int, needed: float
) -> Iterator[Fit]:
    """Fits with each effect whose starts come from scores."""
    s = base.structure
    tasks: list[_Task] = []
    early: list[_Task] = []
    sooner = _sooner(channel, base) if any(e.alone for e in wanted) else []
    for e in wanted:
        if e.slot is not Slot.PLANT:
            for j in s.inputs if e.slot is Slot.INPUT else s.inputs[:1]:
                tasks += _scan(channel, base, base, Part(e, j), best)
                early += [
                    t for model in sooner if e.alone for t in _scan(channel, base, model, Part(e, j), best)
                ]
    plant = [e for e in wanted if e.slot is Slot.PLANT]
    several = len(s.inputs) > 1
    if several:  # how the other inputs enter would change with the rates
        plant = [e for e in plant if e.change is None and not s.effects]
    layouts = _layouts(channel, base) if plant else []
    if several:
        layouts = sorted(layouts, key=lambda f: f.deviance)[:FORMS]
    for layout in layouts:
        for e in plant:
            if not e.refines and e.fits(layout.structure.layout):
                for j in layout.structure.inputs if e.each else layout.structure.inputs[:1]:
                    tasks += _scan(channel, base, layout, Part(e, j), best)
    ranked = lambda tasks: sorted(
        (t for t in tasks if UNDERSTATED * t.promise >= needed), key=lambda task: -task.promise
    )
    chosen = _chosen(ranked(tasks), top, bool(s.effects))
    tasks = ranked(tasks + early)  # what promises most with less delay takes the place of no other
    chosen += [e for e in _chosen(tasks, top, bool(s.effects)) if e.alone and e not in chosen]
    found: list[Fit] = []
    most = 0.0  # that any effect gained so far
    for e in (e for e in chosen if e.slot is not Slot.PLANT):
        for task in (task for task in tasks if task.effect is e):
            for f in _least(fitted(channel, base, task.starts(), iterations)):
                most = max(most, base.deviance - f.deviance)
                found.append(f)
                yield from _bent(channel, f)
    yield from _lagged_fits(channel, base, [f for f in found if f.structure.delay == s.delay], iterations)
    simple: dict[str, Fit] = {}
    for f in _plant_fits(channel, base, [e for e in plant if e in chosen], tasks, iterations):
        most = max(most, base.deviance - f.deviance)
        simple[f.structure.parts[-1].key] = f
        yield f
    yield from _refined_fits(
        channel, base, [e for e in plant if e.refines], simple, layouts, most, iterations
    )


def _sooner(channel: Channel, base: Fit) -> list[Fit]:
    """The linear model with less of its delay, and with none: what takes the place of its dynamics looks late to it."""
    s = base.structure
    if s.layout != "tf" or s.effects:
        return []
    return [fit_linear(channel, replace(s, delay=d)) for d in {s.delay // 2, 0} if d < s.delay]


def _wanted(menu: Menu, s: Structure) -> list[Effect]:
    """The effects of a menu that a structure can take and whose cause it has not."""
    causes = {p.effect.cause for p in s.effects}
    present = {p.effect for p in s.parts}
    return [
        e for e in menu.effects
        if e.simulated and not e.block and e not in present and e.cause not in causes and not (e.alone and s.effects)
    ]  # fmt: skip


def _chosen(tasks: list[_Task], top: int, explained: bool) -> list[Effect]:
    """The effects to fit, of tasks in the order of their promise: the `top` ones, what extends one of them in one place with it, and
    those of which a score from the linear model says little: curves that stand in `BLIND`, and what has a start that the linear model
    does not lead to."""
    chosen: list[Effect] = []
    places: set[str] = set()
    wide = bool(tasks) and tasks[0].promise > LEAST_PROMISE and not explained
    blind = lambda e: e.key in BLIND or e.more is not None
    for task in tasks:
        place = task.effect.extends or task.effect.key
        free = place in places or len(places) < top
        promising = not top or (free and task.promise > LEAST_PROMISE)
        if task.effect not in chosen and (promising or (wide and blind(task.effect))):
            chosen.append(task.effect)
            places.add(place)
    return chosen


def _lagged_fits(channel: Channel, base: Fit, found: list[Fit], iterations: int) -> Iterator[Fit]:
    """The best effects at the input once more, behind an actuator that lags: one of the linear model's poles comes before them, or one that
    is read from what a bend behind it would leave."""
    s = base.structure
    if s.layout != "tf" or s.order < 2:
        return
    poles = np.roots(np.concatenate(([1.0], base.p[: s.order])))
    real = sorted(z.real for z in poles if abs(z.imag) < 1e-9 and 0.02 < z.real < 0.995)
    able = [f for f in found if f.structure.parts[-1].effect.lagged and f.structure.layout == "tf"]
    least_of: dict[Effect, Fit] = {}
    for f in sorted(able, key=lambda f: f.deviance):
        least_of.setdefault(f.structure.parts[-1].effect, f)
    able = list(least_of.values())
    if s.effects or not able or not len(able[0].noise):
        return  # nothing is left that other poles could explain
    least = base.deviance - NEAR * (base.deviance - able[0].deviance)
    near = [f for f in able if f.deviance <= least][:LAGGED]
    # Behind a lag, a curve explains nothing until the lag stands before it.
    curve = next((f for f in able if f.structure.parts[-1].effect.static), able[0])
    tried = near if curve in near else [*near, curve]
    quick = {j: quick_pole(channel, base, j) for j in {f.structure.parts[-1].channel for f in tried}}
    for f in tried:
        best, source = None, f
        for _ in range(RENEWALS if f is able[0] else 1):
            again = _with_fresh_poles(
                channel, f, source.p, f.scales, f.structure, source.deviance - 1.0, iterations
            )
            if again is None:
                break
            best = source = again
        part, at = f.structure.parts[-1], f.structure.slices()[-1].start
        new = replace(f.structure, parts=(*f.structure.parts[:-1], replace(part, first=1)))
        behind = [
            _with_fresh_poles(channel, f, np.insert(source.p, at, -pole), np.insert(f.scales, at, 1.0), new, np.inf, iterations)
            for pole in [*real, quick[part.channel]]
        ]  # fmt: skip
        yield from ([] if best is None else _bent(channel, best))
        yield from _least(g for g in behind if g is not None)


def _bent(channel: Channel, f: Fit) -> list[Fit]:
    """The fit, unless what was added is a curve of an input that has two levels: a gain and an offset, whatever the curve."""
    *before, part = f.structure.parts
    if not part.effect.static or part.effect.slot is not Slot.INPUT or part.own:
        return [f]
    bent = any(
        q.effect.slot is Slot.INPUT and q.channel == part.channel and q.effect.nature is not Nature.TIME
        for q in before  # a gain that changes slowly leaves two levels, or nearly
    )
    return [] if not bent and switched(channel.u[channel.keep][:, part.channel]) else [f]


def _with_fresh_poles(
    channel: Channel, f: Fit, p: Array, scales: Array, s: Structure, limit: float, iterations: int
) -> Fit | None:
    """The fit from parameters whose linear part is made anew, where it ends below a limit of the deviance."""
    starts = [Start(s, q, scales, 0.0) for q in renewed(channel, s, p)]
    for g in _least(fitted(channel, f, starts, QUICK + 3)):
        g = fit(channel, s, g.p, g.scales, noise=g.noise, iterations=iterations)
        if g.deviance < limit:
            return g
    return None


def _own(channel: Channel, base: Fit, e: Effect, menu: Menu) -> Iterator[Fit]:
    """The best fit per input of an effect that has a search of its own."""
    found: dict[int, Fit] = {}
    for f in e.search(channel, base, menu.others) if e.search is not None else ():
        j = f.structure.parts[-1].channel
        if np.isfinite(f.deviance) and (j not in found or f.criterion < found[j].criterion):
            found[j] = f
    yield from found.values()


def _led(channel: Channel, base: Fit, e: Effect, iterations: int) -> Iterator[Fit]:
    """The fit per input of an effect from the start that the linear model does not lead to."""
    s = base.structure
    for j in () if e.more is None else s.inputs if e.slot is Slot.INPUT else s.inputs[:1]:
        start = e.more(channel, base, j)  # pyright: ignore[reportOptionalCall]
        yield from fitted(channel, base, [] if start is None else [start], iterations)


def _scan(channel: Channel, base: Fit, model: Fit, part: Part, best: int) -> list[_Task]:
    """The starts of an effect added to a model: the base, or the base in another layout."""
    found = scored(channel, model, part, best)
    if not np.isfinite(found.promise):
        return []
    return [_Task(part.effect, found.promise + base.deviance - model.deviance, lambda: found.starts)]


def _refined_fits(
    channel: Channel, base: Fit, effects: list[Effect], simple: dict[str, Fit], layouts: list[Fit], most: float,
    iterations: int,
) -> Iterator[Fit]:  # fmt: skip
    """Relatives of an effect inside the plant that did well, in the layout where it did."""
    for e in effects:
        parents = [simple[k] for k in e.refines if k in simple]
        parents = [f for f in parents if base.deviance - f.deviance > max(SHARE * most, 10.0)]
        if not parents:
            continue
        near = min(parents, key=lambda f: f.deviance).structure.layout
        layout = next((f for f in layouts if f.structure.layout == near and e.fits(near)), None)
        if layout is not None:
            found = scored(channel, layout, Part(e, layout.structure.inputs[0]), 2)
            for f in _least(fitted(channel, base, found.starts, QUICK)):
                yield fit(channel, f.structure, f.p, f.scales, noise=f.noise, iterations=iterations)


def _layouts(channel: Channel, base: Fit) -> list[Fit]:
    """The model in the physical layouts of its order."""
    if base.structure.layout != "tf":
        return [base]
    fits = [
        fit(channel, new, p, scales, noise=base.noise, iterations=8, colour=False)
        for new, p, scales in layout_starts(channel, base)
    ]
    return [f for f in fits if np.isfinite(f.deviance)]


def _plant_fits(
    channel: Channel, base: Fit, effects: list[Effect], tasks: list[_Task], iterations: int
) -> Iterator[Fit]:
    """Effects inside the plant: a few steps in each layout, then the best is fitted to the end."""
    ended: dict[str, Fit] = {}  # where the effects that others extend ended
    for e in effects:
        plain = ended.get(e.extends)
        if plain is not None and base.deviance - plain.deviance < 6.0:
            continue
        starts = [start for task in tasks if task.effect is e for start in task.starts()]
        quick = fitted(channel, base, starts, QUICK)
        if plain is not None:
            known = plain.structure.parts[-1].count(plain.structure.order)
            near = [
                replace(start, p=np.concatenate((plain.p, start.p[start.structure.slices()[-1]][known:])))
                for start in starts
                if start.structure.layout == plain.structure.layout
            ]
            quick += fitted(channel, base, near, QUICK + 3)
        quick.sort(key=lambda f: f.deviance)
        if not quick or base.deviance - quick[0].deviance < HOPELESS:
            continue
        for found in _least(to_the_end(channel, f, iterations) for f in quick[:2]):
            if plain is not None and found.deviance < plain.deviance - 3.0:
                bare = replace(found.structure, parts=(*base.structure.parts, plain.structure.parts[-1]))
                again = fit(channel, bare, found.p[: bare.size], found.scales[: bare.size], noise=base.noise,
                            iterations=iterations)  # fmt: skip
                if again.deviance < plain.deviance:
                    ended[e.extends] = again
                    yield again
            ended[e.key] = found
            yield found
