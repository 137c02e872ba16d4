"""A linear model of one output, y = (B u + c) / A, and its free run from a state that a window of samples sets."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from estimators.residual.algebra import definite, stable

Array = NDArray[Any]

REST = 1e-6
"""Variance of a state about rest, of that of the signal: rest is not exact, and a singular prior is no prior."""
FAR = 0.999
"""Radius from which on a pole forgets too slowly (over 1000 samples) for a steady state to say where a record starts."""
FORGOTTEN, LONGEST = 1e-2, 500
"""Share of a response after which an input before a record no longer counts, and most samples of it."""
REACH = 400
"""Most samples that set a training record's state: their covariance is solved as one matrix."""
FEWEST = 5
"""Samples from which on an output is known to rest, an input to be held, or a state is set by measurement."""
STILL = 0.05
"""Standard deviation of a resting output, of that of all its samples."""
UNDRIVEN = 3.0
"""Standard deviations of a model's run from rest, beyond which a record's start is not what its inputs left, as in a record cut out
of a longer one, but how its experiment starts: the next one that begins with the same inputs starts alike."""
AGAIN = 0.1
"""Share of the later samples under inputs held as long as at a record's start, up to which two records that begin so begin alike."""
RARE = 0.05
"""Of the later samples under the inputs of a record's start, those at which the output is as far off its rest, up to which a start as far
is how the experiment starts, and not what was caught of a longer one."""
ALIKE = 2.0
"""Variance of resting samples, and square of what they are off a model at rest, of its noise's variance, up to which it is noise."""


def held_first(u: Array) -> int:
    """Samples before inputs (N, nu) first move."""
    moved = np.flatnonzero((u != u[:1]).any(axis=1))
    return int(moved[0]) if len(moved) else len(u)


def rest_means(u: Array, e: Array) -> Array:
    """Means of as many samples of an error (N,) as the inputs (N, nu) rest at first: such a one is what deviations are from."""
    n = min(held_first(u), len(e))
    return np.convolve(e, np.full(n, 1.0 / n), "valid")


def unmoved(u: Array, y: Array) -> Array:
    """The outputs measured before the inputs (N, nu) first move; none where they are too few to tell anything."""
    y = y[: held_first(u)]
    y = y[np.isfinite(y)]
    return y if len(y) >= FEWEST else y[:0]


def outset(opening: Array) -> float:
    """Where a record begins, of its outputs before the inputs move: what settles there long enough ends at the model's rest."""
    return float(opening[:FEWEST].mean())


def begins_apart(u: Array, far: NDArray[np.bool_]) -> bool:
    """Whether inputs (N, nu) are hardly ever again held as they are at first, or the output hardly ever as `far` (N,) off its rest where they
    are: two records that begin so are two experiments begun alike, and no two pieces of one."""
    held, k = (u == u[:1]).all(axis=1), held_first(u)
    if k < FEWEST or len(u) <= 2 * k:
        return False
    long, short = (np.convolve(held[k:], np.ones(m), "valid") > m - 0.5 for m in (k, FEWEST))
    return bool(long.mean() <= AGAIN or far[k:][: len(short)][short].mean() <= RARE)


