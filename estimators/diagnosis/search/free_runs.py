"""Free runs of a fitted structure: how it starts on a record, and on blocks that its parameters did not see."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from estimators.diagnosis.baseline.blocks import Blocks
from estimators.diagnosis.baseline.linear_model import FAR, LinearModel, Prior
from estimators.diagnosis.effects import Clock, Slot
from estimators.diagnosis.effects.loops import FLOWS, STORES
from estimators.diagnosis.effects.path import INITIAL, STORE_CURVE
from estimators.diagnosis.effects.sensing import REPORTING
from estimators.diagnosis.model.fitting import Channel, Fit, fit, levenberg_marquardt
from estimators.diagnosis.model.layouts import LAYOUTS, layout_matrices
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Structure
from oed.data import Record

Array = NDArray[Any]

OPENING = 20
"""Samples at the start of a record that say how far off its initial state was: as many as set the state of a free run."""
SETTLED = 1e-4
"""What may be left of a wrong state after the constant input that is put before a record."""
LONGEST = 3000
"""Samples of constant input before a record; a pole within `FAR` of the circle has settled to 5 % by then."""
LEVELS = slice(8, 10)
"""Where the levels at the first sample stand among the parameters of two tanks."""
FILLED = np.linspace(-0.25, 1.25, 31)
"""Levels at which a store may be when a record begins, in the range that the training record covered, and some way beyond."""
REFUSED = 3.0
"""Of the model's own error, how far off all of a window must be for a store not to be as full as when the training record began."""
GONE = 0.5
"""Of a state, what may be left at the end of a window for it to be told from a store's level there."""
STRETCHES = 5
"""Of a fold that is scattered over a record: each a twenty-fifth of it, beyond which a curve of five bends is hardly carried."""
UNTOLD = 1e-3
"""Of what a record says of a parameter of a change, below which the blocks beside that of the change say nothing: thirty times its error."""
ASIDE = 1e-3
"""Of how far a store may go within a window, by which its level is moved for a derivative."""
STEPS = 6
"""Gauss-Newton steps without a block, from the fit to all blocks, and to how full a store is: more than the two or three that change
anything."""


class Shaped(Protocol):
    """What a free run needs: a structure and its parameters."""

    @property
    def structure(self) -> Structure:
        """The form."""
        ...

    @property
    def p(self) -> Array:
        """(size,) parameters."""
        ...


@dataclass(frozen=True, eq=False)
class Start:
    """How a free run starts: at rest, or settled under its first input, and how a window of samples corrects that."""

    prior: Prior  # of the simulation error, whose part that decays with the poles is a wrong state
    rest: bool  # no input before the record; else the first one, for ever
    error: float = 0.0  # variance of the fit's simulation error


def start_of(f: Fit, channel: Channel, prior: Prior, rest: bool) -> Start:
    """The start of a fit's free runs: its own simulation error says how far off the state may be.

    Beside it, as far as the fit's initial state was off the start that is taken for granted: another record may start alike;
    and what integrates may start at any level.
    """
    r, start = f.residual, Start(prior, rest)
    run = free_run(f, channel.u, channel.clock, channel.y, 0, start)
    covariance, own = _products(r, len(prior.covariance), len(r)), np.zeros(len(r))
    if f.structure.layout != "tanks" and np.all(np.isfinite(run)):
        own = np.where(channel.keep, channel.y - run - r, 0.0)
    first = prior.covariance[0] * (largest_pole(denominator(f)) >= FAR)
    first += _products(own[: OPENING + len(covariance)], len(covariance), OPENING)
    error = float(np.mean(r**2))
    noise = min(prior.noise, error)
    return Start(
        replace(prior, mean=0.0, covariance=covariance + first, noise=noise, rest=False), rest, error
    )


def _products(x: Array, lags: int, count: int) -> Array:
    """(lags,) mean of x(k) x(k - lag) over the first `count` samples."""
    lags = min(lags, len(x))
    return np.array([x[: min(count, len(x) - k)] @ x[k:][:count] for k in range(lags)]) / max(count, 1)


def denominator(f: Shaped) -> Array:
    """Denominator of the linear part in the shift operator, its leading 1 included."""
    s = f.structure
    if s.layout == "tf":
        return np.concatenate(([1.0], f.p[: s.order]))
    if s.layout == "tanks":
        return np.ones(1)
    from scipy.linalg import expm

    A = layout_matrices(s.layout, f.p[: LAYOUTS[s.layout][1]])[0]
    return np.real(np.poly(np.linalg.eigvals(expm(A))))


