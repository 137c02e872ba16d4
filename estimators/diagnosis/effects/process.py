"""Nonlinear processes of first order that the input passes before the linear part: what they fill and lose, and how fast.

x' = rate (u - x - force(x, u)), integrated like a plant. The linear part after it has poles of its own, so that a
process of any order may follow or, as a lag of the actuator, come before.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from estimators.diagnosis.effects.effect import Clock, Effect, Grid, Nature, Sizes, Slot, level_before
from estimators.diagnosis.effects.input import kept
from estimators.diagnosis.effects.loops import PACES
from estimators.diagnosis.effects.profiled import BEGUN, ENDED, ended, firm, profiled_behind
from estimators.residual.algebra import powers_of_two

Array = NDArray[Any]
FASTEST = 5.0  # rate per sample above which a process is no different from none
INSTANT = 3.0
"""Rate per sample from which a process has settled to 5 % within each: what it does to its input is a curve."""
# first step towards a rest in sizes of the input, and how often it is doubled: as far as it matters
NEAR, DOUBLINGS = (1e-3, 20)
ROOT = 2e-12  # share of a level to which it is found
NEARBY = 25.0
"""Times the linear model's squares, which may have poles that imitate a process, within which its shapes are worth a fit."""
BUMPS = ((3.0, 0.0, 0.4), (3.0, -0.7, 0.4), (3.0, 0.7, 0.4), (2.0, -1.5, 2.0), (2.0, 1.5, 2.0))
"""Of a capacity that depends on the level: how much more it is at most, where, and how wide that is, in standard deviations of the input."""
GROWS = ([1.0, 0.0], [0.0, 1.0], [0.0, 20.0], [-0.6, 0.2])
"""Of a capacity that grows with the level: its slope, and with the level's square, where the level is what the input keeps it at."""
SLIPS, DRAGS = (0.1, 0.3, 0.8), (0.02, 0.3)
"""Of the input's standard deviation, the difference that what slips passes on at most; what takes from it, of how fast it nears its input."""
THINNEST = -0.95  # of a capacity, what its level may take away
QUICKEST = 0.01  # lag in samples below which there is none
RUN_UPS, LEAKS, EMPTY = (0.4, 1.5, 5.0, 20.0), (0.03, 0.15, 0.6), (0.5, 2.5)
"""Lags in samples before what is filled one way, what it loses over what it gains, and how far below the mean input, in standard
deviations, the level lies that it empties to, beside zero."""
SLIPPED, LOADS = (0.15, 0.4, 1.0), (0.02, 0.1, 0.3)
"""Of the input's standard deviation, the slip of most torque; the load, over the torque's slope where nothing slips."""
WEAKENED = (0.05, 0.15, 0.3, 0.5, 0.8)
"""Of the largest input's square, the power in its units, that is tried: at one, the largest input is limited at its own end alone."""
DRAGGED = (0.3, 2.0, 10.0)  # drag over what rolls, at the input's level, that is tried
EVERY, QUICKLY = 18, 8
"""Starts of a drag, all of them, and the steps by which they are told apart: a score of the linear model says nothing of the right one."""
STILL = 0.1  # speed below which a drive gives a force and no power, in those at which drag is as large as what rolls
LEAST = 1e-300  # a difference that no quotient by it leaves without a number
LEAST_FLOW = 1e-3  # of the mean flow: what stands still takes for ever


TURBULENT = 20.0
"""Of a flow through an orifice, the difference at which its rate is stated, in those below which it is laminar. A rate of its square
root alone has the unit of a root, and a number of samples in which it settles is none in another unit of the input."""


def _orifice(p, v, u, q, s, c):
    d = u - p
    slowed = np.sqrt((1.0 + TURBULENT) / (1.0 + np.abs(d) / np.maximum(np.abs(c[1]), LEAST)))
    return d - (1.0 + np.abs(c[0]) * (d > 0.0)) * slowed * d


