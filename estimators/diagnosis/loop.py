"""A record's way through the diagnosis: each stage a pure function from frozen results to one frozen result.

Record -> the best linear model -> faults of the measurement and named causes -> what could be explained -> discovered terms ->
the ladder on unused blocks -> the remainder, and the ladder again -> the verdict. Two things are done again where they must be:
the linear model without samples that are faults, and the discovery beside a model that was found after it.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline import Baseline, Options, best_linear
from estimators.diagnosis.baseline.disturbances import set_aside
from estimators.diagnosis.baseline.search import LONG
from estimators.diagnosis.effects import Effect
from estimators.diagnosis.ladder.anew import begun_anew
from estimators.diagnosis.ladder.asked import begun, outside
from estimators.diagnosis.ladder.claims import ANYTHING, NOTHING_NEW, TOO_SLOW, Named
from estimators.diagnosis.ladder.held_out import HeldOut, assess, onward
from estimators.diagnosis.ladder.outcome import Outcome
from estimators.diagnosis.ladder.stated import Contradiction, lacking, linear_base, settling, starts_at_rest
from estimators.diagnosis.ladder.steps import (
    Kind,
    Ladder,
    Step,
    as_started,
    beyond_chance,
    climb,
    over_linear,
    paired_gain,
    refused,
)
from estimators.diagnosis.ladder.verdicts import verdict
from estimators.diagnosis.policy import Setting
from estimators.diagnosis.record.admission import together, told_from_clock
from estimators.diagnosis.record.measurement import lost_samples, observations, without_faults
from estimators.diagnosis.remainder import Limits, fit_remainder, linear_footing, spliced
from estimators.diagnosis.result.answers import LinearAnswer, RemainderAnswer, early
from estimators.diagnosis.result.model import diagnosed_model
from estimators.diagnosis.result.report import Diagnosis
from estimators.diagnosis.search.candidates import Menu
from estimators.diagnosis.search.discoveries import Discovered, discovered, nothing_left
from estimators.diagnosis.search.elsewhere import seen_elsewhere
from estimators.diagnosis.search.examination import PHYSICAL, Examined, Known, as_motion, examine
from estimators.diagnosis.search.few import best_named
from estimators.diagnosis.search.free_runs import denominator, largest_pole
from estimators.diagnosis.search.named import CLOCKED, Bench, linear_step, named_steps
from estimators.diagnosis.share import Share, explainable_share
from estimators.diagnosis.share.feedback import has_feedback, is_answer
from estimators.diagnosis.share.news import NEWS, Predictor
from oed.covariances import on_one_thread
from oed.data import Record
from oed.errors import InputError
from oed.files.objects import as_records

Array = NDArray[Any]
# of one output: what its samples show, what its trials share, the effects that hold
Parts = tuple[Examined, Bench, Named]


@on_one_thread
def diagnose(
    train: Any,
    test: Any = None,
    setting: Setting | None = None,
    *,
    effects: Iterable[Effect] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Find what a linear model of measured data lacks, add it, and measure the error before and after.

    Parameters
    ----------
    train : Record or DataFrame or Dataset or TimeResponseData or (u, y, dt), or a sequence of them
        Everything is chosen and fitted on these records, of one system: levels, days. Effects of the catalogue are
        looked for on the longest, and must hold on all.
    test : Record or the like, optional
        Held-out record on the same clock; without it the errors are those of blocked cross-validation: every
        block of the longest training record is simulated with parameters fitted to the other blocks.
    setting : Setting, optional
        What is known of the system.
    effects : iterable of Effect, optional
        What is looked for, `[*CATALOGUE, mine]` for one of your own; the catalogue without it.
    progress : callable, optional
        Told the name of each stage as it begins.

    Returns
    -------
    Diagnosis
        Causes, evidence, errors.

    Raises
    ------
    InputError
        If the records cannot be diagnosed: no excitation, different systems, test rows in the training record.

    Notes
    -----
    What a test record's outputs are is never used to fit anything. They can refuse a model or admit one, each of which is then said: an
    answer that is worse there than the linear model gives way to it, as its claims do; one that unused blocks put first without being
    sure of it is the answer where errors there are surely less. Its inputs and its clock decide whether the training data determine a
    model's run there; where not, the answer is the model below, which is said, unless its outputs surely bear it out. One that goes
    on, by its clock, where the training record ends starts from the state there.
    """
    test = None if test is None else as_records(test, missing=True)[0]
    setting = Setting() if setting is None else setting
    setting = setting if effects is None else replace(setting, effects=tuple(effects))
    records = together(train, test)
    if test is not None and not np.isfinite(test.y[setting.skip :]).any(axis=0).all():
        raise InputError(
            f"the test record has {len(test)} samples, of which the first {setting.skip} are left out (skip): no output is "
            "measured in the rest; leave out fewer."
        )
    first = records[0]
    test = replace(test, t0=first.t0) if test is not None and setting.separate else test
    say = progress if progress is not None else lambda stage: None
    say("the best linear model")
    asked = replace(_options(first, setting), asked=() if test is None else (test.u,))
    orders, rest = setting.orders or (None,) * first.n_outputs, bool(setting.deviations)
    moving, base, asked = linear_base(records, orders, asked)
    setting = replace(setting, deviations=asked.deviations)
    setting = replace(setting, effects=told_from_clock(setting.effects, records))
    say("effects of the catalogue")
    own = base if len(records) == 1 else best_linear([first], asked)
    blind = None if test is None else test.replace(y=np.full_like(test.y, np.nan))
    parts = [_named(first, i, own, setting, rest, i in asked.later, blind) for i in range(first.n_outputs)]
    also = seen_elsewhere(first, [p[1] for p in parts], [p[2] for p in parts], _options(first, setting))
    parts = [(found, bench, n) for (found, bench, _), n in zip(parts, also, strict=True)]
    say("terms of no catalogue")
    # what is no measurement is none to what looks at the record anew
    clean = [without_faults(first, [bench.kept for _, bench, _ in parts]), *records[1:]]
    plain = base if clean[0] is first else best_linear(clean, _options(first, setting))
    shares = [_shares(clean, i, plain, part[2].step) for i, part in enumerate(parts)]
    done = [nothing_left(*part, left) for part, (_, left) in zip(parts, shares, strict=True)]
    terms = discovered(clean, plain, setting, _options(first, setting), done)
    say("comparison on blocks not used")
    outcomes = [
        _outcome(records, i, base, plain, part, shares[i], terms[i], setting) for i, part in enumerate(parts)
    ]
    settled = [settling(first, o, base, setting.policy) for o in outcomes]
    outcomes = [o.by_the_clock(first) if c else o for o, c in zip(outcomes, settled, strict=True)]
    held = _held_out(first, test, outcomes, setting)
    outcomes = [o.standing(step) for o, step in zip(outcomes, held.answered, strict=True)]
    outcomes = [_outside_the_loop(o, test, held, setting) for o in outcomes]
    outcomes = [_bent_after_all(o, first, test, held, setting) for o in outcomes]
    lacks = [
        c or lacking(records, o, base, n, asked, setting.policy)
        for c, o, n in zip(settled, outcomes, orders, strict=True)
    ]
    stated = [(o, c) for found in (moving, lacks) for o, c in zip(outcomes, found, strict=True) if c]
    return _diagnosis(records, test, base, outcomes, held, setting, stated)