def largest_pole(den: Array) -> float:
    """Magnitude of the slowest pole of a denominator; 0 where it has none."""
    return float(np.abs(np.roots(den)).max(initial=0.0))


def _beside(f: Shaped) -> float:
    """Magnitude of the slowest pole beside the linear part: of lags before an effect, and of a mode that an input has to itself."""
    s, slowest = f.structure, 0.0
    for part, sl in zip(s.parts, s.slices(), strict=True):
        p, e = f.p[sl], part.effect
        named = (re.fullmatch(r"f\d*", name) for name, _ in part.parameters(s.order))
        den = p[np.array([*map(bool, named)])] if e.slot is Slot.PATH and e.apply is None else p[: part.first]
        slowest = max(slowest, largest_pole(np.concatenate(([1.0], den))))
    return slowest


def lead_in(f: Shaped, start: Start) -> int:
    """Samples of constant input before a record that bring the linear parts to rest; 0 where there is none, or it is at rest."""
    if start.rest:
        return 0
    radius = largest_pole(denominator(f))
    if radius >= FAR:
        return 0
    radius = max(radius, min(_beside(f), FAR))
    return min(LONGEST, 2 + f.structure.delay + int(np.log(SETTLED) / np.log(max(radius, 0.05))))


def free_run(f: Shaped, u: Array, clock: Clock, y: Array, window: int, start: Start) -> Array:
    """(N,) simulated output of another record; its first `window` measured samples may set the state.

    Without a window the run starts at rest, or settled under the first input where signals are as logged. With one, the
    part of the error in the window that decays with the poles is taken for a wrong state, as the linear model's is.
    """
    if f.structure.layout == "tanks":
        return _tanks(f, u, clock, y, window)
    told = np.isfinite(y[: max(window, 0)]).any()
    if told:
        f = _as_told(f, u[:window], Clock(clock.k[:window], clock.length), y[:window], start)
    for at, part in enumerate(f.structure.parts):
        if part.effect in FLOWS and not told:
            f = _beginning(f, at, 0.0, 0.0)  # it forgets how the training record began
    run = _begun(f, u, clock, start)
    if not np.all(np.isfinite(run)):
        return run
    den = denominator(f)
    if told:
        return run + _corrected(den, y - run, window, start)
    prior, integrates = start.prior, largest_pole(den) >= FAR
    first = u[0] if len(prior.held) == u.shape[1] else u[0, list(f.structure.inputs)]
    if integrates and np.isfinite(level := prior.started(first)):
        run = run + (level - run[0])  # its level and its state are one: only where records started is known
    return run


def _begun(f: Shaped, u: Array, clock: Clock, start: Start) -> Array:
    """(N,) simulated output from rest, or settled under the first input."""
    lead = lead_in(f, start)
    padded = np.concatenate((np.repeat(u[:1], lead, axis=0), u))
    early = Clock(np.concatenate((clock.k[0] - np.arange(lead, 0.0, -1.0), clock.k)), clock.length, lead)
    return simulate(f.structure, f.p, padded, early, rest=True)[lead:]


@dataclass(frozen=True, eq=False)
class _Moved:
    """A model that starts from elsewhere than on the training record."""

    structure: Structure
    p: Array


def _as_told(f: Shaped, u: Array, clock: Clock, y: Array, start: Start) -> Shaped:
    """A model whose parts with a start of their own begin another record as its window (M,) says."""
    for at, part in enumerate(f.structure.parts):
        if part.effect in TOLD:
            f = TOLD[part.effect](f, at, u, clock, y, start)
    return f


def _beginning(f: Shaped, at: int, *values: float) -> _Moved:
    """The model with another start, the last parameters, of one of its parts."""
    p, last = f.p.copy(), f.structure.slices()[at].stop
    p[last - len(values) : last] = values
    return _Moved(f.structure, p)


def _as_read(f: Shaped, at: int, u: Array, clock: Clock, y: Array, start: Start) -> Shaped:
    """A model with a sensor that reports changes only, which stands where the window's first sample shows it."""
    bare, own = f.structure.leaving(at)
    signal = _begun(_Moved(bare, f.p[own]), u, clock, start)
    return _beginning(f, at, float(y[np.isfinite(y)][0] - signal[0]))


def _filled(f: Shaped, at: int, u: Array, clock: Clock, y: Array, start: Start) -> Shaped:
    """A model with a store, as full as the window says: as the training record began, unless that is refused there."""
    size, least = f.p[f.structure.slices()[at]][-3:-1]
    left = _left(f, u, clock, y, start)

    def begun(level: float) -> Shaped:
        """From a level, in ranges of the training record."""
        return _beginning(f, at, level * size + least)

    coarse = min(FILLED, key=lambda level: _squares(left(begun(level))))
    fine = minimize_scalar(lambda level: _squares(left(begun(level))), (coarse, coarse + 0.01))
    model = begun(float(fine.x))
    refused = _squares(left(begun(-least / size))) - _squares(left(model)) > REFUSED**2 * start.error
    return model if refused else f


