"""Candidates compared by the error of their free run on blocks that they did not see."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.baseline.blocks import Blocks
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.baseline.regression import Arx
from oed.data import Record

Array = NDArray[Any]

BATCHES = 4
"""Parts of a block whose errors are one unit of a standard error: longer than what noise remembers, and enough of them."""
SLOW = 1.4
"""By so much a pole that remembers longer than a block must lower the error: of such a pole the record shows one response
only, which blocks share, and a trend or a disturbance that came once looks the same; by its square one that outlives the record,
of whose return nothing is seen."""
STEP = 100
"""Samples of the answer to a step by which models that were fitted without one block or another are compared: the poles that a
record may not show are those that are quick beside it."""
NOTHING = 0.005
"""Share of the least error that is no reason for a larger model, however sure it is."""
OPEN = 1.0
"""Variance of a run on the inputs asked for, of the error seen on unused blocks, from which on it tells models apart: five blocks
know a variance to a half, and what is left out for less of it was mostly right."""
ABSURD = 9.0
"""Of the output's variance, the mean square error from which on a run from the inputs alone follows nothing: a level or a slow state that
is not known costs less, over the whole record."""
WORSE = 0.02
"""A simpler model may cost at most so much of the least error, however uncertain that is, and so much again for each further halving of
the parameters: what many of them gain on the blocks of one day they lose on the next."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A model of one output: its kind, its orders in words, its number of parameters, its fit without each block.

    `models` has one model per block, fitted to the others, and the model of all blocks last.
    """

    kind: str
    orders: str
    size: int
    models: list[LinearModel]
    form: Arx
    noise: float = 0.0  # variance of its error where that is known: so far the window's samples may be off


def undoubted(_: "Trial") -> tuple[float, float]:
    """No variance that the records leave open."""
    return 0.0, 0.0


@dataclass(frozen=True, eq=False)
class Trial:
    """A candidate with its free runs on unused blocks, per record (N,), and the mean squares of their batches."""

    candidate: Candidate
    unused: list[Array]
    squares: Array
    slow: bool
    endless: bool  # whether a pole outlives the record
    # what `tried` works out only for a trial that may be chosen, the variance of the model's answer to a step, as far as it
    # depends on the block left out; and that of its runs on the inputs on which it is wanted, above that of its runs on the records, and
    # of a state that a slow pole keeps, as far as a window of samples leaves it open
    doubts: "Callable[[Trial], tuple[float, float]]" = undoubted

    @cached_property
    def rmse(self) -> float:
        """Root mean square error on unused blocks; infinite where one of the fits has no bounded free run."""
        return float(np.sqrt(np.mean(self.squares)))

    @cached_property
    def shown(self) -> Array:
        """The mean squares with the charge for a pole slower than a block."""
        return self.squares * SLOW ** (2 * (self.slow + self.endless))

    @cached_property
    def charged(self) -> Array:
        """What is shown, with the charges for what the records do not determine."""
        spread, beyond = self.doubts(self)
        unsure = min(spread / max(float(self.squares.mean()), 1e-300), 1.0)
        return self.shown * (1.0 + ((1.0 + WORSE) ** 2 - 1.0) * unsure) + beyond


def tried(
    candidate: Candidate, records: Sequence[Record], output: int, blocks: Blocks, prior: Prior,
    asked: Sequence[Array] = (), limit: float = 1.0,
) -> Trial | None:  # fmt: skip
    """A candidate's free run on each block by the fit to the others; None where one has a pole beyond a limit, or rings for ever.

    The run begins where the record begins, as on a test record: a state set just before each block would let a slow
    pole that no input drives stand for a level or a drift.
    """
    longest = max(blocks.lengths)
    if not all(model.within(limit) for model in candidate.models) or _rings(candidate.models[-1], longest):
        return None
    unused = [np.full(n, np.nan) for n in blocks.lengths]
    prior = replace(prior, noise=max(prior.noise, candidate.noise))
    for block, model in zip(blocks.blocks, candidate.models, strict=False):
        record = records[block.record]
        run = model.free_run(prior, record.u[: block.stop], record.y[: block.stop, output], blocks.window)
        unused[block.record][block.rows] = run[block.rows]
    squares = batch_squares(unused, records, output, blocks)
    slow, endless = (kind(candidate.models[-1].radius) for kind in (blocks.slow, blocks.endless))
    return Trial(
        candidate, unused, squares, slow, endless,
        lambda trial: (
            undetermined(candidate.models[:-1], records),
            _left_open(trial, records, blocks, prior, asked) + _started(trial, records, output, prior),
        ),
    )  # fmt: skip


def _left_open(
    trial: Trial, records: Sequence[Record], blocks: Blocks, prior: Prior, asked: Sequence[Array]
) -> float:
    """Variance of the runs on the inputs asked for that the records do not show; none below the error on unused blocks."""
    if not asked:
        return 0.0
    models, last = trial.candidate.models, trial.candidate.models[-1]
    error, seen, state = float(trial.squares.mean()), [r.u for r in records], 0.0
    if trial.slow and np.isfinite(error):
        state = float(np.mean([last.unset(prior, error, len(u), blocks.window) for u in asked]))
    runs = run_spread(models, asked, prior, blocks.window)
    if np.isfinite(error) and not runs + state > OPEN * error:
        runs = max(runs, error * unseen(last, asked, seen))
    if not runs + state > OPEN * error:
        return 0.0
    beyond = max(0.0, runs - run_spread(models, seen, prior, blocks.window)) + state
    return beyond if beyond > OPEN * error else 0.0


def _started(trial: Trial, records: Sequence[Record], output: int, prior: Prior) -> float:
    """Mean square error of the runs of the records from the inputs' first samples alone, where that is no run at all; else none.

    Unused blocks follow inputs that go on: gains of a million at frequencies that these do not have cancel there, and show where a
    record begins with a jump. Of an unstable model no run follows from the inputs alone.
    """
    model, squares, power = trial.candidate.models[-1], [], []
    if model.radius > 1.0:
        return 0.0
    for r in records:
        y = r.y[:, output]
        run = model.free_run(prior, r.u, np.full(len(y), np.nan), 0)
        squares.append((y - run)[np.isfinite(y)] ** 2)
        power.append((y - np.nanmean(y))[np.isfinite(y)] ** 2)
    error = float(np.concatenate(squares).mean())
    return error if not error < ABSURD * float(np.concatenate(power).mean()) else 0.0


def _rings(model: LinearModel, length: int) -> bool:
    """Whether a pair of poles rings through all of a record: what no input need drive is a disturbance."""
    ringing = np.abs(model.poles.imag) > 0.0
    return bool(np.any(np.abs(model.poles[ringing]) > np.exp(-1.0 / length)))


def undetermined(models: Sequence[LinearModel], records: Sequence[Record]) -> float:
    """Variance of the answer to steps of the inputs' standard deviations, by the jackknife over the blocks left out.

    Unused blocks have the spectrum of the others: a pole where the input has no power costs nothing there, and may double the
    error on a record whose input is steps where this one's is ramps. Such a model must be better by what a simpler may cost.
    """
    sizes = np.std(np.concatenate([r.u for r in records]), axis=0)
    step = np.ones(STEP)
    answers = np.array(
        [[size * lfilter(b, m.den, step) for size, b in zip(sizes, m.num, strict=True)] for m in models]
    )
    return float(np.sum(jackknife(answers).mean(axis=-1)))


def run_spread(models: Sequence[LinearModel], inputs: Sequence[Array], prior: Prior, window: int) -> float:
    """Mean variance of the runs of the models without one block or another on inputs (N, nu), by the jackknife.

    All start from the first samples of the run of the last model, of all blocks, as a test record's first samples would
    set them. Unused blocks have the frequencies and levels of the others: they say nothing of a run on inputs that have others.
    """
    *folds, last = models
    found = []
    for u in map(np.nan_to_num, inputs):
        y = last.free_run(prior, u, np.full(len(u), np.nan), 0)
        found.append(jackknife(np.array([m.free_run(prior, u, y, window) for m in folds])).mean())
    return float(np.mean(found))


def unseen(model: LinearModel, inputs: Sequence[Array], seen: Sequence[Array]) -> float:
    """Mean variance of the model's runs on inputs (N, nu), in that of white noise on its runs on those seen by its fit.

    Fits without one block or another end in the same valley, where the records leave a direction of the parameters open; the
    curvature of the error tells of it.
    """
    level = np.concatenate(list(seen)).mean(axis=0)
    shown = np.concatenate([_sensitivities(model, u - level) for u in seen])
    wanted = np.concatenate([_sensitivities(model, u - level) for u in inputs])
    size = np.linalg.norm(shown, axis=0) + 1e-300
    _, values, rows = np.linalg.svd(shown / size, full_matrices=False)
    known = np.maximum(values, UNKNOWN * values[:1])
    return float(np.sum(((wanted / size) @ rows.T / known) ** 2)) / len(wanted)


UNKNOWN = 1e-6
"""Share of the largest singular value, below which a direction of the parameters has left no trace: its derivatives are rounding."""


def _sensitivities(model: LinearModel, drive: Array) -> Array:
    """Derivatives (N, parameters) of a model's run on inputs (N, nu) from rest."""
    drive = np.nan_to_num(drive)
    behind = lambda x: np.asarray(lfilter(np.ones(1), model.den, x))
    entered = [np.asarray(lfilter(b, np.ones(1), x)) for b, x in zip(model.num, drive.T, strict=True)]
    own = -behind(behind(np.sum(entered, axis=0)))
    sources = [(own, k) for k in range(1, len(model.den))]
    sources += [
        (x, k) for b, x in zip(model.num, map(behind, drive.T), strict=True) for k in np.flatnonzero(b)
    ]
    out = np.zeros((len(drive), len(sources)))
    for column, (x, k) in zip(out.T, sources, strict=True):
        column[k:] = x[: len(x) - k]
    return out


