"""Discovery: terms that the linear model lacks, without a catalogue, vouched for by blocks that were not used."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline import Baseline
from estimators.diagnosis.discovery.fitting import Fitted, Piece, fit, forgets, run_piece
from estimators.diagnosis.discovery.form import Assembly
from estimators.diagnosis.discovery.found import FoundTerm, leading_nature, strongest_first
from estimators.diagnosis.discovery.model import DiscoveredModel
from estimators.diagnosis.discovery.search import Budget, acting, bends, complexity, greedy_search
from estimators.diagnosis.discovery.starts import Scales, pieces_of, scales_of
from estimators.diagnosis.discovery.uncertainty import beyond_linear, covariance, pruned
from estimators.diagnosis.discovery.validation import ahead, free_run, start_prior, unused, without_each
from estimators.diagnosis.share.feedback import in_loop
from oed.data import Record

Array = NDArray[Any]
BUDGETS = {
    "quick": Budget(orders=(1, 2, 3), width=4, terms=3, rounds=8),
    "normal": Budget(),
    "thorough": Budget(width=14, beam=2, terms=6, rounds=25),
}
ADMITTED = 1.0  # standard errors by which unused blocks must get better than with the best linear model: the usual rule
LEAST = 0.02  # share of the error below which what was found is as good as nothing, among so many candidates
HALF = 0.5  # of the baseline's error on unused blocks, up to which a model is one whose state no window shows, and not one that cannot start
SEARCHED = 2000  # samples on which terms are looked for; what is found is fitted to all and judged on all
ALIKE = 1.5  # times the answer's error on unused blocks, up to which another model is asked what it makes of a record
BATCHES = 4  # parts of every block: the units of the standard error of a difference


@dataclass(frozen=True, eq=False)
class Discovery:
    """What was found, or that nothing was.

    `model` none where no model with terms is better on unused blocks than the linear one by more than the
    error; `terms` the strongest first; `equation, nature` in the user's units; of most of the terms' weight;
    `unused` per record (N, ny): every block predicted by the same form fitted to the others; `rmse_unused`
    (ny,) on the samples that count; `gain` by how many standard errors the blocks got better than the
    baseline's; `considered` the models that were compared and their errors on unused blocks over the
    baseline's, simplest first; `sought` false where what is left is noise, so that no search was made; `folds` the
    model fitted without each block; `rivals` models with other terms that do nearly as well.
    """

    model: DiscoveredModel | None
    terms: tuple[FoundTerm, ...] = ()
    equation: str = ""
    nature: str = "none"
    unused: tuple[Array, ...] = ()
    rmse_unused: Array = field(default_factory=lambda: np.zeros(0))
    gain: float = 0.0
    considered: tuple[tuple[str, float], ...] = ()
    sought: bool = True
    folds: tuple[DiscoveredModel, ...] = ()
    rivals: tuple[DiscoveredModel, ...] = ()

    @property
    def found(self) -> bool:
        """Whether there is a model with terms."""
        return self.model is not None


def discover(
    records: Sequence[Record], baseline: Baseline, budget: str | Budget = "normal", skip: int | None = None
) -> Discovery:
    """Terms that the linear model lacks, as an equation; nothing where unused blocks do not vouch for it.

    `skip` first samples of a new record that may set its state; None: as many as a block's window.
    """
    budget = BUDGETS[budget] if isinstance(budget, str) else budget
    several = [m.shared[1] for m in baseline.outputs]
    if not _same_inputs(baseline, records[0]):
        several = [np.zeros(records[0].n_inputs, int)]
    delays = np.minimum(np.max(several, axis=0) - 1, np.min(several, axis=0))
    closed = any(in_loop(records, baseline, i) for i in range(len(baseline.outputs)))
    budget = replace(budget, late=_late_inputs(baseline, records[0]), closed=closed)
    scales = scales_of(records, baseline.y_model, np.maximum(delays, 0).astype(int))
    pieces = pieces_of(records, [np.ones(r.y.shape, bool) for r in records], scales)
    smooth = [(y - scales.y) / scales.sy for y in baseline.y_model]
    judge = _Judge(records, baseline, scales, pieces, skip)
    own = tuple(m.shared[0] for m in baseline.outputs)
    most = max(SEARCHED // len(pieces), 1)
    short = [Piece(q.d[:most], q.y[:most], q.weight[:most]) for q in pieces]
    front = _front(greedy_search(short, scales, [y[:most] for y in smooth], scales.zeros, budget, own))
    again = (fit(f.form, f.theta, f.starts, pieces, iterations=budget.rounds) for f in front)
    front = [f for f in again if f is not None and forgets(f, pieces) and bends(f, pieces, 0)]
    whole, alike, gain, considered = _chosen(_pruned(front, pieces, budget.rounds), judge)
    # what a window says nothing of, as a store that is half full, is carried on from the record's start
    predictions = None if whole is None else judge.unused(whole, carried=not judge.starts(whole))
    if whole is None or predictions is None:
        return Discovery(None, considered=considered, gain=gain)
    model = _model(whole, records, pieces, scales)
    terms = strongest_first(model.found(), beyond_linear(whole, pieces))
    return Discovery(
        model,
        tuple(terms),
        model.equation(terms),
        leading_nature(terms),
        tuple(predictions),
        judge.rmse(predictions),
        gain,
        considered,
        folds=tuple(replace(model, theta=f.theta) for f in judge.folds(whole) or ()),
        rivals=tuple(replace(model, form=f.form, theta=f.theta, prior=start_prior(f, pieces)) for f in alike),
    )


def _late_inputs(baseline: Baseline, record: Record) -> tuple[tuple[str, ...], ...]:
    """Per output, inputs that act on it in a later sample only; of one that its linear model leaves out, what others say."""
    acts = [dict(zip(m.inputs, m.delays, strict=True)) for m in baseline.outputs]
    least = [min((own[j] for own in acts if j in own), default=1) for j in range(record.n_inputs)]
    return tuple(tuple(f"u{j}" for j in range(record.n_inputs) if own.get(j, least[j]) > 0) for own in acts)


def _same_inputs(baseline: Baseline, record: Record) -> bool:
    return all(len(m.delays) == record.n_inputs for m in baseline.outputs)


class _Judge:
    """Squared errors where parameters did not see the data, by batch, in units of each output's spread."""

    def __init__(
        self,
        records: Sequence[Record],
        baseline: Baseline,
        scales: Scales,
        pieces: Sequence[Piece],
        skip: int | None,
    ):
        self.records, self.baseline, self.scales, self.pieces = records, baseline, scales, pieces
        self.blocks = baseline.blocks
        self.skip = self.blocks.window if skip is None else skip
        self.counting = baseline.blocks.counting(records)
        self.batches = baseline.blocks.batches(BATCHES)
        self._known: dict[Fitted, list[Fitted] | None] = {}

    def folds(self, f: Fitted) -> list[Fitted] | None:
        """The form fitted without each block; asked of one model several times."""
        if f not in self._known:
            self._known[f] = without_each(f, self.pieces, self.blocks)
        return self._known[f]

    def unused(self, f: Fitted, carried: bool) -> list[Array] | None:
        """Predictions of all blocks in the user's units, by fits that did not see them."""
        folds = self.folds(f)
        if folds is None:
            return None
        return [y * self.scales.sy + self.scales.y for y in unused(folds, self.pieces, self.blocks, carried)]

    def of(self, predictions: Sequence[Array]) -> Array:
        """Mean squares by batch of all blocks."""
        out = []
        for b in self.batches:
            e = ((self.records[b.record].y - predictions[b.record]) / self.scales.sy)[b.rows]
            use = self.counting[b.record][b.rows]
            out.append(float(np.mean(e[use] ** 2)) if use.any() else 0.0)
        return np.array(out)

    def starts(self, f: Fitted) -> bool:
        """Whether the blocks are better predicted than by the baseline also where each starts from its own window alone."""
        got = self.unused(f, False)
        return got is not None and bool(self.of(got).mean() < self.of(self.baseline.unused).mean())

    def ahead(self, f: Fitted) -> Array:
        """Mean squares by batch of the last parts, infinite where a run explodes."""
        got = ahead(f, self.pieces, self.blocks.window)
        if got is None:
            return np.array([np.inf])
        out = []
        for b, y in got.items():
            p = self.pieces[b.record]
            e = ((p.y[b.rows] - y) ** 2 * p.weight[b.rows])[self.blocks.window :]
            out += [float(x.mean()) for x in np.array_split(e, 2 * BATCHES)]
        return np.array(out)

    def through(self, f: Fitted) -> float:
        """Mean square of runs through whole records from their own starts, as on a new record; infinite where one explodes.

        Blocks are short and start anew from a window: where a model leaves its path only in a long run, or does not find it
        without a window, they do not see it.
        """
        asm, prior, window = Assembly(f.form), start_prior(f, self.pieces), self.skip
        runs = [free_run(asm, f.theta, prior, p, window) for p in self.pieces]
        e = [((p.y - y) * p.weight)[window:] for p, y in zip(self.pieces, runs)]
        total = sum(float((x**2).sum()) for x in e) / max(
            sum(float(p.weight[window:].sum()) for p in self.pieces), 1.0
        )
        return total if np.isfinite(total) else np.inf

    def rmse(self, predictions: Sequence[Array]) -> Array:
        """(ny,) over the samples that count."""
        ny = self.records[0].n_outputs
        total, count = np.zeros(ny), np.zeros(ny)
        for r, y, use in zip(self.records, predictions, self.counting):
            total += np.where(use, (r.y - y) ** 2, 0.0).sum(axis=0)
            count += use.sum(axis=0)
        return np.sqrt(total / np.maximum(count, 1))