def _options(train: Record, setting: Setting) -> Options:
    diagonal = setting.structure == "diagonal" and train.n_inputs == train.n_outputs
    return Options(deviations=setting.deviations, diagonal=diagonal)


def _named(
    train: Record, i: int, base: Baseline, setting: Setting, rest: bool, heard: bool, wanted: Record | None
) -> Parts:
    """The named stage of one output: what its samples show, and the effects that hold; `rest` whether records are stated to start so,
    `heard` whether a model that acts at once heard the noise, `wanted` the record on which its run is."""
    order, delays = base.outputs[i].shared
    delay, left = min(delays), train.y[:, i] - base.y_model[0][:, i]
    echo = has_feedback([train], [left], [base.blocks.counting([train])[0][:, i]])
    ahead = delay == 0 and not setting.orders and not echo  # else the input holds the noise of its own sample
    m = base.outputs[i]  # approximated by a long numerator, its poles say nothing
    long = m.together is None and m.model.num.shape[1] >= LONG
    order, memory = PHYSICAL + 1 if long else order, base.blocks.memory(m.model.radius)
    known = Known(order, max(delay - 1, 0), set_aside(left, m.tones, train.dt), memory)
    record, inverse = early(train) if ahead else train, echo and (heard or delay == 0)
    rest = rest or (setting.deviations is None and starts_at_rest(train, i, base))

    def bench_of(found: Examined) -> Bench:
        return Bench(
            found.last, base, i, train, found.thin_of(found.attribution.final), rest, not setting.deviations,
            setting.policy, setting.alpha / train.n_outputs, Menu(setting.effects).family, ahead, echo and not inverse,
            inverse, setting.skip, wanted,
        )  # fmt: skip

    motion = as_motion(record, i, setting, known)
    if motion is not None:
        bench = bench_of(motion)
        named = named_steps(bench, motion.attribution)
        gain = None if named.step is None else bench.over(named.step.unused[0], bench.linear)
        if gain is not None and gain.meets((setting.policy.searched[0], MOST)):
            return motion, bench, named
    found = examine(record, i, setting, known)
    bench = bench_of(found)
    return found, bench, best_named(bench, found.attribution, Menu(setting.effects))


