"""The ladder: every model of an output on the same unused blocks, and the rung that they vouch for.

A step is one whole model, whatever stage it came from: it brings its predictions of blocks that its parameters did not
see, and simulates any record. The stages do not know of each other here; a new kind of model is one more step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline.choice import SLOW
from estimators.diagnosis.effects import Nature
from estimators.diagnosis.ladder.figures import together
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.result.report import ErrorFigure
from estimators.residual.algebra import sum_error
from oed.covariances import NORMAL
from oed.data import Record

if TYPE_CHECKING:
    from estimators.diagnosis.result.answers import Answer

Array = NDArray[Any]


ENDS = 4
"""Samples of a record at which an input is moved, up and down by its standard deviation: a dead zone is not at all of them."""


class Kind(Enum):
    """Where a step comes from, the simplest first: this order is that of the one-standard-error rule."""

    LINEAR = "linear"
    NAMED = "named"
    DISCOVERED = "discovered"
    REMAINDER = "remainder"


@dataclass(frozen=True, eq=False)
class Step:
    """One whole model of one output: `unused` (N,) per training record."""

    kind: Kind
    adds: tuple[str, ...]  # keys of effects, or the terms of an equation
    unused: tuple[Array, ...]  # every block predicted with parameters that did not see it; NaN where none is
    answer: Answer  # the model itself
    size: int = 0  # parameters, for ties
    parameters: dict[str, tuple[float, float, str]] = field(
        default_factory=dict
    )  # value, standard error, unit
    sentences: tuple[str, ...] = ()
    equation: str = ""
    noise: Array = field(
        default_factory=lambda: np.zeros(0)
    )  # AR coefficients that whiten its simulation error
    admitted: bool = True  # False where the stage's own cross-validation refuses it: shown, never the answer
    below: Step | None = None  # the step that it adds to; the linear model where none is named
    echo: bool = (
        False  # it gains so little that it may only hear what the input knows of the noise: it names no cause
    )
    nature: str = ""  # the kind of its first cause
    rivals: tuple[Answer, ...] = ()  # models with other causes that unused blocks cannot tell from it
    folds: tuple[Answer, ...] = ()  # the same model fitted without one block or another
    linear: bool = False  # what it adds are poles, a delay or a level, which a linear predictor has: they cannot be news to it
    # the model without its one cause that is no linear dynamics, which may owe some of its gain to these
    without: Answer | None = None
    slow: bool = False  # a pole remembers longer than a block, and none of the linear model's does

    def simulate(self, record: Record, window: int) -> Array:
        """(N,) free run; the first `window` measured samples may set the state."""
        return self.answer.simulate(record, window)

    def at_once(self, record: Record, window: int) -> bool:
        """Whether it answers an input in the sample in which that acts: only such a model can be the inverse of a controller that does."""
        size = np.std(record.u, axis=0)
        for end in np.linspace(window + 1, len(record), ENDS + 1, dtype=int)[1:]:
            head = record[:end]
            run = self.simulate(head, window)[-1]
            for step in np.concatenate((np.diag(size), -np.diag(size))):
                u = head.u.copy()
                u[-1] += step
                if self.simulate(head.replace(u=u), window)[-1] != run:
                    return True
        return False

    def heard(self, echo: bool) -> Step:
        """The step, refused where it may only hear what the input knows of the noise."""
        return replace(self, admitted=self.admitted and not echo, echo=echo)

    @property
    def told(self) -> bool:
        """Whether the joint fit tells any coefficient of an equation from nothing; other models answer for theirs elsewhere."""
        values = self.parameters.values() if self.kind is Kind.DISCOVERED else ()
        return not values or any(abs(value) > NORMAL * error for value, error, _ in values)

    @property
    def chain(self) -> tuple[Step, ...]:
        """This step and all that it stands on, itself first."""
        return (self, *(self.below.chain if self.below is not None else ()))


def parameters_of(step: Step, effect: str) -> dict[str, tuple[float, float, str]]:
    """The parameters of a step that are an effect's, by its key."""
    return {k: v for k, v in step.parameters.items() if k.startswith(f"{effect}.")}