def _chosen(
    found: list[Fitted], judge: _Judge
) -> tuple[Fitted | None, list[Fitted], float, tuple[tuple[str, float], ...]]:
    """The simplest model within one standard error of the best where it did not see the data, None if it is linear; and others
    that do nearly as well.
    """
    base = judge.of(judge.baseline.unused)
    tried = []
    for f in found:
        got = judge.unused(f, True)
        if got is not None:
            s = np.concatenate([judge.of(got), judge.ahead(f)])
            if np.all(np.isfinite(s)):
                tried.append((f, s))
    m = len(base)
    considered = tuple((_short(f), float(np.sqrt(s[:m].mean() / base.mean()))) for f, s in tried)
    linear, nonlinear = [[t for t in tried if bool(t[0].form.terms) is k] for k in (False, True)]
    lasting = min((judge.through(f) for f, _ in linear), default=np.inf)
    nonlinear = [t for t in nonlinear if judge.through(t[0]) < lasting]
    surely = lambda s: s[:m].mean() < HALF**2 * base.mean()
    nonlinear = [t for t in nonlinear if judge.starts(t[0])] or [t for t in nonlinear if surely(t[1])]
    if not nonlinear or not linear:
        return None, [], 0.0, considered
    best = min(nonlinear, key=lambda t: t[1].mean())
    near = [t for t in nonlinear if t is best or _errors(t[1], best[1]) < 1.0]
    f, s = min(near, key=lambda t: complexity(t[0]))
    rivals = [(x, s) for _, x in linear] + [(base, s[:m])]
    gain = min(_errors(a, b) for a, b in rivals)
    forward = min(x[m:].mean() for _, x in linear)
    less = s[m:].mean() < forward and all(b.mean() < (1 - LEAST) ** 2 * a.mean() for a, b in rivals)
    alike = [g for g, t in nonlinear if g is not f and t.mean() < ALIKE**2 * s.mean()]
    return (f if gain > ADMITTED and less else None), alike, gain, considered