def _exchange(p, v, u, q, s, c):
    return u - p - (1.0 - np.maximum(u, 0.0) * p)


def _limited_power(p, v, u, q, s, c):
    return u - u * np.minimum(1.0, np.abs(c[0]) / np.maximum(u * p, LEAST))  # brakes are not limited


def _by_power(p, v, u, q, s, c):
    x = np.abs(p / c[0])  # speed, in those at which drag is as large as what rolls
    return u - p - (u - p - p * x**2) / np.maximum(x, STILL)


def _rest(force: Callable[..., Any], u: float, c: Array, start: float) -> float:
    """Level at which the process comes to rest under a constant input: it goes the way it moves until that turns.

    Newton's steps leave a force that ends at zero for where no level is.
    """
    move = lambda x: u - x - float(force(x, 0.0, u, u, 0.0, c))
    x, now, step = start, move(start), NEAR * (abs(u) + abs(start) or 1e-9)
    for _ in range(DOUBLINGS):
        ahead = x + float(np.copysign(step, now))
        then = move(ahead)
        if not np.isfinite(then) or now == 0.0:
            return x if now == 0.0 else start
        if now * then <= 0.0:
            near = ROOT * max(abs(x), abs(ahead))
            return float(brentq(move, x, ahead, xtol=near))  # pyright: ignore[reportArgumentType]
        x, now, step = ahead, then, 2.0 * step
    return start


def led(p: Array, lagged: bool) -> tuple[str, tuple[float, ...]]:
    """Layout of a process of parameters p, and logarithms of its rates: where its input is lagged, that of the lag, the last of p, is one."""
    own = float(np.log(abs(p[0])))
    return ("cascade", (own, -float(np.log(max(abs(p[-1]), QUICKEST))))) if lagged else ("first", (own,))


def passed(
    force: Callable[..., Any], u: Array, p: Array, *, start: float | None = None, lagged: bool = False
) -> Array:
    """State (N,) of the process at the end of each sample, its rate p[0] per sample and the parameters of the force after it.

    Where its input is `lagged`, the last of them is the lag, which moves on within a sample, and the force reads what has passed it as
    the last state. It rests before the record. What follows it moves on between the samples: with the end of each sample, a tap of the linear
    part more reaches the present, and a straight line between the samples can be met.
    """
    from estimators.diagnosis.model.layouts import Inside, states

    rate = abs(float(p[0]))
    if not 0.0 < rate < FASTEST:
        return np.full(len(u), np.inf)

    def run(u: Array, p: Array) -> Array:
        level, c = level_before(u), np.array(p[1:], dtype=float)
        x0 = np.full(1 + lagged, level)
        x0[0] = _rest(force, level, c, level if start is None else start)
        again = np.append(u, u[-1])  # one sample more, for the state at the end of the last
        layout, rates = led(p, lagged)
        return states(layout, np.array(rates), again, Inside(((force, c, None),)), x0)[1:, 0]

    return kept(run, u, p, (force, start))


@dataclass(frozen=True)
class Passing:
    """What the input becomes when it passes a process with this force, `lagged` behind a lag that is its last parameter."""

    force: Callable[..., Any]
    lagged: bool = False

    def __call__(self, x: Array, p: Array, clock: Clock) -> Array:
        """(N,) state of the process at the end of each sample."""
        return passed(self.force, x, p, lagged=self.lagged)

    def start(self, level: float, p: Array) -> float:
        """Its state at rest under a constant input."""
        return _rest(self.force, level, np.array(p[1:], dtype=float), level)


def at_once(effect: Effect, q: Array, channel: Any, j: int) -> bool:
    """Whether an effect of parameters q is a process that has no memory from one sample to the next of most of an input, number j."""
    if not isinstance(effect.apply, Passing) or abs(float(q[0])) <= INSTANT:
        return False
    force, u = effect.apply.force, channel.u[:, j]
    x, step = effect.apply(u, q, channel.clock), NEAR * float(np.std(u))
    move = lambda x: u - x - force(x, 0.0, u, u, 0.0, q[1:])
    return float(np.median(np.abs(move(x + step) - move(x)))) * abs(float(q[0])) > INSTANT * step


