"""What was stated of records, a start at rest or an order, and the data deny; a pole that no input drives, an answer to the noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chi2

from estimators.diagnosis.baseline.baseline import Baseline, Options
from estimators.diagnosis.baseline.best import FURTHER, best_linear, own_inputs, prior_of
from estimators.diagnosis.baseline.choice import WORSE
from estimators.diagnosis.baseline.linear_model import rest_means
from estimators.diagnosis.baseline.regression import Arx
from estimators.diagnosis.baseline.search import DELAYS, EARLY, Search
from estimators.diagnosis.ladder.outcome import Outcome
from estimators.diagnosis.ladder.steps import Kind, paired_gain
from estimators.diagnosis.model.forces import effective_samples
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.search.named import INDEPENDENT
from estimators.diagnosis.share.feedback import in_loop
from estimators.residual.algebra import decomposed
from oed.data import Record

Array = NDArray[Any]

MOVING = 1e-6
"""Significance of a state at the start from which on a record does not begin at rest: that was stated, and takes much to be denied."""
SET = 200
"""Samples that set a state whose worth is judged, or that goes on into a test record: light and slow poles have shown theirs by then."""
DENIED = (
    "the record does not start at rest, as was stated: with a state at its start the error is {:.0%} less"
)
LEVEL = "{} does not go about the level where it rested: with a level of its own the error on unused blocks is {:.0%} less"
PLAIN = 4
"""Order of the model whose start is looked at where none is stated: what has more poles follows a start as dynamics."""


HALF = 0.5
"""Share of the error that a state beside a level farther off must take for a start at rest to be denied: a curve leaves a level too."""


@dataclass(frozen=True)
class Contradiction:
    """What does not hold of what was stated: the effect that it goes by, the evidence, its share of the error, its significance."""

    key: str
    sentence: str
    share: float
    p_value: float = 0.0


def _search(records: Sequence[Record], i: int, base: Baseline, options: Options) -> Search:
    own, _ = own_inputs(records, i, options)
    return Search(own, i, base.blocks, prior_of(own, i, options), not options.deviations)


def starts_at_rest(train: Record, i: int, base: Baseline) -> bool:
    """Whether the training record's first samples look as if no input had been before, rather than the first one for long.

    Records of one rig start alike: a test record without a window to set the state is simulated from the same start.
    """
    m = base.outputs[i]
    u, y = train.u[:, list(m.inputs)], train.y[:, i]
    runs = [m.model.free_run(replace(m.prior, rest=rest), u, y, 0) for rest in (True, False)]
    seen = np.isfinite(y)
    return bool(np.sum((y - runs[0])[seen] ** 2) < np.sum((y - runs[1])[seen] ** 2))


def starts_moving(
    records: Sequence[Record], i: int, base: Baseline, order: int | None, options: Options
) -> Contradiction | None:
    """Whether records stated to start at rest do not: a state shows by itself, or beside the level where it ends, which was not subtracted."""
    n = min(base.outputs[i].shared[0], PLAIN) if order is None else order
    search = _search(records, i, base, options)
    if not search.inputs:
        return None
    alone = _moving(search, n, level=False)
    beside = None if alone else _moving(search, n, level=True)
    return beside if beside and beside.share > HALF else alone


def _moving(search: Search, n: int, *, level: bool) -> Contradiction | None:
    """A model of an order with states at the records' starts beside the same one without; with a level, at rest there or at 0."""
    i, form = search.output, Arx(n, n + 1, (1,) * search.inputs, level)
    still, free = (replace(search, prior=replace(search.prior, rest=rest)) for rest in (True, False))
    first = still.of_form(replace(form, offset=False))
    then = first and free.of_form(form, first.models[-1])
    if not (first and then):
        return None
    model = then.models[-1]
    back = still.of_form(
        replace(form, offset=False), replace(model, constant=0.0)
    )  # else another minimum seems to be a start
    noise = min(first.noise, np.inf if back is None else back.noise)
    if level:
        off = model.level(np.zeros(search.inputs))
        there = replace(still, records=[r.replace(y=r.y - off) for r in search.records])
        rest = there.of_form(replace(form, offset=False), replace(model, constant=0.0))
        noise = min(noise, np.inf if rest is None else rest.noise)
    else:  # a state of a pole that forgets nothing is a level, as means of few samples at rest leave it
        constant = still.of_form(replace(form, offset=True), first.models[-1])
        noise = min(noise, np.inf if constant is None else constant.noise)
    prior = replace(free.prior, noise=then.noise)
    left = [r.y[:, i] - model.free_run(prior, r.u, r.y[:, i], min(SET, len(r))) for r in search.records]
    samples = effective_samples(np.concatenate([e[np.isfinite(e)] for e in left]))
    kept = max(then.noise, 1e-300) / max(noise, 1e-300)
    p = float(chi2.sf(max(-samples * np.log(kept), 0.0), max(n, 1) * len(search.records)))
    share = 1.0 - float(np.sqrt(kept))
    return Contradiction("initial", DENIED.format(share), share, p) if p < MOVING else None