def _pruned(found: Sequence[Fitted], pieces: Sequence[Piece], rounds: int) -> list[Fitted]:
    """What is left of the models once insignificant terms are out, each form once."""
    out = {}
    for f in found:
        less = pruned(f, pieces, rounds)
        if less.form not in out or less.sse < out[less.form].sse:
            out[less.form] = less
    return sorted(out.values(), key=lambda f: f.free)


def _errors(a: Array, b: Array) -> float:
    """By how many standard errors the batches b are better than a."""
    d = a - b
    return float(d.mean() / max(d.std(ddof=1) / np.sqrt(len(d)), 1e-300))


def _front(found: list[Fitted]) -> list[Fitted]:
    """The best model of every number of terms and every orders."""
    best: dict[tuple, Fitted] = {}
    for f in found:
        best.setdefault((acting(f), f.form.orders), f)
    return sorted(best.values(), key=lambda f: f.free)


def _short(f: Fitted) -> str:
    return (
        " + ".join("*".join(q.signal for q in t.factors) for t in f.form.terms)
        or f"linear, order {f.form.orders}"
    )


def _model(f: Fitted, records, pieces, scales) -> DiscoveredModel:
    names = {
        f"y{i}": (n, x) for i, (n, x) in enumerate(zip(records[0].output_names, records[0].output_units))
    }
    names |= {f"u{j}": (n, x) for j, (n, x) in enumerate(zip(records[0].input_names, records[0].input_units))}
    asm = Assembly(f.form)
    signals = np.vstack([run_piece(asm, f.theta, s, p.d).signals for s, p in zip(f.starts, pieces)])
    ranges = {
        n: tuple(np.quantile(signals[:, i], [0.005, 0.995]).tolist()) for i, n in enumerate(asm.signals)
    }
    return DiscoveredModel(
        f.form, f.theta, scales, covariance(f, pieces), start_prior(f, pieces), names, ranges
    )