def _process(
    key: str, cause: str, sentence: str, force: Callable[..., Any], parameters: dict[str, str], starts: Any, lag: bool = False,
    **fields: Any,
) -> Effect:  # fmt: skip
    known: dict[str, Any] = {"apply": Passing(force, lag)} | fields
    return Effect(
        key=key, cause=cause, nature=Nature.DYNAMIC, slot=Slot.INPUT, sentence=sentence, lagged=not lag, alone=True,
        parameters={"rate": "1/sample"} | parameters, trials=15, starts=starts, **known,
    )  # fmt: skip


def _shapes(s: Sizes, *shapes: list[float], sizes: list[float]) -> Grid:
    """Every rate with every shape, given in units of its sizes."""
    grid = [[rate, *(a * b for a, b in zip(c, sizes, strict=True))] for rate in s.rates for c in shapes]
    return grid, [max(s.rates), *sizes]


def _losses(s: Sizes, power: int) -> float:
    return s.su / (abs(float(np.mean(s.u))) + s.su) ** power


def _bumps(s: Sizes) -> Grid:
    """Capacities that change in the middle of the range, or beyond an end of it, where the middle shows their flank."""
    mean = float(np.mean(s.u))
    grid = [[rate, more, mean + at * s.su, width * s.su] for rate in s.rates for more, at, width in BUMPS]
    return grid, [max(s.rates), 1.0, s.su, s.su]


def _outflows(s: Sizes) -> float:
    """Coefficient of a square-root outflow that balances the mean input where the level has its size."""
    return float(np.sqrt(abs(np.mean(s.u)) + s.su))


def _through_flow(x: Array, p: Array, clock: Clock) -> Array:
    """A heated volume that a flow passes, then a pipe: what leaves now entered when a volume less had passed.

    p: rate per unit of flow, and the pipe's volume in samples of flow. The process has a rate in samples beside a flow near one.
    """
    unit = float(powers_of_two(np.array(np.mean(x))))
    flow = np.maximum(x / unit, LEAST_FLOW * (abs(float(np.mean(x / unit))) + 1e-300))
    heated = (
        passed(_exchange, flow, np.array([unit * p[0]]), start=1.0 / max(level_before(flow), 1e-300)) / unit
    )
    if not np.isfinite(heated[-1]) or p[1] < 0:
        return np.full(len(x), np.inf)
    through = np.cumsum(flow)  # at the end of each sample
    entered = np.interp(through - p[1] / unit, through, np.arange(len(x)), left=-1.0)
    return np.interp(entered, np.arange(-1, len(x)), np.concatenate((heated[:1], heated)))


def profiled_fits(
    channel: Any, base: Any, part: Any, shapes: Iterable[list[float]], sizes: list[float]
) -> Iterator[Any]:
    """Fits from a grid of shapes with a quick linear part behind, whose poles no score of the linear model's tells."""
    bare, tried = profiled_behind(channel, base, part, shapes)
    if tried and tried[0][0] < NEARBY * float(np.sum(base.residual**2)):
        fits = ended(channel, bare, part, (q for _, q in tried[:BEGUN]), sizes)
        yield from (f for f in fits if firm(base, float(np.sum(f.residual**2))))