def rest_level(u: Array, y: Array, variance: float) -> float:
    """Mean output before the inputs (N, nu) first move, if it rests there; NaN otherwise."""
    y = unmoved(u, y)
    return float(y.mean()) if len(y) and y.var() <= STILL**2 * variance else np.nan


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the output before a record begins, and how far its samples are off the simulation.

    `mean` of the output; `covariance` (m,) autocovariance of the output at lags 0 to m - 1, m above the order
    of every model; `noise` variance of measured minus simulated output, sample by sample; `rest` whether
    signals are deviations from a rest in which every record starts; `level` output at which the training
    records rested under the inputs `held` before they were excited; NaN if they did not; `held` (nu,) those
    inputs; `first` mean output there, rest or noise: all that is known of where a model without a rest of its own starts;
    `opening` (k,) the outputs there where the experiment starts far from the model's rest; `turned` (nu, m) half the mean square change
    of each input within 0 to m - 1 samples: how far those before a record may have been off its first.
    """

    mean: float
    covariance: Array
    noise: float
    rest: bool = False
    level: float = np.nan
    held: Array = field(default_factory=lambda: np.empty(0))
    first: float = np.nan
    opening: Array = field(default_factory=lambda: np.empty(0))
    turned: Array = field(default_factory=lambda: np.empty((0, 0)))

    def of(self, model: "LinearModel", u: Array, y: Array, known: bool = False) -> "Prior":
        """The prior with the opening of the training record (N, nu), (N,) where a model at rest would miss it, or is `known` to."""
        if self.rest or not len(opening := unmoved(u, y)) or not 0.0 < model.radius < FAR:
            return self
        opened, rest = replace(self, opening=opening), model.level(u[0])
        off = abs(outset(opening) - rest)
        apart = off > UNDRIVEN * np.sqrt(self.noise) and begins_apart(u, np.abs(y - rest) >= off)
        moving = apart and np.isnan(self.level)
        if (
            moving and not known
        ):  # nor begun by its first inputs, as an experiment that starts at rest with a step
            runs = (
                model.beginning(opened, u, y).free_run(opened, u, y, 0),
                model.free_run(replace(self, rest=True), u, y, 0),
            )
            begun, rest = (float(np.nansum((y - run)[:REACH] ** 2)) for run in runs)
            moving = rest > ALIKE * begun
        return opened if moving or model.astray(u, y) else self

    def alike(self, u: Array, y: Array, window: int) -> bool:
        """Whether a record (N, nu), (N,) begins as the training records opened, for all that its window measures."""
        return bool(
            not self.rest
            and len(self.opening)
            and (u[:FEWEST] == self.held).all()
            and not np.isfinite(y[:window]).any()
        )

    def opened(self, u: Array, y: Array, window: int) -> tuple[Array, int]:
        """The outputs (N,) that set a run's state and how many: where none is measured, those with which the training records opened
        under the same inputs (N, nu)."""
        if self.rest or not len(self.opening) or np.isfinite(y[:window]).any():
            return y, window
        known = self.opening[: int(np.cumprod((u == self.held).all(axis=1)).sum())]
        return np.concatenate((known, y[len(known) :])), len(known)

    def started(self, u: Array) -> float:
        """Output at the start of a record whose first inputs are u (nu,), as the training records have shown it; NaN if they have not."""
        known = self.level if np.isfinite(self.level) else self.first
        return known if np.array_equal(u, self.held) else np.nan


@dataclass(frozen=True, eq=False)
class LinearModel:
    """y(k) + a1 y(k-1) + ... = sum_j b_j0 u_j(k) + b_j1 u_j(k-1) + ... + c.

    `den` (n + 1,) denominator, its first coefficient 1; `num` (nu, m) numerators by lag from 0; delays are
    leading zeros; `constant` c, the drive of a constant level; `moved` (nu,) standard deviations of the inputs before a
    record, where its state is what they left: of many poles, a state in past outputs is beyond what samples can set;
    `begun` (n,) outputs before a record that begins as the training record did, where that is known.
    """

    den: Array
    num: Array
    constant: float = 0.0
    moved: Array = field(default_factory=lambda: np.empty(0))
    begun: Array = field(default_factory=lambda: np.empty(0))

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.den) - 1

    @cached_property
    def poles(self) -> NDArray[np.complex128]:
        """(n,) poles in the z plane."""
        return np.roots(self.den).astype(complex)

    def within(self, limit: float) -> bool:
        """Whether no pole is outside a circle of a radius of 1 or more."""
        return stable(self.den[1:]) or self.radius <= limit

    @cached_property
    def radius(self) -> float:
        """Largest magnitude of a pole."""
        return float(np.abs(self.poles).max(initial=0.0))

    def driven(self, u: Array, before: Array | None = None) -> Array:
        """(N,) what enters 1/A; inputs `before` (m, nu) came first, and before them, or without them, the first ones."""
        out = np.full(len(u), self.constant)
        held = u[:1] if before is None or not len(before) else before
        for b, x, past in zip(self.num, u.T, held.T, strict=True):
            if len(u) and (used := np.flatnonzero(b)).size:
                last = used[-1]
                lead = np.concatenate((np.full(last, past[0]), past[1:]))[-last:] if last else past[:0]
                out += np.convolve(np.concatenate((lead, x)), b)[last : last + len(x)]
        return out

    def astray(self, u: Array, y: Array) -> float:
        """How far a record (N, nu), (N,) starts from this model's rest, where no input can have left it there; else 0."""
        opening = unmoved(u, y)
        if not len(opening) or not 0.0 < self.radius < FAR:
            return 0.0
        run = self.run(self.driven(u), np.full(self.order, self.level(u[0])))
        off = abs(outset(opening) - float(run[0]))
        return off if off > UNDRIVEN * float(np.std(run)) else 0.0

    def level(self, u: Array) -> float:
        """Output at rest under constant inputs (nu,); not finite without a rest."""
        gain = float(self.den.sum())
        return float(self.num.sum(axis=1) @ u + self.constant) / gain if gain else np.inf

    def run(self, driven: Array, past: Array) -> Array:
        """(N,) free run after the outputs `past` = y(-1), ..., y(-n)."""
        from estimators.diagnosis.baseline.linear_kernels import continued

        if not self.order:
            return driven
        return continued(driven, self.den[1:], np.ascontiguousarray(past)[:, None])[:, 0]

    def free(self, length: int) -> Array:
        """(length, n) what each of the outputs y(-1), ..., y(-n) leaves in the free run."""
        from estimators.diagnosis.baseline.linear_kernels import continued

        return continued(np.zeros(length), self.den[1:], np.eye(self.order))

    def _before(self, prior: Prior, u: Array, y: Array) -> tuple[float, Array]:
        """Mean and covariance (n, n) of the outputs before the first sample."""
        n = self.order
        anywhere = toeplitz(prior.covariance[:n]) if n else np.empty((0, 0))
        if prior.rest:
            return 0.0, REST * anywhere
        level = rest_level(u[: len(y)], y, prior.covariance[0])
        if np.isfinite(level):
            return level, prior.covariance[0] * np.ones((n, n)) + REST * anywhere
        if np.isfinite(y).sum() >= FEWEST:
            return prior.mean, anywhere
        return self.expected(prior, u[0]), REST * anywhere

    def expected(self, prior: Prior, u: Array) -> float:
        """Output before an unmeasured record: where the training records rested, or at rest under inputs (nu,) if there is such a rest."""
        level, own = prior.level if np.array_equal(u, prior.held) else np.nan, self.level(u)
        if len(self.moved) and self.radius < FAR and (level - own) ** 2 <= ALIKE * prior.noise:
            return own  # off its own rest a model of so many poles would ring
        if np.isfinite(level):
            return level
        start = prior.started(u)
        return own if self.radius < FAR else start if np.isfinite(start) else prior.mean

    def before(self, prior: Prior, u: Array, count: int) -> Array:
        """(count,) outputs before an unmeasured record whose inputs stay at u (nu,) at first, the last first."""
        if len(self.begun) and prior.alike(u[None], u[:0], 0):
            return np.concatenate((self.begun, np.zeros(count)))[:count]
        return np.full(count, 0.0 if prior.rest else self.expected(prior, u))

    def free_run(self, prior: Prior, u: Array, y: Array, window: int) -> Array:
        """(N,) simulated output; the first `window` samples of y (N,) set the state, and are smoothed by it.

        The state is the conditional mean of a Gaussian: outputs before the first sample with the prior's covariance, noise
        of variance `noise` on the samples.
        """
        if len(self.begun) and prior.alike(u, y, window):
            return self.run(self.driven(u), self.begun)
        y, window = prior.opened(u, y, window)
        n, w = self.order, min(window, len(y))
        driven = self.driven(u, np.zeros((1, u.shape[1])) if prior.rest else None)
        if len(self.moved) and not prior.rest and np.isfinite(y[:w]).any():
            return self._after_inputs(prior, u, y[:w])
        ahead = self._told(prior, driven, u, y[:w])
        return np.concatenate((ahead[n:], self.run(driven[w:], ahead[w:][::-1])))

    def beginning(self, prior: Prior, u: Array, y: Array) -> "LinearModel":
        """The model with what the training record (N, nu), (N,) tells of its beginning, where others begin alike."""
        if not len(prior.opening) or len(self.moved):
            return self
        ahead = self._told(prior, self.driven(u), u, y[:REACH])
        return replace(self, begun=ahead[: self.order][::-1])

    def later(self, prior: Prior, samples: int) -> tuple["LinearModel", Prior]:
        """The model and the prior of a record that begins so many samples after the training record did, by then nearer to its rest by
        itself."""
        if samples <= 0 or not 0.0 < self.radius < 1.0:
            return self, prior
        rest = self.level(prior.held)

        def past(before: Array) -> Array:
            gone = self.run(np.zeros(samples), before - rest)
            return rest + np.concatenate((gone[::-1], before - rest))[: self.order]

        held = lambda level: float(past(np.full(self.order, level))[0])
        begun = past(self.begun) if len(self.begun) else self.begun
        by_then = replace(prior, level=held(prior.level), first=held(prior.first))
        return replace(self, begun=begun), by_then

    def _told(self, prior: Prior, driven: Array, u: Array, y: Array) -> Array:
        """(n + w,) outputs before a record and in a window of it, as far as the window's samples (w,) tell of them."""
        n, w = self.order, len(y)
        mean, cov = self._before(prior, u, y)
        past = np.full(n, mean)
        ahead = np.concatenate((past, self.run(driven[:w], past)))
        seen = np.flatnonzero(np.isfinite(y)) + n
        if n and len(seen):
            lead = np.concatenate((np.eye(n)[::-1], self.free(w)))
            spread = lead @ cov @ lead.T
            # inputs that are held at first are taken to have been held before
            if len(prior.turned) and self.num.any() and held_first(u) < FEWEST:
                spread[n:, n:] += self._entered(prior.turned, w)
            inner = spread[np.ix_(seen, seen)] + prior.noise * np.eye(len(seen))  # pyright: ignore[reportCallIssue]
            ahead += spread[:, seen] @ definite(inner, y[seen - n] - ahead[seen], 1e-13)
        return ahead

    def _entered(self, turned: Array, length: int) -> Array:
        """(length, length) covariance of a free run, of the inputs before its record, which are taken to have been its first ones."""
        out = np.zeros((length, length))
        for b, half in zip(self.num, turned, strict=True):
            lags = np.arange(1, np.flatnonzero(b)[-1] + 1) if b.any() else np.empty(0, dtype=int)
            change = lambda k, half=half: half[np.minimum(np.abs(k), len(half) - 1)]
            off = change(lags)[:, None] + change(lags) - change(lags[:, None] - lags)
            enters = np.zeros((length, len(lags)))
            for k in range(min(length, len(lags))):
                enters[k, : len(lags) - k] = b[k + 1 : len(lags) + 1]
            left = np.asarray(lfilter([1.0], self.den, enters, axis=0))
            out += left @ off @ left.T
        return out

    def unset(self, prior: Prior, noise: float, length: int, window: int) -> float:
        """Mean variance of a free run of `length` samples, as far as a window of samples with noise of a variance leaves its state
        open where the record may start anywhere."""
        n, free = self.order, self.free(length)
        cov = (REST if prior.rest else 1.0) * toeplitz(prior.covariance[:n])
        seen = free[:window] @ cov
        inner = seen @ free[:window].T + noise * np.eye(len(seen))
        left = cov - seen.T @ np.linalg.pinv(inner, rcond=1e-13, hermitian=True) @ seen
        return max(float(np.mean(np.sum((free @ left) * free, axis=1))), 0.0)

    def _after_inputs(self, prior: Prior, u: Array, window: Array) -> Array:
        """(N,) simulated output after unknown inputs, as far as the samples of the window (w,) tell of them."""
        n, w = len(u), len(window)
        long = min(LONGEST, 1 + int(np.log(FORGOTTEN) / np.log(max(min(self.radius, FAR), 0.1))))
        run = self.run(self.driven(u), np.full(self.order, self.level(u[0])))
        rested = rest_level(u[:w], window, ALIKE * prior.noise / STILL**2)
        if (rested - run[0]) ** 2 <= ALIKE * prior.noise:  # nothing came before, whatever noise may look like
            return run
        seen = np.flatnonzero(np.isfinite(window))
        pulses = np.asarray(lfilter([1.0], self.den, _padded(self.num, w + long), axis=1))
        H = np.concatenate(
            [np.lib.stride_tricks.sliding_window_view(g[1:], long)[:w] for g in pulses], axis=1
        )
        S, H = np.repeat(self.moved**2, long), H[seen]
        inner = (H * S) @ H.T + max(prior.noise, 1e-300) * np.eye(len(seen))
        past = (S * (H.T @ np.linalg.solve(inner, (window - run[:w])[seen]))).reshape(-1, long)[:, ::-1]
        late = LinearModel(self.den, self.num).driven(np.concatenate((past, np.zeros((len(past), n))), axis=1).T,
                                                      np.zeros((1, len(past))))  # fmt: skip
        return run + np.asarray(lfilter([1.0], self.den, late))[long:]


def _padded(rows: Array, width: int) -> Array:
    out = np.zeros((len(rows), max(width, rows.shape[1])))
    out[:, : rows.shape[1]] = rows
    return out