def _as_full(f: Shaped, at: int, u: Array, clock: Clock, y: Array, start: Start) -> Shaped:
    """A model with a store between ends, as full as the window says, by steps from where the training record began, from its ends and from
    between them."""
    q, flow = f.p[f.structure.slices()[at]], u[:, f.structure.parts[at].channel]
    reach = float(np.sum(np.abs(flow - q[1])))
    # as far as it may go in the window: from there it meets no end
    levels = np.concatenate((q[-1:], [0.0], np.abs(q[2:-1]), [reach, -reach]))
    return _stepped(f, at, _left(f, u, clock, y, start), levels[:, None], reach)


def _as_flowing(f: Shaped, at: int, u: Array, clock: Clock, y: Array, start: Start) -> Shaped:
    """A model with a flow that cannot turn back, as far off its rest as the window says, which few samples leave at rest."""
    q = f.p[f.structure.slices()[at]]
    far = max(float(np.ptp(u[:, f.structure.parts[at].channel])), float(np.abs(q[3:]).max()), 1e-300)
    still = float(np.sqrt(start.prior.noise)) / far
    return _stepped(f, at, _left(f, u, clock, y, start), np.stack((np.zeros(2), q[4:])), far, still)


def _stepped(
    f: Shaped, at: int, left: Callable[[Shaped], Array], firsts: Array, far: float, still: float = 0.0
) -> Shaped:
    """The model from the best of some starts (m, n) of a part, each after Gauss-Newton steps on what is left of a window; `far` what it may
    move there, `still` by how much it leaves more, per unit off zero."""
    move, count, tried = max(ASIDE * far, 1e-300), firsts.shape[1], []
    for value in firsts:
        for _ in range(STEPS):
            model = _beginning(f, at, *value)
            ways = [
                (_beginning(f, at, *(value + d)), _beginning(f, at, *(value - d)))
                for d in move * np.eye(count)
            ]
            error = np.concatenate((left(model), -still * value))
            tried.append((_squares(error), model))
            slope = np.stack([(left(more) - left(less)) / (2.0 * move) for more, less in ways], axis=1)
            slope = np.concatenate((slope, -still * np.eye(count)))
            if not (np.all(np.isfinite(error)) and np.all(np.isfinite(slope))):
                break
            value = value - np.linalg.lstsq(slope, error, rcond=None)[0]
    return min(tried, key=lambda entry: entry[0])[1]


TOLD = {
    STORE_CURVE: _filled,
    **dict.fromkeys(REPORTING, _as_read),
    **dict.fromkeys(STORES, _as_full),
    **dict.fromkeys(FLOWS, _as_flowing),
}
"""Effects with a start of their own, and how a window says what it is."""


def _left(f: Shaped, u: Array, clock: Clock, y: Array, start: Start) -> Callable[[Shaped], Array]:
    """What a model leaves of a window's measured samples beside what its quick poles explain: a state that does not decay in the
    window is not told from a level of a store."""
    poles = np.roots(denominator(f))
    quick = np.atleast_1d(np.real(np.poly(poles[np.abs(poles) ** len(y) < GONE])))

    def left(model: Shaped) -> Array:
        error = y - _begun(model, u, clock, start)
        return (error - _corrected(quick, error, len(y), start))[np.isfinite(y)]

    return left


def _squares(error: Array) -> float:
    """Mean square."""
    return float(np.mean(error**2)) if np.all(np.isfinite(error)) else np.inf


def _corrected(den: Array, error: Array, window: int, start: Start) -> Array:
    """(N,) free response that the error in the window asks for."""
    if window <= 0 or len(den) < 2 or largest_pole(den) > 1.0 + SETTLED:
        return np.zeros(len(error))
    model = LinearModel(den, np.zeros((1, 1)))
    return model.free_run(start.prior, np.zeros((len(error), 1)), error, window)


def _tanks(f: Shaped, u: Array, clock: Clock, y: Array, window: int) -> Array:
    """Levels at the start by least squares in the window, from those of the training record."""
    x0 = f.p[LEVELS].copy()
    seen = np.flatnonzero(np.isfinite(y[:window]))
    if len(seen):
        head = Clock(clock.k[:window], clock.length)

        def errors(x: Array) -> Array:
            return (y[:window] - simulate(f.structure, f.p, u[:window], head, rest=True, start=x))[seen]

        x0, _, _ = levenberg_marquardt(errors, x0, np.abs(x0) + (1e-3 * np.abs(x0).max() or 1.0))
    return simulate(f.structure, f.p, u, clock, rest=True, start=x0)