def linear_base(
    records: Sequence[Record], orders: Sequence[int | None], options: Options
) -> tuple[list[Contradiction | None], Baseline, Options]:
    """Which outputs do not start at rest, as was stated, the best linear models, and the options that go on from there."""
    base = best_linear(records, options)
    moving: list[Contradiction | None] = [None] * len(orders)
    if options.deviations:
        moving, base, options = denied_starts(records, base, orders, options)
    return moving, *unheard(records, base, options)


def denied_starts(
    records: Sequence[Record], base: Baseline, orders: Sequence[int | None], options: Options
) -> tuple[list[Contradiction | None], Baseline, Options]:
    """Which outputs do not start at rest, as was stated, and the linear models and options that go on from there."""
    moving = [starts_moving(records, i, base, n, options) for i, n in enumerate(orders)]
    if not any(moving):
        return _levelled(records, base, options)
    # the data then tell the training records' starts, and what was stated holds of the test record alone
    told = replace(options, deviations=None, moving=True)
    return moving, best_linear(records, told), told


NEAR = 3.0
"""Standard errors of a mean: beyond which a level is none of what the noise makes, and within which samples at rest say nothing of it."""


def _levelled(
    records: Sequence[Record], base: Baseline, options: Options
) -> tuple[list[Contradiction | None], Baseline, Options]:
    """The linear models and options with a level of each output, where deviations are from means of so few samples at rest that a constant
    is left, which is no cause; or where a model without one is worse than a constant, which is one, if nothing else is. What has no level
    bends to it."""
    denied: list[Contradiction | None] = [None] * len(base.outputs)
    for i in range(len(base.outputs)):
        rests = [r.y[:, i] - y[:, i] for r, y in zip(records, base.y_model, strict=True)]
        left = np.concatenate([e[np.isfinite(e)] for e in rests])
        error = float(np.std(left)) / np.sqrt(effective_samples(left - left.mean()))
        scatter = float(np.std(rest_means(records[0].u, left)))
        shifted = base.rmse_unused[i] >= np.nanstd(np.concatenate([r.y[:, i] for r in records]))
        if shifted or NEAR * error < abs(left.mean()) < NEAR * scatter:
            told = replace(options, deviations=None)
            other = best_linear(records, told)
            first, second = (float(np.sum(b.rmse_unused**2)) for b in (base, other))
            if not second < (1.0 - FURTHER) ** 2 * first:
                break
            if shifted:
                share = 1.0 - float(other.rmse_unused[i] / base.rmse_unused[i])
                denied[i] = Contradiction("offset", LEVEL.format(records[0].output_names[i], share), share)
            return denied, other, told
    return denied, base, options


HEARD = 0.05
"""Of the error on unused blocks, what a model that acts in the input's own sample may gain by hearing a controller's answer to the noise:
of records in a loop it was 1.5 % at most, and 4 to 17 % worse on inputs of another origin."""


def unheard(records: Sequence[Record], base: Baseline, options: Options) -> tuple[Baseline, Options]:
    """The linear models and options without what acts in the input's own sample on an output whose noise that input answers: most of it
    is the controller's answer, unless unused blocks are far worse without."""
    found = tuple(i for i, m in enumerate(base.outputs) if min(m.delays) == 0 and in_loop(records, base, i))
    if not found:
        return base, options
    told = replace(options, later=found)
    other, at = best_linear(records, told), list(found)
    near = np.all(other.rmse_unused[at] <= (1.0 + HEARD) * base.rmse_unused[at])
    return (other, told) if near else (base, options)