MOST = 0.5
"""Share of the linear model's error that dry friction alone must explain for nothing else to be looked for in the catalogue."""


def _shares(records: Sequence[Record], i: int, base: Baseline, step: Step | None) -> tuple[Share, Share]:
    """The explainable shares of what the linear model leaves of one output, and of what the named model leaves."""
    share = explainable_share(base, records, i)
    runs = None if step is None else _runs(step, records, i, base)
    return share, share if runs is None else explainable_share(replace(base, y_model=runs), records, i)


def _runs(step: Step, records: Sequence[Record], i: int, base: Baseline) -> tuple[Array, ...] | None:
    """Simulated outputs of all records, output i by a step; None where one explodes."""
    out = tuple(y.copy() for y in base.y_model)
    for y, record in zip(out, records, strict=True):
        y[:, i] = step.simulate(record, base.blocks.window)
    return out if all(np.all(np.isfinite(y)) for y in out) else None


def _outcome(
    records: Sequence[Record], i: int, base: Baseline, plain: Baseline, parts: Parts, shares: tuple[Share, Share], terms: Discovered,
    setting: Setting,
) -> Outcome:  # fmt: skip
    """The ladder of one output; `plain` the linear model without the samples that are no measurement."""
    found, bench, named = parts
    share, left = shares
    train, *others = records
    steps = [linear_step(base, i, bench.rest)]
    faulty = bool(np.any(np.isfinite(train.y[: len(bench.kept), i]) & ~bench.kept))
    if faulty:
        steps.append(linear_step(plain, i, bench.rest, tuple(sig.key for sig in found.signatures)))
    if named.step is not None:  # no parameter of it saw the other records
        unseen = [named.step.simulate(r, base.blocks.window) for r in others]
        # From sample to sample of the record as it is.
        radii = base.outputs[i].model.radius, largest_pole(denominator(named.fit)) ** (1.0 / bench.thin)
        slow = [base.blocks.slow(radius) for radius in radii] == [False, True]
        whole = replace(named.step, unused=(*named.step.unused, *unseen), slow=slow)
        steps.append(whole.heard(bench.inverse and bench.echoes(named.step.unused[0])))
        named = replace(named, step=steps[-1])
    if (step := terms.step()) is not None:
        steps.append(step.heard(bench.hears(step)))
    y = [np.nan_to_num(r.y[:, i]) for r in records]
    counted = [bench.counted, *(c[:, i] for c in base.blocks.counting(records)[1:])]
    started = as_started(steps, train, i, setting.skip)
    predictor = cache(lambda: Predictor.of(records, base.y_model, i, counted))
    told = cache(lambda: bench.tells(named.fit))
    news = lambda s: predictor().news(s.unused) > NEWS or (s.kind is Kind.NAMED and told())
    vague = not share.explainable and named.anything(setting.effects) and not told()
    sure = lambda s: s.nature in CLOCKED or beyond_chance(y, started[0].unused, s.unused, counted)
    holds = lambda s: sure(s) and (s.linear or (not (vague and s.kind is Kind.NAMED) and news(s)))
    steps = [replace(s, admitted=s.admitted and (s.kind is Kind.LINEAR or holds(s))) for s in started]
    if named.alike is not None and named.step is not None and not news(named.step):
        named = named.as_linear()
    fallen = [first for s, first in zip(steps, started, strict=True) if first.admitted > s.admitted]
    for s in (s for s in fallen if s.kind is Kind.NAMED):
        named = named.without_claims(ANYTHING if vague else NOTHING_NEW if sure(s) else TOO_SLOW)
    least = int(faulty)
    ladder = climb(y, steps, counted, setting.policy, least=least)
    if ladder.chosen.kind is Kind.DISCOVERED:
        without = refused(steps, Kind.DISCOVERED)
        other = climb(y, without, counted, setting.policy, least=least)
        gain = paired_gain(y, other.chosen.unused, ladder.chosen.unused, ladder.counted, setting.policy)
        if not gain.meets(setting.policy.unchecked) and not terms.confirmed(counted):
            steps, ladder = without, other

    def remainder(below: Ladder, above: Share) -> Step | None:
        step = _remainder_step(records, i, base, below, above, setting)
        return None if step is None or bench.echoes(step.unused[0]) else step

    above = share if ladder.chosen.kind is Kind.LINEAR else left
    spent = ladder.chosen.kind is Kind.NAMED and not left.explainable and bench.spent(named.fit)
    sought = terms.found.sought if above.explainable else above.predicted[1] > 0.0 and above.news > NEWS
    if sought and not spent and (rest := remainder(ladder, above)) is not None:
        gain = paired_gain(y, ladder.chosen.unused, rest.unused, ladder.counted, setting.policy)
        if above.explainable or gain.surely(setting.policy.searched):
            ladder = climb(y, [*steps, rest], counted, setting.policy, least=least)
    most = share.predicted[1] if share.explainable and not spent else 0.0
    ladder = over_linear(ladder, most, lambda linear: remainder(linear, share), y, setting.policy)
    # What the answer explains was no noise that an input answers.
    errors = [r.y[:, i] - ladder.chosen.simulate(r, base.blocks.window) for r in records]
    echo = bench.inverse and has_feedback(records, errors, counted)
    loop = echo and min(base.outputs[i].delays) > 0 and is_answer(records, errors, counted)
    inverse = echo and ladder.chosen.at_once(train, base.blocks.window)
    step = named.step if inverse else None
    apart = step is not None and not step.echo and not step.at_once(train, base.blocks.window)
    return Outcome(i, found, named, ladder, share, left, terms.found, inverse, loop, apart)