def on_record(
    f: Shaped, record: Record, output: int, clock: Clock, window: int, start: Start, thin: int
) -> Array:
    """(N,) simulated output of a record; a thinned model's is interpolated between its samples."""
    prior = start.prior
    own = record.u if len(prior.held) == record.n_inputs else record.u[:, list(f.structure.inputs)]
    y, window = prior.opened(own, record.y[:, output], window)
    if thin == 1:
        return free_run(f, record.u, clock, y, window, start)
    record = record.replace(y=y, output_names=(), output_units=())
    short = thinned(record, thin)
    slow = Clock(clock.k[0] / thin + np.arange(len(short), dtype=float), clock.length // thin)
    few = max(window // thin, 2 * f.structure.order) if window else 0
    run = free_run(f, short.u, slow, short.y[:, 0], few, start)
    return lengthened(run, thin, len(record))


def lengthened(run: Array, thin: int, n: int) -> Array:
    """(n,) values between those of a thinned signal."""
    if thin == 1 or not np.all(np.isfinite(run)):
        return run if len(run) == n else np.full(n, np.inf)
    return CubicSpline(thin * np.arange(len(run)), run)(np.arange(n))


def thinned(record: Record, by: int) -> Record:
    """Every `by`-th sample, the input averaged over the interval that it acts in."""
    if by == 1:
        return record
    n = len(record) // by
    u = record.u[: n * by].reshape(n, by, -1).mean(axis=1)
    return record.replace(u=u, y=record.y[: n * by : by], dt=record.dt * by)


def blocked(
    channel: Channel, f: Fit, blocks: Blocks, thin: int, start: Start, *, white: bool
) -> tuple[Array, tuple[Array, ...]]:  # fmt: skip
    """(N,) free run of every block of the one training record, by parameters fitted to the others; and those of each fold.

    The run starts as on a test record, not from the state that was fitted to this one, and goes through to the block. A
    model that hangs on its fitted state is shown for what it is. When something changes within a block no other block can tell:
    that time stays what the whole record says, as does what the others say nothing of, the state that it leaves at once. Infinite in
    a block whose fit failed.
    """
    n, out, found = len(channel), np.full(len(channel), np.inf), []
    scales = f.scales.copy()
    for part, sl in zip(f.structure.parts, f.structure.slices(), strict=True):
        if part.effect is INITIAL:  # no other block says anything of the record's own start
            scales[sl] = 0.0
    tanks = f.structure.layout == "tanks"
    if tanks:  # nor of the levels that its tanks start from
        scales[LEVELS] = 0.0
    own = not tanks and not any(part.effect is INITIAL for part in f.structure.parts[: f.structure.base])
    window = max(blocks.window // thin, 2 * f.structure.order) if blocks.window else 0
    y = np.where(channel.keep, channel.y, np.nan)
    folds = [([block], blocks.training(block)) for block in blocks.blocks]
    if any(part.effect is STORE_CURVE for part in f.structure.parts):
        folds = blocks.scattered(STRETCHES)
    timed = [
        (sl, sl.start + i, int(np.clip(f.p[sl.start + i], 0, n - 1)))
        for part, sl in zip(f.structure.parts, f.structure.slices(), strict=True)
        for i in part.times(f.structure.order)
    ]
    told = np.nan_to_num(f.jacobian) ** 2
    for fold, mask in folds:
        training, free = mask[0][::thin][:n], scales.copy()
        for of, time, at in timed:
            if not training[at] and len(told):
                free[of] *= told[training][:, of].sum(axis=0) > UNTOLD * told[:, of].sum(axis=0)
            free[time] *= training[at]
        keep = channel.keep & training
        g = fit(
            replace(channel, keep=keep), f.structure, f.p, free, noise=None if white else f.noise,
            iterations=STEPS, colour=False,
        )  # fmt: skip
        if np.isfinite(g.deviance):
            found.append(g.p)
            if own:  # at rest, or from an initial state that is the effect
                run = simulate(g.structure, g.p, channel.u, channel.clock)
            else:
                run = free_run(g, channel.u, channel.clock, y, window, start)
            for block in fold:
                rows = slice(block.start // thin, min(-(-block.stop // thin), n))
                out[rows] = run[rows]
    return lengthened(out, thin, blocks.lengths[0]), tuple(found)
