"""Errors before and after on data not used, whether the free run of the answer is sane there, and what it is asked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline.choice import jackknife
from estimators.diagnosis.ladder.asked import curve_unknown, inside
from estimators.diagnosis.ladder.figures import about, difference_figure, moves, root, root_figure, together
from estimators.diagnosis.ladder.stated import SET
from estimators.diagnosis.ladder.steps import Kind, Ladder, Step, beyond_chance, is_sane
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.result.report import ErrorFigure
from estimators.diagnosis.share.feedback import has_feedback
from estimators.residual.algebra import mean_error
from oed.data import Record

if TYPE_CHECKING:
    from estimators.diagnosis.result.answers import Answer

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Simulated outputs before and after (N, ny), their errors, and what has to be said of them."""

    before: Array
    after: Array
    rmse_before: ErrorFigure
    rmse_after: ErrorFigure
    pred_before: ErrorFigure
    pred_after: ErrorFigure
    difference: ErrorFigure
    room: ErrorFigure
    rungs: tuple[dict[str, Any], ...]
    answered: tuple[Step, ...]  # per output, the step whose free run is given
    warnings: tuple[str, ...]
    # the share removed by the models of what is claimed, also where their runs are too loose to be the answer, from the linear model
    # or from themselves without it, where the record stays in the range of the training data; the difference where no share is sure
    borne: ErrorFigure
    untried: bool = False  # whether the record asks for a curve where nothing is known of it, so that it says nothing of a claim
    lost: bool = False  # whether the record's own mean is nearer to it than the free run of what is claimed
    by_chance: bool = False  # whether it alone chose the answer, by no more than errors as slow may have in common by chance
    within: bool = False  # whether only its samples in the range of the training data bear what is claimed

    @property
    def bears(self) -> bool:
        """Whether the record bears what is claimed of the system: its errors are less with it, and less than a constant's."""
        return not self.by_chance and (self.untried or (self.borne.low > 0.0 and not self.lost))

    @property
    def misread(self) -> bool:
        """Whether faults of the samples explain more than all that is claimed of the system: the linear model that knows of them, on the
        way from the one that does not."""
        known = [r["rmse_test"] for r in self.rungs if r["step"] == Kind.LINEAR.value and r["adds"]]
        before, after = self.rmse_before.value, self.rmse_after.value
        return any(before**2 - error**2 > error**2 - after**2 for error in known)


def removed(before: Array, after: Array, floor: tuple[float, int], policy: Policy) -> ErrorFigure:
    """(before - after)/(before - floor) with its interval; NaN where there is hardly anything to remove.

    The floor is from other data, of so many samples: a standard deviation with its own sampling error.
    """
    level, samples = floor
    room = root(before) - level
    if room <= policy.removable * level:
        return ErrorFigure(*[float("nan")] * 3)
    value = (root(before) - root(after)) / room
    own = mean_error(moves(before, after) * (1.0 - value) - moves(after, after)) / room
    return about(value, float(np.hypot(own, value / room * level / np.sqrt(2.0 * samples))))


UNDETERMINED = (
    "what the {} model of {} changes on the test record hangs on single blocks of the training data, on a curve between the levels "
    "of its input, or on which of several models is right that do nearly as well: the errors after are those of the {} model"
)


BORNE = (
    "what the {} model of {} changes on the test record is not determined by the training data alone: its errors, surely less than "
    "those of the {} model, bear it out"
)


AFTER_ALL = (
    "unused blocks alone do not admit the {} model of {}: its errors on the test record, surely less than those of the {} model, do, and "
    "this one thing the test record chose"
)


REFUSED = (
    "the {} model is worse on the test record than the linear model ({:.4g} against {:.4g}): the answer is the linear model, and this "
    "one thing the test record chose"
)


WITHIN = (
    "what is claimed is borne out in the {:.3g} % of the test record's samples that stay in the range of the training data, where the "
    "error falls from {:.4g} to {:.4g}; over the whole of it that is not sure"
)