def _remainder_step(
    records: Sequence[Record], i: int, base: Baseline, ladder: Ladder, share: Share, setting: Setting
) -> Step | None:
    """What is still explainable above the ladder's answer, taken up where unused blocks admit it."""
    below = ladder.chosen
    if any(len(u) != len(r) for u, r in zip(below.unused, records, strict=True)):
        return None
    if below is ladder.linear:
        footing = linear_footing(base, records)
    else:
        final = _runs(below, records, i, base)
        if final is None:
            return None
        unused = [u.copy() for u in base.unused]
        for u, own in zip(unused, below.unused, strict=True):
            u[:, i] = own
        footing = spliced(final, unused, base.blocks)
    rest = fit_remainder(base, records, footing, i, limits=Limits.of(setting.effort), policy=setting.policy,
                         counts=list(ladder.counted), share=share)  # fmt: skip
    if not rest.admitted:
        return None
    others = tuple(LinearAnswer(k, m.inputs, m.model, m.prior) for k, m in enumerate(base.outputs))
    answer = RemainderAnswer(i, below.answer, others, rest)
    return Step(Kind.REMAINDER, ("fading memory",), rest.unused, answer, below.size + MEMBER * len(rest.members),
                sentences=(rest.why,), below=below, nature=share.nature)  # fmt: skip


MEMBER = 20
"""Parameters that a member of the remainder counts as in the noise floor: ridge regressions and networks are pulled to zero."""