@dataclass(frozen=True)
class Gain:
    """By how much the mean squared error falls from one model to another, with its standard error by pieces."""

    value: float
    error: float
    share: float  # of the first model's root mean square error
    steady: float = 0.0
    # mean of the pieces' own relative gains in its standard errors: where one stretch has nearly all of the squares, their
    # sum says as little of the others as its standard error does

    def beyond(self, errors: float) -> bool:
        """Whether it is larger than so many of its standard errors, in squares or stretch by stretch."""
        return self.value > 0.0 and (self.value > errors * self.error or self.steady > errors)

    def meets(self, limit: tuple[float, float]) -> bool:
        """Whether it is what a limit of the policy asks: beyond so many standard errors, and more than a share of the error."""
        errors, share = limit
        return self.beyond(errors) and self.share > share

    def surely(self, limit: tuple[float, float]) -> bool:
        """Whether it is so in squares and stretch by stretch: what one regression of these blocks does not see, another may by luck."""
        return self.meets(limit) and self.value > limit[0] * self.error and self.steady > limit[0]


@dataclass(frozen=True, eq=False)
class Rung:
    """One step with its errors on unused blocks of all records together, (N,), NaN where they do not count, and what they come to."""

    step: Step
    errors: Array
    figure: ErrorFigure

    @property
    def value(self) -> float:
        """Root mean square of the errors."""
        return self.figure.value


@dataclass(frozen=True, eq=False)
class Ladder:
    """The steps of one output, the simplest first, and which of them is the answer."""

    rungs: tuple[Rung, ...]
    answer: int
    counted: tuple[NDArray[np.bool_], ...]  # samples of each record on which the errors were taken
    exact: bool = False  # the linear model leaves the rounding of doubles, and nothing can be missing

    @property
    def linear(self) -> Step:
        """The model before anything was added."""
        return self.rungs[0].step

    @property
    def chosen(self) -> Step:
        """The answer."""
        return self.rungs[self.answer].step

    @property
    def explained(self) -> float:
        """Share of the linear model's squared error on unused blocks that the answer takes away; nothing of none."""
        return 1.0 - self.left(self.rungs[self.answer].value)

    def left(self, value: float) -> float:
        """An error's mean square as a share of the linear model's on unused blocks; all of it where that model has none."""
        ratio = value / self.rungs[0].value if self.rungs[0].value > 0.0 else 1.0
        return (
            ratio * ratio
        )  # where ** 2 raises beyond the range of doubles, as it does for an error of rounding alone


def _pieces(squares: Sequence[Array], counted: Sequence[NDArray[np.bool_]], count: int) -> Array:
    """Sums of squares and numbers of samples over about `count` stretches of all records together, (pieces, 2)."""
    total = sum(len(s) for s in squares)
    rows = []
    for s, use in zip(squares, counted, strict=True):
        for part in np.array_split(np.arange(len(s)), max(2, round(count * len(s) / total))):
            rows.append((float(np.sum(s[part][use[part]])), float(np.sum(use[part]))))
    return np.array([row for row in rows if row[1] > 0])


def _mean(pieces: Array) -> tuple[float, float]:
    """Mean over samples and its standard error; pieces near one another are correlated, as slow errors last longer than one."""
    total = pieces[:, 1].sum()
    mean = float(pieces[:, 0].sum() / total)
    return mean, sum_error(pieces[:, 0] - mean * pieces[:, 1]) / float(total)


def paired_gain(
    measured: Sequence[Array], first: Sequence[Array], second: Sequence[Array],
    counted: Sequence[NDArray[np.bool_]], policy: Policy,
) -> Gain:  # fmt: skip
    """What the second prediction gains over the first on the same samples; all or nothing where one is not finite."""
    before = [(y - a) ** 2 for y, a in zip(measured, first, strict=True)]
    after = [(y - b) ** 2 for y, b in zip(measured, second, strict=True)]
    for squares, nothing in ((after, Gain(-np.inf, 0.0, -np.inf)), (before, Gain(np.inf, 0.0, 1.0))):
        if not all(np.all(np.isfinite(s[use])) for s, use in zip(squares, counted, strict=True)):
            return nothing
    first_pieces, second_pieces = (_pieces(squares, counted, policy.pieces) for squares in (before, after))
    gained = first_pieces - second_pieces * [1.0, 0.0]
    (value, error), (base, _) = _mean(gained), _mean(first_pieces)
    relative = gained[:, 0] / np.maximum(first_pieces[:, 0] + second_pieces[:, 0], 1e-300)
    spread = sum_error(relative - relative.mean()) / len(relative)
    share = 1.0 - float(np.sqrt(max(base - value, 0.0) / max(base, 1e-300)))
    return Gain(value, error, share, float(np.mean(relative)) / max(spread, 1e-300))