MORE = 0.4
"""Share of its change from which on the variance of a run must not exceed all that its model has gained: of two such runs, .31
of the change was far above the error, .42 below it."""


def _undetermined(run: Array, linear: Array, folds: Sequence[Array], gained: float) -> bool:
    """Whether the variance of a run, (n,), by the jackknife over blocks left out, is more than half of what it changes.

    A change is an effect and that error; where the error is the larger of the two, the run without the change is nearer. An
    effect that is as large as on the unused blocks has `gained` its mean square there: a large error of more is no help either.
    """
    known = np.array([f for f in folds if np.all(np.isfinite(f))])
    if len(known) < 2:
        return False
    variance = float(np.mean(jackknife(known)))
    change = float(np.mean((run - linear) ** 2))
    return variance > (MORE if variance > gained else 0.5) * change


def _order(ladder: Ladder) -> list[int]:
    """The rungs in whose order one stands in for those before it: the answer, whatever else surely gains on unused blocks, linear ones."""
    able = [
        j
        for j, r in enumerate(ladder.rungs)
        if r.step.admitted and r.step.kind is not Kind.LINEAR and r.figure.high < ladder.rungs[0].value
    ]
    able.sort(key=lambda j: (j != ladder.answer, ladder.rungs[j].value))
    linear = [j for j, r in enumerate(ladder.rungs) if r.step.kind is Kind.LINEAR]
    return list(dict.fromkeys((ladder.answer, *able, *reversed(linear))))


def _determined(
    ladder: Ladder, order: Sequence[int], runs: Sequence[Array], simulate: Callable[[Answer], Array], use: NDArray[np.bool_],
    known: Sequence[bool],
) -> int:  # fmt: skip
    """The first of some rungs whose run, and those of all that it stands on, the training data determine on a record.

    Where one is not determined, another that bends stands in for it only if it makes of the record what that one does: it explains
    less, and two that differ do not both know what is missing.
    """
    refused, linear = [], runs[0][use]
    for j in (j for j in order if j and known[j]):
        step, own = ladder.rungs[j].step, runs[j][use]
        gained = ladder.rungs[0].value ** 2 - ladder.rungs[j].value ** 2
        parts = [(runs[j] if q is step else simulate(q.answer), q) for q in step.chain if q.folds or q.rivals]
        apart = step.kind is not Kind.LINEAR and _undecided(own, linear, refused, APART[Kind.DISCOVERED])
        if not apart and not any(
            _undetermined(run[use], linear, [simulate(a)[use] for a in q.folds], gained)
            or _undecided(run[use], linear, [simulate(a)[use] for a in q.rivals], APART[q.kind])
            for run, q in parts
        ):
            return j
        refused.append(own)
    return 0


APART = {Kind.NAMED: 1.0, Kind.DISCOVERED: 0.4}
"""Of what a model changes, squares by which its rivals' runs may be off it: two causes, each with an error of its own, are twice as
far from one another as from the truth; models of one search share terms and errors. Of those that came nearer to a test record
their rivals were off by up to .02, of those that left it by .5 to .7."""


def _undecided(run: Array, linear: Array, rivals: Sequence[Array], most: float) -> bool:
    """Whether rivals of a model make so much less or more of what it changes in a run, (n,): their median."""
    far = [float(np.sum((run - other) ** 2)) if np.all(np.isfinite(other)) else np.inf for other in rivals]
    return bool(far) and float(np.median(far)) > most * float(np.sum((run - linear) ** 2))


def continues(train: Record, test: Record) -> bool:
    """Whether a test record goes on where the training record ends, by their clock: two parts of one record."""
    return abs(test.t0 - train.t0 - len(train) * train.dt) < 1e-3 * train.dt