def lacking(
    records: Sequence[Record], o: Outcome, base: Baseline, order: int | None, options: Options, policy: Policy
) -> Contradiction | None:
    """What a linear model of a stated order lacks, whose input acts in its own sample or the next.

    Where the answer is the linear model and nothing bends what it leaves: a delay, if the stated order does as well as the best
    model with one; else an order more, else two: what needs still more is no such thing. With several inputs an order is each one's own affair.
    """
    i, search = o.index, _search(records, o.index, base, options)
    linear = o.ladder.chosen.kind is Kind.LINEAR and not o.bent and not o.share.feedback
    if order is None or not linear or search.inputs != 1:
        return None
    y = [np.nan_to_num(r.y[:, i]) for r in records]

    def form(n: int, nb: int, delay: int) -> Arx:
        return Arx(n, nb, (delay,), search.offset)

    def left(limit: tuple[float, float], *forms: Arx) -> float:
        """Share of the error on unused blocks by which the best linear model is better; 0 where that is within a limit."""
        trials = [search.tried(search.of_form(form, base.outputs[i].model)) for form in forms]
        known = [t for t in trials if t is not None and np.isfinite(t.rmse)]
        if not known:
            return 1.0
        best = min(known, key=lambda t: t.rmse).unused
        gain = paired_gain(y, best, o.ladder.linear.unused, o.ladder.counted, policy)
        return gain.share if gain.meets(limit) else 0.0

    share = left(policy.searched, form(order, order, 1), form(order, order + 1, 0))
    if share <= 0.0:
        return None
    late = {d for at in base.outputs[i].delays for d in range(at - EARLY, at + EARLY + 1)}.union(DELAYS)
    told = {
        "delay": ("the input acts later than in the next sample", [form(order, order + 1, d) for d in sorted(late) if d > 1]),
        "order_one": ("the linear part needs one more order", [form(order + 1, order + 1, 1)]),
        "order": ("the linear part needs a higher order", [form(order + 2, order + 2, 1)]),
    }  # fmt: skip
    less = f"the error on unused blocks is {share:.0%} less than with the order {order} that was stated"
    # what none of them explains was no linear part of so few poles, and is not named
    key = next((key for key, (_, forms) in told.items() if left(policy.claimed, *forms) <= 0.0), None)
    return None if key is None else Contradiction(key, f"{told[key][0]}: {less}", share)


SETTLES = "drift"
"""The effect that a level which settles goes by."""
SLOWER = 20
"""Samples that a level which settles takes at least: a quicker one is a start, which the first samples set."""


def settling(train: Record, o: Outcome, base: Baseline, policy: Policy) -> Contradiction | None:
    """A slow real pole of the linear model that no input drives: without it the inputs explain as much beside exp(-t/T), and not alone."""
    m, i, n = base.outputs[o.index], o.index, len(train)
    real = m.model.poles[(np.abs(m.model.poles.imag) < 1e-9) & (m.model.poles.real > 0.0)].real
    z = float(np.max(real, initial=0.0))
    if o.share.feedback or m.together is not None or not np.exp(-1.0 / SLOWER) < z < np.exp(-1.0 / n):
        return None
    y, use = train.y[:, i], base.blocks.counting([train])[0][:, i]
    quick = np.real(np.poly(np.delete(m.model.poles, np.argmin(np.abs(m.model.poles - z)))))
    u = train.u[:, list(m.inputs)]
    driven = [lfilter([1.0], quick, x - x[0]) for x in u.T]
    columns = [np.concatenate((np.zeros(k), x[: n - k])) for x in driven for k in range(m.model.num.shape[1])]

    def left(*more: Array) -> Array:
        X = np.column_stack((*columns, np.ones(n), *more))[use]
        return y[use] - X @ decomposed(X, y[use])

    beside, alone = left(z ** np.arange(n)), left()
    own = (y - base.y_model[0][:, i])[use]
    kept = float(np.sum(beside**2) / np.sum(alone**2))
    share, samples = 1.0 - float(np.sqrt(kept)), effective_samples(beside)
    p = float(chi2.sf(-samples * np.log(kept), 1))
    as_good = float(np.sum(beside**2)) <= (1.0 + WORSE) ** 2 * float(np.sum(own**2))
    if not (as_good and samples > INDEPENDENT and share > policy.searched[1] and p < MOVING):
        return None
    lasts = -train.dt / np.log(z)
    words = f"no input drives a level that settles in {lasts:.3g} s (its time constant): with it the error is {share:.0%} less"
    return Contradiction(SETTLES, words, share, p)