CHANCE = 25.0
"""Likelihood ratio, of samples that are independent of one another, that the best of some hundreds of changes reaches of slow noise: of
36 records beside random walks and noises with memories of 50 and 200 samples, four models took half of the error of unused
blocks or more, by 7 to 16; true ones of rigs had 37 or more."""


def beyond_chance(
    measured: Sequence[Array], first: Sequence[Array], second: Sequence[Array], counted: Sequence[NDArray[np.bool_]]
) -> bool:  # fmt: skip
    """Whether what a second prediction changes has more in common with the errors of the first than slow signals have by chance.

    Two that are slow go together over many samples: stretches of a record that no fit saw are no others, as neighbours share both.
    """
    before = after = samples = 0.0
    for y, a, b, use in zip(measured, first, second, counted, strict=True):
        e, change = (np.where(use, x, 0.0) for x in (y - a, b - a))
        if not np.all(np.isfinite(change)):
            return False
        before, after = before + float(e @ e), after + float((e - change) @ (e - change))
        samples += min(common_samples(e, change), float(use.sum()))
    return after <= 0.0 or samples * float(np.log(max(before, 1e-300) / after)) > CHANCE


def common_samples(a: Array, b: Array) -> float:
    """Independent samples by which two signals (N,) that know nothing of one another are correlated, as Bartlett counts them."""
    n = len(a)
    rho = []
    for x in (a, b):
        power = np.abs(np.fft.rfft(x / (np.abs(x).max() + 1e-300), 2 * n)) ** 2
        covariance = np.fft.irfft(power)[: n // 4]
        rho.append(covariance / (covariance[0] + 1e-300))
    lags = np.arange(1, n // 4)
    return n / max(1.0 + 2.0 * float(np.sum((1.0 - lags / n) * rho[0][1:] * rho[1][1:])), 1.0)


def unused_errors(measured: Sequence[Array], step: Step, counted: Sequence[NDArray[np.bool_]]) -> Array:
    """The step's errors on unused blocks of all records together, (N,): NaN where they do not count, infinite where there is no number."""
    off = np.concatenate([y - s for y, s in zip(measured, step.unused, strict=True)])
    return np.where(np.concatenate(counted), np.where(np.isfinite(off), off, np.inf), np.nan)


def _charged(measured: Sequence[Array], step: Step) -> Sequence[Array]:
    """The step's unused runs, with the errors that a pole slower than a block is charged for."""
    return (
        [y - SLOW * (y - run) for y, run in zip(measured, step.unused, strict=True)]
        if step.slow
        else step.unused
    )


def refused(steps: Sequence[Step], kind: Kind) -> list[Step]:
    """The steps, those of a kind shown only; what was refused before stays so."""
    return [replace(s, admitted=s.admitted and s.kind is not kind) for s in steps]


def as_started(steps: Sequence[Step], train: Record, i: int, skip: int) -> list[Step]:
    """The steps; only shown where a run from the record's own start, set as a test record's will be, is worse than the linear one.

    Blocks have a window that sets their state: they do not see what a model takes for granted of a start.
    """
    y = train.y[:, i]
    use = np.isfinite(y) & (np.arange(len(y)) >= skip)
    with np.errstate(over="ignore"):
        errors = [float(np.sum((s.simulate(train, skip) - y)[use] ** 2)) for s in steps]
    return [replace(s, admitted=s.admitted and e <= errors[0]) for s, e in zip(steps, errors, strict=True)]


def climb(
    measured: Sequence[Array],
    steps: Sequence[Step],
    counted: Sequence[NDArray[np.bool_]],
    policy: Policy,
    *,
    least: int = 0,
) -> Ladder:
    """Order the steps, and climb to each that is better on unused blocks than the answer so far, beyond its standard errors.

    `measured` and `counted` are (N,) per training record; the first step is the linear model. By construction the
    answer is no worse there than the linear model, whatever a stage claims of itself; of an exact one there is nothing to gain. Steps before `least` are shown only:
    a linear model fitted to samples that are no measurements. A named cause that runs by the clock gives way to discovered
    terms that do as well without one: they say what happens when it all begins again.
    """
    counted = tuple(
        use & np.isfinite(first) for use, first in zip(counted, steps[0].unused, strict=True)
    )  # where the linear model predicts nothing, nothing is compared
    order = list(Kind)
    ranked = [steps[0], *sorted(steps[1:], key=lambda s: (order.index(s.kind), s.size))]
    errors = [unused_errors(measured, s, counted) for s in ranked]
    able = [
        i
        for i, (s, e) in enumerate(zip(ranked, errors, strict=True))
        if i >= least and (i == least or (s.admitted and not np.any(np.isinf(e))))
    ]
    answer = able[0]
    y = np.concatenate([m[use] for m, use in zip(measured, counted, strict=True)])
    exact = together([errors[answer]], [errors[answer]]).value <= ROUNDING * float(
        np.max(np.abs(y), initial=0.0)
    )
    for i in () if exact else able[1:]:
        before, after = (_charged(measured, ranked[k]) for k in (answer, i))
        gain = paired_gain(measured, before, after, counted, policy)
        searched = ranked[i].kind in (Kind.DISCOVERED, Kind.REMAINDER)
        if gain.meets(policy.searched if searched else policy.claimed):
            answer = i
        elif ranked[i].kind is Kind.DISCOVERED and ranked[answer].nature == Nature.TIME:
            back = paired_gain(measured, ranked[i].unused, ranked[answer].unused, counted, policy)
            answer = answer if back.meets(policy.claimed) else i
    return Ladder(_rungs(ranked, errors, answer), answer, counted, exact)


def _rungs(steps: Sequence[Step], errors: Sequence[Array], answer: int) -> tuple[Rung, ...]:
    """The steps with their errors, each figure beside that of the answer."""
    return tuple(Rung(s, e, together([e], [errors[answer]])) for s, e in zip(steps, errors, strict=True))


ROUNDING = 1e-13
"""Of the largest sample: what a sum of some hundred doubles may be off by, and no record of a sensor is good to."""


def over_linear(
    ladder: Ladder,
    most: float,
    make: Callable[[Ladder], Step | None],
    measured: Sequence[Array],
    policy: Policy,
) -> Ladder:
    """The ladder with a step made on the linear model itself, where `most` that can be explained is more than the answer does: what is
    named or found may be one piece of what is missing, and a regression of it all does not need that. It is the answer where it surely
    does more, and else stands by for an answer that a record turns out not to determine."""
    if ladder.exact or not most > ladder.explained:
        return ladder
    if (step := make(replace(ladder, answer=0))) is None:
        return ladder
    gain = paired_gain(measured, ladder.chosen.unused, step.unused, ladder.counted, policy)
    more = gain.meets((policy.searched[0], policy.lasting))
    answer = len(ladder.rungs) if more else ladder.answer
    errors = [*(r.errors for r in ladder.rungs), unused_errors(measured, step, ladder.counted)]
    rungs = _rungs([*(r.step for r in ladder.rungs), step], errors, answer)
    return replace(ladder, rungs=rungs, answer=answer)


def is_sane(run: Array, linear: Array, y: Array, policy: Policy) -> bool:
    """Whether a run stays near the training outputs y (n,), or not much farther off than the linear model's run does."""
    low, high = float(np.nanmin(y)), float(np.nanmax(y))
    half, middle = max(high - low, 1e-300) / 2.0, (low + high) / 2.0
    if not np.all(np.isfinite(run)):
        return False
    asked = float(np.max(np.abs(linear - middle), initial=half)) if np.all(np.isfinite(linear)) else np.inf
    most, beside = policy.sane_reach
    return bool(np.max(np.abs(run - middle)) < min(most * half, beside * asked))