def onward(train: Record, test: Record | None, skip: int) -> Callable[[Answer | Step], Array]:
    """How models run over the record that is judged: the test record, whose state is set by its first `skip` samples and, where it goes on
    from the training record, by the end of that; without one, the training record."""
    record = train if test is None else test
    if test is None or not continues(train, test):
        return lambda model: model.simulate(record, skip)
    last = train[-min(SET, len(train)) :]
    whole = last.replace(u=np.concatenate((last.u, test.u)), y=np.concatenate((last.y, test.y)))
    return lambda model: model.simulate(whole, len(last) + skip)[len(last) :]


def _as_read(run: Array, held: NDArray[np.bool_]) -> Array:
    """(N,) a run as a sensor shows it that keeps its last value in some samples."""
    return run[np.maximum.accumulate(np.where(held, 0, np.arange(len(run))))]


def assess(
    train: Record, test: Record | None, ladders: Sequence[Ladder], *, skip: int, floor: float, counts: Array,
    held: NDArray[np.bool_], policy: Policy,
) -> HeldOut:  # fmt: skip
    """The errors of every rung on the test record, or on the unused blocks of the training record where there is none.

    `counts` (N, ny) says which samples of that record count, `held` (N, ny) in which of them the sensor shows its last value:
    what is simulated is then compared as it would show it, but for the linear model, which knows of no such sensor. The
    answer of each output is its ladder's; where its free run explodes, or is not determined by the training data, and the record does
    not surely bear it out, that is said, and the best of the others that is sane and determined stands in its place; and where the
    test record is further from the answer than from the linear model, that is said, and the linear model is the answer.
    """
    record, free_run = train if test is None else test, onward(train, test, skip)
    y = np.nan_to_num(record.y)
    runs = [
        [r.step.unused[0] if test is None else _as_read(free_run(r.step), held[:, i] & (r.step is not ladder.linear))
         for r in ladder.rungs]
        for i, ladder in enumerate(ladders)
    ]  # fmt: skip
    answers, warnings, untried, by_chance = [], [], False, False
    for i, ladder in enumerate(ladders):
        name, use = record.output_names[i], counts[:, i]
        off = [(y[:, i] - run)[use, None] for run in runs[i]]
        sane = [
            j
            for j in _order(ladder)
            if is_sane(runs[i][j][use], runs[i][0][use], train.y[:, i], policy)
            or (
                test is not None
                and np.all(np.isfinite(off[j]))
                and difference_figure(off[0], off[j]).low > 0.0
            )
        ]
        answers.append(sane[0] if sane else 0)
        if answers[-1] != ladder.answer or not sane:
            warnings.append(_exploded(ladder, answers[-1] if sane else None, name))
        if test is not None:
            known = [not curve_unknown(r.step, train, record) for r in ladder.rungs]
            untried |= not known[answers[-1]]
            j = _determined(ladder, sane, runs[i], free_run, use, known)
            if j != answers[-1]:
                borne = difference_figure(off[j], off[answers[-1]]).low > 0.0
                kinds = (ladder.rungs[k].step.kind.value for k in (answers[-1], j))
                warnings.append((BORNE if borne else UNDETERMINED).format(next(kinds), name, next(kinds)))
                answers[-1] = answers[-1] if borne else j

    def stacked(which: Sequence[int]) -> Array:
        return np.stack([r[j] for r, j in zip(runs, which, strict=True)], axis=1)

    before = stacked([0] * len(runs))
    weight = counts & np.isfinite(before)
    rows = weight.any(axis=1)

    def errors(run: Array) -> Array:
        e = np.where(weight, np.nan_to_num(y - run, nan=FAR, posinf=FAR, neginf=-FAR), 0.0)
        return e[rows] / np.sqrt(weight[rows].sum(axis=1, keepdims=True))

    first, second = errors(before), errors(stacked(answers))
    refused = test is not None and root(second) > root(first)
    if refused:
        kinds = {k.rungs[a].step.kind.value for k, a in zip(ladders, answers, strict=True) if a}
        warnings.append(REFUSED.format(" and ".join(sorted(kinds)), root(second), root(first)))
        answers, second = [0] * len(runs), first
    if test is not None:
        for i, ladder in enumerate(ladders):
            off = [np.where(counts[:, i], y[:, i] - run, 0.0)[counts[:, i], None] for run in runs[i]]
            sane = [
                is_sane(run[counts[:, i]], runs[i][0][counts[:, i]], train.y[:, i], policy) for run in runs[i]
            ]
            echoes = any(r.step.echo for r in ladder.rungs)
            loop = echoes and has_feedback([record], [y[:, i] - runs[i][0]], [counts[:, i]])
            if (j := _borne_after_all(ladder, answers[i], off, sane, loop, policy)) != answers[i]:
                kinds = (ladder.rungs[k].step.kind.value for k in (j, answers[i]))
                warnings.append(AFTER_ALL.format(next(kinds), record.output_names[i], next(kinds)))
                by_chance |= _by_chance(*(off[k][:, 0] for k in (answers[i], j)))
                answers[i] = j
        second = errors(stacked(answers))
    steps = [ladder.rungs[a].step for ladder, a in zip(ladders, answers, strict=True)]
    at = [k.answer if s.kind is Kind.LINEAR else a for s, k, a in zip(steps, ladders, answers, strict=True)]
    after, claimed = stacked(answers), stacked(at)
    bare = [ladder.rungs[a].step.without for ladder, a in zip(ladders, at, strict=True)]
    plain = [r[0] if test is None or a is None else free_run(a) for r, a in zip(runs, bare, strict=True)]
    ahead = [np.stack([_innovations(y[:, i] - run[:, i], noise) for i, noise in enumerate(noises)], axis=1)
             for run, noises in ((before, [np.zeros(0)] * len(steps)), (after, [s.noise for s in steps]))]  # fmt: skip
    third, least = errors(claimed), min(first, errors(np.stack(plain, axis=1)), key=root)
    figures, (one, other) = (
        (root_figure(first, second), root_figure(second, second)),
        (errors(y - e) for e in ahead),
    )
    worse, level = _worse_than_constant(y, weight, figures, policy), (floor, len(train))
    lost = ANSWER in _worse_than_constant(y, weight, (figures[0], root_figure(third, third)), policy)
    borne, within = _borne(least, third, level, policy), False
    if test is not None and not refused and not borne.low > 0.0:  # a claim is of what the training data cover
        use = inside([train], test)[rows]
        borne = _borne(least[use], third[use], level, policy)
        if within := borne.low > 0.0:
            warnings.append(WITHIN.format(100.0 * use.mean(), root(least[use]), root(third[use])))
    return HeldOut(
        before, after, figures[0], figures[1], root_figure(one, other), root_figure(other, other),
        difference_figure(first, second), removed(first, second, level, policy),
        tuple(_rungs(ladders, runs, lambda run: root_figure(errors(run), second), answers)), tuple(steps),
        (*warnings, *worse.values()),
        borne, untried, lost, by_chance, within,
    )  # fmt: skip