def _held_out(train: Record, test: Record | None, outcomes: list[Outcome], setting: Setting) -> HeldOut:
    record = train if test is None else test
    counts, held = np.isfinite(record.y), np.zeros(record.y.shape, dtype=bool)
    for o in outcomes:
        if any(sig.key == "held" for sig in o.examined.signatures):
            y = np.nan_to_num(record.y[:, o.index])
            held[:, o.index] = lost_samples(record.u, y)
        if test is None:
            counts[:, o.index] &= o.ladder.counted[0] & ~held[:, o.index]
    if test is not None:
        counts[: setting.skip] = False
    floor = float(np.sqrt(np.mean([_floor(o, train) ** 2 for o in outcomes])))
    skip, ladders = setting.skip if test is not None else 0, [o.ladder for o in outcomes]
    on = partial(assess, skip=skip, floor=floor, counts=counts, held=held, policy=setting.policy)
    return begun_anew(lambda record: on(train, record, ladders), train, test, ladders)


def _judged(test: Record, i: int, setting: Setting) -> NDArray[np.bool_]:
    """(N,) samples of an output of a test record that count."""
    return np.isfinite(test.y[:, i]) & (np.arange(len(test)) >= setting.skip)


def _outside_the_loop(o: Outcome, test: Record | None, held: HeldOut, setting: Setting) -> Outcome:
    """Not taken for a controller's inverse where a test record bears its model and no input there knows of the noise."""
    if not o.inverse or o.ladder.chosen.echo or test is None or not held.bears:
        return o
    left = test.y[:, o.index] - held.after[:, o.index]
    echo = has_feedback([test], [left], [_judged(test, o.index, setting)])
    return o if echo else replace(o, inverse=False)


def _bent_after_all(
    o: Outcome, train: Record, test: Record | None, held: HeldOut, setting: Setting
) -> Outcome:
    """With the bent effect for which linear dynamics stood that fit the training record as well, where a test record tells the two
    models apart by what a search must gain: as an answer that it bears out, neither saw it."""
    n, i = o.named, o.index
    step = next((s for s in held.answered[i].chain if s.kind is Kind.NAMED), None)
    if test is None or step is None or n.alike is None or not n.bent:
        return o
    run = onward(train, test, setting.skip)
    counts = _judged(test, i, setting)
    gain = paired_gain(
        [np.nan_to_num(test.y[:, i])], [run(n.alike[1])], [run(step)], [counts], setting.policy
    )
    rivals = tuple(name for name in n.bent[0].rivals if name != n.alike[0].cause)
    bent = replace(n, claims=(replace(n.bent[0], rivals=rivals),))
    return replace(o, named=bent) if gain.meets(setting.policy.searched) else o


def _floor(o: Outcome, train: Record) -> float:
    """Standard deviation of what the answer leaves on the training record, its parameters counted."""
    step, use = o.ladder.chosen, o.ladder.counted[0]
    rest = (np.nan_to_num(train.y[:, o.index]) - step.simulate(train, 20))[use]
    return float(np.sqrt(np.sum(rest**2) / max(1, use.sum() - step.size)))


def _diagnosis(
    records: Sequence[Record], test: Record | None, base: Baseline, outcomes: list[Outcome], held: HeldOut, setting: Setting,
    stated: Sequence[tuple[Outcome, Contradiction]],
) -> Diagnosis:  # fmt: skip
    train = records[0]
    words = (
        "test record"
        if test is not None
        else f"held-out blocks of the record ({len(base.blocks.blocks)}-fold cross-validation of the parameters)"
    )
    notes = [*held.warnings, *base.warnings]
    if test is not None:
        notes += outside(records, test, setting.policy) + begun(test, held.after, setting.skip)
    floor = float(np.sqrt(np.mean([_floor(o, train) ** 2 for o in outcomes])))
    found: dict[str, Any] = verdict(outcomes, held, setting, train, stated)
    found["data"] += observations(records)
    return Diagnosis(
        rmse_before=held.rmse_before, rmse_after=held.rmse_after, pred_rmse_before=held.pred_before,
        pred_rmse_after=held.pred_after, difference=held.difference, noise_floor=floor, room=held.room,
        yhat_before=held.before, yhat_after=held.after, held_out=words,
        warnings=tuple(notes), model=diagnosed_model(records, held.answered, [o.ladder for o in outcomes]), linear=base.described, ladder=held.rungs,
        extra={"outputs": [o.examined for o in outcomes], "finals": [o.named.fit for o in outcomes], "train": train, "records": records,
               "test": train if test is None else test},
        **found,
    )  # fmt: skip