def _driven(
    effect: Callable[[], Effect], paces: tuple[float, ...] = (1.0,), most: int = ENDED
) -> Callable[..., Iterator[Any]]:
    """The search of what is driven: every input, before the linear model's poles and before a quick linear part, at so many times the rates
    of its starts, as the linear model's slowest pole may be quicker; `most` of its starts are told apart by a few steps."""

    def search(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
        from estimators.diagnosis.model.fitting import fit
        from estimators.diagnosis.model.structure import Part
        from estimators.diagnosis.search.starts import fitted, scored, sizes_of

        s = base.structure
        for j in s.inputs if s.layout == "tf" and s.order else ():
            part = Part(effect(), j)
            begun = fitted(channel, base, scored(channel, base, part, most).starts, QUICKLY)
            for f in sorted(begun, key=lambda f: f.deviance)[:ENDED]:
                yield fit(channel, f.structure, f.p, f.scales, noise=f.noise, iterations=30)
            shapes, sizes = part.effect.starts(sizes_of(channel, base, part))  # pyright: ignore[reportOptionalCall]
            tried = ([pace * rate, *c] for pace, (rate, *c) in product(paces, shapes))
            yield from profiled_fits(channel, base, part, tried, sizes)

    return search


def _levels(s: Sizes) -> list[float]:
    """Zero, and levels below the input, for one that is logged from another zero."""
    mean = float(np.mean(s.u))
    return [0.0, *(mean - below * s.su for below in EMPTY)]


def _fills(s: Sizes) -> Grid:
    grid = [list(q) for q in product(s.rates, LEAKS, _levels(s), RUN_UPS)]
    return grid, [max(s.rates), 0.1, s.su, 1.0]


def _pulled(s: Sizes) -> Grid:
    widths = [share * s.su for share in SLIPPED]
    grid = [list(q) for q in product(s.rates, widths, LOADS, _levels(s)[:1], RUN_UPS)]
    return grid, [max(s.rates), s.su, 0.1, s.su, 1.0]


def _weakened(s: Sizes) -> Grid:
    return _shapes(s, *([share] for share in WEAKENED), sizes=[float(np.max(np.abs(s.u))) ** 2])


THROUGH = _process(
    "through_flow", "flow_dependent_delay", "the input is a flow: the residence time and the delay fall with it", _exchange,
    {"volume": "u sample"}, lambda s: (
        [[r / s.level, v * s.level] for r in s.rates for v in (0.0, 3.0, 10.0)], [max(s.rates) / s.level, s.level]),
    apply=_through_flow,
)  # fmt: skip

POWERED = _process(
    "power_limited", "state_saturation", "its power is limited: what drives it is the weaker the faster it is, a vehicle, a winch",
    _limited_power, {"power": "u^2"}, _weakened, search=_driven(lambda: POWERED, PACES),
)  # fmt: skip
BY_POWER = _process(
    "driven_by_power", "nonlinear_drag", "its input is a power: what drives it is power over speed, against a drag that grows with speed",
    _by_power, {"even": "u"}, lambda s: ([[r * np.sqrt(g) / (1.0 + 3.0 * g), (s.level + s.su) / (1.0 + g) / np.sqrt(g)]
                                          for r in s.rates for g in DRAGGED], [max(s.rates), s.level + s.su]),
    search=_driven(lambda: BY_POWER, most=EVERY),
)  # fmt: skip

CHECKED = _process(
    "check_valve", "asymmetric_rise_and_fall",
    "it fills one way only and empties by itself: an accumulator behind a check valve, a peak detector, a rectifier with its capacitor",
    lambda p, v, u, q, s, c: q - p - np.maximum(q - p, 0.0) + c[0] * (p - c[1]),
    {"loss": "1", "level": "u", "lag": "sample"}, _fills, search=_driven(lambda: CHECKED), lag=True,
)  # fmt: skip
PULLED = _process(
    "pull_out", "slip", "its torque rises with the slip to a largest one and falls beyond it (Kloss): an induction machine",
    lambda p, v, u, q, s, c: q - p - (q - p) / (1.0 + ((q - p) / np.maximum(np.abs(c[0]), LEAST)) ** 2) + c[1] * (p - c[2]),
    {"width": "u", "loss": "1", "level": "u", "lag": "sample"}, _pulled, search=_driven(lambda: PULLED), lag=True,
)  # fmt: skip

PROCESS = (
    _process("rise_and_fall", "asymmetric_rise_and_fall", "it rises at another rate than it falls",
             lambda p, v, u, q, s, c: -c[0] * np.maximum(u - p, 0.0),
             {"asymmetry": "1"}, lambda s: _shapes(s, [-0.6], [1.0], [3.0], sizes=[1.0])),
    _process("orifices", "asymmetric_rise_and_fall", "it fills and empties through orifices, at rates of their own", _orifice,
             {"asymmetry": "1", "smooth": "u"}, lambda s: _shapes(s, [0.0, 0.05], [2.0, 0.05], sizes=[1.0, s.su])),
    _process("loss_cubic", "nonlinear_loss", "a loss k3 x^3 that grows with the level",
             lambda p, v, u, q, s, c: c[0] * p**3, {"k3": "1/u^2"},
             lambda s: _shapes(s, [0.1], [0.5], [-0.1], sizes=[_losses(s, 3)]), family="losses"),
    _process("loss", "nonlinear_loss", "a loss k2 x^2 + k3 x^3 that depends on the level",
             lambda p, v, u, q, s, c: (c[0] + c[1] * p) * p**2,
             {"k2": "1/u", "k3": "1/u^2"}, lambda s: _shapes(s, [0.2, 0.2], [-0.2, 0.1], sizes=[_losses(s, 2), _losses(s, 3)]),
             family="losses"),
    _process("outflow_root", "square_root_outflow", "an outflow that grows with the square root of the level, k sqrt(x)",
             lambda p, v, u, q, s, c: c[0] * np.sqrt(np.maximum(p, 0.0)) - p,
             {"k": "u^0.5"}, lambda s: _shapes(s, [1.0], sizes=[_outflows(s)])),
    _process("vessel", "level_dependent_outflow", "a vessel that widens with its level, emptied through an orifice by k sqrt(x)",
             lambda p, v, u, q, s, c: u - p - (u - c[0] * np.sqrt(np.maximum(p, 0.0))) / (1.0 + (c[1] * p) ** 2),
             {"k": "u^0.5", "widening": "1/u"},
             lambda s: _shapes(s, [1.0, 0.5], [1.0, 1.5], sizes=[_outflows(s), 1.0 / (abs(float(np.mean(s.u))) + s.su)])),
    _process("capacity_bump", "level_dependent_lag",
             "its time constant, a capacity, is another one near one level: heat that melts, a vessel that widens, iron that saturates",
             lambda p, v, u, q, s, c: (u - p) * (1.0 - 1.0 / (1.0 + np.maximum(c[0], THINNEST) * np.exp(-(((p - c[1]) / c[2]) ** 2)))),
             {"more": "1", "level": "u", "width": "u"}, _bumps),
    _process("capacity_level", "level_dependent_lag",
             "its time constant, a capacity, depends on the level, as 1 + k1 x + k2 x^2: a cone, a trough, a heat that grows",
             lambda p, v, u, q, s, c: (u - p) * (1.0 - 1.0 / np.maximum(1.0 + (c[0] + c[1] * p) * p, 1.0 + THINNEST)),
             {"k1": "1/u", "k2": "1/u^2"}, lambda s: _shapes(s, *GROWS, sizes=[_losses(s, 2), _losses(s, 3)])),
    _process("slipping", "slip", "what drives it slips: beyond a limit a belt, a clutch, a tyre passes on no more",
             lambda p, v, u, q, s, c: u - p - np.maximum(np.abs(c[0]), LEAST) * np.tanh((u - p) / np.maximum(np.abs(c[0]), LEAST)) + c[1] * p,
             {"limit": "u", "loss": "1"}, lambda s: _shapes(s, *map(list, product(SLIPS, DRAGS)), sizes=[s.su, 1.0])),
    CHECKED,
    PULLED,
    POWERED,
    BY_POWER,
    THROUGH,
)  # fmt: skip