def _borne(before: Array, after: Array, floor: tuple[float, int], policy: Policy) -> ErrorFigure:
    """The share removed where that is surely some, else the difference: beside a floor too near to tell a share, errors may still fall."""
    share = removed(before, after, floor, policy)
    return share if share.low > 0.0 else difference_figure(before, after)


def _borne_after_all(
    ladder: Ladder, answer: int, off: Sequence[Array], sane: Sequence[bool], loop: bool, policy: Policy
) -> int:
    """The rung that unused blocks put before the answer without being sure of it, where errors on the test record, (n, 1), are surely less
    with it and its own fit tells it from nothing: the best on unused blocks of those. One that may only hear what the input knows of the
    noise hears it on a test record from a `loop` as well."""
    limit = (1.0 - policy.searched[1]) * ladder.rungs[answer].value
    able = [
        j
        for j, r in enumerate(ladder.rungs)
        if sane[j]
        and r.step.kind is not Kind.LINEAR
        and r.value < limit
        and r.step.told
        and not (loop and r.step.echo)
    ]
    surely = lambda j, rows: difference_figure(off[answer][rows], off[j][rows]).low > 0.0
    late = slice(len(off[answer]) // 2, None)  # a better start alone, which is not heard there, is no effect
    borne = [j for j in able if surely(j, slice(None)) and surely(j, late)]
    return min(borne, key=lambda j: ladder.rungs[j].value, default=answer)


def _by_chance(before: Array, after: Array) -> bool:
    """Whether errors (n,) are less than others by no more than what slow signals have in common by chance."""
    return not beyond_chance(
        [before], [np.zeros(len(before))], [before - after], [np.ones(len(before), dtype=bool)]
    )


def _innovations(e: Array, noise: Array) -> Array:
    return np.convolve(np.nan_to_num(e, posinf=FAR, neginf=-FAR), np.concatenate(([1.0], noise)))[: len(e)]


def _exploded(ladder: Ladder, instead: int | None, name: str) -> str:
    kind = ladder.chosen.kind.value
    if instead is None:
        return f"the free runs of all models of {name} leave every bound on the test record: no error there means anything"
    return (
        f"the free run of the {kind} model of {name} leaves every bound on the test record: the errors after are those "
        f"of the {ladder.rungs[instead].step.kind.value} model"
    )


ANSWER = "answer"
FAR = 1e40  # an error that is no number: beyond all others, and its sixth power one


def _worse_than_constant(
    y: Array, weight: Array, figures: Sequence[ErrorFigure], policy: Policy
) -> dict[str, str]:
    """The free runs, of the linear model and the answer, that predict less than the record's own mean does, each with a sentence."""
    spread = np.sqrt(np.mean([np.var(y[weight[:, i], i]) for i in range(y.shape[1])]))
    return {
        words: f"the free run of the {words} is worse on data not used ({figure.value:.4g}) than the record's own mean ({spread:.4g})"
        for words, figure in zip(("linear model", ANSWER), figures, strict=True)
        if figure.value > policy.constant * spread
    }


def _rungs(
    ladders: Sequence[Ladder],
    runs: list[list[Array]],
    figure_of: Callable[[Array], ErrorFigure],
    answers: Sequence[int],
) -> list[dict]:
    """One row per kind of step over all outputs: each output stands on its last rung of that kind or below."""
    kinds = list(dict.fromkeys(r.step.kind for kind in ladders for r in kind.rungs))
    rows = []
    for kind in sorted(kinds, key=list(Kind).index):
        at = [_last(ladder, kind) for ladder in ladders]
        run = np.stack([r[j] for r, j in zip(runs, at, strict=True)], axis=1)
        used = [ladder.rungs[j] for ladder, j in zip(ladders, at, strict=True)]
        unused = together([r.errors for r in used], [k.rungs[k.answer].errors for k in ladders])
        figure = figure_of(run)
        figure = figure if figure.value < FAR / 1e9 else ErrorFigure(np.inf, np.inf, np.inf)
        adds = [key for r in used if r.step.kind is kind for key in r.step.adds]
        rows.append({
            "step": kind.value, "adds": adds, "rmse_unused": unused.value, "low": unused.low, "high": unused.high,
            "rmse_test": figure.value, "low_test": figure.low, "high_test": figure.high,
            "answer": any(k.rungs[a].step.kind is kind for k, a in zip(ladders, answers, strict=True)),
        })  # fmt: skip
    return rows


def _last(ladder: Ladder, kind: Kind) -> int:
    order = list(Kind)
    able = [j for j, r in enumerate(ladder.rungs) if order.index(r.step.kind) <= order.index(kind)]
    same = [j for j in able if ladder.rungs[j].step.kind is kind]
    return min(same or able[-1:], key=lambda j: ladder.rungs[j].value)