def jackknife(estimates: Array) -> Array:
    """Variance of what was estimated without each block in turn, (blocks, ...)."""
    k = len(estimates)
    return (k - 1) / k * np.sum((estimates - estimates.mean(axis=0)) ** 2, axis=0)


def batch_squares(unused: Sequence[Array], records: Sequence[Record], output: int, blocks: Blocks) -> Array:
    """Mean squares of measured minus simulated output over each batch of each block that has a sample."""
    out = []
    for record, run, (*starts, stop) in zip(records, unused, _edges(blocks), strict=True):
        y = record.y[:stop, output]
        seen = np.isfinite(y)
        e = np.where(seen, y - run[:stop], 0.0)
        count = np.add.reduceat(seen, starts, dtype=float)
        out.append(np.add.reduceat(e * e, starts)[count > 0.0] / count[count > 0.0])
    return np.concatenate(out)


@lru_cache(maxsize=8)
def _edges(blocks: Blocks) -> tuple[tuple[int, ...], ...]:
    """Where the batches of each record begin, one after the other, and where the last ends."""
    batches = [[b for b in blocks.batches(BATCHES) if b.record == k] for k in range(len(blocks.lengths))]
    return tuple((*(b.start for b in of), of[-1].stop) for of in batches)


def cheapest(trials: Iterable[Trial]) -> Trial:
    """The trial of the least charged error; what each shows bounds it from below, so that few charges are worked out."""
    first, *others = sorted(trials, key=lambda t: float(t.shown.mean()))
    for t in others:
        if not t.shown.mean() < first.charged.mean():
            break
        first = t if t.charged.mean() < first.charged.mean() else first
    return first


def simplest(trials: Iterable[Trial]) -> Trial:
    """The trial with fewest parameters whose error is the least within one standard error of their difference."""
    known = [t for t in trials if np.isfinite(t.rmse)]
    best = cheapest(known)

    def as_good(t: Trial) -> bool:
        halvings = max(1.0, float(np.log2(best.candidate.size / t.candidate.size)))
        few, most = (((1.0 + x) ** 2 - 1.0) * best.charged.mean() for x in (NOTHING, WORSE * halvings))
        if (t.shown - best.charged).mean() > most:
            return False
        d = t.charged - best.charged
        error = d.std() / np.sqrt(max(len(d) - 1, 1))
        return d.mean() <= min(max(error, few), most)

    return min((t for t in known if as_good(t)), key=lambda t: (t.candidate.size, t.rmse))
