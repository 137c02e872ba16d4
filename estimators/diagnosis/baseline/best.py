"""From records to the Baseline: tones first, then the choice, then what is said of it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline.baseline import Baseline, Options, OutputModel
from estimators.diagnosis.baseline.blocks import Block, Blocks, blocks_of
from estimators.diagnosis.baseline.choice import SLOW, Trial, batch_squares, cheapest, simplest, tried
from estimators.diagnosis.baseline.disturbances import foretold, noise_model, recurring, tones, waves
from estimators.diagnosis.baseline.linear_model import Prior, rest_level, unmoved
from estimators.diagnosis.baseline.search import LONG as TAPS
from estimators.diagnosis.baseline.search import LOW, ORDERS, REFINED, Search
from estimators.residual.algebra import delayed
from oed.data import Record
from oed.errors import InputError

Array = NDArray[Any]

QUIET = 1e-4
"""Noise of a window's samples, of the output's variance, while nothing is known of it: a state that is too free costs less
than one that is held."""
LONG = 8000
"""Samples from which on the model is chosen on pieces of every block, and only fitted to all of them."""
FURTHER = 0.02
"""Of the error on unused blocks, what a patient search must gain: less is no other model. Where the usual one asks for the most poles
there are, which stand for any that it missed, fewer need gain nothing."""
LITTLE, SURELY, GROWTH = 0.5, 0.5, 1e3
"""Error of stable models, of the output's standard deviation, from which on an unstable one is tried, as where one of their poles
remembers longer than a block; of theirs, what it may leave, as its pole may also follow a drift; and by how much it may grow over
a record: a free run shows no more of what starts it."""
LAGS = 64
"""Lags of the output's covariance, and of the inputs' changes, that a prior holds: above every order."""


def best_linear(records: Sequence[Record], options: Options | None = None) -> Baseline:
    """The linear model of each output with the least free-run error on unused blocks, and the simplest within
    its error.
    """
    options = Options() if options is None else options
    if not records:
        raise InputError("there is no training record; give at least one.")
    blocks = blocks_of(records, options.blocks, 0 if options.deviations else options.window, options.guard)
    found = [_output(records, i, blocks, options) for i in range(records[0].n_outputs)]
    outputs = tuple(m for m, *_ in found)
    blocks = replace(blocks, once=max(once for *_, once in found))
    unused = tuple(np.stack([t.unused[r] for _, t, _ in found], axis=1) for r in range(len(records)))
    squares = [batch_squares(t.unused, records, i, blocks) for i, (_, t, _) in enumerate(found)]
    rmse = np.array([np.sqrt(s.mean()) for s in squares])
    se = np.array(
        [s.std(ddof=1) / np.sqrt(len(s)) / (2.0 * max(r, 1e-300)) for s, r in zip(squares, rmse, strict=True)]
    )
    base = Baseline(outputs, blocks, (), unused, rmse, se, records[0].dt)
    base = replace(
        base, y_model=tuple(base.simulate(record, base.opening(len(record))) for record in records)
    )
    return replace(base, outputs=tuple(_with_noise(m, i, base, records) for i, m in enumerate(outputs)))


def _with_noise(m: OutputModel, i: int, base: Baseline, records: Sequence[Record]) -> OutputModel:
    """The model with the one-step model of what its free run leaves, and the warnings that its errors call for."""
    counts = base.blocks.counting(records)
    rest = [
        np.where(c[:, i], r.y[:, i] - y[:, i], np.nan)
        for r, y, c in zip(records, base.y_model, counts, strict=True)
    ]
    noise, deviation = noise_model([e - np.nanmean(e) for e in rest])
    y = np.concatenate([r.y[c[:, i], i] for r, c in zip(records, counts, strict=True)])
    constant, name, warnings = float(np.std(y)), records[0].output_names[i], []
    if base.rmse_unused[i] >= constant:
        warnings.append(
            f"{name}: no linear model predicts unused blocks better than the record's mean "
            f"(error {base.rmse_unused[i]:.4g}, standard deviation {constant:.4g})."
        )
    if m.ill_posed(base.blocks):
        k = base.blocks.guard
        near = [base.k_step(r, k)[:, i] - r.y[:, i] for r in records]
        error = float(np.sqrt(np.nanmean(np.concatenate(near) ** 2)))
        inside = 1.0 - m.model.radius
        keeps = (
            f"remembers the initial state for {1.0 / max(inside, 1e-12):.3g} samples"
            if inside >= 0.0
            else f"is unstable: an error of the initial state grows e-fold in {-1.0 / inside:.3g} samples"
        )
        warnings.append(
            f"{name}: the free run is ill-posed: a pole at radius {m.model.radius:.5g} {keeps}; {k} samples ahead the error is {error:.4g}."
        )
    return replace(m, noise=noise, noise_std=deviation, warnings=tuple(warnings))


def own_inputs(records: Sequence[Record], i: int, options: Options) -> tuple[list[Record], tuple[int, ...]]:
    """The records with the inputs alone that drive an output, and which those are."""
    inputs = (i,) if options.diagonal else tuple(range(records[0].n_inputs))
    return [r.replace(u=r.u[:, list(inputs)], input_names=(), input_units=()) for r in records], inputs


def _output(
    records: Sequence[Record], i: int, blocks: Blocks, options: Options
) -> tuple[OutputModel, Trial, int]:
    """The model of an output, its trial, and the first samples that do not count."""
    own, inputs = own_inputs(records, i, options)
    prior = prior_of(own, i, options)
    asked = tuple(u[:, list(inputs)] for u in options.asked)
    later = i in options.later
    search = Search(own, i, blocks, prior, not options.deviations, asked, options.moving, later=later)
    parts, places = _pieces(own, blocks)
    screen = search if parts is own else replace(search, records=parts, blocks=places)
    screen, known, lines = _screened(screen)
    if lines and parts is own:
        own = list(screen.records)
    if not known:
        raise InputError(
            f"no stable linear model follows {records[0].output_names[i]}; give a record whose inputs move it."
        )
    if parts is own:
        screen, known = _after_start(screen, known)
    trials = known + screen.refined(known)
    chosen = simplest(trials)
    further = known + replace(screen, patient=True).refined(known)
    last = simplest(further)
    needed = 0.0 if last.candidate.form.na < chosen.candidate.form.na == max(REFINED) else FURTHER
    if last.rmse < (1.0 - needed) * chosen.rmse:
        trials, chosen = further, last
    if chosen.slow or chosen.rmse > LITTLE * np.sqrt(prior.covariance[0]):
        # over the whole records, where the screen sees pieces of them
        free = replace(screen, limit=GROWTH ** (1.0 / max(blocks.lengths)))
        chosen = _held_by_a_loop(free, known, chosen)
        if chosen.candidate.models[-1].radius > 1.0:
            search = replace(search, limit=free.limit)
    if places is not blocks:
        chosen = search.again(chosen.candidate)
    c = chosen.candidate
    why = [
        f"{records[0].output_names[i]}: {c.kind} with {c.orders}: the simplest of {len(trials)} stable models within one "
        f"standard error of the least free-run error on {len(blocks.blocks)} unused blocks ({chosen.rmse:.4g})."
    ]
    if lines:
        listed = ", ".join(f"{w / (2 * np.pi * records[0].dt):.4g} Hz" for w in lines)
        why.append(f"Tones that no input drives were set aside before the order was chosen: {listed}.")
    joint = [t for t in trials if not len(t.candidate.models[-1].moved)] if len(c.models[-1].moved) else []
    shared = simplest(joint).candidate if joint else None
    noise = QUIET * prior.covariance[0] if chosen.slow else chosen.rmse**2
    prior = replace(prior, noise=chosen.rmse**2).of(c.models[-1], own[0].u, own[0].y[:, i], search.moving)
    last = c.models[-1].beginning(prior, own[0].u, own[0].y[:, i])
    prior = replace(prior, noise=noise)
    model = OutputModel(inputs, c.kind, c.orders, c.form.delay, last, prior, np.ones(1),
                        chosen.rmse, tuple(why), tuple(c.models[:-1]), tuple(w / (2 * np.pi * records[0].dt) for w in lines),
                        together=None if shared is None else (shared.form.na, shared.form.delay))  # fmt: skip
    return model, chosen, screen.blocks.once


def _after_start(search: Search, known: list[Trial]) -> tuple[Search, list[Trial]]:
    """The search, and the models known, judged without what answers a start to which no input brings the system.

    Only the first block has it: its error there, by poles fitted to the others, is no measure of a model fitted to all.
    """
    first, record = simplest(known), search.records[0]
    model = first.candidate.models[-1]
    if not (off := model.astray(record.u, record.y[:, search.output])) > first.rmse:
        return search, known
    once = min(int(np.log(first.rmse / off) / np.log(model.radius)), len(record) // 2)
    search = replace(search, blocks=replace(search.blocks, once=once))
    return search, [
        replace(t, squares=batch_squares(t.unused, search.records, search.output, search.blocks))
        for t in known
    ]


def _held_by_a_loop(free: Search, known: list[Trial], chosen: Trial) -> Trial:
    """The best model with an unstable pole, as a plant in a loop may have, where that surely foretells more than a stable one."""
    if not (grown := free.arx()):
        return chosen
    best = simplest(grown + free.refined(known + grown))
    return best if best.rmse < SURELY * chosen.rmse else chosen


def _screened(search: Search) -> tuple[Search, list[Trial], list[float]]:
    """The search on records without tones that no input drives, its ARX, and the tones' angular frequencies.

    They are looked for in what a low-order model leaves, then again without those found, for a model that was not fitted
    to them; and set aside where that foretells unused blocks better than the best model of the records as they are.
    """
    known, lines, now = search.arx(), [], search
    for most in (LOW, max(ORDERS)):
        low = [t for t in known if t.candidate.form.na <= most]
        found, clean = _without_tones(search, simplest(low)) if low else ([], search.records)
        quiet = (without := replace(search, records=clean)).arx() if found else []
        if not _least(quiet) < _least(known) or _resonates(search, known, without, quiet):
            break
        lines, now, known = found, without, quiet
    if len(search.blocks.blocks) == len(search.records):
        return now, known, lines  # a block is all of its record: nothing beside it shows a trend
    # A slow pole follows a trend as it follows the input: a model that has none foretells unused blocks.
    # What needs many coefficients beside a trend has a pole that makes it.
    straight = replace(search, records=_without_trends(search, []))
    straight = replace(search, records=_without_trends(search, straight.arx(few=True)))
    level = [t for t in straight.arx(few=True) if not t.slow]
    return (straight, straight.arx(), []) if _least(level) * SLOW**2 < _least(known) else (now, known, lines)


def _resonates(search: Search, known: list[Trial], without: Search, quiet: list[Trial]) -> bool:
    """Whether the records as they are have a model as good as the records without tones: a resonance that the input drives is none.

    In noise, ARX of ten lags knows little of light modes; what is refined does. No sample sets the state here, unless the records
    are known to begin in one: a pole that rings from the start on is no resonance.
    """
    started = search.blocks if search.moving else replace(search.blocks, window=0)
    found = (
        tried(t.candidate, search.records, search.output, started, search.prior)
        for t in search.refined(known)
    )
    own = _least([t for t in found if t is not None])
    return own <= _least(quiet) and own <= _least(without.refined(quiet))


def _without_trends(search: Search, known: Sequence[Trial]) -> list[Record]:
    """The records less a straight line each, in every block that of the other blocks: beside a long numerator, or the best known."""
    clean, i = [], search.output
    model = simplest(known).candidate.models[-1] if known else None
    for k, r in enumerate(search.records):
        run = 0.0 if model is None else model.free_run(search.prior, r.u, r.y[:, i], 0)
        t = np.linspace(-1.0, 1.0, len(r))
        lags = [delayed(u[:, None], range(TAPS)) for u in r.u.T] if model is None else []
        W, e, y = np.column_stack((t, np.ones(len(r)), *lags)), r.y[:, i] - run, r.y.copy()
        e[:TAPS] = np.nan
        for b in search.blocks.blocks:
            if b.record == k and b.stop - b.start < len(r):
                y[b.rows, i] -= foretold(e, W, slice(0, 1), b.rows)
        clean.append(r.replace(y=y))
    return clean


def _least(trials: Sequence[Trial]) -> float:
    return float(cheapest(trials).charged.mean()) if trials else np.inf


def _without_tones(search: Search, trial: Trial) -> tuple[list[float], Sequence[Record]]:
    """Angular frequencies of the tones in the residual of a model, and the records without them.

    In each block the tones, and the level that what is no sine has, are those of the other blocks, so that an error on unused blocks
    counts how far they foretell.
    """
    records, i, model = search.records, search.output, trial.candidate.models[-1]
    slowest = 2.0 * np.pi / min(b.stop - b.start for b in search.blocks.blocks)  # slower ones are slow noise
    lines, clean = [], []
    for k, r in enumerate(records):
        run = model.free_run(search.prior, r.u, r.y[:, i], 0)
        own = [b.rows for b in search.blocks.blocks if b.record == k]
        found = tones(r.y[:, i], run, r.u) or (recurring(r.y[:, i] - run, own) if len(own) > 2 else [])
        y, found = r.y.copy(), [w for w in found if w > slowest]
        for b in search.blocks.blocks:
            if found and b.record == k:
                y[b.rows, i] -= foretold(r.y[:, i] - run, waves(found, len(r)), slice(0, None), b.rows)
        clean.append(r.replace(y=y) if found else r)
        lines += found
    return sorted(set(lines)), clean if lines else records


def _pieces(records: list[Record], blocks: Blocks) -> tuple[list[Record], Blocks]:
    """The records, or of long ones the middle of every block as a record of its own, and their blocks."""
    total = sum(blocks.lengths)
    if total <= LONG:
        return records, blocks
    parts = []
    for b in blocks.blocks:
        size = int((b.stop - b.start) * LONG / total)
        first = (b.start + b.stop - size) // 2
        parts.append(records[b.record][first : first + size])
    lengths = tuple(map(len, parts))
    return parts, Blocks(lengths, blocks.window, 0, tuple(Block(k, 0, n) for k, n in enumerate(lengths)))


def prior_of(records: Sequence[Record], i: int, options: Options) -> Prior:
    """What the records of an output say of it before they begin."""
    y = np.concatenate([r.y[:, i] for r in records])
    mean = float(np.nanmean(y))
    d = np.nan_to_num(y - mean)
    covariance = np.array([d[: max(len(d) - k, 0)] @ d[k:] for k in range(LAGS)]) / len(d)
    level, held = rest_level(records[0].u, records[0].y[:, i], covariance[0]), records[0].u[0]
    first = unmoved(records[0].u, records[0].y[:, i])
    start = float(first.mean()) if len(first) else np.nan
    at_rest = bool(options.deviations)
    turned = (
        np.empty((0, 0))
        if at_rest
        else np.array([_turned([r.u[:, j] for r in records]) for j in range(len(held))])
    )
    return Prior(mean, covariance, QUIET * covariance[0], at_rest, level, held, start, turned=turned)


def _turned(inputs: Sequence[Array]) -> Array:
    """Half the mean square change of an input within 0 to LAGS - 1 samples."""
    out = np.zeros(LAGS)
    for k in range(1, LAGS):
        changes = np.concatenate([u[k:] - u[:-k] for u in inputs])
        changes = changes[np.isfinite(changes)]
        out[k] = 0.5 * np.mean(changes**2) if len(changes) else out[k - 1]
    return out
